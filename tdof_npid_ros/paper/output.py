"""The folder that a subcommand fills: empty, or its own of an earlier run, never somebody else's."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tdof_npid_ros.output_file import OutputError, hold
from tdof_npid_ros.workers import ChunkCheckpoint

MARKER = ".tdof-npid"
UNFINISHED = ".unfinished.json"


def claim_folder(folder: Path, subcommand: str) -> Path:
    """Make the folder and mark it as the output of a subcommand, so that a later run may write it again.

    Raises:
        OutputError: there is something in the folder that this subcommand did not write, it cannot be written, or
            another run writes it now.
    """
    marker = folder / MARKER
    try:
        if folder.exists() and not folder.is_dir():
            raise OutputError(f"{folder} is a file: give a folder for the output")
        if folder.is_dir() and any(folder.iterdir()) and _written_by(marker) != subcommand:
            raise OutputError(f"{folder} holds files that '{subcommand}' did not write: give a new or an empty folder")
        folder.mkdir(parents=True, exist_ok=True)
        hold(folder)
        marker.write_text(f"{subcommand}\n", encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{folder} cannot be written: {error.strerror}") from error
    return folder


@contextmanager
def kept_until_written(folder: Path, work: dict[str, Any]) -> Iterator[ChunkCheckpoint]:
    """Keep what is computed in the folder until all that is made of it is written: a run that was killed goes on there.

    Args:
        folder: claimed.
        work: all that the results depend on, as JSON holds it; those of other work are thrown away.
    """
    checkpoint = ChunkCheckpoint(folder / UNFINISHED, work, resume=True, replace=True)
    yield checkpoint
    checkpoint.path.unlink(missing_ok=True)


def _written_by(marker: Path) -> str:
    return marker.read_text(encoding="utf-8").strip() if marker.is_file() else ""
