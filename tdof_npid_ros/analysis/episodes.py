"""Every episode in a bag: runs of a plan in lockstep, and stretches of a realtime loop or of a robot."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tdof_npid_ros.analysis.errors import AnalysisError
from tdof_npid_ros.analysis.parameters import Configuration, ParameterHistory, configurations
from tdof_npid_ros.analysis.recording import Loop, Signal, read_loops
from tdof_npid_ros.bag.reader import BagReader
from tdof_npid_ros.control.gains import Gains
from tdof_npid_ros.control.session import FAR_NS
from tdof_npid_ros.parameters import sample_period_in_ns
from tdof_npid_ros.scenario import LARGEST_PLAN, Plan, parse_plan, read_episodes
from tdof_npid_ros.wire import AnswerLabel, EpisodeLabel

LONGEST_GAP_NS = 3600 * 10**9  # between stamps of one recording; a robot's first message may be stamped 0 …
LONGEST_GAP_PERIODS = 1000  # … but a slow loop has its time
UNPLANNED = "recording"  # the name of an episode without a plan


@dataclass(frozen=True)
class Episode:
    """A stretch of a loop, on the grid of its sample period.

    Attributes:
        bag, namespace: where it is from.
        name: of its plan in the scenario, or the plan's digest, or `recording`.
        number: the plant's count in lockstep, else the count in the bag.
        plan: None in a bag without, and in realtime, where setpoint and disturbance come from their topics.
        sample_period_ns: of the outputs.
        start_ns: when the first output was published, ns since the epoch.
        time: s, (samples,).
        setpoint, output, control_effort: (samples, lanes); NaN where the bag does not hold them.
        disturbance: (samples,).
        gains: every set of controller parameters that answered, in order; empty where the bag does not hold them.
        plainly_operated: whether the control law alone made the efforts: no manual mode, rate limit, filter, …
        plant: the parameters of the simulated plant; empty where the bag does not hold them.
        missing: outputs that the plan has and the bag has not.
    """

    bag: str
    namespace: str
    name: str
    number: int
    plan: Plan | None
    sample_period_ns: int
    start_ns: int
    time: np.ndarray
    setpoint: np.ndarray
    disturbance: np.ndarray
    output: np.ndarray
    control_effort: np.ndarray
    gains: tuple[Gains, ...]
    plainly_operated: bool
    plant: Mapping[str, object]
    missing: int

    @property
    def lanes(self) -> int:
        """Number of independent loops, or of a robot's joints."""
        return int(self.output.shape[1])

    @property
    def controller(self) -> str:
        """Type of the controller; empty where the bag does not tell."""
        return ", ".join(dict.fromkeys(gains.type for gains in self.gains))


def episodes_in(reader: BagReader, path: str | Path) -> list[Episode]:
    """The episodes in a bag, in the order in which they began; `path` is for messages.

    Raises:
        AnalysisError: there is no output in it, or none of two samples.
        BagError: it is damaged.
    """
    found = [episode for loop in read_loops(reader, str(path)) for episode in _episodes(loop)]
    if not found:
        raise AnalysisError(f"{path}: no episode of at least two outputs in it: record longer")
    return sorted(found, key=lambda episode: episode.start_ns)


def bag_names(bags: Iterable[str]) -> dict[str, str]:
    """For each bag as much of the end of its path as tells it from the others; nothing for a single one."""
    parts = {bag: Path(bag).resolve().parts for bag in bags}
    different = len(set(parts.values()))
    depth = 0
    while len({path[len(path) - depth :] for path in parts.values()}) < different:
        depth += 1
    return {bag: "/".join(path[len(path) - depth :]) for bag, path in parts.items()}


def _episodes(loop: Loop) -> Iterator[Episode]:
    names = _plan_names(loop.scenario, loop.plans)
    answers = loop.control_effort
    by_episode: dict[EpisodeLabel | None, list[slice]] = defaultdict(list)
    for stretch in _stretches(answers) if answers is not None else []:
        by_episode[_episode_of(answers, stretch)].append(stretch)  # type: ignore[arg-type]
    known = configurations(loop.histories)
    for count, stretch in enumerate(_stretches(loop.output), start=1):
        label = _episode_of(loop.output, stretch)
        if label is not None:
            mine = by_episode[label].pop(0) if by_episode[label] else slice(0, 0)
        else:
            mine = _published_during(loop.output, stretch, answers)
        episode = _episode(loop, stretch, label, count, answers, mine, known, names)
        if episode is not None:
            yield episode


