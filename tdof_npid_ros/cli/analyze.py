"""`tdof-npid analyze`: metrics and pictures of the episodes in bags."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from tdof_npid_ros.analysis.report import analyze
from tdof_npid_ros.case import load_case
from tdof_npid_ros.cli.choice import add_choice, choice
from tdof_npid_ros.cli.terminal import width
from tdof_npid_ros.output_file import check_outputs


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this subcommand's arguments."""
    parser.add_argument("bags", nargs="+", metavar="BAG", help="bag folders, .mcap or .db3 files; several are compared")
    parser.add_argument(
        "--case",
        metavar="FILE",
        help="parameter file that names the class of the bag's plant, for the comparison with the simulation",
    )
    add_choice(parser)
    parser.add_argument(
        "--plot", "--png", type=Path, metavar="FILE", help="picture of setpoint, output and effort"
    )  # --png: as it was called first
    parser.add_argument("--html", type=Path, metavar="FILE", help="one page with interactive plots, for any browser")
    parser.add_argument("--csv", type=Path, metavar="FILE", help="the table, numbers in full")


def run(arguments: argparse.Namespace) -> int:
    """Print the metrics of every episode and write what was asked for."""
    check_outputs([path for path in (arguments.plot, arguments.html, arguments.csv) if path], _files(arguments.bags))
    if arguments.case:
        load_case(arguments.case)  # from now on its class serves a bag whose plant bears its name
    report = analyze(arguments.bags, choice(arguments))
    written = []
    if arguments.plot:
        report.picture(arguments.plot)
        written.append(arguments.plot)
    if arguments.html:
        report.html(arguments.html)
        written.append(arguments.html)
    if arguments.csv:
        arguments.csv.write_text(report.as_csv(), encoding="utf-8")
        written.append(arguments.csv)
    if arguments.json:
        print(json.dumps(report.as_json(), allow_nan=False))
        return 0
    print(report.table(width()))
    for path in written:
        print(f"written: {path}")
    return 0


def _files(bags: list[str]) -> list[Path]:
    """The bags, and what lies in those that are folders."""
    return [file for bag in map(Path, bags) for file in (bag, *(bag.iterdir() if bag.is_dir() else ()))]
