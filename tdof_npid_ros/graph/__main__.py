"""`python -m tdof_npid_ros.graph plant --ros-args …`: a node, where there is no `ros2 run`."""

from __future__ import annotations

import importlib
import sys

NODES = ("plant", "controller", "scenario", "tuner", "recorder", "replay")


def main() -> None:
    """Run the node that the first argument names."""
    if len(sys.argv) < 2 or sys.argv[1] not in NODES:
        sys.exit(f"usage: python -m tdof_npid_ros.graph {'|'.join(NODES)} [--ros-args …]")
    name = sys.argv.pop(1)
    importlib.import_module(f"tdof_npid_ros.graph.{name}_node").main()


main()
