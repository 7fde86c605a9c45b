"""Checkpoints of what takes long: JSON files that are either whole or refused, and are replaced in one step."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import Any

from tdof_npid_ros.input_file import InputError, read_file
from tdof_npid_ros.one_line import one_line

VERSIONS = {"tuning": 3, "sweep": 1}
"""By what a checkpoint is of: the version that this program writes and reads."""

LARGEST = 256 << 20  # bytes: more than the largest population, or the results of a million plants, take


class CheckpointError(ValueError):
    """A checkpoint that cannot be written or read, or is of something else. The message is one line: which, why."""


def write_checkpoint(path: Path, kind: str, content: dict[str, Any]) -> None:
    """Replace the checkpoint; killed at any moment, the file is the old one or the new one.

    Args:
        kind: of `VERSIONS`.

    Raises:
        CheckpointError: it cannot be written; the old one is as it was.
    """
    text = json.dumps(content, allow_nan=False)
    head = f'"format": "{_format(kind)}", "version": {VERSIONS[kind]}, "digest": "{_digest(text)}"'
    document = f'{{{head},\n"content": {text}}}\n'
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
        raise CheckpointError(f"checkpoint {path} cannot be written: {error.strerror}") from error


def read_checkpoint(path: Path, kind: str) -> dict[str, Any]:
    """The content of a checkpoint.

    Args:
        kind: of `VERSIONS`.

    Raises:
        CheckpointError: it cannot be read, is none, is damaged, or a newer program wrote it.
    """
    try:
        document = json.loads(read_file(path, LARGEST).decode("utf-8"))
    except InputError as error:
        raise CheckpointError(f"checkpoint {error}") from error
    except (ValueError, RecursionError):
        raise CheckpointError(
            f"checkpoint {path} is damaged or no checkpoint: give another file, or start anew"
        ) from None
    if not isinstance(document, dict) or document.get("format") != _format(kind):
        raise CheckpointError(f"{path} is no {kind} checkpoint: give another file, or start anew")
    version, known = document.get("version"), VERSIONS[kind]
    if type(version) is not int or version < 1:
        raise CheckpointError(
            f"checkpoint {path} is damaged: its version is {one_line(version, 50)}, no number from 1 on"
        )
    if version > known:
        raise CheckpointError(
            f"checkpoint {path} has version {version}, this program knows {known}: update the program"
        )
    if version < known:
        raise CheckpointError(f"checkpoint {path} has version {version}: an older program worked otherwise, start anew")
    content = document.get("content")
    if not isinstance(content, dict) or document.get("digest") != _digest(json.dumps(content)):
        raise CheckpointError(f"checkpoint {path} is damaged: its digest does not match, start anew with another file")
    return content


def first_difference(there: Any, here: dict[str, Any]) -> str:
    """What differs between the descriptions of two works, the first such thing; empty if nothing does."""
    if not isinstance(there, dict):
        return "it describes none"
    for key in (*here, *there):
        if there.get(key) != here.get(key):
            return f"{key} is {there.get(key)} there and {here.get(key)} here"
    return ""


def _format(kind: str) -> str:
    return f"tdof_npid_ros {kind} checkpoint"


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
