"""The loops that a bag shows, whoever recorded them: output, setpoint, effort and disturbance as tracks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from tdof_npid_ros.analysis.errors import AnalysisError
from tdof_npid_ros.analysis.parameters import read_histories
from tdof_npid_ros.analysis.recording import Loop, Signal, Surroundings, signal_of
from tdof_npid_ros.analysis.sources import (
    NOTHING_CHOSEN,
    Chosen,
    Role,
    Source,
    announced,
    candidates,
    leaf_of,
    read_track,
    resolved,
    states,
    told_topics,
)
from tdof_npid_ros.analysis.tracks import Track, by_place, on_one_clock
from tdof_npid_ros.bag.reader import BagReader
from tdof_npid_ros.field_path import FieldPath, Step
from tdof_npid_ros.names import namespace_of
from tdof_npid_ros.wire import JOINT_STATE, AnswerLabel

OUTPUT, SETPOINT, EFFORT, DISTURBANCE = "output", "setpoint", "control_effort", "disturbance"  # as our nodes call them
NO_OUTPUTS: Final = (SETPOINT, EFFORT, DISTURBANCE, "controller_state", "manual_effort", "tuning_progress")
SCALARS: Final = ("std_msgs/msg/Float64", "std_msgs/msg/Float32")


@dataclass(frozen=True)
class ObservedLoop(Surroundings):
    """One loop in a bag.

    Attributes:
        output: what is controlled.
        setpoint: as its topic tells it; None in a bag without.
        effort: the controller's; None in a bag without.
        acted_on: the setpoint that the efforts bear, by their messages; None if they bear none.
        disturbance: None in a bag without.
        notes: what was guessed or mended, for people.
        hint: where a setpoint might be, if none was found.
    """

    output: Track
    setpoint: Track | None
    effort: Track | None
    acted_on: Track | None
    disturbance: Track | None
    notes: tuple[str, ...]
    hint: str


class _Roles(NamedTuple):
    """Which source plays which role, and the namespace of the controller."""

    namespace: str
    output: Source
    setpoint: Source | None
    effort: Source | None

    @property
    def is_driven(self) -> bool:
        return self.setpoint is not None or self.effort is not None


class _Tracks(NamedTuple):
    output: Track
    setpoint: Track | None
    effort: Track | None
    acted_on: Track | None
    disturbance: Track | None


def observed_loops(reader: BagReader, bag: str, chosen: Chosen = NOTHING_CHOSEN) -> list[ObservedLoop]:
    """The loops in a bag; joints that come in messages of their own are loops of their own.

    Raises:
        AnalysisError: no topic can be an output, or what was chosen is not there.
        BagError: the bag is damaged.
    """
    histories = read_histories(reader)
    return [
        loop
        for roles in _loops(reader, bag, chosen)
        for loop in _observed(reader, Surroundings.read(reader, bag, roles.namespace, histories), roles)
    ]


def recorded_loops(reader: BagReader, bag: str, chosen: Chosen = NOTHING_CHOSEN) -> list[Loop]:
    """The loops in a bag with the messages of our own controller, for what computes its answers again.

    Raises:
        AnalysisError: no topic can be an output, or the efforts that were chosen are not our controller's.
        BagError: the bag is damaged.
    """
    histories = read_histories(reader)
    found = []
    for roles in _loops(reader, bag, chosen):
        around = Surroundings.read(reader, bag, roles.namespace, histories)
        topic = _answers_topic(reader, roles.effort)
        output = roles.output
        is_signal = _type(reader, output) == JOINT_STATE and output.path.path == "position"
        found.append(
            Loop(
                bag,
                around.namespace,
                around.plans,
                around.plan_times,
                histories,
                output.topic,
                signal_of(reader, output.topic) if is_signal else _as_signal(read_track(reader, output)),
                topic,
                signal_of(reader, topic) if topic else None,
            )
        )
    return found


def _answers_topic(reader: BagReader, effort: Source | None) -> str:
    """The topic of our controller's answers; empty where the efforts are another's."""
    if effort is None:
        return ""
    if _type(reader, effort) == JOINT_STATE and effort.path.path == "effort":
        return effort.topic
    if effort.told:
        raise AnalysisError(
            f"--effort {effort.path}: only our controller's answers can be computed again: {JOINT_STATE}, whose "
            "frame_id names the parameters"
        )
    return ""


def _as_signal(track: Track) -> Signal:
    """A track as if it were a JointState's position."""
    count = len(track)
    name, position, nothing = np.empty((3, count), object)
    for rows in (name, position, nothing):
        rows[:] = [np.empty(0)] * count
    for layout in track.layouts:
        for row, values in zip(layout.rows.tolist(), layout.values, strict=True):
            position[row] = values
            name[row] = np.array([key for key in layout.keys if isinstance(key, str)])
    zeros = np.zeros(count, np.int64)
    return Signal(track.stamp_ns, track.frame_id, track.receive_ns, zeros, name, position, nothing, nothing)


