"""Standard streams that never cost a result: closed, broken, full, or of another encoding."""

from __future__ import annotations

import contextlib
import os
import sys
from typing import Any

_NAMES = ("stdin", "stdout", "stderr")


class LenientStream:
    """A text stream whose failure is kept, not raised: what cannot be written is dropped, and the program goes on.

    Attributes:
        failure: the first error; None as long as all is well.
    """

    def __init__(self, stream: Any) -> None:
        self._stream = stream
        self.failure: OSError | None = None

    def write(self, text: str) -> int:
        """Write, or drop the text."""
        if self.failure is None:
            try:
                self._stream.write(text)
            except OSError as error:
                self._fail(error)
        return len(text)

    def flush(self) -> None:
        """Flush, if the stream is in order."""
        if self.failure is None:
            try:
                self._stream.flush()
            except OSError as error:
                self._fail(error)

    def _fail(self, error: OSError) -> None:
        self.failure = error
        with contextlib.suppress(OSError, ValueError):  # what it still holds goes nowhere, also at the program's end
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, self._stream.fileno())
            os.close(null)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def prepare_streams() -> None:
    """Make the standard streams fit to be written to, whatever they are; before anything else opens a file.

    A closed stream's number would be given to the next file or socket that is opened, and messages would be written
    into that.
    """
    for number, name in enumerate(_NAMES):
        try:
            os.fstat(number)
        except OSError:
            null = os.open(os.devnull, os.O_RDWR)
            if null != number:
                os.dup2(null, number)
                os.close(null)
            os.set_inheritable(number, True)
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "r" if number == 0 else "w", encoding="utf-8"))  # noqa: SIM115, PTH123
    for name in _NAMES[1:]:
        stream = getattr(sys, name)
        if not isinstance(stream, LenientStream):
            with contextlib.suppress(AttributeError):
                stream.reconfigure(errors="backslashreplace")  # a path need not be text
            setattr(sys, name, LenientStream(stream))