def _stretches(signal: Signal) -> list[slice]:
    """Stretches of one episode each: the frame_id's episode stays the same, no stamp goes back to a start or far
    ahead."""
    if not len(signal):
        return []
    stamps = signal.stamp_ns
    back = (stamps[1:] < stamps[:-1]) & ((stamps[1:] == 0) | (stamps[:-1] - stamps[1:] > FAR_NS))
    starts = {0, *(np.flatnonzero(back) + 1).tolist()}
    steps = np.diff(stamps)
    gap_ns = max(LONGEST_GAP_NS, LONGEST_GAP_PERIODS * int(np.median(steps))) if len(steps) else LONGEST_GAP_NS
    ahead = (np.flatnonzero(steps > gap_ns) + 1).tolist()
    starts |= {first for first in ahead if _episode_of(signal, slice(first, first + 1)) is None}
    runs = signal.runs()
    for before, run in zip(runs, runs[1:], strict=False):
        if _episode_of(signal, before) != _episode_of(signal, run):
            starts.add(run.start)
    ordered = [*sorted(starts), len(signal)]
    return [slice(a, b) for a, b in zip(ordered, ordered[1:], strict=False)]


def _episode_of(signal: Signal, stretch: slice) -> EpisodeLabel | None:
    """The episode that an output or an answer names."""
    return EpisodeLabel.named_in(str(signal.frame_id[stretch.start]))


def _published_during(output: Signal, stretch: slice, answers: Signal | None) -> slice:
    if answers is None:
        return slice(0, 0)
    first = int(output.publish_ns[stretch.start])
    after = int(output.publish_ns[stretch.stop]) if stretch.stop < len(output) else None
    a = int(np.searchsorted(answers.publish_ns, first))
    return slice(a, len(answers) if after is None else int(np.searchsorted(answers.publish_ns, after)))


def _episode(
    loop: Loop,
    stretch: slice,
    label: EpisodeLabel | None,
    count: int,
    answers: Signal | None,
    mine: slice,
    known: Mapping[str, Configuration],
    names: Mapping[str, str],
) -> Episode | None:
    stamps, first = np.unique(loop.output.stamp_ns[stretch], return_index=True)
    if len(stamps) < 2:
        return None
    rows = _rows(loop.output.position[stretch], loop.bag)[first]
    if not rows.shape[1]:
        return None
    period_ns = int(np.median(np.diff(stamps)))
    digest = label.plan if label is not None else ""
    plan = loop.plans.get(digest)
    grid = _grid(stamps, period_ns, plan, loop.bag)
    hold = not digest
    output = _on_grid(grid, stamps, rows, hold)
    setpoint, effort = np.full((2, *output.shape), np.nan)
    digests: list[str] = []
    if answers is not None and mine.stop > mine.start:
        effort_stamps, index = np.unique(answers.stamp_ns[mine], return_index=True)
        effort_rows, setpoint_rows = (_rows(c[mine], loop.bag)[index] for c in (answers.effort, answers.position))
        effort = _on_grid(grid, effort_stamps, _widened(effort_rows, output), hold)
        setpoint = _on_grid(grid, effort_stamps, _widened(setpoint_rows, output), hold)
        changes = np.flatnonzero(answers.frame_id[mine][1:] != answers.frame_id[mine][:-1]) + 1
        digests = [AnswerLabel.parse(str(answers.frame_id[mine][i])).parameters for i in (0, *changes)]
    used = [known[name] for name in digests] if set(digests) <= known.keys() else []
    start_ns = int(loop.output.publish_ns[stretch.start])
    if plan is not None:
        signals = plan.sampled(period_ns)
        setpoint = np.repeat(signals.setpoint[:, None], output.shape[1], axis=1)
        disturbance = signals.disturbance
    else:
        if np.isnan(setpoint).all() and loop.setpoint is not None:
            setpoint = np.repeat(
                _live(loop.setpoint, "position", loop, stretch, grid)[:, None], output.shape[1], axis=1
            )
        disturbance = _live(loop.disturbance, "effort", loop, stretch, grid)
    return Episode(
        bag=loop.bag,
        namespace=loop.namespace,
        name=names.get(digest, digest) or UNPLANNED,
        number=label.number if label is not None and digest else count,
        plan=plan,
        sample_period_ns=period_ns,
        start_ns=start_ns,
        time=grid / 1e9,
        setpoint=setpoint,
        disturbance=disturbance,
        output=output,
        control_effort=effort,
        gains=tuple(configuration.gains for configuration in used),
        plainly_operated=all(configuration.options.is_plain for configuration in used),
        plant=loop.plant.at(start_ns) if loop.plant is not None else {},
        missing=int(np.isnan(output).any(axis=1).sum()),
    )


