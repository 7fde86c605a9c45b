"""What bags tell: episodes, metrics, comparison with the in-process simulation, verification. Knows files, no ROS."""

from tdof_npid_ros.analysis.errors import AnalysisError

__all__ = ["AnalysisError"]
