"""`tdof-npid verify`: every control effort of a bag computed again and compared bit for bit."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict

from tdof_npid_ros.analysis.verify import Verification, verify

DIFFERENT = 1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this subcommand's arguments."""
    parser.add_argument("bags", nargs="+", metavar="BAG", help="bag folders, .mcap or .db3 files")


def run(arguments: argparse.Namespace) -> int:
    """Print the account of each bag; 0 only if something was verified in each and nothing differs."""
    accounts = [verify(bag) for bag in arguments.bags]
    if arguments.json:
        print(json.dumps({"bags": [_as_json(account) for account in accounts]}, default=str))
    else:
        print("\n".join(line for account in accounts for line in account.lines()))
    return 0 if all(account.sound for account in accounts) else DIFFERENT


def _as_json(account: Verification) -> dict[str, object]:
    return {"sound": account.sound, **asdict(account)}
