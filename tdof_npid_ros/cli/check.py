"""`tdof-npid check`: a parameter file, looked at as an experienced colleague would."""

from __future__ import annotations

import argparse
import json

from tdof_npid_ros.advice import advice
from tdof_npid_ros.case import load_case
from tdof_npid_ros.cli.terminal import say


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this subcommand's arguments."""
    parser.add_argument("case", metavar="CASE", help="a case's name, or the path of a parameter file")


def run(arguments: argparse.Namespace) -> int:
    """Print what is to be said; 1 if something in it is wrong."""
    case = load_case(arguments.case)
    found = advice(case)
    if arguments.json:
        print(json.dumps({"case": case.name, "advice": [one._asdict() for one in found]}))
    else:
        for one in found:
            say([f"{one.severity:8}  {one.about}: {one.text}.", f"{'':8}  → {one.remedy}."])
        if not found:
            print(f"{case.name}: nothing to say against it.")
    return int(any(one.severity == "error" for one in found))
