"""`tdof-npid get`: parameters of a running node, and what the loop's nodes say of themselves."""

from __future__ import annotations

import argparse
import json
from typing import Any

from tdof_npid_ros.cli.loop_client import add_loop_arguments, client_of
from tdof_npid_ros.cli.terminal import say


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this subcommand's arguments."""
    parser.add_argument("names", nargs="*", metavar="NAME", help="parameters (default: all of the node)")
    parser.add_argument("--diagnostics", action="store_true", help="what the loop's nodes say of themselves, instead")
    add_loop_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Print them."""
    with client_of(arguments) as client:
        found: dict[str, Any]
        if arguments.diagnostics:
            found = client.diagnostics()
        else:
            remote = client.remote(arguments.node)
            client.check_names(arguments.node, arguments.names)
            found = remote.parameters(arguments.names or sorted(remote.parameter_names()))
    if arguments.json:
        print(json.dumps(found, default=str))
    else:
        say(f"{name} = {value}" for name, value in found.items())
    return 0
