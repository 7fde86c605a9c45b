"""A signal from fields of any topic, and into them: `TOPIC TYPE FIELD [SCALE [OFFSET]]`, one text per lane.

    /imu/data sensor_msgs/msg/Imu angular_velocity.z
    /imu/data sensor_msgs/msg/Imu angular_velocity.z 57.29577951308232      in degrees per s
    /boiler/temperature sensor_msgs/msg/Temperature temperature 1 273.15    in K
    /arm/commands std_msgs/msg/Float64MultiArray data[0]

What is read is SCALE times the field plus OFFSET; what is written into a field likewise.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from tdof_npid_ros.field_path import FieldPath, FieldPathError
from tdof_npid_ros.wire import NO_VALUES, SECOND, Sample

SYNTAX: Final = "TOPIC TYPE FIELD [SCALE [OFFSET]], as in /imu/data sensor_msgs/msg/Imu angular_velocity.z"
_NUMBERS: Final = re.compile(r"(?:double|float)(?:\[\d+\])?|sequence<(?:double|float)(?:, (\d+))?>")
LARGEST_PLACE: Final = 100_000  # in an array that is written: as many lanes as there may be


class Field(NamedTuple):
    """A field of a topic's messages, and how its numbers become the signal's, or the signal's become its."""

    path: FieldPath
    scale: float = 1.0
    offset: float = 0.0

    @classmethod
    def parse(cls, text: str) -> Field:
        """Read a field.

        Raises:
            FieldPathError: the text is none.
        """
        words = text.split()
        if not 3 <= len(words) <= 5:
            raise FieldPathError(f"{text!r} is no field with its type: write {SYNTAX}")
        try:
            scale, offset = [float(word) for word in words[3:]] + [1.0, 0.0][len(words) - 3 :]
        except ValueError:
            raise FieldPathError(f"{text!r}: scale and offset must be numbers: write {SYNTAX}") from None
        if not (math.isfinite(scale) and math.isfinite(offset)) or scale == 0.0:
            raise FieldPathError(f"{text!r}: scale and offset must be finite, and the scale not 0")
        return cls(FieldPath.parse(" ".join(words[:3])), scale, offset)


def parse_fields(texts: str | Sequence[str]) -> list[Field]:
    """The fields of a parameter, one per lane; none if it is empty.

    Raises:
        FieldPathError: a text is no field.
    """
    return [Field.parse(text) for text in ([texts] if isinstance(texts, str) else texts) if text.strip()]


class FieldReader:
    """Reads a signal from the messages of one topic or several.

    Args:
        fields: one per lane; or a single one that leads to an array, of which each element is a lane.
        whole: whether a sample has a new value in every lane; else it has nan in those of other topics.

    Attributes:
        types: by topic, `package/msg/Type`.

    Raises:
        FieldPathError: a topic is to have two types.
    """

    def __init__(self, fields: Sequence[Field], whole: bool = True) -> None:
        self.types: dict[str, str] = {}
        for path in (field.path for field in fields):
            if self.types.setdefault(path.topic, path.type) != path.type:
                raise FieldPathError(f"{path.topic} is to be both {self.types[path.topic]} and {path.type}: a topic "
                                     "has one type")  # fmt: skip
        self._fields, self._whole = tuple(fields), whole
        self._takes_names = len(fields) == 1 and fields[0].path.steps[-1].element is None
        self._new: dict[str, int] = {}  # topics that the next sample has values of, and their stamps
        self._values: list[np.ndarray] = [np.full(1, np.nan) for _ in fields]

    def forget(self) -> None:
        """What has come belongs to no sample any more."""
        self._new.clear()

    @property
    def awaited(self) -> list[str]:
        """Topics that the next sample waits for."""
        return [topic for topic in self.types if topic not in self._new]

    def read(self, topic: str, message: Mapping[str, Any], sent_ns: int) -> Sample | None:
        """The signal, in `position`, as of this message; None where that of other topics has to come first.

        A whole sample bears the latest of its stamps.

        Args:
            message: of the topic, decoded, by field.
            sent_ns: the stamp of a message without a header.

        Raises:
            FieldPathError: a field is not there, or the stamp is no time.
        """
        header = message.get("header")
        frame_id = ""
        if isinstance(header, Mapping) and "stamp" in header:
            sent_ns = _time_ns(int(header["stamp"]["sec"]), int(header["stamp"]["nanosec"]))
            frame_id = str(header.get("frame_id", ""))
        else:
            sent_ns = _time_ns(*divmod(sent_ns, SECOND))
        mine = [i for i, field in enumerate(self._fields) if field.path.topic == topic]
        found = [self._fields[i].path.select(message) for i in mine]
        for i, one in zip(mine, found, strict=True):  # in this order of sums on every machine
            self._values[i] = one.values * self._fields[i].scale + self._fields[i].offset
        names = found[0].names if self._takes_names else ()
        if len(self.types) == 1:
            return Sample(sent_ns, frame_id, names, np.concatenate(self._values), NO_VALUES, NO_VALUES)
        self._new[topic] = sent_ns
        if self._whole and self.awaited:
            return None
        values = [
            its if field.path.topic in self._new else np.full(len(its), np.nan)
            for its, field in zip(self._values, self._fields, strict=True)
        ]
        stamp_ns = max(self._new.values())
        self._new.clear()
        return Sample(stamp_ns, "", (), np.concatenate(values), NO_VALUES, NO_VALUES)


