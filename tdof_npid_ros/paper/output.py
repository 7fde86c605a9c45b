"""The folder that a subcommand fills: empty, or its own of an earlier run, never somebody else's."""

from __future__ import annotations

from pathlib import Path

from tdof_npid_ros.output_file import OutputError, hold

MARKER = ".tdof-npid"


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


def _written_by(marker: Path) -> str:
    return marker.read_text(encoding="utf-8").strip() if marker.is_file() else ""
