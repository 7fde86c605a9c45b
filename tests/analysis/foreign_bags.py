"""Bags as other people record them: robots, Float64 loops, several publishers, clocks that differ."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

JOINT_STATE = "sensor_msgs/msg/JointState"
FLOAT64 = "std_msgs/msg/Float64"
FLOAT64_ARRAY = "std_msgs/msg/Float64MultiArray"
STATE = "control_msgs/msg/MultiDOFStateStamped"
TRAJECTORY_STATE = "control_msgs/msg/JointTrajectoryControllerState"
COMMAND = "control_msgs/msg/MultiDOFCommand"
START_NS = 1_700_000_000_000_000_000
H_NS = 10_000_000
TAU = 0.2  # s: a joint follows its setpoint by 1 - exp(-t/TAU)

STORE = get_typestore(Stores.ROS2_JAZZY)
STORE.register(
    get_types_from_msg(
        "string name\nfloat64 reference\nfloat64 feedback\nfloat64 feedback_dot\nfloat64 error\nfloat64 error_dot\n"
        "float64 time_step\nfloat64 output",
        "control_msgs/msg/SingleDOFState",
    )
)
STORE.register(get_types_from_msg("std_msgs/Header header\ncontrol_msgs/SingleDOFState[] dof_states", STATE))
STORE.register(get_types_from_msg("string[] dof_names\nfloat64[] values\nfloat64[] values_dot", COMMAND))
_POINTS = "".join(
    f"\ntrajectory_msgs/JointTrajectoryPoint {name}" for name in ("reference", "feedback", "error", "output")
)
STORE.register(get_types_from_msg(f"std_msgs/Header header\nstring[] joint_names{_POINTS}", TRAJECTORY_STATE))

Message = tuple[int, str, str, Any]  # receive time in ns from the start on, topic, type, message


def follows(start: float, steps: Sequence[tuple[float, float]], tau: float = TAU) -> Callable[[float], float]:
    """The output over time of a first-order loop that begins at rest at `start`: steps are (time, setpoint)."""

    def at(t: float) -> float:
        y, since, target = start, 0.0, start
        for when, setpoint in steps:
            if t < when:
                break
            y = target + (y - target) * np.exp(-(when - since) / tau)
            since, target = when, setpoint
        return float(target + (y - target) * np.exp(-(t - since) / tau))

    return at


def header(stamp_ns: int, frame_id: str = "") -> Any:
    return STORE.types["std_msgs/msg/Header"](
        STORE.types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9)), frame_id
    )


def joints(
    values: dict[str, float] | Sequence[float], stamp_ns: int = 0, field: str = "position", **others: Sequence[float]
) -> Any:
    """A JointState with one field filled, by name or by place."""
    names = list(values) if isinstance(values, dict) else []
    numbers = list(values.values()) if isinstance(values, dict) else list(values)
    arrays = {"position": [], "velocity": [], "effort": [], field: numbers, **others}
    return STORE.types[JOINT_STATE](
        header(stamp_ns), names, *(np.array(arrays[name], np.float64) for name in ("position", "velocity", "effort"))
    )


def float64(value: float) -> Any:
    return STORE.types[FLOAT64](value)


def floats(values: Sequence[float]) -> Any:
    layout = STORE.types["std_msgs/msg/MultiArrayLayout"]([], 0)
    return STORE.types[FLOAT64_ARRAY](layout, np.array(values, np.float64))


def state(dofs: dict[str, tuple[float, float, float]], stamp_ns: int) -> Any:
    """A pid_controller's state: reference, feedback and output by joint."""
    one = STORE.types["control_msgs/msg/SingleDOFState"]
    states = [one(name, r, y, 0.0, r - y, 0.0, 0.01, u) for name, (r, y, u) in dofs.items()]
    return STORE.types[STATE](header(stamp_ns), states)


def write(folder: Path, messages: Sequence[Message]) -> Path:
    """A bag of messages, in the order of their receive times."""
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = {
            topic: writer.add_connection(topic, type_name, typestore=STORE)
            for topic, type_name in dict.fromkeys((topic, type_name) for _, topic, type_name, _ in messages)
        }
        for time_ns, topic, type_name, message in sorted(messages, key=lambda message: message[0]):
            data = STORE.serialize_cdr(message, type_name)
            writer.write(connections[topic], START_NS + time_ns, data)
    return folder


def measured(
    outputs: dict[str, Callable[[float], float]],
    seconds: float = 5.0,
    topic: str = "/joint_states",
    stamp: Callable[[int], int] = lambda time_ns: START_NS + time_ns,
    period_ns: int = H_NS,
    offset_ns: int = 0,
) -> list[Message]:
    """Joint states every period."""
    return [
        (t, topic, JOINT_STATE, joints({name: y(t / 1e9) for name, y in outputs.items()}, stamp(t)))
        for t in range(offset_ns, round(seconds * 1e9), period_ns)
    ]


def setpoints(
    told: Sequence[tuple[float, dict[str, float] | Sequence[float]]], topic: str = "/setpoint"
) -> list[Message]:
    """Setpoints at times in s; each comes just before the output of that time."""
    return [(round(t * 1e9) - 1000, topic, JOINT_STATE, joints(values)) for t, values in told]
