"""A still picture of episodes: setpoint, output and effort, one column for each kind of episode."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from tdof_npid_ros.analysis.episodes import Episode, bag_names
from tdof_npid_ros.control.law import limits_of
from tdof_npid_ros.plotting import Curve, Panel, draw_responses
from tdof_npid_ros.units import common_units

MOST_COLUMNS = 6
MOST_LANES = 7  # of an episode: as many as there are colours
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
    parts += [episode.joints[lane] or f"lane {lane}"] if episode.lanes > 1 or episode.joints[lane] else []
    return " ".join(part for part in [*parts, bag] if part)


def draw(episodes: Sequence[Named], path: Path, legend: Mapping[str, str]) -> None:
    """Write the picture; `legend` says how curves of some episodes are called, by the episodes' names.

    Raises:
        PlottingError: the file cannot be written.
    """
    kinds = list(grouped(episodes).items())
    bags = bag_names(episode.bag for _, episode in episodes)
    panels = [panel(group, members, bags, legend) for group, members in kinds[:MOST_COLUMNS]]
    more = len(kinds) - len(panels)
    draw_responses(
        panels, path, title=f"{more} more kinds of episodes are not shown here: --html shows all" if more else ""
    )


def panel(group: str, members: Sequence[Named], bags: Mapping[str, str], legend: Mapping[str, str]) -> Panel:
    """What there is to draw of the episodes of one kind.

    Args:
        bags: what a bag is called in a legend, by its path.
        legend: what the curves of some episodes are called, by the episodes' names.
    """
    curves = [
        Curve(
            legend.get(name) or label(name if len(members) > 1 else "", episode, lane, bags[episode.bag]),
            episode.time,
            episode.output[:, lane],
            episode.control_effort[:, lane],
            episode.setpoint[:, lane],
            episode.disturbance[:, lane],
        )
        for name, episode in members
        for lane in range(min(episode.lanes, MOST_LANES))
    ]
    return Panel(group, curves, limits(members), units=common_units(episode.units for _, episode in members))


def limits(members: Sequence[Named]) -> tuple[float, float]:
    """The effort's limits, where all of these episodes have the same; else none."""
    found = {
        (limits_of(gains, lane)[0], limits_of(gains, lane)[1])
        for _, episode in members
        for gains in episode.gains
        for lane in range(gains.lanes)
    }
    return next(iter(found)) if len(found) == 1 else (-np.inf, np.inf)
