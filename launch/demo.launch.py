"""The closed loop of a case on an installed ROS 2: `ros2 launch tdof_npid_ros demo.launch.py case:=p1-c0.5`."""

from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

NODES = ("recorder", "plant", "controller", "scenario")


def generate_launch_description() -> LaunchDescription:
    """One node of each kind with the parameter file of the case."""
    file = [LaunchConfiguration("case"), ".yaml"]
    parameters = PathJoinSubstitution([FindPackageShare("tdof_npid_ros"), "config", file])
    return LaunchDescription(
        [
            DeclareLaunchArgument("case", default_value="p1-c0.5", description="p1-c0.5, p1-c4, …, sprott"),
            DeclareLaunchArgument("namespace", default_value="", description="namespace of the loop"),
            *(
                Node(
                    package="tdof_npid_ros",
                    executable=node,
                    namespace=LaunchConfiguration("namespace"),
                    parameters=[parameters],
                    output="screen",
                )
                for node in NODES
            ),
        ]
    )
