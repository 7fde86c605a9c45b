"""Bags of a loop, made in process: the compiled loop's trajectories, written as the nodes would have published them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore

from tdof_npid_ros.bag.writer import BagWriter
from tdof_npid_ros.case import Case
from tdof_npid_ros.control.controller import parameters_digest
from tdof_npid_ros.control.gains import Gains
from tdof_npid_ros.plants.start import plant_at_start

TYPES = get_typestore(Stores.ROS2_JAZZY)
JOINT_STATE = "sensor_msgs/msg/JointState"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
EVENT = "rcl_interfaces/msg/ParameterEvent"
START_NS = 1_700_000_000_000_000_000
STEP_NS = 100_000  # between two messages in the bag


def joint_state(
    stamp_ns: int,
    frame_id: str,
    position: Sequence[float] = (),
    effort: Sequence[float] = (),
    velocity: Sequence[float] = (),
    names: Sequence[str] = (),
) -> bytes:
    arrays = [np.array(values, np.float64) for values in (position, velocity, effort)]
    return _cdr(JOINT_STATE, TYPES.types[JOINT_STATE](_header(stamp_ns, frame_id), list(names), *arrays))


def plan_message(plan: Any) -> bytes:
    point = TYPES.types["trajectory_msgs/msg/JointTrajectoryPoint"]
    duration = TYPES.types["builtin_interfaces/msg/Duration"]
    nothing = np.zeros(0)
    points = [
        point(np.array(row, np.float64), nothing, nothing, nothing, duration(*divmod(time_ns, 10**9)))
        for time_ns, row in zip(plan.times_ns, plan.values, strict=True)
    ]
    return _cdr(TRAJECTORY, TYPES.types[TRAJECTORY](_header(0, plan.digest), list(plan.names), points))


def parameter_event(node: str, parameters: Mapping[str, Any]) -> bytes:
    value_type, parameter = (TYPES.types[f"rcl_interfaces/msg/{name}"] for name in ("ParameterValue", "Parameter"))
    kinds = {bool: (1, 1), int: (2, 2), float: (3, 3), str: (4, 4)}

    def value(content: Any) -> Any:
        fields: list[Any] = [0, False, 0, 0.0, "", np.zeros(0, np.uint8), np.zeros(0, bool)]
        fields += [np.zeros(0, np.int64), np.zeros(0), []]
        if isinstance(content, (list, tuple)):
            texts = isinstance(content[0], str)
            fields[0] = 9 if texts else 8
            fields[fields[0]] = list(content) if texts else np.array(content, np.float64)
        else:
            fields[0], at = kinds[type(content)]
            fields[at] = content
        return value_type(*fields)

    changes = [parameter(name, value(content)) for name, content in parameters.items()]
    stamp = TYPES.types["builtin_interfaces/msg/Time"](0, 0)
    return _cdr(EVENT, TYPES.types[EVENT](stamp, node, changes, [], []))


class LoopBag:
    """A bag being written as the recorder writes it, with a clock of its own."""

    def __init__(self, folder: Path, namespace: str = "/") -> None:
        self.writer = BagWriter(folder)
        self.namespace = namespace
        self.now_ns = START_NS
        self._topics: dict[str, int] = {}
        self._sequence: dict[str, int] = {}

    def write(self, topic: str, type_name: str, data: bytes) -> None:
        name = topic if topic.startswith("/") else self.namespace + topic
        if name not in self._topics:
            self._topics[name] = self.writer.add_topic(name, type_name)
        self._sequence[name] = self._sequence.get(name, 0) + 1
        self.now_ns += STEP_NS
        self.writer.write(self._topics[name], data, self.now_ns, self.now_ns - 1000, self._sequence[name])

    def skip(self, topic: str) -> None:
        """A message that is lost."""
        name = self.namespace + topic
        self._sequence[name] = self._sequence.get(name, 0) + 1

    def parameters(self, node: str, values: Mapping[str, Any]) -> None:
        self.write("/parameter_events", EVENT, parameter_event(self.namespace + node, values))

    def configuration(self, case: Case, gains: Gains, **of_the_plant: Any) -> None:
        period = {"sample_period": case.sample_period}
        plant = {
            **{name: value for name, value in case.plant_values.items() if value != []},
            "model": case.model,
            "lanes": gains.lanes,
        }
        plant |= {"effort_min": case.effort_limits[0], "effort_max": case.effort_limits[1]}
        self.parameters("plant", {**plant, **period, "mode": "lockstep", **of_the_plant})
        self.parameters("controller", {**gains.as_dict(), **case.options.as_dict(), **period})
        plans = {f"plan.{name}": list(lines) for name, lines in case.episodes.items()}
        self.parameters("scenario", {"episodes": list(case.episodes), **plans, **period})

    def episode(self, case: Case, gains: Gains, name: str, number: int, lost: Sequence[int] = ()) -> None:
        """One lockstep episode; outputs and answers of the steps `lost` are missing."""
        plan, run = case.plans[name], case.simulate(name, gains)
        applied = np.clip(np.roll(run.control_effort, 1, axis=0), *case.effort_limits)
        applied[0] = plant_at_start(
            case.plant_at, plan.start, case.signals[name].segments[0].plant, case.effort_limits
        ).initial_effort
        digest = parameters_digest(gains, case.sample_period_ns, case.options)
        frame = f"{plan.digest}/{number}"
        self.write("scenario_plan", TRAJECTORY, plan_message(plan))
        for k in range(len(run.time)):
            stamp = k * case.sample_period_ns
            if k in lost:
                self.skip("output"), self.skip("control_effort")
                continue
            self.write("output", JOINT_STATE, joint_state(stamp, frame, run.output[k], applied[k]))
            setpoint = np.full(gains.lanes, run.setpoint[k])
            answer = joint_state(stamp, f"{digest} {frame}", setpoint, run.control_effort[k])
            self.write("control_effort", JOINT_STATE, answer)

    def __enter__(self) -> LoopBag:
        return self

    def __exit__(self, *_: object) -> None:
        self.writer.close()


def _header(stamp_ns: int, frame_id: str) -> Any:
    time = TYPES.types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9))
    return TYPES.types["std_msgs/msg/Header"](time, frame_id)


def _cdr(type_name: str, message: Any) -> bytes:
    return bytes(TYPES.serialize_cdr(message, type_name))
