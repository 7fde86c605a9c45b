"""Records for identification from bags: stretches of output and applied effort, on the time of the stamps."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tdof_npid_ros.analysis.episodes import plan_names
from tdof_npid_ros.analysis.loops import ObservedLoop, observed_loops
from tdof_npid_ros.analysis.sources import NOTHING_CHOSEN, Chosen, Source, read_track
from tdof_npid_ros.analysis.tracks import Key, Track, matched
from tdof_npid_ros.bag.reader import BagReader
from tdof_npid_ros.field_path import FieldPath, Step
from tdof_npid_ros.identification import IdentificationError
from tdof_npid_ros.identification.fit import Stretch
from tdof_npid_ros.plants.catalog import make_plant
from tdof_npid_ros.plants.start import plant_at_start
from tdof_npid_ros.scenario import Plan
from tdof_npid_ros.wire import JOINT_STATE, EpisodeLabel

LEAST_STRETCH = 10  # samples; shorter ones are left out
GAP = 20.0  # periods without an output end a stretch
EVEN = 1e-6  # of a period: stamps that are nearer to a grid are on it


@dataclass(frozen=True)
class Record:
    """A stretch with what is known beside it.

    Attributes:
        name: of the episode, or `recording`.
        number: counts the stretches of its bag, from 1.
        stretch: output and applied effort.
        setpoint: at each stamp, (samples,); NaN where it is not known.
        limits: of the effort; infinite where they are not known.
        notes: what was made of the bag, for people.
    """

    name: str
    number: int
    stretch: Stretch
    setpoint: np.ndarray
    limits: tuple[float, float]
    notes: tuple[str, ...] = ()


def read_records(
    bags: Sequence[str | Path], episode: str | None = None, chosen: Chosen = NOTHING_CHOSEN
) -> list[Record]:
    """The records in some bags.

    Args:
        episode: only stretches of that name or number; None: all.
        chosen: which topics and fields are output and effort, where the user says so.

    Raises:
        IdentificationError: there is none, or several loops or joints.
        AnalysisError, BagError: a bag cannot be read.
    """
    records: list[Record] = []
    for bag in bags:
        with BagReader(Path(bag)) as reader:
            loop, key = _only_one(observed_loops(reader, str(bag), chosen), str(bag))
            records += _records(reader, loop, key, chosen)
    if not records:
        raise IdentificationError(
            f"{', '.join(map(str, bags))}: no stretch of {LEAST_STRETCH} outputs with an effort in it: record "
            f"longer, and "
            "the effort too; choose it with --effort TOPIC:FIELD where it is not found"
        )
    if episode is not None:
        names = list(dict.fromkeys(record.name for record in records))
        records = [record for record in records if episode in (record.name, str(record.number))]
        if not records:
            raise IdentificationError(f"no episode {episode!r}: there are {', '.join(names)}, and numbers from 1")
    return records


def _only_one(loops: Sequence[ObservedLoop], bag: str) -> tuple[ObservedLoop, Key]:
    """The one loop with one joint.

    Raises:
        IdentificationError: there are others, and which is meant is not said.
    """
    found = [(loop, key) for loop in loops for key in loop.output.keys if key in loop.output.driven()]
    if len(found) == 1:
        return found[0]
    topics = [f"{loop.output.source}[{key}]" for loop, key in found]
    raise IdentificationError(
        f"{bag}: {len(found)} outputs in it ({', '.join(topics[:8])}{', …' if len(topics) > 8 else ''}): choose one "
        f"with "
        "--output TOPIC:FIELD[NAME], and with --effort what drives it"
        if found
        else f"{bag}: no output in it: choose one with --output TOPIC:FIELD"
    )


def _records(reader: BagReader, loop: ObservedLoop, key: Key, chosen: Chosen) -> Iterator[Record]:
    output = loop.output
    measured = output.table([key])[:, 0]
    told, kind = _applied(reader, loop, key, chosen)
    names = plan_names(loop.scenario, loop.plans)
    setpoints = loop.acted_on or loop.setpoint
    number = 0
    for part in _parts(output):
        label = EpisodeLabel.named_in(str(output.frame_id[part.start]))
        stamps, first = np.unique(output.stamp_ns[part], return_index=True)
        if len(stamps) < LEAST_STRETCH:
            continue
        number += 1
        y, receive = measured[part][first], output.receive_ns[part][first]
        period_ns = float(np.median(np.diff(stamps)))
        if told is not None:
            until = told[part][first]
            effort = np.append(until[1:], until[-1])
        elif loop.effort is not None:
            effort = _held(_during(loop.effort, output, part), key, stamps, receive, period_ns)
        else:
            continue
        plan = loop.plans.get(label.plan) if label is not None else None
        notes = [*loop.notes, kind]
        if plan is not None:
            signals = plan.sampled(round(period_ns))
            at = np.clip(np.round(stamps / period_ns).astype(int), 0, signals.steps)
            setpoint = signals.setpoint[at]
            if np.any(signals.disturbance[at]):
                effort = effort + signals.disturbance[at]
                notes.append("the plan's disturbance is added to the effort")
        elif setpoints is not None:
            setpoint = _held(_during(setpoints, output, part), key, stamps, receive, period_ns)
        else:
            setpoint = np.full(len(stamps), np.nan)
        known = np.isfinite(y) & np.isfinite(effort)
        if np.count_nonzero(known) < LEAST_STRETCH:
            continue
        time = (stamps[known] - stamps[known][0]) / 1e9
        before, limits = _from_plant(loop, plan, int(receive[0]))
        at_rest = label is not None and bool(known[0]) and stamps[0] == 0  # else it is met in the middle
        if not at_rest:
            before = float(effort[known][0])
        elif told is not None and math.isfinite(until[0]):
            before = float(until[0])
        stretch = Stretch(time, effort[known], y[known], at_rest, before, is_even(time))
        name = names.get(label.plan, label.plan) if label is not None and label.plan else "recording"
        yield Record(name, number, stretch, setpoint[known], limits, tuple(note for note in notes if note))


def is_even(time: np.ndarray) -> bool:
    """Whether times (samples,), in s, lie on a grid, but for the rounding of stamps."""
    steps = np.diff(time)
    return bool(steps.max() - steps.min() <= 2e-9 + EVEN * steps.mean())


def _parts(output: Track) -> list[slice]:
    """Stretches in which the episode is the same and the stamps go on, without a gap."""
    count = len(output)
    if count < 2:
        return []
    steps = np.diff(output.stamp_ns)
    forward = steps[steps > 0]
    period = float(np.median(forward)) if len(forward) else 1.0
    broken = (steps < 0) | (steps > GAP * period) | (output.frame_id[1:] != output.frame_id[:-1])
    starts = [0, *(np.flatnonzero(broken) + 1).tolist(), count]
    return [slice(a, b) for a, b in zip(starts, starts[1:], strict=False)]


def _applied(reader: BagReader, loop: ObservedLoop, key: Key, chosen: Chosen) -> tuple[np.ndarray | None, str]:
    """The effort that the outputs' own messages tell, by message: what was applied until then; and what to say of it.

    None where they tell none that moves, or where the user names another.
    """
    path = FieldPath.parse(loop.output.source)
    theirs = "the effort is the one that the controller asks for: any limit of the actuator is not in it"
    if chosen.effort is not None and chosen.effort.topic.lstrip("/") != path.topic.lstrip("/"):
        return None, ""
    if reader.topics[path.topic].type != JOINT_STATE and chosen.effort is None:
        return None, theirs
    own = chosen.effort or FieldPath(path.topic, "", (Step("effort", path.steps[-1].element),))
    track = read_track(reader, Source("effort", replace(own, topic=path.topic)))
    values = matched(track, [key])[:, 0]
    if len(track) != len(loop.output):
        values = values[np.clip(np.searchsorted(track.log_ns, loop.output.log_ns), 0, len(track) - 1)]
    known = values[np.isfinite(values)]
    if not len(known) or (np.ptp(known) == 0.0 and loop.effort is not None and chosen.effort is None):
        return None, theirs
    return values, "the effort is the output's own, as it was applied"


def _during(track: Track, output: Track, part: slice) -> Track:
    """What arrived while a part of the outputs did, where their stamps go back and so mean several times; else all."""
    in_order = not (np.diff(output.receive_ns) < 0).any()
    if not (track.has_header and in_order and (np.diff(output.stamp_ns) < 0).any()):
        return track
    until = output.receive_ns[part.stop] if part.stop < len(output) else np.iinfo(np.int64).max
    of_part = (track.receive_ns >= output.receive_ns[part.start]) & (track.receive_ns < until)
    return track.only(np.flatnonzero(of_part))


def _held(track: Track, key: Key, stamps: np.ndarray, receive: np.ndarray, period_ns: float) -> np.ndarray:
    """What holds from each output on, as near as half a sample: by the stamps where both have them, else as
    received."""
    table = matched(track, [key])[:, 0]
    kept = np.isfinite(table)
    times, values = track.stamp_ns[kept], table[kept]
    if not len(values):
        return np.full(len(stamps), np.nan)
    overlaps = times.max() >= stamps[0] and times.min() <= stamps[-1] and np.ptp(times) > 0
    if not (track.has_header and overlaps):
        times, stamps = track.receive_ns[kept], receive
    order = np.argsort(times, kind="stable")
    at = np.searchsorted(times[order], stamps + 0.5 * period_ns, side="right") - 1
    return np.where(at >= 0, values[order][np.maximum(at, 0)], np.nan)


def _from_plant(loop: ObservedLoop, plan: Plan | None, time_ns: int) -> tuple[float, tuple[float, float]]:
    """The effort before an episode and its limits, as far as a simulated plant's parameters and its plan tell."""
    if loop.plant is None:
        return 0.0, (-math.inf, math.inf)
    values = loop.plant.at(time_ns)
    limits = (float(values.get("effort_min", -math.inf)), float(values.get("effort_max", math.inf)))
    try:
        changes = plan.plant_changes(0) if plan is not None else {}
        start = plan.start if plan is not None else None
        plant = plant_at_start(lambda at: make_plant(str(values["model"]), {**values, **at}), start, changes, limits)
        return float(plant.initial_effort), limits
    except ValueError:
        return 0.0, limits
