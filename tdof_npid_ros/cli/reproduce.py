"""`tdof-npid reproduce`: the paper's tables and figures beside ours."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from tqdm import tqdm

from tdof_npid_ros.cli.scheduler import add_scheduler_argument
from tdof_npid_ros.paper.output import claim_folder
from tdof_npid_ros.paper.reproduce import SUBCOMMAND, Effort, Reproduction, reproduce
from tdof_npid_ros.workers import workers


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this subcommand's arguments."""
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="a new or empty folder, or an earlier output"
    )
    parser.add_argument("--only", metavar="NAMES", help="some of them, as table4,figure9 (default: all)")
    parser.add_argument(
        "--seeds", type=int, default=1, metavar="N", help="HGA runs per row; the best counts (default: 1)"
    )
    add_scheduler_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    """Compute, write, and say where the page is and what came out."""
    only = [] if arguments.only is None else [name.strip().lower() for name in arguments.only.split(",")]
    reproduction = Reproduction(only, Effort(seeds=arguments.seeds))
    claim_folder(arguments.out, SUBCOMMAND)
    jobs = len(reproduction.jobs(arguments.out))
    with workers(arguments.scheduler) as where, tqdm(total=jobs, unit="job", leave=False, disable=None) as bar:
        summary = reproduce(arguments.out, reproduction, where, lambda label: _show(bar, label))
    if arguments.json:
        print(json.dumps(summary))
    else:
        rows, conclusions = summary["rows"], summary["conclusions"]
        print(f"{len(summary['items'])} tables and figures: {summary['page']}")
        if rows:
            print(
                f"  published rows reproduced at the published gains: {sum(row['reproduced'] for row in rows)} of "
                f"{len(rows)}"
            )
            beaten = sum(one["lower_overshoot"] and one["lower_objective"] for one in conclusions)
            print(f"  TDOF-NPID beats PID in M_p and objective, ours tuned: {beaten} of {len(conclusions)}")
    return 0


def _show(bar: tqdm[None], label: str) -> None:
    if getattr(bar, "desc", ""):  # a bar that is not shown has none
        bar.update()
    bar.set_description(label)
