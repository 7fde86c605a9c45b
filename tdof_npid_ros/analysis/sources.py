"""Which topics and fields of a bag are a loop's output, setpoint and effort: as told, or guessed and announced."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np

from tdof_npid_ros.analysis.errors import AnalysisError
from tdof_npid_ros.analysis.tracks import Layout, Track, layouts_of
from tdof_npid_ros.bag.reader import BagReader
from tdof_npid_ros.field_path import NAMES_OF_ELEMENTS, FieldPath, FieldPathError, Selection, Step
from tdof_npid_ros.names import namespace_of
from tdof_npid_ros.wire import JOINT_STATE, SECOND

Role = Literal["output", "setpoint", "effort"]

# The field of a message that plays a role, where only the topic is said.
FIELDS: Final[Mapping[str, Mapping[Role, str]]] = {
    JOINT_STATE: {"output": "position", "setpoint": "position", "effort": "effort"},
    **{
        f"std_msgs/msg/{name}": {"output": "data", "setpoint": "data", "effort": "data"}
        for name in ("Float64", "Float32", "Float64MultiArray", "Float32MultiArray")
    },
    "control_msgs/msg/MultiDOFStateStamped": {
        "output": "dof_states.feedback",
        "setpoint": "dof_states.reference",
        "effort": "dof_states.output",
    },
    "control_msgs/msg/SingleDOFStateStamped": {
        "output": "dof_state.feedback",
        "setpoint": "dof_state.reference",
        "effort": "dof_state.output",
    },
    "control_msgs/msg/JointControllerState": {"output": "process_value", "setpoint": "set_point", "effort": "command"},
    "control_msgs/msg/JointTrajectoryControllerState": {
        "output": "feedback.positions",
        "setpoint": "reference.positions",
        "effort": "output.effort",
    },
    "control_msgs/msg/MultiDOFCommand": {"setpoint": "values", "effort": "values"},
    "trajectory_msgs/msg/JointTrajectory": {"setpoint": "points[0].positions", "effort": "points[0].effort"},
}
# What topics of each role are called, the likeliest first.
LEAVES: Final[Mapping[Role, Sequence[str]]] = {
    "output": ("output", "joint_states", "state", "feedback", "measurement", "process_value"),
    "setpoint": ("setpoint", "reference", "set_point", "target", "ref"),
    "effort": ("control_effort", "effort", "command", "cmd"),
}
OPTIONS: Final = "--output, --setpoint and --effort"
_MOST_TOLD = 12  # topics in a message


@dataclass(frozen=True)
class Chosen:
    """The topics and fields that a user names; None: to be guessed."""

    output: FieldPath | None = None
    setpoint: FieldPath | None = None
    effort: FieldPath | None = None

    @classmethod
    def read(cls, output: str | None, setpoint: str | None, effort: str | None) -> Chosen:
        """The choice as it was written.

        Raises:
            AnalysisError: one is no path.
        """
        try:
            return cls(*(None if text is None else FieldPath.parse(text) for text in (output, setpoint, effort)))
        except FieldPathError as error:
            raise AnalysisError(str(error)) from None


NOTHING_CHOSEN = Chosen()


@dataclass(frozen=True)
class Source:
    """A field of a topic in a bag, in a role.

    Attributes:
        path: with the topic as the bag has it, and the field.
        guessed: nobody told it, and it is not what our own loops call it.
        told: by the user.
    """

    role: Role
    path: FieldPath
    guessed: bool = False
    told: bool = False

    @property
    def topic(self) -> str:
        """The topic as the bag has it."""
        return self.path.topic

    @property
    def namespace(self) -> str:
        """Of the topic; ends with a slash."""
        return namespace_of(self.topic)


def leaf_of(topic: str) -> str:
    """A topic's name in its namespace."""
    return topic.rpartition("/")[2]


