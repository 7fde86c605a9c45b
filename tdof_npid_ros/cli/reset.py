"""`tdof-npid reset`: let a running loop's plant begin once more."""

from __future__ import annotations

import argparse
import json

from tdof_npid_ros.cli.loop_client import add_loop_arguments, client_of


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this subcommand's arguments."""
    add_loop_arguments(parser, with_node=False)


def run(arguments: argparse.Namespace) -> int:
    """Ask the plant for it and say what it answers."""
    with client_of(arguments) as client:
        answer = client.remote("plant").trigger("reset")
    print(json.dumps({"answer": answer}) if arguments.json else answer)
    return 0
