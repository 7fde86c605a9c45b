"""Every episode in a bag: runs of a plan in lockstep, and stretches of a realtime loop or of a robot."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tdof_npid_ros.analysis.errors import AnalysisError
from tdof_npid_ros.analysis.loops import ObservedLoop, observed_loops
from tdof_npid_ros.analysis.parameters import Configuration, ParameterHistory, configurations, scenario_plans
from tdof_npid_ros.analysis.recording import PLAN_AFTER_RESET_NS
from tdof_npid_ros.analysis.sources import NOTHING_CHOSEN, Chosen
from tdof_npid_ros.analysis.tracks import Key, Track, held, latest_told, matched
from tdof_npid_ros.bag.reader import BagReader
from tdof_npid_ros.control.gains import Gains
from tdof_npid_ros.control.session import FAR_NS
from tdof_npid_ros.plants.catalog import make_plant
from tdof_npid_ros.plants.noise import largest_noise
from tdof_npid_ros.responses import ROUNDING, Lane, largest_move
from tdof_npid_ros.scenario import LARGEST_PLAN, Plan, PlanError
from tdof_npid_ros.units import Units
from tdof_npid_ros.wire import AnswerLabel, EpisodeLabel

LONGEST_GAP_NS = 3600 * 10**9  # between stamps of one recording; a robot's first message may be stamped 0 …
LONGEST_GAP_PERIODS = 1000  # … but a slow loop has its time
LONGEST_HELD = 10  # periods that an output stands in for those that are not in the bag
TO_AND_FRO = 10  # messages in a row that go to and fro between two values: of two publishers
TO_AND_FRO_SIZE = 0.05  # of all that the output moves; less may be an encoder's last digit
TURN = 2 * np.pi
TURNED = 0.9  # of a turn, between two outputs: not the way that a joint has gone
TWO_SOURCES = "of two publishers, or of a clock that was set back: these outputs are left out"
UNPLANNED = "recording"  # the name of an episode without a plan
ANSWERS_BY_STAMP = 0.5  # of the efforts bear an output's stamp: then they are answers to outputs


@dataclass(frozen=True)
class Episode:
    """A stretch of a loop, on the grid of its sample period.

    Attributes:
        bag, namespace: where it is from.
        name: of its plan in the scenario, or the plan's digest, or `recording`.
        number: the plant's count in lockstep, else the count in the bag.
        plan: None in a bag without, and in realtime, where setpoint and disturbance come from their topics.
        followed: digest of the plan that the scenario played; empty where the bag does not tell.
        sample_period_ns: of the outputs.
        start_ns: when the first output was published, ns since the epoch.
        first_stamp_ns: of the first output.
        time: s from the first output on, (samples,).
        joints: what the lanes are called, (lanes,); None for a lane without a name.
        setpoint, output, control_effort: (samples, lanes); NaN where the bag does not hold them.
        disturbance: (samples, lanes).
        gains: every set of controller parameters that answered, in order; empty where the bag does not hold them.
        plainly_operated: whether the control law alone made the efforts: no manual mode, rate limit, filter, …
        plant: the parameters of the simulated plant; empty where the bag does not hold them.
        missing: outputs that the plan has and the bag has not.
        begins: by lane, whether the first setpoint came with the first output, rather than stood before.
        from_rest: whether the loop starts with the first output.
        largest_step: of the setpoint in the scenario; None where the bag does not tell.
        turn: by lane, of angles, else 0.
        notes: what was guessed or mended.
        hint: where a setpoint might be, if none was found.
    """

    bag: str
    namespace: str
    name: str
    number: int
    plan: Plan | None
    followed: str
    sample_period_ns: int
    start_ns: int
    first_stamp_ns: int
    time: np.ndarray
    joints: tuple[str | None, ...]
    setpoint: np.ndarray
    disturbance: np.ndarray
    output: np.ndarray
    control_effort: np.ndarray
    gains: tuple[Gains, ...]
    plainly_operated: bool
    plant: Mapping[str, object]
    missing: int
    begins: np.ndarray
    from_rest: bool
    largest_step: float | None
    turn: tuple[float, ...]
    notes: tuple[str, ...]
    hint: str

    @property
    def lanes(self) -> int:
        """Number of independent loops, or of a robot's joints."""
        return int(self.output.shape[1])

    @property
    def units(self) -> Units:
        """Of output and effort, where the bag tells."""
        return Units.of(self.plant)

    @property
    def controller(self) -> str:
        """Type of the controller; empty where the bag does not tell."""
        return ", ".join(dict.fromkeys(gains.type for gains in self.gains))

    @cached_property
    def _begins(self) -> float | None:
        """The output at which its plan begins, as far as that or the plant tells; None without a plan."""
        if self.plan is None:
            return None
        return _told_initial_output(self.plant) if self.plan.start is None else self.plan.start

    def lane(self, lane: int) -> Lane:
        """What drives one lane and what it does."""
        segments = self.plan.sampled(self.sample_period_ns).segments[1:] if self.plan is not None else ()
        return Lane(
            self.sample_period_ns / 1e9,
            self.time,
            self.setpoint[:, lane],
            self.disturbance[:, lane],
            self.output[:, lane],
            [segment.first for segment in segments],
            setpoint_is_new=bool(self.begins[lane]),
            disturbance_is_new=self.from_rest,
            seen_late=self.plan is None,
            largest_step=self.largest_step,
            begins=self._begins,
            turn=self.turn[lane],
        )


