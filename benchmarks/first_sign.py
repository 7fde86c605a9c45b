"""Runs a node and prints a line when it is up: `python -m benchmarks.first_sign NODE`."""

from __future__ import annotations

import importlib
import sys

NODES = {"controller": "ControllerNode", "plant": "PlantNode"}


def run(name: str) -> None:
    """Start the node as its `main` does, and say so."""
    import rclpy

    module = importlib.import_module(f"tdof_npid_ros.graph.{name}_node")
    rclpy.init()
    node = getattr(module, NODES[name])()
    node.trigger_configure()
    node.trigger_activate()
    print("up", flush=True)
    node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    run(sys.argv[1])
