"""Text from outside, fit to be a part of one line on a terminal or in a log, or of a file."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

LONGEST: Final = 500  # characters: more than any message of ours needs


def one_line(text: object, longest: int = LONGEST) -> str:
    """The text on one line: white space as single blanks, what cannot be printed as an escape, a long text cut in its
    middle.

    So neither a name with a line break or a terminal's control sequence in it, nor a message that quotes a whole
    file, spoils what stands around it.
    """
    whole = str(text)
    if len(whole) > 4 * longest:  # before it is worked on: it may have any length
        whole = f"{whole[: 2 * longest]}{whole[-2 * longest :]}"
    line = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in " ".join(whole.split()))
    if len(line) <= longest:
        return line
    tail = longest // 4
    return f"{line[: longest - tail - 3]} … {line[-tail:]}"


def as_text(path: str | Path) -> str:
    """A path as text that any file or picture may hold: bytes in it that are not UTF-8 as escapes.

    >>> as_text(os.fsdecode(b"gr\\xfc\\xdfe")), as_text("größe")
    ('gr\\\\xfc\\\\xdfe', 'größe')
    """
    return os.fsencode(path).decode("utf-8", "backslashreplace")