def episodes_in(reader: BagReader, path: str | Path, chosen: Chosen = NOTHING_CHOSEN) -> list[Episode]:
    """The episodes in a bag, in the order in which they began; `path` is for messages.

    Raises:
        AnalysisError: there is no output in it, or none of two samples.
        BagError: it is damaged.
    """
    loops = observed_loops(reader, str(path), chosen)
    if not loops:
        raise AnalysisError(
            f"{path}: the output's messages hold no values: choose another field with --output TOPIC:FIELD, as "
            "/joint_states:velocity"
        )
    found = [episode for loop in loops for episode in _episodes(loop)]
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


def _episodes(loop: ObservedLoop) -> Iterator[Episode]:
    answers = _Answers.of(loop.effort)
    output = _without_lone_zeros(loop.output)
    known = configurations(loop.histories)
    names = plan_names(loop.scenario, loop.plans)
    driven = _driven(loop)
    for count, stretch in enumerate(_stretches(output), start=1):
        label = _episode_of(output, stretch)
        mine = answers.published_during(output, stretch) if label is None else answers.of_episode(label)
        view = _View(loop, output.only(np.arange(stretch.start, stretch.stop)), label, mine, driven, count == 1)
        episode = _episode(view, count, known, names)
        if episode is not None:
            yield episode


class _View(NamedTuple):
    """A stretch of a loop.

    Attributes:
        output: of the stretch alone.
        label: the episode that its messages name.
        answers: indices of the efforts that belong to it.
        driven: the joints that have a setpoint or effort; empty: not known.
        is_first: of the recording.
    """

    loop: ObservedLoop
    output: Track
    label: EpisodeLabel | None
    answers: np.ndarray
    driven: frozenset[Key]
    is_first: bool


class _Answers:
    """The efforts of a loop by the episodes that they name."""

    def __init__(self, effort: Track | None) -> None:
        self._effort = effort
        self._by_episode: dict[EpisodeLabel | None, list[slice]] = defaultdict(list)

    @classmethod
    def of(cls, effort: Track | None) -> _Answers:
        answers = cls(effort)
        for stretch in _stretches(effort) if effort is not None else []:
            assert effort is not None
            answers._by_episode[_episode_of(effort, stretch)].append(stretch)
        return answers

    def of_episode(self, label: EpisodeLabel) -> np.ndarray:
        """The next answers to an episode of this label."""
        stretches = self._by_episode[label]
        mine = stretches.pop(0) if stretches else slice(0, 0)
        return np.arange(mine.start, mine.stop)

    def published_during(self, output: Track, stretch: slice) -> np.ndarray:
        """What was received from the stretch's first output on, until the next stretch's."""
        if self._effort is None:
            return np.arange(0)
        times = self._effort.receive_ns
        mine = times >= output.receive_ns[stretch.start]
        if stretch.stop < len(output):
            mine &= times < output.receive_ns[stretch.stop]
        return np.flatnonzero(mine)


