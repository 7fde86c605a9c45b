"""Outputs of a tuning run: refused at its start if they could not be written at its end."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from tdof_npid_ros.tuning import TuningError

ROOM = 65536  # bytes: more than a result or a checkpoint of any population takes


def check_writable(path: Path) -> None:
    """Make sure that a file can be written, and that the disk has room for it; it stays as it is.

    Raises:
        TuningError: it cannot.
    """
    try:
        if path.exists():
            with path.open("r+b"):
                pass
        with tempfile.TemporaryFile(dir=path.parent) as probe:
            probe.write(b"\0" * ROOM)
            probe.flush()
            os.fsync(probe.fileno())
    except OSError as error:
        raise TuningError(f"{path} cannot be written: {error.strerror}") from error
