"""The closed loop of a case, or of a parameter file, on an installed ROS 2.

ros2 launch tdof_npid_ros loop.launch.py case:=p1-c0.5 mode:=lockstep bag:=bags/first type:=npid
"""

from typing import Any

from launch.actions import DeclareLaunchArgument, EmitEvent, OpaqueFunction, RegisterEventHandler
from launch.event_handlers import OnProcessIO
from launch.events import Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription
from tdof_npid_ros.parameter_file import find_parameter_file

SWITCH = ("true", "false")
NODES = ("recorder", "plant", "controller", "scenario")  # in the order in which they start
ALL_PLAYED = b"all episodes played"  # the scenario says so in its log
FILES = "as in the parameter file"

# name, default, choices, description; empty: as in the parameter file
ARGUMENTS: tuple[tuple[str, str, tuple[str, ...] | None, str], ...] = (
    ("case", "p1-c0.5", None, "name of a file in config/, or the path of a parameter file"),
    ("namespace", "", None, "namespace of the loop"),
    ("mode", "", ("", "lockstep", "realtime"), f"lockstep or realtime; empty: {FILES}"),
    ("type", "", ("", "pid", "npid", "tdof_npid1", "tdof_npid2"), f"of the controller; empty: {FILES}"),
    ("bag", "", None, f"folder that the recorder writes; empty: {FILES}"),
    ("lossless", "", ("", *SWITCH), f"lockstep: wait for the recorder; empty: {FILES}"),
    (
        "publish_clock",
        "",
        ("", *SWITCH),
        f"whether the plant publishes /clock; empty: {FILES}",
    ),
    ("log_level", "info", ("debug", "info", "warn", "error", "fatal"), "of all nodes"),
    ("stay", "false", SWITCH, "stay when all episodes have been played"),
    *((node, "true", SWITCH, f"start the {node}") for node in NODES),
)
# What an argument sets, and of which nodes
SETS = {
    "mode": ("plant", "scenario"),
    "type": ("controller",),
    "bag": ("recorder",),
    "lossless": ("plant", "recorder"),
    "publish_clock": ("plant",),
}


def generate_launch_description() -> LaunchDescription:
    """One node of each kind; the launch ends when the episodes have been played."""
    declared = [
        DeclareLaunchArgument(name, default_value=default, choices=choices, description=description)
        for name, default, choices, description in ARGUMENTS
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=_loop)])


def _loop(context: Any) -> list[Any]:
    value = {name: LaunchConfiguration(name).perform(context) for name, *_ in ARGUMENTS}
    file = str(find_parameter_file(value["case"]))
    nodes = {
        node: Node(
            package="tdof_npid_ros",
            executable=node,
            name=node,
            namespace=value["namespace"],
            parameters=[file, *_set(node, value)],
            ros_arguments=["--log-level", value["log_level"]],
            output="screen",
        )
        for node in NODES
        if value[node] == "true"
    }
    if value["stay"] == "true" or "scenario" not in nodes:
        return list(nodes.values())
    ends = OnProcessIO(target_action=nodes["scenario"], on_stdout=_end_when_played, on_stderr=_end_when_played)
    return [*nodes.values(), RegisterEventHandler(ends)]


def _set(node: str, value: dict[str, str]) -> list[dict[str, Any]]:
    """The parameters that the arguments set of a node: after the file, so that they hold."""
    given = {name: value[name] for name, nodes in SETS.items() if node in nodes and value[name]}
    parameters = {name: text == "true" if text in SWITCH else text for name, text in given.items()}
    return [parameters] if parameters else []


def _end_when_played(event: Any) -> list[Any]:
    return [EmitEvent(event=Shutdown(reason="all episodes played"))] if ALL_PLAYED in event.text else []
