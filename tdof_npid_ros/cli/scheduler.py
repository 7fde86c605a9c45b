"""`--scheduler`: where the chunks of a long work run."""

from __future__ import annotations

import argparse


def add_scheduler_argument(parser: argparse._ActionsContainer) -> None:
    """Add it."""
    parser.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="of a Dask cluster that does the work: tcp://HOST:8786, or its scheduler file, FILE.json (default: "
        "threads of this machine)",
    )
