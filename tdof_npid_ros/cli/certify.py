"""`tdof-npid certify`: whether a loop is known to come to rest from everywhere."""

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
from tdof_npid_ros.stability.certificate import certify

NOT_CERTIFIED = 1  # exit status


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this subcommand's arguments."""
    parser.add_argument("case", help="a case (p1-c0.5, …, sprott) or the path of a parameter file")
    add_gain_arguments(parser)
    parser.add_argument("--html", type=Path, metavar="FILE", help="one page: the certificate, its picture and numbers")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="the picture alone: Re G over the frequency")


def run(arguments: argparse.Namespace) -> int:
    """Print the certificate, and write its page; the exit status is 0 if the loop is certified, else 1."""
    outputs = [path for path in (arguments.html, arguments.plot) if path]
    check_outputs(outputs, [find_parameter_file(arguments.case)])
    case = load_case(arguments.case)
    gains = chosen_gains(case, arguments)
    found = certify(case, gains)
    if outputs:
        from tdof_npid_ros.stability.certificate_page import draw_certificate, write_page

        name = f"{case.name}, {title(gains)}"
        if arguments.plot:
            draw_certificate(case, gains, found, arguments.plot, name)
        if arguments.html:
            write_page(case, gains, found, arguments.html, name)
    if arguments.json:
        print(json.dumps(loop_report(case, gains) | {"certificate": found.as_dict()}, allow_nan=False))
    else:
        say([headline(case, gains), *found.lines()])
    return 0 if found.is_certified else NOT_CERTIFIED
