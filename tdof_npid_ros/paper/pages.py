"""The report as pages: one self-contained HTML file, and the same in Markdown."""

from __future__ import annotations

import base64
import html
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tdof_npid_ros.paper.report import DEVIATION, Figure, Finding, Table

Block = Table | Figure | Finding | str
DEVIATION_CLASSES = ((4.0, "near"), (10.0, "off"), (float("inf"), "far"))  # up to so many per cent or points
NUMBER_STARTS = tuple("+-0123456789")  # of cells such as "97 %"
ANSWER_CLASSES = {"yes": "near", "with σ tuned": "off", "NO": "far"}

CSS = """
body { font: 15px/1.55 system-ui, sans-serif; color: #222; max-width: 72rem; margin: 2rem auto; padding: 0 1.2rem; }
h1 { font-size: 1.7rem; } h2 { margin-top: 2.6rem; border-bottom: 2px solid #2f5d8a; padding-bottom: .2rem; }
h3 { margin-top: 1.8rem; } nav a { margin-right: 1rem; } a { color: #2f5d8a; }
img { max-width: 100%; } figure { margin: 1rem 0; } figcaption, .note { color: #666; font-size: .9rem; }
sub { font-size: .75em; line-height: 0; } li { margin: .25rem 0; }
.scroll { overflow-x: auto; } table { border-collapse: collapse; font-size: .86rem; margin: .6rem 0; }
th { text-align: left; background: #eef2f6; vertical-align: bottom; } th, td { padding: .2rem .6rem; }
td { border-top: 1px solid #eee; font-variant-numeric: tabular-nums; } tr.first td { border-top: 1px solid #9ab; }
td { white-space: nowrap; } td.number { text-align: right; } .near { color: #1e7a4f; } .off { color: #b36b00; }
.far { color: #b3261e; font-weight: 600; }
"""


@dataclass(frozen=True)
class Section:
    """A heading and what stands under it."""

    title: str
    blocks: tuple[Block, ...]


def html_page(title: str, sections: Sequence[Section], folder: Path) -> str:
    """The whole report in one file; the pictures, read from `folder`, are inside."""
    links = "".join(f'<a href="#{_anchor(section.title)}">{html.escape(section.title)}</a>' for section in sections)
    body = "\n".join(
        f'<h2 id="{_anchor(section.title)}">{html.escape(section.title)}</h2>\n'
        + "\n".join(_html_block(block, folder) for block in section.blocks)
        for section in sections
    )
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title>'
        f"<style>{CSS}</style></head>\n<body><h1>{html.escape(title)}</h1>\n<nav>{links}</nav>\n{body}\n</body></html>\n"
    )


def markdown_page(title: str, sections: Sequence[Section]) -> str:
    """The same report; the pictures are linked."""
    parts = [f"# {title}"]
    for section in sections:
        parts += [f"## {section.title}", *(_markdown_block(block) for block in section.blocks)]
    return "\n\n".join(parts) + "\n"


def markdown_table(table: Table) -> str:
    """One table with its title and note."""
    lines = [f"### {table.title}", "", _line(table.columns), _line(["---"] * len(table.columns))]
    lines += [_line(cells) for cells in table.shown()]
    return "\n".join([*lines, "", table.note] if table.note else lines)


def _markdown_block(block: Block) -> str:
    if isinstance(block, Table):
        return f"{markdown_table(block)}\n\n[{block.name}.csv]({block.name}.csv)"
    if isinstance(block, Figure):
        return f"### {block.title}\n\n![{block.title}]({block.name}.png)\n\n{block.caption} [Data]({block.name}.csv)"
    if isinstance(block, Finding):
        table = [_markdown_block(block.table)] if block.table else []
        return "\n\n".join([f"### {block.title}", *block.paragraphs, *table])
    return block


def _html_block(block: Block, folder: Path) -> str:
    if isinstance(block, Table):
        return f"<h3>{_inline(block.title)}</h3>\n{_html_table(block)}"
    if isinstance(block, Figure):
        picture = base64.b64encode((folder / f"{block.name}.png").read_bytes()).decode("ascii")
        title = html.escape(block.title)
        return (
            f'<h3>{title}</h3>\n<figure><img alt="{title}" src="data:image/png;base64,{picture}">'
            f"<figcaption>{_inline(block.caption)}</figcaption></figure>"
        )
    if isinstance(block, Finding):
        paragraphs = "\n".join(_paragraph(text) for text in block.paragraphs)
        return f"<h3>{_inline(block.title)}</h3>\n{paragraphs}\n{_html_table(block.table) if block.table else ''}"
    return _paragraph(block)


def _html_table(table: Table) -> str:
    head = "".join(f"<th>{_inline(heading)}</th>" for heading in table.columns)
    rows = []
    for cells, values in zip(table.shown(), table.rows, strict=True):
        marked = [
            f'<td class="{_classes(value, heading)}">{_inline(cell)}</td>'
            for cell, value, heading in zip(cells, values, table.columns, strict=True)
        ]
        first = ' class="first"' if cells[max(table.keys - 1, 0)] else ""
        rows.append(f"<tr{first}>{''.join(marked)}</tr>")
    note = f'<p class="note">{_inline(table.note)}</p>' if table.note else ""
    return f'<div class="scroll"><table><tr>{head}</tr>\n{chr(10).join(rows)}</table></div>{note}'


def _classes(value: object, heading: str) -> str:
    if isinstance(value, str):
        return ANSWER_CLASSES.get(value, "number" if value.startswith(NUMBER_STARTS) else "")
    if isinstance(value, float) and heading.startswith(DEVIATION):
        return "number " + next(name for limit, name in DEVIATION_CLASSES if abs(value) <= limit)
    return "number"


def _paragraph(text: str) -> str:
    lines = text.splitlines()
    if all(line.startswith("- ") for line in lines):
        return "<ul>" + "".join(f"<li>{_inline(line[2:])}</li>" for line in lines) + "</ul>"
    return f"<p>{_inline(text)}</p>"


def _inline(text: str) -> str:
    """Text as HTML: symbols with their subscripts (K_p, IAE_SP), and **what is bold**."""
    text = re.sub(r"\b([A-Za-zM]+)_([A-Za-z]+)\b", r"\1<sub>\2</sub>", html.escape(text))
    return re.sub(r"\*\*(.+?)\*\*", r"<strong>\1</strong>", text)


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _anchor(title: str) -> str:
    return "".join(letter if letter.isalnum() else "-" for letter in title.lower())
