"""`tdof-npid`: one program; each subcommand is a module of its own, imported only when it is called."""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Sequence

# Name, and its one line of help. The module is cli.<name>: add_arguments(parser) and run(arguments) -> exit status.
SUBCOMMANDS = {
    "demo": "run the paper's first process over ROS 2, end to end",
    "simulate": "run a case in process and print its metrics",
    "tune": "find the gains of a case with the hybrid genetic algorithm",
    "pareto": "the trade-off between tracking and rejection (the paper's Figure 6)",
    "reproduce": "every table and figure of the paper, published beside ours",
    "analyze": "metrics and pictures of the episodes in bags",
    "verify": "recompute every control effort of a bag and compare bit for bit",
    "recover": "rewrite a damaged or unfinished bag whole",
    "replay": "publish a bag again over ROS 2",
    "bench": "measure the claims about speed on this machine",
}
USAGE_ERROR = 2


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; returns its exit status: 0 only on success, 2 for bad input."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    parser = argparse.ArgumentParser(prog="tdof-npid", description="Nonlinear two-degree-of-freedom PID control loops.")
    subparsers = parser.add_subparsers(dest="subcommand", metavar="SUBCOMMAND", required=True)
    for name, text in SUBCOMMANDS.items():
        subparser = subparsers.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        subparser.add_argument("--json", action="store_true", help="print one JSON object, for scripts")
        if given and given[0] == name:
            importlib.import_module(f"{__name__}.{name}").add_arguments(subparser)
    parsed = parser.parse_args(given)
    module = importlib.import_module(f"{__name__}.{parsed.subcommand}")
    try:
        return int(module.run(parsed))
    except (ValueError, OSError, RuntimeError) as error:
        print(f"tdof-npid {parsed.subcommand}: {error}", file=sys.stderr)
        return USAGE_ERROR
    except KeyboardInterrupt:
        print(f"tdof-npid {parsed.subcommand}: interrupted", file=sys.stderr)
        return 130


def entry() -> None:
    """The console script."""
    sys.exit(main())