def _driven(loop: ObservedLoop) -> frozenset[Key]:
    """The joints that are controlled; empty where nothing tells by name."""
    found: set[Key] = set()
    for track in (loop.acted_on, loop.setpoint, loop.effort):
        if track is not None and track.bears_names:
            found |= track.driven()
        elif track is not None and track.layouts and track is not loop.effort:
            return frozenset()  # by place, so that it is for all
    return frozenset(found & set(loop.output.keys))


def _without_lone_zeros(output: Track) -> Track:
    """The track without messages whose stamp alone is not set."""
    stamps = output.stamp_ns
    if len(stamps) < 3:
        return output
    lone = np.zeros(len(stamps), bool)
    lone[1:-1] = (stamps[1:-1] == 0) & (stamps[:-2] > 0) & (stamps[2:] > stamps[:-2])
    if lone.any():
        lone &= np.array([EpisodeLabel.parse(str(frame)) is None for frame in output.frame_id.tolist()])
    return output.only(np.flatnonzero(~lone)) if lone.any() else output


def _stretches(track: Track) -> list[slice]:
    """Stretches of one episode each: the frame_id's episode stays the same, no stamp goes back to a start or far
    ahead."""
    if not len(track):
        return []
    stamps = track.stamp_ns
    back = (stamps[1:] < stamps[:-1]) & ((stamps[1:] == 0) | (stamps[:-1] - stamps[1:] > FAR_NS))
    starts = {0, *(np.flatnonzero(back) + 1).tolist()}
    steps = np.diff(stamps)
    gap_ns = max(LONGEST_GAP_NS, LONGEST_GAP_PERIODS * int(np.median(steps))) if len(steps) else LONGEST_GAP_NS
    ahead = (np.flatnonzero(steps > gap_ns) + 1).tolist()
    starts |= {first for first in ahead if _episode_of(track, slice(first, first + 1)) is None}
    for change in (np.flatnonzero(track.frame_id[1:] != track.frame_id[:-1]) + 1).tolist():
        if _episode_of(track, slice(change - 1, change)) != _episode_of(track, slice(change, change + 1)):
            starts.add(change)
    ordered = [*sorted(starts), len(track)]
    return [slice(a, b) for a, b in zip(ordered, ordered[1:], strict=False)]


def _episode_of(track: Track, stretch: slice) -> EpisodeLabel | None:
    """The episode that an output or an answer names."""
    return EpisodeLabel.named_in(str(track.frame_id[stretch.start]))