def resolved(reader: BagReader, bag: str, role: Role, path: FieldPath) -> Source:
    """What a user's choice means in this bag.

    Raises:
        AnalysisError: there is no such topic, or of its type no field is known to play the role.
    """
    topic = path.topic if path.topic in reader.topics else f"/{path.topic}"
    if topic not in reader.topics:
        raise AnalysisError(f"{bag}: --{role} {path}: no topic {path.topic}; in it are {told_topics(reader) or 'none'}")
    type_name = reader.topics[topic].type
    if path.type and path.type != type_name:
        raise AnalysisError(f"{bag}: --{role} {path}: {topic} is of type {type_name}")
    field = FIELDS.get(type_name, {}).get(role)
    if not path.steps and field is None:
        raise AnalysisError(
            f"{bag}: --{role} {path}: say which field of {type_name}, as in {topic}:FIELD; there are "
            + ", ".join(_paths(reader, topic))
        )
    return Source(role, replace(path, topic=topic, steps=path.steps or _steps(field or "")), told=True)


def candidates(reader: BagReader, role: Role, namespace: str | None = None) -> list[Source]:
    """Topics that may play a role by their type and name, the likeliest first; of one namespace, or of all."""
    found = []
    for rank, leaf in enumerate(LEAVES[role]):
        for topic, info in sorted(reader.topics.items()):
            field = FIELDS.get(info.type, {}).get(role)
            if field is None or not info.count or leaf_of(topic) != leaf or topic in reader.unreadable:
                continue
            if namespace is None or namespace_of(topic) == namespace:
                found.append((rank, topic, Source(role, FieldPath(topic, "", _steps(field)), guessed=True)))
    return [source for _, _, source in sorted(found, key=lambda item: item[:2])]


def states(reader: BagReader, role: Role) -> list[Source]:
    """Topics that tell a controller's whole state: output, setpoint and effort in one message."""
    return [
        Source(role, FieldPath(topic, "", _steps(FIELDS[info.type][role])), guessed=True)
        for topic, info in sorted(reader.topics.items())
        if info.type.startswith("control_msgs/")
        and len(FIELDS.get(info.type, {})) == 3
        and info.count
        and topic not in reader.unreadable
    ]


def told_topics(reader: BagReader, without: Collection[str] = ()) -> str:
    """The bag's topics with messages that can be read, and their types; empty if there are none but `without`."""
    without = {*without, *reader.unreadable, *(topic for topic, info in reader.topics.items() if not info.count)}
    told = [f"{topic} ({info.type})" for topic, info in sorted(reader.topics.items()) if topic not in without]
    more = f" and {len(told) - _MOST_TOLD} more" if len(told) > _MOST_TOLD else ""
    return ", ".join(told[:_MOST_TOLD]) + more


def announced(sources: Iterable[Source | None]) -> str | None:
    """What was guessed, for people; None where nothing was."""
    used = [source for source in sources if source is not None]
    if not any(source.guessed for source in used):
        return None
    told = ", ".join(f"{source.role} {source.path}" for source in used)
    return f"taken as {told}; choose others with {OPTIONS}"


def read_track(reader: BagReader, source: Source) -> Track:
    """The messages of a source; their receive times are still the publish times.

    Raises:
        AnalysisError: the field is not in the messages.
        BagError: the topic cannot be read.
    """
    try:
        return _from_columns(reader, source) or _from_messages(reader, source)
    except FieldPathError as error:
        raise AnalysisError(str(error)) from None


