"""The HTML report: one file that needs nothing else, with plots to zoom, hover and hide."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tdof_npid_ros.analysis.episodes import bag_names
from tdof_npid_ros.analysis.picture import MOST_LANES, Named, grouped, panel
from tdof_npid_ros.interactive import Page, response_plots


def write(episodes: Sequence[Named], table: Sequence[Sequence[str]], notes: Sequence[str], path: Path) -> None:
    """Write the page.

    Args:
        table: of metrics: rows of cells, the first the titles.
        notes: lines below it.

    Raises:
        PlottingError: the file cannot be written.
    """
    bags = bag_names(episode.bag for _, episode in episodes)
    page = Page("Closed-loop episodes")
    page.table(table)
    for note in notes:
        page.text(note)
    page.text(
        "Drag to move, Ctrl and wheel or pinch to zoom, the arrow back for the whole; a click on a name hides it."
    )
    for group, members in grouped(episodes).items():
        page.heading(group)
        page.plot(*response_plots(panel(group, members, bags, {})))
    page.heading("Controllers")
    controllers = _controllers(episodes, bags)
    if len(controllers) > 1:
        page.table(controllers)
    else:
        page.text("No parameters of a controller are in the bag.")
    page.write(path)


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
