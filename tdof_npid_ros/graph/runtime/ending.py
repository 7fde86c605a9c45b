"""A node's process ends in time and with its status, even if the middleware hangs or aborts while it leaves."""

from __future__ import annotations

import ctypes
import signal
import sys
import time

SIGEV_THREAD = 2  # the timer calls a function, on a thread of its own


class _SigEvent(ctypes.Structure):
    """`struct sigevent` of glibc."""

    _fields_ = [
        ("value", ctypes.c_ssize_t),
        ("signal", ctypes.c_int),
        ("notify", ctypes.c_int),
        ("function", ctypes.c_void_p),
        ("attributes", ctypes.c_void_p),
        ("reserved", ctypes.c_char * 32),
    ]


def end_within(seconds: float, status: int) -> None:
    """Let this process end after so many seconds with this status, wherever it is then; nothing if it has ended before.

    For the time when all is in order but that the middleware is still to leave its domain. There Fast DDS may wait for
    itself for ever (its issues 6193 and 6502), on a thread that holds Python's interpreter lock, or when Python is gone
    already; so it is the C library's timer that calls `_exit`. And C++ may abort the process (a thread that still runs
    when its object is destroyed): then the thread that aborts, after it has said why, waits for the timer. Without
    effect where there is no such timer.
    """
    if sys.platform != "linux":
        return
    library = ctypes.CDLL(None)
    function = ctypes.cast(library._exit, ctypes.c_void_p)
    event = _SigEvent(value=status, notify=SIGEV_THREAD, function=function)
    timer = ctypes.c_void_p()
    whole, part = divmod(round(seconds * 1e9), 1_000_000_000)
    once = (ctypes.c_long * 4)(0, 0, whole, part)  # struct itimerspec
    if library.timer_create(time.CLOCK_MONOTONIC, ctypes.byref(event), ctypes.byref(timer)) == 0:
        library.timer_settime(timer, 0, once, None)
        library.signal.argtypes = [ctypes.c_int, ctypes.c_void_p]
        library.signal(signal.SIGABRT, ctypes.cast(library.pause, ctypes.c_void_p))
