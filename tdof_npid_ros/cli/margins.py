"""`tdof-npid margins`: how far a loop is from instability."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from tdof_npid_ros.case import load_case
from tdof_npid_ros.cli.gains import add_gain_arguments, chosen_gains, headline, loop_report
from tdof_npid_ros.cli.simulate import title
from tdof_npid_ros.cli.terminal import say
from tdof_npid_ros.output_file import check_outputs
from tdof_npid_ros.parameter_file import find_parameter_file
from tdof_npid_ros.stability.margins import margins
from tdof_npid_ros.stability.picture import draw_margins


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this subcommand's arguments."""
    parser.add_argument("case", help="a case (p1-c0.5, …, sprott) or the path of a parameter file")
    add_gain_arguments(parser)
    point = "a nonlinear plant is linearised there (default: as the episode setpoint ends)"
    parser.add_argument("--setpoint", type=float, metavar="R", help=f"setpoint at which the loop rests: {point}")
    parser.add_argument("--disturbance", type=float, metavar="D", help="disturbance under which it rests")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="picture: Nyquist curve, sensitivities, responses")


def run(arguments: argparse.Namespace) -> int:
    """Print the margins, and draw them."""
    check_outputs([arguments.plot] if arguments.plot else [], [find_parameter_file(arguments.case)])
    case = load_case(arguments.case)
    gains = chosen_gains(case, arguments)
    found = margins(case, gains, setpoint=arguments.setpoint, disturbance=arguments.disturbance)
    if arguments.plot:
        draw_margins(case, gains, found, arguments.plot, f"{case.name}, {title(gains)}")
    if arguments.json:
        print(json.dumps(loop_report(case, gains) | {"margins": found.as_dict()}, allow_nan=False))
    else:
        say([headline(case, gains), *(f"  {line}" for line in found.lines())])
    return 0
