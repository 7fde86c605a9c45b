"""What `analyze` tells of bags: metrics of every episode as a table, CSV, JSON, a picture and an HTML page."""

from __future__ import annotations

import csv
import io
import math
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from tdof_npid_ros.analysis import page, picture
from tdof_npid_ros.analysis.effort import Deviation, deviation, episode_effort
from tdof_npid_ros.analysis.episodes import Episode, bag_names, episodes_in
from tdof_npid_ros.analysis.loop_margins import episode_margins
from tdof_npid_ros.analysis.sources import NOTHING_CHOSEN, Chosen
from tdof_npid_ros.bag.reader import BagReader
from tdof_npid_ros.metrics import DisturbanceMetrics, EffortUse, SetpointMetrics, in_units
from tdof_npid_ros.one_line import as_text
from tdof_npid_ros.parameters import NOISE, PLANT
from tdof_npid_ros.plants.catalog import model_parameters
from tdof_npid_ros.responses import NO_SETPOINT, Response, responses
from tdof_npid_ros.stability.margins import Margins
from tdof_npid_ros.units import common_units

LANES_SHOWN = 7  # of an episode, in tables for people, as many as there are colours; JSON and CSV hold all
# Column of the table and of the CSV: title, and how a person reads a value.
COLUMNS: Final[dict[str, tuple[str, Callable[[Any], str]]]] = {
    "bag": ("bag", "{}".format),
    "episode": ("episode", "{}".format),
    "controller": ("controller", "{}".format),
    "lane": ("lane", "{}".format),
    "joint": ("joint", "{}".format),
    "response": ("response to", "{}".format),
    "start_s": ("at (s)", "{:g}".format),
    "overshoot_percent": ("M_p (%)", "{:.4f}".format),
    "settling_time_s": ("t_s (s)", in_units),
    "peak": ("M_peak", in_units),
    "recovery_time_s": ("t_rcy (s)", in_units),
    "iae": ("IAE", in_units),
    "iae_change_percent": ("ΔIAE (%)", "{:+.1f}".format),
    "effort_variation": ("Σ|Δu|", "{:.4g}".format),
    "effort_peak": ("max|u|", "{:.4g}".format),
    "saturated_percent": ("at limit (%)", "{:.1f}".format),
    "deviation": ("off simulation", "{:.3g}".format),
    "m_s": ("M_s", "{:.2f}".format),
}
UNITS_OF: Final = {"peak": "{output}", "iae": "{output} s", "effort_variation": "{effort}", "effort_peak": "{effort}"}
WHICH_ROW = ("bag", "episode", "lane", "joint", "start_s")  # what tells one row from another


@dataclass(frozen=True)
class EpisodeReport:
    """One episode and what it shows.

    Attributes:
        responses: by lane, in order of time.
        effort: by lane.
        deviation: from the in-process simulation.
        margins: of the loop, by lane; None where plant or gains are not known.
    """

    episode: Episode
    responses: tuple[tuple[Response, ...], ...]
    effort: tuple[EffortUse, ...]
    deviation: Deviation
    margins: tuple[Margins | None, ...]

    def metrics(self, lane: int = 0) -> SetpointMetrics | DisturbanceMetrics | None:
        """The paper's metrics of the lane's first response."""
        return self.responses[lane][0].metrics


