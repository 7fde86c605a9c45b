"""The closed loop of a case, or of a parameter file, on an installed ROS 2.

ros2 launch tdof_npid_ros loop.launch.py case:=p1-c0.5 mode:=lockstep bag:=bags/first type:=npid
"""

from typing import Any

from launch.actions import RegisterEventHandler
from launch.event_handlers import OnProcessIO

from launch import LaunchDescription
from tdof_npid_ros.graph.launching import LOG_LEVEL, NAMESPACE, SWITCH, Argument, description, ended, node
from tdof_npid_ros.parameter_file import find_parameter_file
from tdof_npid_ros.parameters import CONTROLLER_TYPES

NODES = ("recorder", "plant", "controller", "scenario")  # in the order in which they start
ALL_PLAYED = b"all episodes played"  # the scenario says so in its log
FILES = "as in the parameter file"
ARGUMENTS = (
    Argument("case", "p1-c0.5", "name of a file in config/, or the path of a parameter file"),
    NAMESPACE,
    Argument("mode", "", f"lockstep or realtime; empty: {FILES}", ("plant", "scenario"), ("", "lockstep", "realtime")),
    Argument("type", "", f"of the controller; empty: {FILES}", ("controller",), ("", *CONTROLLER_TYPES)),
    Argument("bag", "", f"folder that the recorder writes; empty: {FILES}", ("recorder",)),
    Argument("lossless", "", f"lockstep: wait for the recorder; empty: {FILES}", ("plant", "recorder"), ("", *SWITCH)),
    Argument("publish_clock", "", f"whether the plant publishes /clock; empty: {FILES}", ("plant",), ("", *SWITCH)),
    LOG_LEVEL,
    Argument("stay", "false", "stay when all episodes have been played", (), SWITCH),
    *(Argument(one, "true", f"start the {one}", (), SWITCH) for one in NODES),
)


def generate_launch_description() -> LaunchDescription:
    """One node of each kind; they end when the episodes have been played."""
    return description(ARGUMENTS, _loop)


def _loop(value: dict[str, str]) -> list[Any]:
    file = str(find_parameter_file(value["case"]))
    nodes = {one: node(one, value, ARGUMENTS, [file]) for one in NODES if value[one] == "true"}
    if value["stay"] == "true" or "scenario" not in nodes:
        return list(nodes.values())

    def end_when_played(event: Any) -> list[Any]:
        return ended(nodes.values()) if ALL_PLAYED in event.text else []

    ends = OnProcessIO(target_action=nodes["scenario"], on_stdout=end_when_played, on_stderr=end_when_played)
    return [*nodes.values(), RegisterEventHandler(ends)]
