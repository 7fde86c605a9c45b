"""The controller alone, for a robot, on an installed ROS 2; with a recorder if a bag is given.

ros2 launch tdof_npid_ros controller.launch.py params:=arm.yaml output:=joint_states name:=arm_controller bag:=bags/arm
"""

from typing import Any

from launch import LaunchDescription
from tdof_npid_ros.graph.launching import LOG_LEVEL, NAMESPACE, Argument, description, node

REMAPPED = {
    "output": "topic that the controller takes the output from: the robot's joint_states",
    "control_effort": "topic that the efforts are published on",
    "setpoint": "topic that the controller takes the setpoint from",
}
ARGUMENTS = (
    Argument("params", None, "parameter file with gains, limits and joint_names; its section bears the name"),
    Argument("name", "controller", "of the node"),
    NAMESPACE,
    *(Argument(topic, topic, text) for topic, text in REMAPPED.items()),
    Argument("bag", "", "folder to record to; empty: no recorder", ("recorder",)),
    LOG_LEVEL,
)


def generate_launch_description() -> LaunchDescription:
    """The controller, remapped to the robot's topics."""
    return description(ARGUMENTS, _nodes)


def _nodes(value: dict[str, str]) -> list[Any]:
    remapped = [(topic, value[topic]) for topic in REMAPPED if value[topic] != topic]

    def started(executable: str, name: str) -> Any:
        return node(executable, value, ARGUMENTS, [value["params"]], name=name, remappings=remapped)

    controller = started("controller", value["name"])
    # The recorder hears the same topics, in the same way.
    return [started("recorder", "recorder"), controller] if value["bag"] else [controller]
