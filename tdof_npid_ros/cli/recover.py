"""`tdof-npid recover`: rewrite a damaged or unfinished bag whole."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path

from tdof_npid_ros.bag.recover import recover


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this subcommand's arguments."""
    parser.add_argument("bag", type=Path, metavar="BAG", help="bag folder or .mcap file; it is not changed")
    parser.add_argument("destination", type=Path, metavar="NEW", nargs="?", help="the new bag (default: BAG-recovered)")


def run(arguments: argparse.Namespace) -> int:
    """Write the new bag and say what is missing; 0 also when something is."""
    bag = arguments.bag.absolute()
    name = bag.name if bag.is_dir() else bag.stem
    report = recover(arguments.bag, arguments.destination or bag.with_name(f"{name}-recovered"))
    if arguments.json:
        print(json.dumps({**asdict(report), "whole": report.whole}, default=str))
    else:
        print("\n".join(report.lines()))
    return 0