# Which topics


def _loops(reader: BagReader, bag: str, chosen: Chosen) -> list[_Roles]:
    setpoint = resolved(reader, bag, "setpoint", chosen.setpoint) if chosen.setpoint else None
    effort = resolved(reader, bag, "effort", chosen.effort) if chosen.effort else None
    if chosen.output is not None:
        outputs = [resolved(reader, bag, "output", chosen.output)]
    else:
        outputs = _possible_outputs(reader, bag)
    return [roles for output in outputs for roles in _roles(reader, output, setpoint, effort)]


def _possible_outputs(reader: BagReader, bag: str) -> list[Source]:
    """Our own `output`; else what is driven by a setpoint or effort; else any joint states; else any JointState."""
    by_name = candidates(reader, "output")
    signals = [source for source in by_name if _type(reader, source) == JOINT_STATE]
    ours = [replace(source, guessed=False) for source in signals if leaf_of(source.topic) == OUTPUT]
    if ours:
        return ours
    joint_states = [replace(source, guessed=False) for source in signals]
    others = {source.topic: source for source in (*by_name, *states(reader, "output")) if source not in signals}
    driven = [
        source
        for source in (*joint_states, *others.values())
        if any(roles.is_driven for roles in _roles(reader, source, None, None))
    ]
    any_signal = [
        Source("output", _field(topic, "position"))
        for topic, info in sorted(reader.topics.items())
        if info.type == JOINT_STATE and info.count and leaf_of(topic) not in NO_OUTPUTS
    ]
    possible = driven or joint_states or any_signal or list(others.values())
    if not possible:
        raise AnalysisError(
            f"{bag}: no output in it that can be told by its name: choose one with --output TOPIC:FIELD; its topics "
            f"are {told_topics(reader) or 'none'}"
            + "".join(f"; missing: {line}" for line in (*reader.missing, *reader.left_out))
        )
    return possible


def _roles(reader: BagReader, output: Source, setpoint: Source | None, effort: Source | None) -> list[_Roles]:
    """The loops of an output: the one in its namespace, or those of controllers in other namespaces."""
    same = {role: _of_topic(states(reader, role), output.topic) for role in (_SETPOINT, _EFFORT)}
    if any(same.values()):
        return [_Roles(output.namespace, output, setpoint or same[_SETPOINT], effort or same[_EFFORT])]
    here = _in_namespace(reader, output, output.namespace)
    if not (here.is_driven or setpoint or effort):
        elsewhere = [_in_namespace(reader, output, name) for name in _controllers_elsewhere(reader, output)]
        if elsewhere:
            return elsewhere
    namespace = effort.namespace if effort is not None else output.namespace
    return [here._replace(namespace=namespace, setpoint=setpoint or here.setpoint, effort=effort or here.effort)]


_SETPOINT: Final[Role] = "setpoint"
_EFFORT: Final[Role] = "effort"


def _of_topic(sources: list[Source], topic: str) -> Source | None:
    return next((source for source in sources if source.topic == topic), None)


def _in_namespace(reader: BagReader, output: Source, namespace: str) -> _Roles:
    """The output with the likeliest setpoint and effort of a namespace."""
    setpoint, effort = (_beside(reader, output, role, namespace) for role in (_SETPOINT, _EFFORT))
    return _Roles(namespace, output, setpoint, effort)


def _beside(reader: BagReader, output: Source, role: Role, namespace: str) -> Source | None:
    """The likeliest setpoint or effort of a namespace: scalars go with scalars, arrays with arrays."""
    for source in candidates(reader, role, namespace):
        is_scalar, is_output_scalar = (_type(reader, each) in SCALARS for each in (source, output))
        if source.topic != output.topic and is_scalar == is_output_scalar:
            is_ours = _type(reader, source) == JOINT_STATE and leaf_of(source.topic) in (SETPOINT, EFFORT)
            return replace(source, guessed=not is_ours or namespace != output.namespace)
    return _answers(reader, output, namespace) if role == _EFFORT else None


