"""`tdof-npid bench`: the benchmarks of a checkout."""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this subcommand's arguments."""
    parser.add_argument("--size", choices=["small", "full"], default="full", help="small: only whether they run")
    parser.add_argument(
        "--only", nargs="+", metavar="NAME", help="some of them, by the names of the files in benchmarks/"
    )
    parser.add_argument("--out", type=Path, default=Path("bench"), help="folder of the page (default: bench)")


def run(arguments: argparse.Namespace) -> int:
    """Run them in this Python and write the page.

    Raises:
        FileNotFoundError: the benchmarks are not here.
    """
    if not (ROOT / "benchmarks" / "__main__.py").is_file():
        raise FileNotFoundError("the benchmarks are not installed with the package: run this in a checkout of it")
    command = [sys.executable, "-m", "benchmarks", "--size", arguments.size, "--out", str(arguments.out.resolve())]
    command += ["--only", *arguments.only] if arguments.only else []
    command += ["--json"] if arguments.json else []
    return subprocess.run(command, cwd=ROOT).returncode