@dataclass(frozen=True)
class Report:
    """What `analyze` found.

    Attributes:
        episodes: of all bags, in the order of the bags and of time.
        missing: what bags that were cut off lack, and what cannot be decoded, a line for each thing.
    """

    episodes: tuple[EpisodeReport, ...]
    missing: tuple[str, ...] = ()

    def rows(self) -> list[dict[str, Any]]:
        """One row per response, by the names of `COLUMNS`; None where there is no such number."""
        names = bag_names(report.episode.bag for report in self.episodes)
        rows: list[dict[str, Any]] = []
        first: dict[tuple[Any, ...], float] = {}
        for report in self.episodes:
            mine = _rows(report, names[report.episode.bag])
            rows += mine
            for row, same in zip(mine, _alike(report), strict=True):
                if row["iae"] is None or same is None:
                    continue
                if same in first and first[same] > 0:
                    row["iae_change_percent"] = 100.0 * (row["iae"] / first[same] - 1.0)
                first.setdefault(same, row["iae"])
        return rows

    def table(self, width: int | None = None) -> str:
        """The rows as a table for a terminal; columns without a value are left out.

        Args:
            width: of the terminal: a wider table goes on below, with what says which row it is; None: it may be wide.
        """
        cells, left_out = self._cells()
        lines = [line for part in _parts(cells, width) for line in _lines(part)]
        if left_out:
            lines.append(f"… {left_out} rows of further lanes: --csv or --json has them")
        return "\n".join([*lines, *self.notes()])

    def _cells(self) -> tuple[list[list[str]], int]:
        """The table for people, titles first, without columns that say nothing; and how many rows it leaves out."""
        rows = self.rows()
        shown = [row for row in rows if row["lane"] < LANES_SHOWN]
        names = [name for name in COLUMNS if any(row[name] not in (None, "") for row in shown)]
        if all(row["lane"] == 0 or row["joint"] for row in rows):
            names.remove("lane")
        units = common_units(report.episode.units for report in self.episodes)
        titles = [units.titled(COLUMNS[name][0], UNITS_OF.get(name, "")) for name in names]
        return [titles, *([_shown(row, name) for name in names] for row in shown)], len(rows) - len(shown)

    def notes(self) -> list[str]:
        """Why numbers are missing, and what was guessed: a line for each cause, with its bag if there are several."""
        causes: dict[str, list[str]] = {}
        bags = bag_names(report.episode.bag for report in self.episodes)
        for report in self.episodes:
            episode = report.episode
            for cause, lane in _causes(report):
                joint = episode.joints[lane] if lane is not None else None
                parts = (bags[episode.bag], title(episode), f"({joint})" if joint else "")
                causes.setdefault(cause, []).append(" ".join(part for part in parts if part))
        found = [f"{', '.join(dict.fromkeys(names))}: {cause}" for cause, names in causes.items()]
        return [*found, *(f"missing: {line}" for line in self.missing)]

    def as_json(self) -> dict[str, Any]:
        """The whole report as a JSON object; limits that are infinite become null."""
        changes = iter([row["iae_change_percent"] for row in self.rows()])
        episodes = [_as_json(report, changes) for report in self.episodes]
        document: dict[str, Any] = _finite({"episodes": episodes, "missing": list(self.missing)})
        return document

    def as_csv(self) -> str:
        """The rows as CSV, numbers in full."""
        text = io.StringIO()
        writer = csv.DictWriter(text, fieldnames=list(COLUMNS), lineterminator="\n")
        writer.writeheader()
        writer.writerows(self.rows())
        return text.getvalue()

    def picture(self, path: str | Path, legend: Mapping[str, str] | None = None) -> None:
        """Write setpoint, output and effort of every episode to a PNG (or what the suffix says).

        Args:
            legend: what curves are called, by the titles of their episodes; the others by controller and number.

        Raises:
            AnalysisError: the file cannot be written.
        """
        picture.draw([(title(report.episode), report.episode) for report in self.episodes], Path(path), legend or {})

    def html(self, path: str | Path) -> None:
        """Write one self-contained page with interactive plots.

        Raises:
            AnalysisError: the file cannot be written.
        """
        named = [(title(report.episode), report.episode) for report in self.episodes]
        page.write(named, self._cells()[0], self.notes(), Path(path))


def analyze(paths: Iterable[str | Path], chosen: Chosen = NOTHING_CHOSEN) -> Report:
    """Every episode of some bags, measured.

    Args:
        chosen: topics and fields of the loop; what is not told is guessed, and the guess noted.

    Raises:
        AnalysisError: there is no output in a bag.
        BagError: no bag, or it is damaged.
    """
    episodes: list[EpisodeReport] = []
    missing: list[str] = []
    for path in paths:
        with BagReader(path) as reader:
            episodes += map(_report, episodes_in(reader, as_text(path), chosen))
            missing += map(as_text, (*reader.missing, *reader.left_out))
    return Report(tuple(episodes), tuple(missing))


def title(episode: Episode) -> str:
    """What a person calls an episode: namespace, plan and number."""
    return f"{episode.namespace.strip('/')} {episode.name} #{episode.number}".strip()


def _report(episode: Episode) -> EpisodeReport:
    lanes = range(episode.lanes)
    return EpisodeReport(
        episode,
        tuple(tuple(responses(episode.lane(lane))) for lane in lanes),
        tuple(episode_effort(episode, lane) for lane in lanes),
        deviation(episode),
        episode_margins(episode),
    )


def _causes(report: EpisodeReport) -> Iterator[tuple[str, int | None]]:
    """Yield what there is to say of an episode, and the lane that it is about."""
    episode = report.episode
    for note in episode.notes:
        yield note, None
    for lane, found in enumerate(report.responses[:LANES_SHOWN]):
        for response in found:
            if response.reason and (response.kind != "tracking" or response.iae is None):
                hint = f"; {episode.hint}" if response.reason == NO_SETPOINT and episode.hint else ""
                yield f"response to {response.kind}: {response.reason}{hint}", lane
    for lane, loop in enumerate(report.margins[:LANES_SHOWN]):
        if loop is not None and loop.reason:
            yield f"no margins: {loop.reason}", lane
    if report.deviation.reason and episode.plan is not None:
        yield f"not compared with the simulation: {report.deviation.reason}", None


