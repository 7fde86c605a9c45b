"""The HTML report: one file that needs nothing else, with plots to zoom, hover and toggle."""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tdof_npid_ros.analysis.episodes import Episode
from tdof_npid_ros.analysis.errors import AnalysisError
from tdof_npid_ros.analysis.picture import MOST_LANES, Named, grouped, label

MOST_POINTS = 200_000  # of a curve; longer ones are thinned to the least and the largest value of each stretch
_TEMPLATE = Path(__file__).with_name("report_page.html")


def write(episodes: Sequence[Named], table: Sequence[Sequence[str]], notes: Sequence[str], path: Path) -> None:
    """Write the page.

    Args:
        table: rows of cells, the first the titles.
        notes: lines below the table.

    Raises:
        AnalysisError: the file cannot be written.
    """
    several_bags = len({episode.bag for _, episode in episodes}) > 1
    plots = [
        {"title": group, "curves": [curve for name, e in members for curve in _curves(name, e, several_bags)]}
        for group, members in grouped(episodes).items()
    ]
    text = _TEMPLATE.read_text(encoding="utf-8")
    text = text.replace("<!-- table -->", _table(table) + "".join(f"<p>{html.escape(note)}</p>" for note in notes))
    text = text.replace("/* plots */ []", json.dumps(plots).replace("</", "<\\/"))
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise AnalysisError(f"{path} cannot be written: {error.strerror}") from None


def _curves(name: str, episode: Episode, several_bags: bool) -> list[dict[str, Any]]:
    return [
        {
            "label": label(name, episode, lane, several_bags),
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


def _table(rows: Sequence[Sequence[str]]) -> str:
    used = [i for i in range(len(rows[0])) if any(row[i] not in ("-", "") for row in rows[1:])]
    head = "".join(f"<th>{html.escape(rows[0][i])}</th>" for i in used)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(row[i])}</td>" for i in used) + "</tr>" for row in rows[1:])
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