def _rows(values: np.ndarray, bag: str) -> np.ndarray:
    """One row per message, (messages, lanes)."""
    if values.dtype != object:
        return values
    if len({len(row) for row in values}) > 1:
        raise AnalysisError(f"{bag}: the number of values changes within an episode: it cannot be analysed")
    return np.stack(list(values))


def _widened(rows: np.ndarray, like: np.ndarray) -> np.ndarray:
    """One value for all lanes becomes one per lane; what does not fit is not known."""
    lanes = like.shape[1]
    if rows.shape[1] == lanes:
        return rows
    return np.repeat(rows, lanes, axis=1) if rows.shape[1] == 1 else np.full((len(rows), lanes), np.nan)


def _grid(stamps: np.ndarray, period_ns: int, plan: Plan | None, bag: str) -> np.ndarray:
    """Stamps k·h, of the whole plan or from the first output to the last."""
    if plan is not None:
        return np.arange(plan.steps(period_ns) + 1, dtype=np.int64) * period_ns
    if (stamps[-1] - stamps[0]) // period_ns > LARGEST_PLAN:
        raise AnalysisError(
            f"{bag}: outputs stamped from {stamps[0] / 1e9:.9g} to {stamps[-1] / 1e9:.9g} s, mostly {period_ns} ns "
            "apart, "
            f"are more than {LARGEST_PLAN:,} sample periods: analyse a shorter or more regular recording"
        )
    return np.arange(stamps[0], stamps[-1] + 1, period_ns, dtype=np.int64)


def _on_grid(grid: np.ndarray, stamps: np.ndarray, rows: np.ndarray, hold: bool) -> np.ndarray:
    """Rows by the stamps of the grid; where there is none, NaN, or (hold) the row before."""
    at = np.searchsorted(stamps, grid, side="right") - 1
    values = rows[np.maximum(at, 0)].astype(np.float64)
    values[at < 0 if hold else (at < 0) | (stamps[np.maximum(at, 0)] != grid)] = np.nan
    return values


def _live(signal: Signal | None, field: str, loop: Loop, stretch: slice, grid: np.ndarray) -> np.ndarray:
    """What was published on a topic last before each output, (samples,); 0 before the first."""
    if signal is None or not len(signal):
        return np.zeros(len(grid))
    values = np.array([row[0] if len(row) else 0.0 for row in getattr(signal, field)])
    at = np.searchsorted(signal.publish_ns, loop.output.publish_ns[stretch], side="right") - 1
    column = np.where(at < 0, 0.0, values[np.maximum(at, 0)])
    stamps, first = np.unique(loop.output.stamp_ns[stretch], return_index=True)
    return _on_grid(grid, stamps, column[first][:, None], hold=True)[:, 0]


def _plan_names(scenario: ParameterHistory | None, plans: Mapping[str, Plan]) -> dict[str, str]:
    """What the scenario calls the plans, by digest."""
    names: dict[str, str] = {}
    for _, values in scenario.sets() if scenario is not None else ():
        if "sample_period" not in values:
            continue
        try:
            for name, lines in read_episodes(values).items():
                names[parse_plan(lines, sample_period_in_ns(values["sample_period"])).digest] = name
        except ValueError:
            continue  # parameters come one by one: not all of them yet
    return {digest: name for digest, name in names.items() if digest in plans}