def _answers(reader: BagReader, output: Source, namespace: str) -> Source | None:
    """Answers of our controller in a namespace, on a topic that bears another name: told by the digest they bear."""
    for topic, info in sorted(reader.topics.items()):
        is_signal = info.type == JOINT_STATE and info.count and topic not in reader.unreadable
        if not is_signal or namespace_of(topic) != namespace or leaf_of(topic) in NO_OUTPUTS or topic == output.topic:
            continue
        frames = set(reader.columns(topic, ["header.frame_id"])["header.frame_id"].tolist())
        if frames and all(AnswerLabel.parse(frame).is_ours for frame in frames):
            return Source(_EFFORT, _field(topic, "effort"), guessed=True)
    return None


def _controllers_elsewhere(reader: BagReader, output: Source) -> list[str]:
    """Namespaces with a setpoint or effort for joints of this output, and no output of their own."""
    measured = set(read_track(reader, output).keys)
    taken = {source.namespace for source in candidates(reader, "output")}
    found = []
    for namespace in sorted({namespace_of(topic) for topic in reader.topics} - taken):
        roles = _in_namespace(reader, output, namespace)
        sources = [source for source in (roles.setpoint, roles.effort) if source is not None]
        driven = {key for source in sources for key in read_track(reader, source).keys}
        names = {key for key in driven if isinstance(key, str)}
        if names & measured or (driven and not names and len(driven) == len(measured)):
            found.append(namespace)
    return found


# What they tell


def _observed(reader: BagReader, surroundings: Surroundings, roles: _Roles) -> Iterator[ObservedLoop]:
    tracks, clock_note = _on_one_clock(_tracks(reader, roles))
    notes = [announced((roles.output, roles.setpoint, roles.effort)), clock_note]
    known = {source.topic for source in (roles.output, roles.effort) if source is not None}
    others = told_topics(reader, known)
    hint = f"choose it with --setpoint TOPIC:FIELD of {others}" if others else ""
    for group in tracks.output.groups():
        output, stamp_note = _with_stamps(group, roles.output.topic)
        setpoint, effort = (
            by_place(track) if track and source and source.told and len(output.keys) == 1 else track
            for track, source in ((tracks.setpoint, roles.setpoint), (tracks.effort, roles.effort))
        )
        yield ObservedLoop(
            surroundings.bag,
            surroundings.namespace,
            surroundings.plans,
            surroundings.plan_times,
            surroundings.histories,
            output,
            setpoint,
            effort,
            tracks.acted_on,
            tracks.disturbance,
            tuple(note for note in (*notes, stamp_note) if note),
            hint,
        )


def _tracks(reader: BagReader, roles: _Roles) -> _Tracks:
    output = read_track(reader, roles.output)
    setpoint, effort = (
        None if source is None else read_track(reader, source) for source in (roles.setpoint, roles.effort)
    )
    acted_on = None
    if roles.effort is not None and _type(reader, roles.effort) == JOINT_STATE:
        acted_on = read_track(reader, Source("setpoint", _field(roles.effort.topic, "position")))
        if not acted_on.layouts or (roles.setpoint is not None and roles.setpoint.told):
            acted_on = None
    topic = roles.namespace + DISTURBANCE
    is_there = topic in reader.topics and topic not in reader.unreadable
    has_disturbance = is_there and reader.topics[topic].type == JOINT_STATE
    disturbance = read_track(reader, Source("effort", _field(topic, "effort"))) if has_disturbance else None
    return _Tracks(output, setpoint, effort, acted_on, disturbance)


def _on_one_clock(tracks: _Tracks) -> tuple[_Tracks, str | None]:
    found, note = on_one_clock([track for track in tracks if track is not None])
    clocked = iter(found)
    return _Tracks(*(None if track is None else next(clocked) for track in tracks)), note  # type: ignore[arg-type]


def _with_stamps(track: Track, topic: str) -> tuple[Track, str | None]:
    """The track with the receive times as stamps, where the stamps tell no time."""
    stamps = track.stamp_ns
    if len(stamps) < 2 or (stamps != stamps[0]).any():
        return track, None
    mended = replace(track, stamp_ns=track.receive_ns)
    if not track.has_header:
        return mended, None
    what = "never changes" if stamps[0] else "is never set"
    return mended, f"{topic}: header.stamp {what}: its times are those of receiving"


def _type(reader: BagReader, source: Source) -> str:
    return reader.topics[source.topic].type


def _field(topic: str, field: str) -> FieldPath:
    return FieldPath(topic, "", (Step(field, None),))
