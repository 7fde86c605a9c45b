"""A still picture of episodes: setpoint, output and effort, one column for each kind of episode."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from tdof_npid_ros.analysis.episodes import Episode, bag_names
from tdof_npid_ros.analysis.errors import AnalysisError

MOST_COLUMNS = 6
MOST_LANES = 4  # of an episode
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f7f7f", "#000000")
_DASHES = ("-", "--", "-.", ":")  # so that curves that coincide are seen
Named = tuple[str, Episode]


def grouped(episodes: Sequence[Named]) -> dict[str, list[Named]]:
    """Episodes by what they are called, so that the same episode of several controllers or bags is one picture."""
    groups: dict[str, list[Named]] = {}
    for name, episode in episodes:
        groups.setdefault(episode.name, []).append((name, episode))
    return groups


def label(name: str, episode: Episode, lane: int, bag: str) -> str:
    """How a curve is called in a legend; `bag` is empty where there is only one."""
    parts = [episode.controller.replace("_", "-").upper(), name.rpartition(" ")[2]]
    parts += [f"lane {lane}"] if episode.lanes > 1 else []
    return " ".join(part for part in [*parts, bag] if part)


def draw(episodes: Sequence[Named], path: Path, legend: Mapping[str, str]) -> None:
    """Write the picture; `legend` says how curves of some episodes are called, by the episodes' names.

    Raises:
        AnalysisError: the file cannot be written.
    """
    kinds = list(grouped(episodes).items())
    groups = kinds[:MOST_COLUMNS]
    bags = bag_names(episode.bag for _, episode in episodes)
    figure = Figure(figsize=(1.5 + 5.5 * len(groups), 6.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, len(groups), sharex="col", squeeze=False)
    for column, (group, members) in enumerate(groups):
        above, below = axes[0][column], axes[1][column]
        drawn: set[bytes] = set()  # what drives, which is often the same in all episodes
        colour = 0
        for name, episode in members:
            _draw_driving(below, episode.time, episode.disturbance, "disturbance", drawn)
            for lane in range(min(episode.lanes, MOST_LANES)):
                _draw_driving(above, episode.time, episode.setpoint[:, lane], "setpoint", drawn)
                style = {"color": _COLOURS[colour % len(_COLOURS)], "ls": _DASHES[colour % len(_DASHES)], "lw": 1.3}
                text = legend.get(name) or label(name, episode, lane, bags[episode.bag])
                above.plot(episode.time, episode.output[:, lane], label=text, **style)
                below.plot(episode.time, episode.control_effort[:, lane], drawstyle="steps-post", **style)
                colour += 1
        above.set_title(group)
        above.legend(fontsize=8)
        if below.get_legend_handles_labels()[0]:
            below.legend(fontsize=8)
        below.set_xlabel("time (s)")
        for axis in (above, below):
            axis.grid(alpha=0.3)
    axes[0][0].set_ylabel("setpoint r, output y")
    axes[1][0].set_ylabel("control effort u, disturbance d")
    if len(kinds) > len(groups):
        figure.supxlabel(f"… and {len(kinds) - len(groups)} more kinds of episodes: --html shows all", fontsize=9)
    try:
        figure.savefig(path, dpi=120, format=path.suffix[1:] or "png")
    except (OSError, ValueError) as error:
        raise AnalysisError(f"{path} cannot be written: {error}") from None


def _draw_driving(axis: Axes, time: np.ndarray, values: np.ndarray, name: str, drawn: set[bytes]) -> None:
    """Draw a setpoint or disturbance, dashed, unless it is there already, or a disturbance that is none."""
    content = values.tobytes()
    if content in drawn or np.isnan(values).all() or (name == "disturbance" and not values.any()):
        return
    drawn.add(content)
    axis.plot(time, values, "--", color="0.4", lw=1, label=name, drawstyle="steps-post")
