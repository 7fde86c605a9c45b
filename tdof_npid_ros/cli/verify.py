"""`tdof-npid verify`: what a bag's messages must be, computed again and compared bit for bit."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict

from tdof_npid_ros.analysis.account import DIFFERENT, UNCHECKED, VERIFIED, Verification
from tdof_npid_ros.analysis.verify import verify
from tdof_npid_ros.case import load_case
from tdof_npid_ros.cli.choice import add_choice, choice


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this subcommand's arguments."""
    parser.description = (
        "Exit status 0: all is checked and equal; 1: something differs; 3: nothing differs, but not all can be checked."
    )
    parser.add_argument("bags", nargs="+", metavar="BAG", help="bag folders, .mcap or .db3 files")
    parser.add_argument("--case", metavar="FILE", help="parameter file that names the class of the bag's plant")
    parser.add_argument(
        "--law-only", action="store_true", help="check the control efforts alone, nothing of plan and plant"
    )
    add_choice(parser)


def run(arguments: argparse.Namespace) -> int:
    """Print the account of each bag."""
    if arguments.case:
        load_case(arguments.case)  # from now on its class serves a bag whose plant bears its name
    accounts = [verify(bag, choice(arguments), arguments.law_only) for bag in arguments.bags]
    if arguments.json:
        print(json.dumps({"bags": [_as_json(account) for account in accounts]}, default=str))
    else:
        print("\n".join(line for account in accounts for line in account.lines()))
    found = {account.status for account in accounts}
    return next(status for status in (DIFFERENT, UNCHECKED, VERIFIED) if status in found)


def _as_json(account: Verification) -> dict[str, object]:
    return {"sound": account.sound, "status": account.status, **asdict(account)}
