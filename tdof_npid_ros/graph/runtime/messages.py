"""Between ROS messages and the loop's values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from builtin_interfaces.msg import Duration, Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from tdof_npid_ros.scenario import Plan
from tdof_npid_ros.wire import SECOND

EPISODE = "episode"  # the topic
TASK = "state"  # of a node, in its diagnostics
NAMED_LANES = 8  # more are read by programs, which go by the place


def stamp_ns(stamp: Time | Duration) -> int:
    """A stamp or duration in ns."""
    return int(stamp.sec * SECOND + stamp.nanosec)


def set_stamp(stamp: Time | Duration, time_ns: int) -> None:
    """Write a time in ns into a stamp or duration."""
    stamp.sec, stamp.nanosec = divmod(time_ns, SECOND)


def time_message(time_ns: int) -> Time:
    """A stamp of a time in ns."""
    sec, nanosec = divmod(time_ns, SECOND)
    return Time(sec=sec, nanosec=nanosec)


def plan_message(plan: Plan, start_ns: int) -> JointTrajectory:
    """A plan as it is latched on `scenario_plan`; it starts at `start_ns` of the loop's time."""
    header = Header(stamp=time_message(start_ns), frame_id=plan.digest)
    message = JointTrajectory(header=header, joint_names=list(plan.names))
    for time_ns, row in zip(plan.times_ns, plan.values, strict=True):
        sec, nanosec = divmod(time_ns, SECOND)
        message.points.append(JointTrajectoryPoint(positions=row, time_from_start=Duration(sec=sec, nanosec=nanosec)))
    return message


def plan_from_message(message: JointTrajectory) -> Plan:
    """The plan that a message holds.

    Raises:
        PlanError: it is not a valid plan.
    """
    return Plan(
        tuple(message.joint_names),
        tuple(stamp_ns(point.time_from_start) for point in message.points),
        tuple(tuple(point.positions) for point in message.points),
    )


def diagnostics_message(stamp: Time, name: str, level: int, text: str, facts: Mapping[str, object]) -> DiagnosticArray:
    """One node's diagnostics, called `<node>: state` as is the custom; `name` is the node's full name."""
    status = DiagnosticStatus(
        level=bytes([level]),
        name=f"{name}: {TASK}",
        hardware_id=name,
        message=text,
        values=[KeyValue(key=key, value=str(value)) for key, value in facts.items()],
    )
    return DiagnosticArray(header=Header(stamp=stamp), status=[status])


def node_of(status: DiagnosticStatus) -> str:
    """The full name of the node whose diagnostics these are."""
    return str(status.name).partition(":")[0]


def lane_names(lanes: int) -> list[str]:
    """What a signal bears in `name`: viewers such as PlotJuggler show only values that have one."""
    return [f"lane{lane}" for lane in range(lanes)] if lanes <= NAMED_LANES else []


def signal_message(frame_id: str) -> JointState:
    """An empty signal to fill and publish again and again."""
    return JointState(header=Header(frame_id=frame_id))


def given_message(topic: str, values: Sequence[float], node: Node, joints: Sequence[str] = ()) -> JointState:
    """What somebody who steers gives on `setpoint`, `disturbance` or `manual_effort`: one value, or one per lane.

    Args:
        node: whose clock stamps it.
        joints: which of the joints a setpoint is for; none: all.
    """
    message = JointState(name=list(joints))
    message.header.stamp = node.get_clock().now().to_msg()
    setattr(message, "position" if topic == "setpoint" else "effort", [float(value) for value in values])
    return message
