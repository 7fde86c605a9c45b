"""Which field of which topic a signal is: one grammar for bags and nodes.

    /joint_states:position[elbow]                       the element that the message's names call elbow
    /cmd:data[0]                                        an element by its place
    /imu/data:angular_velocity.z                        a field of a field
    /pid/controller_state:dof_states[elbow].feedback    of an array of messages the one that bears the name
    /imu/data sensor_msgs/msg/Imu angular_velocity.z    with the type, for a topic that nobody publishes yet
    /joint_states:position                              all elements, with their names
    /pid/controller_state:dof_states.feedback           likewise, of an array of messages

An index of digits is a place, counted from 0; anything else is a name. In quotes, `['0']`, digits are a name too.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

GRAMMAR = "TOPIC:FIELD.FIELD[INDEX or NAME], or TOPIC TYPE FIELD, as in /joint_states:position[elbow]"
NAMES_OF_ELEMENTS = ("name", "names", "joint_names", "dof_names")
"""Fields that name the elements of the arrays beside them, in the order in which they are looked for."""

_TOPIC = re.compile(r"~?/?[A-Za-z_]\w*(?:/[A-Za-z_]\w*)*", re.ASCII)
_TYPE = re.compile(r"[A-Za-z]\w*/(?:msg/)?[A-Za-z]\w*", re.ASCII)
_STEP = re.compile(r"([A-Za-z]\w*)(?:\[([^\]]*)\])?", re.ASCII)
_QUOTED = re.compile(r"(['\"])(.+)\1")


class FieldPathError(ValueError):
    """A path that cannot be read, or that leads to no number; the message says what is there."""


class Step(NamedTuple):
    """A field, and which of its elements: by its place, by its name, or (None) all."""

    field: str
    element: int | str | None

    def __str__(self) -> str:
        """The step as it is written."""
        if self.element is None:
            return self.field
        is_name_of_digits = isinstance(self.element, str) and self.element.isdecimal()
        return f"{self.field}['{self.element}']" if is_name_of_digits else f"{self.field}[{self.element}]"


class Selection(NamedTuple):
    """What a path finds in a message.

    Attributes:
        names: of the values, (values,); empty where the message has none for them.
        values: float64, (values,).
    """

    names: tuple[str, ...]
    values: np.ndarray


@dataclass(frozen=True)
class FieldPath:
    """A topic and a field of its messages.

    Attributes:
        topic: as it was written.
        type: of the messages, `package/msg/Type`; empty: as the bag or the graph says.
        steps: from the message to the numbers; empty: not said, the reader chooses by the type.
    """

    topic: str
    type: str = ""
    steps: tuple[Step, ...] = ()

    @classmethod
    def parse(cls, text: str) -> FieldPath:
        """Read a path in either way of writing.

        Raises:
            FieldPathError: the text is neither.
        """
        words = text.split()
        if len(words) == 3:
            topic, type_name, path = words
        else:
            topic, colon, path = text.strip().partition(":")
            type_name = ""
            if colon and not path:
                raise _unreadable(text, "no field after the colon")
        if not _TOPIC.fullmatch(topic):
            raise _unreadable(text, f"{topic!r} is no topic")
        if type_name and not _TYPE.fullmatch(type_name):
            raise _unreadable(text, f"{type_name!r} is no message type")
        package, _, short = type_name.partition("/")
        return cls(
            topic,
            f"{package}/msg/{short.removeprefix('msg/')}" if type_name else "",
            _steps(path, text) if path else (),
        )

    def __str__(self) -> str:
        """The path as it is written."""
        if self.type:
            return f"{self.topic} {self.type} {self.path}"
        return f"{self.topic}:{self.path}" if self.steps else self.topic

    @property
    def path(self) -> str:
        """The way within a message, `position[elbow]`."""
        return ".".join(map(str, self.steps))

    def select(self, message: Any) -> Selection:
        """The numbers that the path leads to.

        Args:
            message: decoded: a mapping by field as from a bag, or an object with fields as rclpy's messages.

        Raises:
            FieldPathError: a field, name or place is not there, or what is there is no number.
        """
        names: tuple[str, ...] = ()
        value, parents = message, [message]
        for step in self.steps:
            if _is_array(value):
                value = [self._field(element, step) for element in value]
                if step.element is not None or (len(value) and _is_array(value[0])):
                    raise self._wrong(f"{step.field} is asked of an array: choose an element of that, as in [0]")
                continue
            value = self._field(value, step)
            if _is_array(value):
                names = _names(value, parents)
                if step.element is not None:
                    place = self._place(step, len(value), names)
                    value, names = value[place], names[place : place + 1]
            elif step.element is not None:
                raise self._wrong(f"{step.field} is no array, so it has no element {step.element}")
            parents.append(value)
        return Selection(names, self._numbers(value))

    def check(self, message: Any) -> None:
        """See that the fields are there, as far as an empty message (`Type()`) can tell.

        Raises:
            FieldPathError: a field is not there, or is no array although an element of it is asked for.
        """
        value = message
        for step in self.steps:
            value = self._field(value, step)
            if _is_array(value):
                return  # what is in it, only messages tell
            if step.element is not None:
                raise self._wrong(f"{step.field} is no array, so it has no element {step.element}")
        self._numbers(value)

    def _field(self, message: Any, step: Step) -> Any:
        if not _has(message, step.field):
            raise self._wrong(f"no field {step.field!r}: there are {', '.join(_fields(message)) or 'none'}")
        return _get(message, step.field)

    def _place(self, step: Step, count: int, names: Sequence[str]) -> int:
        if isinstance(step.element, int):
            if step.element >= count:
                raise self._wrong(f"{step.field} has {count} elements, so none at place {step.element}")
            return step.element
        assert step.element is not None
        if step.element not in names:
            raise self._wrong(f"no element of {step.field} is called {step.element!r}: {_told(names)}")
        return list(names).index(step.element)

    def _numbers(self, value: Any) -> np.ndarray:
        if not isinstance(value, str) and not (_is_array(value) and len(value) and isinstance(value[0], str)):
            try:
                return np.atleast_1d(np.asarray(value, dtype=np.float64))
            except (TypeError, ValueError):
                pass
        inside = value[0] if _is_array(value) and len(value) else value
        fields = ", ".join(_fields(inside))
        raise self._wrong("it leads to no number" + (f": go on to one of {fields}" if fields else ""))

    def _wrong(self, why: str) -> FieldPathError:
        return FieldPathError(f"{self}: {why}")


def _steps(path: str, text: str) -> tuple[Step, ...]:
    steps = []
    at = 0
    while at <= len(path):
        match = _STEP.match(path, at)
        if match is None or (match.end() < len(path) and path[match.end()] != "."):
            raise _unreadable(text, f"{path[at:]!r} is no field")
        steps.append(Step(match[1], _index(match[2], text)))
        at = match.end() + 1
    return tuple(steps)


def _index(index: str | None, text: str) -> int | str | None:
    if index is None:
        return None
    if index.isdecimal() and index.isascii():
        return int(index)
    quoted = _QUOTED.fullmatch(index)
    name = quoted[2] if quoted else index.strip()
    if not name or name.startswith("-"):
        raise _unreadable(text, f"[{index}] is neither a name nor a place, which is counted from 0")
    return name


def _unreadable(text: str, why: str) -> FieldPathError:
    return FieldPathError(f"{text!r} is no field of a topic: {why}; write {GRAMMAR}")


def _is_array(value: Any) -> bool:
    return not isinstance(value, (str, bytes, Mapping)) and hasattr(value, "__len__")


def _fields(value: Any) -> list[str]:
    if isinstance(value, Mapping):
        return list(value)
    of_message = getattr(value, "get_fields_and_field_types", None)
    return list(of_message()) if of_message is not None else []


def _has(value: Any, field: str) -> bool:
    return field in _fields(value)


def _get(value: Any, field: str) -> Any:
    return value[field] if isinstance(value, Mapping) else getattr(value, field)


def _names(array: Any, parents: Sequence[Any]) -> tuple[str, ...]:
    """The names of an array's elements: their own, or those in a message around it, the nearest first."""
    if len(array) and _fields(array[0]):
        own = [_get(element, "name") if _has(element, "name") else None for element in array]
        return tuple(map(str, own)) if all(isinstance(name, str) for name in own) else ()
    for parent in reversed(parents):
        for field in NAMES_OF_ELEMENTS:
            names = _get(parent, field) if _has(parent, field) else ()
            if _is_array(names) and len(names) == len(array) and all(isinstance(name, str) for name in names):
                return tuple(map(str, names))
    return ()


def _told(names: Sequence[str]) -> str:
    return f"there are {', '.join(names)}" if names else "the message names none, so choose by place, as in [0]"
