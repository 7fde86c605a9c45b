"""The closed loop of a case on an installed ROS 2: `ros2 launch tdof_npid_ros demo.launch.py case:=p1-c0.5`."""

from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterFile
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

CASES = ("p1-c0.5", "p1-c4", "p2-c2", "p2-c5", "p3-c1", "p3-c2", "sprott")
NODES = ("recorder", "plant", "controller", "scenario")


def generate_launch_description() -> LaunchDescription:
    """One node of each kind with the parameter file of the case."""
    case = PathJoinSubstitution([FindPackageShare("tdof_npid_ros"), "config", LaunchConfiguration("case")])
    parameters = ParameterFile([case, ".yaml"])
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "case", default_value=CASES[0], choices=CASES, description="parameter file in config/"
            ),
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