def _episode(view: _View, count: int, known: Mapping[str, Configuration], names: Mapping[str, str]) -> Episode | None:
    loop, output = view.loop, view.output
    keys = [key for key in output.keys if key in view.driven] or list(output.keys)
    stamps, first = np.unique(output.stamp_ns, return_index=True)
    if len(stamps) < 2 or not keys:
        return None
    period_ns = int(np.median(np.diff(stamps)))
    digest = view.label.plan if view.label is not None else ""
    plan = loop.plans.get(digest)
    grid = _grid(stamps, period_ns, plan, loop.bag)
    hold = not digest
    sampling = _Sampling(grid, period_ns, output, stamps, first, hold)
    table = output.table(keys)
    torn = (
        []
        if view.label is not None
        else [lane for lane in range(len(keys)) if _mixed_values_left_out(output, table[:, lane])]
    )
    y = sampling.outputs(table)
    effort = sampling.of_answers(loop.effort, view.answers, keys)
    start_ns = int(output.receive_ns[0])
    used = _used(loop, view.answers, known)
    plant = loop.plant.at(start_ns) if loop.plant is not None else {}
    from_rest = _is_start(view, int(grid[0]), plant, y)
    begins = np.full(len(keys), from_rest)
    turn = _turn(loop, used, start_ns)
    angles = (
        [] if used or loop.controller is not None else [lane for lane in range(len(keys)) if turns_over(y[:, lane])]
    )
    if plan is not None:
        signals = plan.sampled(period_ns)
        setpoint, disturbance = (
            np.repeat(values[:, None], len(keys), axis=1) for values in (signals.setpoint, signals.disturbance)
        )
    else:
        setpoint = sampling.of_answers(loop.acted_on, view.answers, keys)
        live, is_new = sampling.live(loop.setpoint, keys)
        unknown = np.isnan(setpoint).all(axis=0)
        setpoint[:, unknown] = live[:, unknown]
        begins[unknown] |= is_new[unknown]
        disturbance = np.nan_to_num(sampling.live(loop.disturbance, keys)[0])  # before the first there is none
        if view.label is not None:
            digest = loop.plan_followed(start_ns)
            _forget_the_episode_before(setpoint, loop.plans.get(digest), grid)
    return Episode(
        bag=loop.bag,
        namespace=loop.namespace,
        name=names.get(digest, digest) or UNPLANNED,
        number=view.label.number if view.label is not None and plan is not None else count,
        plan=plan,
        followed=digest,
        sample_period_ns=period_ns,
        start_ns=start_ns,
        first_stamp_ns=int(grid[0]),
        time=(grid - grid[0]) / 1e9,
        joints=tuple(key if isinstance(key, str) else None for key in keys),
        setpoint=setpoint,
        disturbance=disturbance,
        output=y,
        control_effort=effort,
        gains=tuple(configuration.gains for configuration in used),
        plainly_operated=all(configuration.options.is_plain for configuration in used),
        plant=plant,
        missing=int(np.isnan(y).any(axis=1).sum()),
        begins=begins,
        from_rest=from_rest,
        largest_step=_largest_step(loop, period_ns, plant, y, turn, start_ns),
        turn=tuple(TURN if lane in angles else turn for lane in range(len(keys))),
        notes=(
            *loop.notes,
            *(f"{_called(keys[lane])} turns over at its end: measured as an angle" for lane in angles),
            *(f"{_called(keys[lane])} goes to and fro between two values: {TWO_SOURCES}" for lane in torn),
        ),
        hint=loop.hint,
    )


def _is_start(view: _View, first_stamp_ns: int, plant: Mapping[str, object], output: np.ndarray) -> bool:
    """Whether the loop starts with the stretch's first output: at time 0, or where the plant's label says so."""
    if view.label is None or view.label.plan:
        return first_stamp_ns == 0
    # Of a recording that begins within an episode, the first output is not the plant's initial one.
    off = np.abs(output[0] - _initial_output(plant, output))
    return not view.is_first or bool((off <= _noise_bound(plant)).all())


def _forget_the_episode_before(setpoint: np.ndarray, plan: Plan | None, grid: np.ndarray) -> None:
    """In realtime the plant is reset first, and then the plan's first setpoint comes: until it does, there is none."""
    if plan is None:
        return
    soon = int(np.searchsorted(grid, grid[0] + PLAN_AFTER_RESET_NS))
    for lane in range(setpoint.shape[1]):
        planned = np.flatnonzero(setpoint[:soon, lane] == plan.value_at("setpoint", 0))
        if planned.size:
            setpoint[: planned[0], lane] = np.nan


