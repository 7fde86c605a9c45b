"""The tuner with the loop that it tunes, on an installed ROS 2; all of it ends with the tuner.

ros2 launch tdof_npid_ros tuner.launch.py case:=p1-c0.5 type:=tdof_npid2 seed:=1 result:=tuned.yaml
"""

from typing import Any

from launch.actions import RegisterEventHandler
from launch.event_handlers import OnProcessExit

from launch import LaunchDescription
from tdof_npid_ros.graph.launching import LOG_LEVEL, NAMESPACE, SWITCH, Argument, description, ended, node
from tdof_npid_ros.parameter_file import find_parameter_file
from tdof_npid_ros.parameters import CONTROLLER_TYPES

FILES = "as in the parameter file"
LOOP = ("plant", "controller")
ARGUMENTS = (
    Argument("case", "p1-c0.5", "name of a file in config/, or the path of a parameter file", ("tuner",)),
    NAMESPACE,
    Argument("type", "", f"of the controller to tune; empty: {FILES}", ("tuner",), ("", *CONTROLLER_TYPES)),
    Argument("seed", "", f"the same seed gives the same result; empty: {FILES}", ("tuner",)),
    Argument("generations", "", f"of a whole population each; empty: {FILES}", ("tuner",)),
    Argument("result", "", f"parameter file to write the optimum to; empty: {FILES}", ("tuner",)),
    Argument("checkpoint", "", f"file, saved after each generation; empty: {FILES}", ("tuner",)),
    Argument("mode", "", f"lockstep or realtime; empty: {FILES}", ("plant",), ("", "lockstep", "realtime")),
    LOG_LEVEL,
    *(Argument(one, "true", f"start the {one}; false: it runs already", (), SWITCH) for one in LOOP),
)


def generate_launch_description() -> LaunchDescription:
    """Plant, controller and tuner."""
    return description(ARGUMENTS, _tuner)


def _tuner(value: dict[str, str]) -> list[Any]:
    file = str(find_parameter_file(value["case"]))
    loop = [node(one, value, ARGUMENTS, [file]) for one in LOOP if value[one] == "true"]
    tuner = node("tuner", value, ARGUMENTS, [file])
    end = OnProcessExit(target_action=tuner, on_exit=ended(loop))
    return [*loop, tuner, RegisterEventHandler(end)]
