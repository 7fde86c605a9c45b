"""`python -m tdof_npid_ros`."""

from tdof_npid_ros.cli import entry

entry()
