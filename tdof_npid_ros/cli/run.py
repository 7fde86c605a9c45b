"""`tdof-npid run`: all the loop's nodes as processes, in one command."""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tqdm import tqdm

from tdof_npid_ros.cli.gains import add_gain_arguments, asked_for

if TYPE_CHECKING:
    from tdof_npid_ros.graph.running import RunningLoop

BAR = "{desc} |{bar:30}| {n:.0f}/{total:.0f} simulated s [{elapsed}]"
REDRAWN = 0.25  # s between redrawings, so that a log of them stays readable


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this subcommand's arguments."""
    parser.add_argument("case", help="a case (p1-c0.5, …, sprott) or the path of a parameter file")
    add_gain_arguments(parser)
    parser.add_argument("--bag", type=Path, metavar="DIR", help="record to this new folder")
    parser.add_argument("--realtime", action="store_true", help="on a steady clock (default: the file's mode)")
    parser.add_argument("--for", type=float, dest="seconds", metavar="S", help="stop after so many seconds")
    parser.add_argument("--namespace", default="/", help="where the nodes run (default: /)")


def run(arguments: argparse.Namespace) -> int:
    """Start the nodes, play the case's episodes, stop the nodes, and say where things are."""
    from tdof_npid_ros.graph.running import run as running

    if arguments.seconds is not None and not arguments.seconds > 0:
        raise ValueError(f"--for {arguments.seconds:g}: it must be above 0 s")
    started = time.monotonic()
    mode: Literal["realtime"] | None = "realtime" if arguments.realtime else None
    if not arguments.json:
        print("Starting plant, controller and scenario …", flush=True)
    options = {"bag": arguments.bag, "mode": mode, "namespace": arguments.namespace}
    with running(arguments.case, **options, **asked_for(arguments)) as loop:
        if not loop.case.episodes:
            raise ValueError(f"{arguments.case}: no episodes in it to play: give the scenario some")
        finished = _play(loop, arguments.seconds, quiet=arguments.json)
    if arguments.json:
        bag = str(arguments.bag) if arguments.bag else None
        elapsed = round(time.monotonic() - started, 3)
        print(json.dumps({"case": loop.case.name, "finished": finished, "bag": bag, "elapsed_s": elapsed}))
        return 0
    print(f"{loop.case.name}: {'all episodes played' if finished else 'stopped before all episodes were played'}")
    if arguments.bag:
        print(f"bag      {arguments.bag}")
        print(f"next     tdof-npid analyze {arguments.bag} --html report.html")
        print(f"         tdof-npid verify {arguments.bag}")
    return 0


def _play(loop: RunningLoop, seconds: float | None, quiet: bool) -> bool:
    """Play all episodes with a progress bar; whether they have ended by themselves."""
    deadline = None if seconds is None else time.monotonic() + seconds
    loop.play()
    with tqdm(total=loop.to_play_s, disable=quiet or None, bar_format=BAR, mininterval=REDRAWN) as bar:
        while loop.is_playing:
            if deadline is not None and time.monotonic() > deadline:
                return False
            loop.idle(0.1)
            bar.update(max(0.0, loop.played_s - bar.n))
    return True
