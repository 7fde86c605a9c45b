"""What the report is made of: tables, pictures with their data, and findings."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

Cell = str | float | int | None
DEVIATION = "Δ"  # the headings of columns of deviations begin with it
NOTHING = "–"
LEAST_SHOWN = 5e-5  # smaller numbers are shown as 0


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        name: of its files, `table2`.
        columns: headings, all different.
        rows: one cell per column; numbers stay numbers.
        keys: how many leading columns say what a row is about; where they repeat, a page shows them once.
        note: what to know when reading it.
    """

    name: str
    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    keys: int = 1
    note: str = ""

    def csv(self) -> str:
        """As CSV, in full precision."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(self.columns)
        writer.writerows(self.rows)
        return text.getvalue()

    def shown(self) -> list[list[str]]:
        """The cells as a reader sees them: four digits, deviations with their sign, repeated keys left out."""
        lines = []
        previous: tuple[Cell, ...] = ()
        for row in self.rows:
            line = [shown_cell(cell, heading) for cell, heading in zip(row, self.columns, strict=True)]
            for i in range(self.keys):
                if row[: i + 1] == previous[: i + 1]:
                    line[i] = ""
            lines.append(line)
            previous = row
        return lines


def shown_cell(cell: Cell, heading: str) -> str:
    """One cell as text."""
    if cell is None:
        return NOTHING
    if isinstance(cell, float):
        return _shown_deviation(cell) if heading.startswith(DEVIATION) else _shown_number(cell)
    return str(cell)


def _shown_number(value: float) -> str:
    """Four digits, without zeros beyond the third decimal."""
    if abs(value) < LEAST_SHOWN:
        return "0"
    return re.sub(r"(\.\d{3}\d*?)0+$", r"\1", f"{value:#.4g}".rstrip("."))


def _shown_deviation(value: float) -> str:
    """With its sign; one decimal, or two where one would show nothing."""
    return f"{value:+.1f}" if abs(value) >= 0.1 else f"{round(value, 2) + 0.0:+.2f}"


@dataclass(frozen=True)
class Figure:
    """A picture and its data.

    Attributes:
        name: of its files, `figure7`.
        draw: writes the PNG.
        data: columns by heading, numbers or names, of one length.
    """

    name: str
    title: str
    caption: str
    draw: Callable[[Path], None]
    data: dict[str, np.ndarray]

    def csv(self) -> str:
        """The data as CSV."""
        lines = [",".join(self.data)]
        rows = zip(*(column.tolist() for column in self.data.values()), strict=True)
        lines += [",".join(one if isinstance(one, str) else f"{one:.9g}" for one in row) for row in rows]
        return "\n".join(lines) + "\n"


@dataclass(frozen=True)
class Finding:
    """Something that the reproduction found out: what is so, and the table that shows it."""

    title: str
    paragraphs: tuple[str, ...]
    table: Table | None = None
