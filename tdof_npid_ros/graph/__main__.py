"""`python -m tdof_npid_ros.graph NODE [arguments]` runs a node; `ros2 run` calls the functions below.

`NODE --help` prints its parameters, and needs no ROS.

The node is imported in here, so that Ctrl-C ends it at once and quietly, also while it is still being loaded.
"""

from __future__ import annotations

import ctypes
import importlib
import os
import signal
import sys
from types import FrameType

from tdof_npid_ros.graph import NEEDS_ROS, ros_is_missing
from tdof_npid_ros.reference import node_help
from tdof_npid_ros.streams import prepare_streams

MODULES = {
    "plant": "plant.node",
    "controller": "controller_node",
    "scenario": "scenario_node",
    "tuner": "tuner.node",
    "recorder": "recorder.node",
    "replay": "replay_node",
}


PARENT = "TDOF_NPID_PARENT"  # environment variable: the process that this one must not outlive
PR_SET_PDEATHSIG = 1


def end_with_parent() -> None:
    """Have this process told to stop when the one that started it as a part of itself has ended, however it ended."""
    parent = os.environ.pop(PARENT, "")
    if not parent or sys.platform != "linux":
        return
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGINT)  # it holds for what this process executes, too
    if str(os.getppid()) != parent:  # it has ended meanwhile
        os._exit(0)


def run(node: str, arguments: list[str]) -> None:
    """Run a node with its command line's arguments, the program's name first."""
    prepare_streams()
    if {"-h", "--help"} & set(arguments[1:]):
        print(node_help(node))
        return
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _leave)
    end_with_parent()
    try:
        module = importlib.import_module(f"tdof_npid_ros.graph.{MODULES[node]}")
    except ModuleNotFoundError as error:
        if not ros_is_missing(error):
            raise
        print(f"{node}: {NEEDS_ROS}", file=sys.stderr)
        sys.exit(2)
    module.main(arguments)


def _leave(number: int, frame: FrameType | None) -> None:
    """End at once: there is nothing to put in order before the node is there and takes the signals itself."""
    os._exit(0)


def plant() -> None:
    """Run the plant."""
    run("plant", sys.argv)


def controller() -> None:
    """Run the controller."""
    run("controller", sys.argv)


def scenario() -> None:
    """Run the scenario."""
    run("scenario", sys.argv)


def tuner() -> None:
    """Run the tuner."""
    run("tuner", sys.argv)


def recorder() -> None:
    """Run the recorder."""
    run("recorder", sys.argv)


def replay() -> None:
    """Run the replay."""
    run("replay", sys.argv)


if __name__ == "__main__":
    if len(sys.argv) < 2 or sys.argv[1] not in MODULES:
        print(
            f"usage: python -m tdof_npid_ros.graph {{{','.join(MODULES)}}} [--help] [--ros-args ...]", file=sys.stderr
        )
        sys.exit(2)
    run(sys.argv[1], sys.argv[1:])
