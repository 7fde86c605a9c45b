"""Ctrl-C where a program holds what others use: never lost, and never in the midst of what must be done whole."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

_taken: list[int] = []  # by `heeded`
_waiting: list[int] = []  # for the end of `afterwards`


@contextmanager
def heeded() -> Iterator[None]:
    """Let Ctrl-C raise KeyboardInterrupt meanwhile, also where whoever started us has SIGINT ignored, as a shell does
    for what a script starts in the background."""

    def take(number: int, _: FrameType | None) -> None:
        _taken.append(number)
        raise KeyboardInterrupt

    with _handled_by(take):
        try:
            yield
        finally:
            _taken.clear()


@contextmanager
def afterwards() -> Iterator[None]:
    """Let Ctrl-C wait until this is done, however it ends; `check` does not wait for that."""
    came = False
    try:
        with _handled_by(lambda number, _: _waiting.append(number)):
            try:
                yield
            finally:
                came = bool(_waiting)
                _waiting.clear()
    finally:
        if came:
            signal.raise_signal(signal.SIGINT)


def check() -> None:
    """Raise KeyboardInterrupt if one waits, or if one was taken and somebody has swallowed it, as Python does in a
    destructor."""
    if _waiting or _taken:
        raise KeyboardInterrupt


@contextmanager
def _handled_by(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """Signals come to the main thread alone: elsewhere this does nothing."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
