"""`tdof-npid replay`: publish a bag again over ROS 2."""

from __future__ import annotations

import argparse
import json
import re

from tdof_npid_ros.analysis.compare import Comparison
from tdof_npid_ros.cli.choice import add_choice, choice
from tdof_npid_ros.graph.replay_node import replay
from tdof_npid_ros.names import in_namespace
from tdof_npid_ros.parameter_file import for_ros
from tdof_npid_ros.parameters import REPLAY


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this subcommand's arguments."""
    parser.add_argument("bag", metavar="BAG", help="bag folder, .mcap or .db3 file")
    parser.add_argument(
        "--rate", type=float, default=REPLAY["rate"].default, help="times the recorded speed (default 1)"
    )
    start = REPLAY["start"].default
    parser.add_argument("--start", type=float, default=start, metavar="S", help="seconds of the recording to leave out")
    parser.add_argument("--loop", action="store_true", help="begin again at the end")
    parser.add_argument("--clock", action="store_true", help="publish /clock")
    parser.add_argument("--namespace", default="/", help="where to publish (default /)")
    parser.add_argument(
        "--compare",
        action="store_true",
        help="give the recorded outputs to a live controller, as fast as it answers, and compare its efforts; "
        "0 if they are equal, or differ because its parameters do",
    )
    add_choice(parser)


def run(arguments: argparse.Namespace) -> int:
    """Replay to the end, or to Ctrl-C."""
    parameters = {name: getattr(arguments, name) for name in ("bag", "rate", "start", "loop", "clock", "compare")}
    chosen = choice(arguments)
    for role in ("output", "setpoint", "effort"):
        if (path := getattr(chosen, role)) is not None:
            parameters[role] = str(path)
    for_ros(arguments.bag)
    namespace = in_namespace(arguments.namespace).rstrip("/") or "/"
    if not re.fullmatch(r"/|(/[A-Za-z_]\w*)+", namespace, re.ASCII):
        raise ValueError(
            f"--namespace {arguments.namespace!r}: it must be names of letters, digits and _ between slashes"
        )
    ros = ["--ros-args", "-r", f"__ns:={namespace}"]
    for name, value in parameters.items():
        ros += ["-p", f"{name}:={json.dumps(value)}"]

    def tell(comparison: Comparison) -> None:
        if arguments.json:
            print(json.dumps(comparison.as_dict()), flush=True)
        elif comparison.lines():
            print("\n".join(comparison.lines()), flush=True)

    return replay(["replay", *ros], tell)