def _time_ns(seconds: int, nanoseconds: int) -> int:
    """A stamp in ns.

    Raises:
        FieldPathError: no message could bear it.
    """
    if not (-(2**31) <= seconds < 2**31 and 0 <= nanoseconds < SECOND):
        raise FieldPathError(f"its stamp of {seconds} s and {nanoseconds} ns is no time")
    return seconds * SECOND + nanoseconds


class FieldWriter:
    """Writes a signal into messages of one topic or several.

    Args:
        fields: one per lane; or a single one that is an array, which holds all lanes.
        new_message: an empty message of a type, `package/msg/Type`.

    Attributes:
        messages: by topic: type, and the message that `write` fills.

    Raises:
        FieldPathError: a field is not there, or cannot hold a number.
    """

    def __init__(self, fields: Sequence[Field], new_message: Any) -> None:
        self._fields = tuple(fields)
        self.messages: dict[str, tuple[str, Any]] = {}
        for field in fields:
            topic, type_name = field.path.topic, field.path.type
            known, _ = self.messages.setdefault(topic, (type_name, new_message(type_name)))
            if known != type_name:
                raise FieldPathError(f"{topic} is to be both {known} and {type_name}: a topic has one type")
        self._holds_all = len(fields) == 1 and self._is_array(fields[0])
        self.write(0, np.full(len(fields), 0.5))

    def fits(self, lanes: int) -> bool:
        """Whether there is a field for each of the lanes."""
        return self._holds_all or lanes == len(self._fields)

    def write(self, stamp_ns: int, values: np.ndarray) -> None:
        """Fill the messages with these values, (lanes,), and their headers with the stamp.

        Raises:
            FieldPathError: a field does not take its value.
        """
        for _, message in self.messages.values():
            if hasattr(message, "header"):
                message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, SECOND)
        if self._holds_all:
            field = self._fields[0]
            self._put(field, (values * field.scale + field.offset).tolist())
            return
        for field, value in zip(self._fields, values.tolist(), strict=True):
            self._put(field, value * field.scale + field.offset)

    def _is_array(self, field: Field) -> bool:
        owner, last = self._owner(field), field.path.steps[-1]
        return last.element is None and hasattr(getattr(owner, last.field, 0.0), "__len__")

    def _owner(self, field: Field) -> Any:
        """The message in which the last step's field is."""
        owner = self.messages[field.path.topic][1]
        for step in field.path.steps[:-1]:
            owner = self._there(field, owner, step.field)
            if step.element is not None:
                raise FieldPathError(f"{field.path}: {step} cannot be written into; only the last field may be indexed")
        return owner

    @staticmethod
    def _there(field: Field, owner: Any, name: str) -> Any:
        known = list(owner.get_fields_and_field_types()) if hasattr(owner, "get_fields_and_field_types") else []
        if name not in known:
            raise FieldPathError(f"{field.path}: no field {name!r}: there are {', '.join(known) or 'none'}")
        return getattr(owner, name)

    def _put(self, field: Field, value: float | list[float]) -> None:
        owner, last = self._owner(field), field.path.steps[-1]
        now, place = self._there(field, owner, last.field), last.element
        if isinstance(place, str) or (place is not None and place > LARGEST_PLACE):
            raise FieldPathError(f"{field.path}: say the place in the array, from 0 to {LARGEST_PLACE}, as in [0]")
        kind = _NUMBERS.fullmatch(owner.get_fields_and_field_types()[last.field])
        is_array = hasattr(now, "__len__")
        if kind is None or is_array != (place is not None or isinstance(value, list)):
            raise FieldPathError(
                f"{field.path}: it does not take the number {value}: it must be a float, or one's place"
            )
        if not is_array:
            setattr(owner, last.field, value)
            return
        # rclpy's messages do not look at what they are given, and the middleware ends the process over what is wrong.
        elements = list(now)
        if isinstance(value, list):
            elements = value
        elif place is not None:
            elements += [0.0] * (place + 1 - len(elements))
            elements[place] = value
        if isinstance(now, np.ndarray) and len(elements) != len(now):
            raise FieldPathError(f"{field.path}: it has {len(now)} elements, not {len(elements)}")
        if kind[1] and len(elements) > int(kind[1]):
            raise FieldPathError(f"{field.path}: it has room for {kind[1]} elements, not for {len(elements)}")
        setattr(owner, last.field, np.array(elements, now.dtype) if isinstance(now, np.ndarray) else elements)
