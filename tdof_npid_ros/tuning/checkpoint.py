"""Checkpoints: JSON files that are either whole or refused, and are replaced in one step."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import Any

from tdof_npid_ros.input_file import InputError, read_file
from tdof_npid_ros.one_line import one_line
from tdof_npid_ros.tuning import TuningError

FORMAT = "tdof_npid_ros tuning checkpoint"
VERSION = 2
LARGEST = 256 << 20  # bytes: more than the largest population takes


def write_checkpoint(path: Path, content: dict[str, Any]) -> None:
    """Replace the checkpoint; killed at any moment, the file is the old one or the new one.

    Raises:
        TuningError: it cannot be written; the old one is as it was.
    """
    text = json.dumps(content, allow_nan=False)
    document = f'{{"format": "{FORMAT}", "version": {VERSION}, "digest": "{_digest(text)}",\n"content": {text}}}\n'
    unfinished = path.with_name(f".{path.name}.unfinished")
    try:
        unfinished.unlink(missing_ok=True)  # of a run that was killed
        with unfinished.open("x", encoding="utf-8") as file:
            file.write(document)
            file.flush()
            os.fsync(file.fileno())
        unfinished.replace(path)
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    except OSError as error:
        unfinished.unlink(missing_ok=True)
        raise TuningError(f"checkpoint {path} cannot be written: {error.strerror}") from error


def read_checkpoint(path: Path) -> dict[str, Any]:
    """The content of a checkpoint.

    Raises:
        TuningError: it cannot be read, is none, is damaged, or a newer program wrote it.
    """
    try:
        document = json.loads(read_file(path, LARGEST).decode("utf-8"))
    except InputError as error:
        raise TuningError(f"checkpoint {error}") from error
    except (ValueError, RecursionError):
        raise TuningError(f"checkpoint {path} is damaged or no checkpoint: give another file, or start anew") from None
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise TuningError(f"{path} is no tuning checkpoint: give another file, or start anew")
    version = document.get("version")
    if type(version) is not int or version < 1:
        raise TuningError(f"checkpoint {path} is damaged: its version is {one_line(version, 50)}, no number from 1 on")
    if version > VERSION:
        raise TuningError(f"checkpoint {path} has version {version}, this program knows {VERSION}: update the program")
    if version < VERSION:
        raise TuningError(f"checkpoint {path} has version {version}: an older program searched otherwise, start anew")
    content = document.get("content")
    if not isinstance(content, dict) or document.get("digest") != _digest(json.dumps(content)):
        raise TuningError(f"checkpoint {path} is damaged: its digest does not match, start anew with another file")
    return content


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