def _from_columns(reader: BagReader, source: Source) -> Track | None:
    """By columns, which is fast: where the path leads through no array of messages."""
    steps = source.path.steps
    fields = reader.fields(source.topic)
    path = ".".join(step.field for step in steps)
    element = steps[-1].element
    names_at = _names_fields(fields, steps)
    through_arrays = any("[" in fields.get(".".join(s.field for s in steps[:i]), "") for i in range(1, len(steps)))
    if path not in fields or through_arrays or len(names_at) > 1 or (isinstance(element, str) and not names_at):
        return None
    header = [name for name in ("header.stamp", "header.frame_id") if name in fields]
    columns = reader.columns(source.topic, [path, *names_at, *header])
    values = columns[path]
    if values.dtype == object:
        if not all(isinstance(value, np.ndarray) and value.dtype.kind in "fiub" for value in values):
            return None
    elif values.dtype.kind in "fiub":
        values = (values if values.ndim == 2 else values[:, None]).astype(np.float64, copy=False)
    else:
        return None
    names = columns[names_at[0]] if names_at else np.empty((len(values), 0), "U1")
    track = _track(reader, source, columns, layouts_of(names, values))
    return track if element is None else _element(track, source.path, element)


def _names_fields(fields: Mapping[str, str], steps: Sequence[Step]) -> list[str]:
    """Fields that may name the elements of an array, beside it or in a message around it."""
    around = ["".join(f"{step.field}." for step in steps[:depth]) for depth in range(len(steps))]
    found = [prefix + field for prefix in around for field in NAMES_OF_ELEMENTS]
    return [name for name in found if fields.get(name, "").startswith("string[")]


def _element(track: Track, path: FieldPath, element: int | str) -> Track:
    """One element of each message, by name or place."""
    layouts = []
    for layout in track.layouts:
        if isinstance(element, int) and element < len(layout.keys):
            at = element
        elif element in layout.keys and isinstance(element, str):
            at = layout.keys.index(element)
        else:
            continue
        layouts.append(Layout(layout.keys[at : at + 1], layout.rows, layout.values[:, at : at + 1]))
    if not layouts:
        names = ", ".join(map(str, track.keys)) or "no elements"
        raise FieldPathError(f"{path}: no message has that element: there are {names}")
    return replace(track, layouts=tuple(layouts))


def _from_messages(reader: BagReader, source: Source) -> Track:
    """Message by message, for any path."""
    found: list[Selection] = []
    failure: FieldPathError | None = None
    log, publish, stamps, frames = [], [], [], []
    for log_ns, publish_ns, message in reader.decoded(source.topic):
        try:
            selection = source.path.select(message)
        except FieldPathError as error:
            failure, selection = error, Selection((), np.empty(0))
        found.append(selection)
        log.append(log_ns)
        publish.append(publish_ns)
        header = message.get("header", {})
        if "stamp" in header:
            stamps.append(header["stamp"]["sec"] * SECOND + header["stamp"]["nanosec"])
        frames.append(header.get("frame_id", ""))
    if failure is not None and not any(len(selection.values) for selection in found):
        raise failure
    names, values = np.empty((2, len(found)), object)
    for i, selection in enumerate(found):
        names[i], values[i] = selection.names, selection.values
    columns = {
        "log_time": np.array(log, np.int64),
        "publish_time": np.array(publish, np.int64),
        "header.frame_id": np.array(frames, object),
    }
    if stamps:
        columns["header.stamp"] = np.array(stamps, np.int64)
    return _track(reader, source, columns, layouts_of(names, values))


def _track(reader: BagReader, source: Source, columns: Mapping[str, np.ndarray], layouts: tuple[Layout, ...]) -> Track:
    count = len(columns["log_time"])
    return Track(
        str(source.path),
        columns.get("header.stamp", np.zeros(count, np.int64)),
        columns["publish_time"],
        columns["log_time"],
        columns.get("header.frame_id", np.full(count, "", "U1")),
        layouts,
        has_header="header.stamp" in columns,
        for_all=reader.topics[source.topic].type == JOINT_STATE,
    )


def _paths(reader: BagReader, topic: str) -> list[str]:
    return list(reader.fields(topic)) if topic not in reader.unreadable else []


def _steps(path: str) -> tuple[Step, ...]:
    return FieldPath.parse(f"/topic:{path}").steps
