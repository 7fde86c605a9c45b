"""Nonlinear two-degree-of-freedom PID control loops as ROS 2 nodes."""

__version__ = "0.1.0"
