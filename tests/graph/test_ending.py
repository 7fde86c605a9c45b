"""A process whose work is done ends in time and with its status, whatever the middleware does while it leaves."""

import subprocess
import sys
import time

import pytest

HANGS = "import threading; threading.Event().wait()"
ABORTS = "import os; os.abort()"
ABORTS_AT_THE_VERY_END = (
    "import ctypes; library = ctypes.CDLL(None);"
    "library.__cxa_atexit(ctypes.cast(library.abort, ctypes.c_void_p), None, None)"
)
ABORTS_IN_A_THREAD = (
    "import ctypes, threading, time; threading.Thread(target=ctypes.CDLL(None).abort).start(); time.sleep(9)"
)


@pytest.mark.parametrize("leave", [HANGS, ABORTS, ABORTS_AT_THE_VERY_END, ABORTS_IN_A_THREAD])
def test_a_process_ends_in_time_and_with_its_status(leave: str) -> None:
    program = f"from tdof_npid_ros.graph.runtime.ending import end_within; end_within(0.5, 3); {leave}"
    began = time.monotonic()
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, timeout=60)
    assert done.returncode == 3, done.stderr
    assert time.monotonic() - began > 0.5
