"""`make bench`: every benchmark in one run, and the page of its figures."""

from __future__ import annotations

import argparse
import importlib
import json
import sys
from pathlib import Path

from benchmarks import LONG, MODULES
from benchmarks.harness import Result, measure, text
from benchmarks.page import DATA, read_results, write_page


def main() -> None:
    """Run them, print each, and write RESULTS.md with a picture per question."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks")
    parser.add_argument("--size", choices=["small", "full"], default="full", help="small: only whether they run")
    parser.add_argument("--only", nargs="+", metavar="NAME", choices=[*MODULES, *LONG], help="the other sections stay")
    parser.add_argument("--all", action="store_true", help=f"with the long ones: {', '.join(LONG)}")
    parser.add_argument("--out", type=Path, help="folder of the page (default, at full size: benchmarks)")
    parser.add_argument("--page", action="store_true", help=f"measure nothing, only write the page from its {DATA}")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    folder = arguments.out or (Path(__file__).parent if arguments.size == "full" else None)
    results: dict[str, Result] = {}
    for name in () if arguments.page else arguments.only or (MODULES + LONG if arguments.all else MODULES):
        module = importlib.import_module(f"benchmarks.{name}")
        results[name] = measure(module, arguments.size)
        if not arguments.json:
            seconds = results[name].circumstances["seconds"]
            print(text(f"{name}: {module.TITLE}", results[name]), f"\n  [{seconds} s]\n", flush=True)
        if folder:  # at once: a failure further on loses nothing
            write_page({**read_results(folder), name: results[name]}, folder)
    if arguments.page and folder:
        write_page(read_results(folder), folder)
    if arguments.json:
        print(json.dumps({name: result.as_dict() for name, result in results.items()}))
    sys.exit(0)


if __name__ == "__main__":
    main()
