"""The ROS 2 graph: nodes that wire parameters, topics, services and timers to the layers below."""

from __future__ import annotations

from typing import Final

NEEDS_ROS: Final = (
    "needs ROS 2: source an installed one, or pip install 'ros-jazzy-rclpy[fastrtps]' ros-jazzy-common-interfaces"
)


def ros_is_missing(error: ModuleNotFoundError) -> bool:
    """Whether an import has failed for want of ROS 2 (and not of a module that it should have found)."""
    return (error.name or "").partition(".")[0] == "rclpy"