class _Sampling(NamedTuple):
    """How a stretch's messages come onto its grid.

    Attributes:
        grid: stamps, (samples,).
        output: the stretch's outputs; `stamps` their different stamps, `first` the first message of each.
        hold: between outputs the value before goes on; else there is none.
    """

    grid: np.ndarray
    period_ns: int
    output: Track
    stamps: np.ndarray
    first: np.ndarray
    hold: bool

    def outputs(self, rows: np.ndarray) -> np.ndarray:
        """The outputs, a row for each message, on the grid; NaN where the bag has none.

        Where all outputs do not come on the grid (`hold`), the value before stands in for a while.
        """
        if not self.hold:
            return self.by_stamp(self.stamps, rows[self.first])
        latest = latest_told(rows)
        values = self.by_stamp(self.stamps, np.take_along_axis(rows, latest, axis=0)[self.first])
        told_at = self.by_stamp(self.stamps, (self.output.stamp_ns - self.grid[0])[latest][self.first])
        values[(self.grid - self.grid[0])[:, None] - told_at > LONGEST_HELD * self.period_ns] = np.nan
        return values

    def by_stamp(self, stamps: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Rows (stamps, lanes) on the grid: those of its stamps, or the nearest and then held; NaN before the first."""
        grid = self.grid + self.period_ns // 2 if self.hold else self.grid
        at = np.searchsorted(stamps, grid, side="right") - 1
        values = rows[np.maximum(at, 0)].astype(np.float64)
        values[at < 0 if self.hold else (at < 0) | (stamps[np.maximum(at, 0)] != grid)] = np.nan
        return values

    def of_answers(self, track: Track | None, answers: np.ndarray, keys: Sequence[Key]) -> np.ndarray:
        """Efforts, or the setpoints that they bear, (samples, lanes): by the stamps of the outputs that they answer, or
        by arrival where they are not stamped so."""
        if track is None or not answers.size:
            return np.full((len(self.grid), len(keys)), np.nan)
        mine = track.only(answers)
        if np.isin(mine.stamp_ns, self.stamps).mean() < ANSWERS_BY_STAMP:
            return self.live(mine, keys)[0]
        stamps, first = np.unique(mine.stamp_ns, return_index=True)
        table = matched(mine, keys)
        return self.by_stamp(stamps, (held(table) if self.hold else table)[first])

    def live(self, track: Track | None, keys: Sequence[Key]) -> tuple[np.ndarray, np.ndarray]:
        """What was received last before each output, (samples, lanes); and, by lane, whether what stands at the first
        output came within a sample period before it."""
        if track is None or not len(track):
            return np.full((len(self.grid), len(keys)), np.nan), np.zeros(len(keys), bool)
        order = np.argsort(track.receive_ns, kind="stable")
        times, told = track.receive_ns[order], matched(track, keys)[order]
        at = np.searchsorted(times, self.output.receive_ns, side="right") - 1
        rows = np.where((at < 0)[:, None], np.nan, held(told)[np.maximum(at, 0)])
        came = np.where(np.isnan(told[: at[0] + 1]), np.iinfo(np.int64).min, times[: at[0] + 1, None])
        latest = came.max(axis=0, initial=np.iinfo(np.int64).min)
        is_new = latest > self.output.receive_ns[0] - self.period_ns
        hold = self._replace(hold=True)
        return hold.by_stamp(self.stamps, rows[self.first]), is_new


def _mixed_values_left_out(output: Track, values: np.ndarray) -> bool:
    """Whether an output's values (messages,), or some of them, are those of two sources, so that no one knows which are
    meant; these become NaN in place."""
    order = np.argsort(output.stamp_ns, kind="stable")
    order = order[~np.isnan(values[order])]
    mixed = of_two_sources(output.stamp_ns[order], values[order])
    values[order[mixed]] = np.nan
    return bool(mixed.stop)


def of_two_sources(stamps: np.ndarray, values: np.ndarray) -> slice:
    """From the first to the last of the messages (messages,) that come in turn from two sources: each second value
    lies far off, and each second interval is another.

    >>> stamps = np.arange(40) * 10 + np.tile([0, 3], 20)
    >>> of_two_sources(stamps, np.tile([0.0, 1.0], 20)), of_two_sources(stamps, np.arange(40.0))
    (slice(0, 40, None), slice(0, 0, None))
    """
    if len(values) < TO_AND_FRO + 2:
        return slice(0, 0)
    moves, intervals = np.abs(np.diff(values)), np.diff(stamps)
    away = np.minimum(moves[:-1], moves[1:])
    back = np.abs(values[2:] - values[:-2])
    uneven = np.abs(np.diff(intervals)) > 0.1 * (intervals[:-1] + intervals[1:])
    jumps = (away > 10 * back) & (away > TO_AND_FRO_SIZE * np.ptp(values)) & uneven
    runs = np.flatnonzero(np.convolve(jumps, np.ones(TO_AND_FRO), "valid") == TO_AND_FRO)
    return slice(int(runs[0]), int(runs[-1]) + TO_AND_FRO + 2) if runs.size else slice(0, 0)


def _used(loop: ObservedLoop, answers: np.ndarray, known: Mapping[str, Configuration]) -> list[Configuration]:
    """The parameters that efforts were computed with, in order; none if one of them is not known."""
    if loop.effort is None or not answers.size:
        return []
    frames = loop.effort.frame_id[answers]
    changes = np.flatnonzero(frames[1:] != frames[:-1]) + 1
    digests = [AnswerLabel.parse(str(frames[i])).parameters for i in (0, *changes)]
    return [known[digest] for digest in digests] if set(digests) <= known.keys() else []


def _turn(loop: ObservedLoop, used: Sequence[Configuration], start_ns: int) -> float:
    """Of angles, if the controller takes setpoint and output for such."""
    if not used and loop.controller is not None and loop.controller.at(start_ns).get("angle") is True:
        return TURN
    return max((configuration.options.turn for configuration in used), default=0.0)


def turns_over(output: np.ndarray) -> bool:
    """Whether an output (samples,) is an angle that jumps at the end of its turn, from -π to π or from 0 to 2π.

    >>> turns_over(np.array([3.0, 3.1, -3.1, -3.0])), turns_over(np.array([3.0, 3.1, 3.2, 3.3]))
    (True, False)
    """
    known = output[~np.isnan(output)]
    if not known.size or np.abs(np.diff(known)).max(initial=0.0) < TURNED * TURN:
        return False
    margin = TURN * ROUNDING
    begin = -TURN / 2 if known.min() < 0 else 0.0
    return bool(begin - margin <= known.min() and known.max() <= begin + TURN + margin)


def _called(key: Key) -> str:
    return key if isinstance(key, str) else f"lane {key}"


def _largest_step(
    loop: ObservedLoop, period_ns: int, plant: Mapping[str, object], output: np.ndarray, turn: float, start_ns: int
) -> float | None:
    """The largest setpoint step of the scenario, or else of the plans that are in the bag."""
    plans = scenario_plans(loop.scenario.at(start_ns)) if loop.scenario is not None else {}
    sampled = []
    for plan in plans.values() or loop.plans.values():
        try:
            sampled.append(plan.sampled(period_ns))
        except PlanError:
            continue  # shorter than a sample
    start = _initial_output(plant, output)
    sizes = [largest_move(plan.setpoint, start if plan.start is None else plan.start, turn) for plan in sampled]
    return max(sizes, default=None)


def _initial_output(plant: Mapping[str, object], output: np.ndarray) -> float:
    """Where the plant starts: of its model, or else what was recorded first."""
    if (told := _told_initial_output(plant)) is not None:
        return told
    known = output[~np.isnan(output)]
    return float(known[0]) if known.size else 0.0


def _told_initial_output(plant: Mapping[str, object]) -> float | None:
    """The output with which a plant begins; None where the bag does not tell, or each lane has its own."""
    try:
        return float(make_plant(str(plant["model"]), plant).initial_output)
    except (KeyError, ValueError):
        return None


def _noise_bound(plant: Mapping[str, object]) -> float:
    """How far its noise takes a plant's output at the most."""
    try:
        return largest_noise(make_plant(str(plant["model"]), plant))
    except (KeyError, ValueError):
        return 0.0


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


def plan_names(scenario: ParameterHistory | None, plans: Mapping[str, Plan]) -> dict[str, str]:
    """What the scenario calls the plans, by digest."""
    names: dict[str, str] = {}
    for _, values in scenario.sets() if scenario is not None else ():
        names |= {plan.digest: name for name, plan in scenario_plans(values).items()}
    return {digest: name for digest, name in names.items() if digest in plans}
