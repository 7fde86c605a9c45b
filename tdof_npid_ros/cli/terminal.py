"""Text for a terminal: as wide as it is, broken between cells."""

from __future__ import annotations

import os
import re
import shutil
import sys
import textwrap
from collections.abc import Iterable

LEAST_TEXT = 24  # columns that a text beside its title must have; with less it goes below
_CELL = re.compile(r"\S+(?: \S+)*")  # cells are two spaces apart, or more


def width() -> int | None:
    """Columns of the terminal, or of $COLUMNS; None where there is neither: what reads along finds whole lines."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() or "COLUMNS" in os.environ else None


def say(lines: Iterable[str]) -> None:
    """Print lines, too long ones broken for this terminal."""
    columns = width()
    for line in lines:
        print("\n".join(broken(line, columns) if columns else [line]), flush=True)


def broken(line: str, columns: int) -> list[str]:
    """A line in parts of at most so many columns: between its cells, and within a text that is a cell by itself.

    Example:
        >>> broken("p1  kp 9.4  ki 9.4", 10)
        ['p1  kp 9.4', '  ki 9.4']
        >>> broken("hint     a text that is longer than the terminal", 34)
        ['hint     a text that is longer', '         than the terminal']
    """
    if len(line) <= columns:
        return [line]
    indent = " " * (len(line) - len(line.lstrip()) + 2)
    cells = list(_CELL.finditer(line))
    if len(cells) < 3:  # a text, perhaps with a title before it
        at = cells[-1].start() if cells and columns - cells[-1].start() >= LEAST_TEXT else len(indent)
        return textwrap.wrap(line, columns, subsequent_indent=" " * at, break_long_words=False, break_on_hyphens=False)
    parts: list[str] = []
    start = 0
    for cell in cells:
        begun = indent if parts else ""
        if cell.end() - start + len(begun) > columns and cell.start() > start:
            parts.append(begun + line[start : cell.start()].rstrip())
            start = cell.start()
    return [*parts, (indent if parts else "") + line[start:]]
