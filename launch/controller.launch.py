"""The controller alone, for a robot, on an installed ROS 2; with a recorder if a bag is given.

ros2 launch tdof_npid_ros controller.launch.py params:=arm.yaml output:=joint_states name:=arm_controller bag:=bags/arm
"""

from typing import Any

from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription

# name, default, description; no default: it must be given
ARGUMENTS: tuple[tuple[str, str | None, str], ...] = (
    ("params", None, "parameter file with gains, limits and joint_names; its section bears the controller's name"),
    ("name", "controller", "of the node"),
    ("namespace", "", "namespace of the controller"),
    ("output", "output", "topic that the controller takes the output from: the robot's joint_states"),
    ("control_effort", "control_effort", "topic that the efforts are published on"),
    ("setpoint", "setpoint", "topic that the controller takes the setpoint from"),
    ("bag", "", "folder to record to; empty: no recorder"),
    ("log_level", "info", "debug, info, warn, error or fatal"),
)
REMAPPED = ("output", "control_effort", "setpoint")


def generate_launch_description() -> LaunchDescription:
    """The controller, remapped to the robot's topics."""
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=description)
        for name, default, description in ARGUMENTS
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=_nodes)])


def _nodes(context: Any) -> list[Any]:
    value = {name: LaunchConfiguration(name).perform(context) for name, *_ in ARGUMENTS}
    common = {
        "package": "tdof_npid_ros",
        "namespace": value["namespace"],
        "ros_arguments": ["--log-level", value["log_level"]],
        "output": "screen",
    }
    nodes = [
        Node(
            executable="controller",
            name=value["name"],
            parameters=[value["params"]],
            remappings=[(topic, value[topic]) for topic in REMAPPED if value[topic] != topic],
            **common,
        )
    ]
    if value["bag"]:
        nodes.append(Node(executable="recorder", name="recorder", parameters=[{"bag": value["bag"]}], **common))
    return nodes
