"""A bag, published again on an installed ROS 2; compared with a live controller if a parameter file is given.

ros2 launch tdof_npid_ros replay.launch.py bag:=bags/first rate:=2.0
ros2 launch tdof_npid_ros replay.launch.py bag:=bags/first case:=p1-c0.5
"""

from typing import Any

from launch.actions import RegisterEventHandler
from launch.event_handlers import OnProcessExit

from launch import LaunchDescription
from tdof_npid_ros.graph.launching import LOG_LEVEL, NAMESPACE, SWITCH, Argument, description, ended, node
from tdof_npid_ros.parameter_file import find_parameter_file

ARGUMENTS = (
    Argument("bag", None, "the bag to publish again", ("replay",)),
    NAMESPACE,
    Argument("rate", "", "times the recorded speed; empty: 1", ("replay",)),
    Argument("start", "", "s of the recording to leave out; empty: 0", ("replay",)),
    Argument("loop", "false", "begin again at the end", ("replay",), SWITCH),
    Argument("clock", "false", "publish /clock", ("replay",), SWITCH),
    Argument("case", "", "start a controller with this case's parameters, and compare its efforts; empty: none"),
    LOG_LEVEL,
)


def generate_launch_description() -> LaunchDescription:
    """The replay, and a controller to compare with."""
    return description(ARGUMENTS, _replay)


def _replay(value: dict[str, str]) -> list[Any]:
    if not value["case"]:
        return [node("replay", value, ARGUMENTS)]
    controller = node("controller", value, ARGUMENTS, [str(find_parameter_file(value["case"]))])
    compare = Argument("compare", "", "", ("replay",))
    replay = node("replay", {**value, "compare": "true"}, [*ARGUMENTS, compare])
    return [controller, replay, RegisterEventHandler(OnProcessExit(target_action=replay, on_exit=ended([controller])))]
