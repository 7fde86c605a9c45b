"""`make bench`: every benchmark in one run, and the page of its figures."""

from __future__ import annotations

import argparse
import importlib
import json
import sys
import time
from pathlib import Path

from benchmarks.harness import Result, machine, text
from benchmarks.page import write_page

MODULES = (
    "loop_speed", "tuning", "seeds", "lockstep", "live_tuning", "recorder", "reader", "realtime", "startup", "growth",
)  # fmt: skip


def main() -> None:
    """Run them, print each, and write RESULTS.md with a picture per question."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks")
    parser.add_argument("--size", choices=["small", "full"], default="full")
    parser.add_argument("--only", nargs="+", choices=MODULES, default=MODULES)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    results: dict[str, Result] = {}
    for name in arguments.only:
        start = time.monotonic()
        results[name] = importlib.import_module(f"benchmarks.{name}").run(arguments.size)
        if not arguments.json:
            print(text(results[name]), f"\n  [{time.monotonic() - start:.0f} s]\n", flush=True)
    if arguments.json:
        print(json.dumps({name: result.as_dict() for name, result in results.items()}))
    write_page(results, machine(), arguments.out)
    sys.exit(0)


if __name__ == "__main__":
    main()
