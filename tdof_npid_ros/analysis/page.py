"""The HTML report: one file that needs nothing else, with plots to zoom, hover and toggle."""

from __future__ import annotations

import base64
import html
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tdof_npid_ros.analysis.episodes import Episode, bag_names
from tdof_npid_ros.analysis.errors import AnalysisError
from tdof_npid_ros.analysis.picture import MOST_LANES, Named, grouped, label

MOST_POINTS = 200_000  # of a curve; longer ones are thinned to the least and the largest value of each stretch
_NUMBER = re.compile(r"[-+]?(inf|nan|[\d.]*(e[-+]?\d+)?)")
_TEMPLATE = Path(__file__).with_name("report_page.html")


def write(episodes: Sequence[Named], table: Sequence[Sequence[str]], notes: Sequence[str], path: Path) -> None:
    """Write the page.

    Args:
        table: of metrics: rows of cells, the first the titles.
        notes: lines below it.

    Raises:
        AnalysisError: the file cannot be written.
    """
    bags = bag_names(episode.bag for _, episode in episodes)
    plots = [
        {"title": group, "curves": [curve for name, e in members for curve in _curves(name, e, bags[e.bag])]}
        for group, members in grouped(episodes).items()
    ]
    text = _TEMPLATE.read_text(encoding="utf-8")
    text = text.replace("<!-- table -->", _table(table))
    text = text.replace("<!-- notes -->", "".join(f"<p>{html.escape(note)}</p>" for note in notes))
    text = text.replace("<!-- controllers -->", _table(_controllers(episodes, bags)))
    text = text.replace("/* plots */ []", json.dumps(plots).replace("</", "<\\/"))
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise AnalysisError(f"{path} cannot be written: {error.strerror}") from None


def _curves(name: str, episode: Episode, bag: str) -> list[dict[str, Any]]:
    return [
        {
            "label": label(name, episode, lane, bag),
            "setpoint": _points(episode.time, episode.setpoint[:, lane]),
            "output": _points(episode.time, episode.output[:, lane]),
            "effort": _points(episode.time, episode.control_effort[:, lane]),
            "disturbance": _points(episode.time, episode.disturbance),
        }
        for lane in range(min(episode.lanes, MOST_LANES))
    ]


def _points(time: np.ndarray, values: np.ndarray) -> dict[str, Any]:
    """A curve as base64 of little-endian float64: times, then values. One that only steps keeps its corners."""
    keep = np.flatnonzero(~np.isnan(values))
    if keep.size > 2:
        steps = np.flatnonzero(np.diff(values[keep])) + 1
        if steps.size < keep.size // 10:
            keep = keep[np.unique(np.concatenate([[0], steps - 1, steps, [keep.size - 1]]))]
    if keep.size > MOST_POINTS:
        stretches = np.array_split(keep, MOST_POINTS // 2)
        ends = [(part[np.argmin(values[part])], part[np.argmax(values[part])]) for part in stretches]
        keep = np.unique(np.array(ends))
    data = np.stack([time[keep], values[keep]]).astype("<f8")
    return {"n": int(keep.size), "data": base64.b64encode(data.tobytes()).decode()}


def _controllers(episodes: Sequence[Named], bags: Mapping[str, str]) -> list[list[str]]:
    """A table of the parameters that each episode's efforts were computed with, titles first."""
    rows = [
        {
            "bag": bags[episode.bag],
            "episode": name,
            "h (s)": f"{episode.sample_period_ns / 1e9:g}",
            **{key: _value(value) for key, value in gains.as_dict().items()},
        }
        for name, episode in episodes
        for gains in episode.gains
    ]
    titles = [title for title in (rows[0] if rows else ()) if any(row[title] for row in rows)]
    return [titles, *([row[title] for title in titles] for row in rows)]


def _value(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, (list, tuple)):
        return ", ".join(map(_value, value[:MOST_LANES])) + ", …" * (len(value) > MOST_LANES)
    return str(value)


def _table(rows: Sequence[Sequence[str]]) -> str:
    """An HTML table, titles first; columns of numbers are aligned to the right."""
    numeric = [all(_NUMBER.fullmatch(cell) for cell in column) for column in zip(*rows[1:], strict=True)]

    def line(cells: Sequence[str], tag: str) -> str:
        classes = [' class="number"' if is_number else "" for is_number in numeric]
        pairs = zip(cells, classes, strict=True)
        return "<tr>" + "".join(f"<{tag}{class_}>{html.escape(cell)}</{tag}>" for cell, class_ in pairs) + "</tr>"

    if not numeric:
        return "<p>none in the bag</p>"
    body = "".join(line(row, "td") for row in rows[1:])
    return f"<table><thead>{line(rows[0], 'th')}</thead><tbody>{body}</tbody></table>"