def _alike(report: EpisodeReport) -> Iterator[tuple[Any, ...] | None]:
    """Yield, for each row, what it has in common with rows that it may be compared with: plant, plan, lane and
    response. None where the bag does not tell plant and plan."""
    episode = report.episode
    known = episode.followed and episode.plant
    plant = tuple(sorted((name, repr(value)) for name, value in episode.plant.items() if name in _of_plant(episode)))
    for lane, found in enumerate(report.responses):
        counts: Counter[str] = Counter()
        for response in found:
            counts[response.kind] += 1
            key = (episode.followed, episode.sample_period_ns, plant, lane, response.kind, counts[response.kind])
            yield key if known else None


def _of_plant(episode: Episode) -> Collection[str]:
    """The parameters that make the plant what it is, without those of how it is run."""
    try:
        parameters = set(model_parameters(str(episode.plant.get("model"))))
    except ValueError:
        parameters = set(episode.plant) - set(PLANT)
    return {"model", "effort_min", "effort_max", *NOISE, *parameters}


def _rows(report: EpisodeReport, bag: str) -> list[dict[str, Any]]:
    episode, off = report.episode, report.deviation
    rows = []
    for lane, (found, use) in enumerate(zip(report.responses, report.effort, strict=True)):
        for response in found:
            values: dict[str, Any] = dict.fromkeys(COLUMNS)
            values |= {"bag": bag, "episode": title(episode)}
            values |= {"controller": episode.controller, "lane": lane, "response": response.kind}
            values |= {"joint": episode.joints[lane]}
            values |= {"start_s": response.start_s, "iae": response.iae}
            metrics = asdict(response.metrics) if response.metrics is not None else {}
            values |= {name: value for name, value in metrics.items() if name in COLUMNS}
            values |= {"effort_variation": use.total_variation, "effort_peak": use.peak}
            if use.saturated_share is not None:
                values["saturated_percent"] = 100.0 * use.saturated_share
            if off.output is not None and off.control_effort is not None:
                values["deviation"] = max(off.output, off.control_effort)
            loop = report.margins[lane]
            values["m_s"] = loop.m_s if loop is not None else None
            rows.append(values)
    return rows


def _parts(cells: list[list[str]], width: int | None) -> list[list[list[str]]]:
    """A table, or its columns in tables that fit, each after the columns that say which row it is."""
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    titles = [COLUMNS[name][0] for name in WHICH_ROW]
    first = [i for i, title in enumerate(cells[0]) if title in titles]
    parts: list[list[int]] = [[]]
    for i in (i for i in range(len(widths)) if i not in first):
        if width is not None and parts[-1] and sum(widths[j] + 2 for j in (*first, *parts[-1], i)) - 2 > width:
            parts.append([])
        parts[-1].append(i)
    return [[[line[i] for i in sorted((*first, *part))] for line in cells] for part in parts]


def _lines(cells: list[list[str]]) -> list[str]:
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = ["  ".join(c.ljust(w) for c, w in zip(line, widths, strict=True)).rstrip() for line in cells]
    lines.insert(1, "  ".join("─" * width for width in widths))
    return lines


def _shown(row: dict[str, Any], name: str) -> str:
    return "-" if row[name] is None else COLUMNS[name][1](row[name])


def _as_json(report: EpisodeReport, iae_changes: Iterator[float | None]) -> dict[str, Any]:
    episode = report.episode
    return {
        "bag": episode.bag,
        "namespace": episode.namespace,
        "name": episode.name,
        "number": episode.number,
        "plan": episode.plan.digest if episode.plan is not None else None,
        "controller": episode.controller,
        "gains": [gains.as_dict() for gains in episode.gains],
        "sample_period_s": episode.sample_period_ns / 1e9,
        "samples": len(episode.time),
        "first_stamp_ns": episode.first_stamp_ns,
        "missing": episode.missing,
        "lanes": [
            {
                "joint": joint,
                "responses": [_response_as_json(response, next(iae_changes)) for response in found],
                "effort": asdict(use),
                "margins": loop.as_dict() if loop is not None else None,
            }
            for joint, found, use, loop in zip(
                episode.joints, report.responses, report.effort, report.margins, strict=True
            )
        ],
        "notes": list(episode.notes),
        "deviation": asdict(report.deviation),
    }


def _response_as_json(response: Response, iae_change: float | None) -> dict[str, Any]:
    document = asdict(response)
    return document | (document.pop("metrics") or {}) | {"iae_change_percent": iae_change}


def _finite(value: Any) -> Any:
    """The value with infinities and NaN as None, which is all that JSON can say."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
