"""Messages and bags for the tests, serialized by software that is not ours (`rosbags`)."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore

from tdof_npid_ros.bag.writer import BagWriter

TYPES = get_typestore(Stores.ROS2_JAZZY)
JOINT_STATE = "sensor_msgs/msg/JointState"
START_NS = 1_700_000_000_000_000_000


def budget(name: str, default: int) -> int:
    """Return how many cases to try: the environment variable, or what is right for every run."""
    return int(os.environ.get(name, default))


def stamp(nanoseconds: int) -> Any:
    return TYPES.types["builtin_interfaces/msg/Time"](nanoseconds // 10**9, nanoseconds % 10**9)


def header(nanoseconds: int, frame_id: str) -> Any:
    return TYPES.types["std_msgs/msg/Header"](stamp(nanoseconds), frame_id)


def serialize(type_name: str, message: Any, *, little_endian: bool = True) -> bytes:
    return bytes(TYPES.serialize_cdr(message, type_name, little_endian=little_endian))


def joint_state(
    nanoseconds: int = 0,
    frame_id: str = "",
    name: Sequence[str] = (),
    position: Sequence[float] = (),
    velocity: Sequence[float] = (),
    effort: Sequence[float] = (),
    *,
    little_endian: bool = True,
) -> bytes:
    """Return a serialized sensor_msgs/msg/JointState."""
    arrays = [np.array(values, np.float64) for values in (position, velocity, effort)]
    message = TYPES.types[JOINT_STATE](header(nanoseconds, frame_id), list(name), *arrays)
    return serialize(JOINT_STATE, message, little_endian=little_endian)


def write_bag(
    folder: Path,
    messages: int = 1000,
    *,
    each: Callable[[BagWriter, int], None] | None = None,
    **options: Any,
) -> list[tuple[str, int, int, bytes]]:
    """Write a bag of a loop's two topics, and return what went in; `each` is called before each message."""
    written = []
    with BagWriter(folder, **options) as writer:
        topics = {name: writer.add_topic(name, JOINT_STATE) for name in ("/output", "/control_effort")}
        for step in range(messages):
            topic = "/control_effort" if step % 2 else "/output"
            data = joint_state(step * 1000, "a1b2c3/0", position=[np.sin(step)], effort=[np.cos(step)])
            if each is not None:
                each(writer, step)
            writer.write(topics[topic], data, START_NS + step * 1000, START_NS + step * 1000 - 7, step // 2 + 1)
            written.append((topic, START_NS + step * 1000, START_NS + step * 1000 - 7, data))
    return written
