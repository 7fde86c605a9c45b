"""`tdof-npid demo`: the paper's first process over ROS 2, end to end."""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

from tdof_npid_ros.case import load_case
from tdof_npid_ros.cli.gains import gains_by_source
from tdof_npid_ros.control.gains import Gains, controller_type
from tdof_npid_ros.paper.tables import COMPARED, published

if TYPE_CHECKING:
    from tdof_npid_ros.analysis.report import Report

CASE = "p1-c0.5"
NAMESPACE = "/demo"
TUNED_TYPE = "tdof_npid2"
PICTURED = ("pid", "tdof_npid2")  # the others nearly coincide with the latter
GENERATIONS, SEED = 5, 1  # of 40 candidates: a short tuning


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this subcommand's arguments."""
    parser.add_argument("--bag", type=Path, metavar="DIR", help="folder of the bag (default: bags/demo-<time>)")


def run(arguments: argparse.Namespace) -> int:
    """Tune over ROS 2, then run the published and the tuned gains, recorded, and compare."""
    from tdof_npid_ros.analysis.report import analyze

    case = load_case(CASE)
    bag = arguments.bag or Path("bags") / f"demo-{time.strftime('%Y%m%d-%H%M%S')}"
    _check_free(bag)
    with tempfile.TemporaryDirectory() as folder:
        result = Path(folder) / "tuned.yaml"
        _tune(result, quiet=arguments.json)
        tuned = gains_by_source(case, TUNED_TYPE, str(result))
        rounds = {name: gains_by_source(case, name, "published") for name in COMPARED} | {f"{TUNED_TYPE}, tuned": tuned}
        _record(rounds, bag, quiet=arguments.json)
        shutil.copy(result, bag / "tuned.yaml")
    report = analyze([bag])
    picture = bag / "responses.png"
    _draw(report, [name for name in rounds for _ in case.plans], picture)
    if arguments.json:
        print(json.dumps({"bag": str(bag), "picture": str(picture), "episodes": report.as_json()["episodes"]}))
    else:
        print(_comparison(report, list(rounds), len(case.plans)))
        program = "tdof-npid" if shutil.which("tdof-npid") else sys.argv[0]
        print(f"bag      {bag}\npicture  {picture}\ntuned    {bag / 'tuned.yaml'}")
        print(f"next     {program} verify {bag}")
        print(f"         {program} analyze {bag} --html report.html")
    return 0


def _draw(report: Report, in_order: Sequence[str], path: Path) -> None:
    """The picture of PID beside TDOF-NPID2, each with its overshoot.

    Args:
        in_order: which round each episode is of.
    """
    from tdof_npid_ros.analysis.report import Report, title

    shown = [(one, name) for one, name in zip(report.episodes, in_order, strict=False) if name in PICTURED]
    legend: dict[str, str] = {}
    for kind in PICTURED:
        overshoots = [getattr(one.metrics(), "overshoot_percent", None) for one, name in shown if name == kind]
        told = next((f": overshoot {found:.0f} %" for found in overshoots if found is not None), "")
        legend |= {title(one.episode): f"{_as_printed(kind)}{told}" for one, name in shown if name == kind}
    Report(tuple(one for one, _ in shown)).picture(path, legend)


def _check_free(bag: Path) -> None:
    """Refuse a folder that could not be recorded to, before the tuning has taken its time."""
    if bag.exists():
        raise FileExistsError(f"{bag} exists already and is not overwritten: choose another --bag")
    try:
        bag.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=bag.parent):
            pass
    except OSError as error:
        raise RuntimeError(f"the bag {bag} cannot be written: {error.strerror}") from error


def _tune(result: Path, quiet: bool) -> None:
    """A short run of the tuner node on a loop of its own."""
    from tdof_npid_ros.graph.running import run as running

    if not quiet:
        print(f"Tuning {TUNED_TYPE} through a loop of plant, controller and tuner in {NAMESPACE} …", flush=True)
    with (
        running(CASE, namespace=NAMESPACE, nodes=("plant", "controller")) as loop,
        tqdm(total=GENERATIONS, disable=quiet or None, bar_format=_TUNING_BAR, mininterval=_REDRAWN) as bar,
    ):
        loop.start("tuner", case=CASE, type=TUNED_TYPE, generations=GENERATIONS, seed=SEED, result=result)
        while not loop.has_ended("tuner"):
            loop.idle(0.05)
            best = loop.conductor.fact("tuner", "best")
            text = "first generation" if best in ("", "inf") else f"best IAE {best[:7]}"
            bar.set_description(f"{text:16}", refresh=False)
            bar.update(int(loop.conductor.fact("tuner", "generation") or 0) - bar.n)


def _record(rounds: dict[str, Gains], bag: Path, quiet: bool) -> None:
    """Play the case's episodes once for each set of gains, recorded, with a progress bar in simulated seconds."""
    from tdof_npid_ros.graph.running import run as running

    if not quiet:
        print(f"Starting plant, controller, scenario and recorder in {NAMESPACE} …", flush=True)
    with (
        running(CASE, bag=bag, namespace=NAMESPACE) as loop,
        tqdm(disable=quiet or None, bar_format=_PLAYING_BAR, mininterval=_REDRAWN) as bar,
    ):
        for round_, (name, gains) in enumerate(rounds.items()):
            bar.set_description(f"{name:17}")
            loop.use(gains)
            loop.play()
            bar.total = len(rounds) * loop.to_play_s
            while loop.is_playing:
                loop.idle(0.05)
                bar.update(max(0.0, round_ * loop.to_play_s + loop.played_s - bar.n))


_REDRAWN = 0.25  # s between redrawings, so that a log of them stays readable


def _as_printed(name: str) -> str:
    """A round's name as the paper writes controllers: TDOF-NPID2, tuned."""
    kind, comma, how = name.partition(",")
    return kind.replace("_", "-").upper() + comma + how


_TUNING_BAR = "{desc} |{bar:30}| generation {n:.0f}/{total:.0f} [{elapsed}]"
_PLAYING_BAR = "{desc} |{bar:30}| {n:.0f}/{total:.0f} simulated s [{elapsed}]"


def _comparison(report: Any, rounds: list[str], episodes: int) -> str:
    """The paper's metrics of each round, measured from the bag, beside the published ones."""
    lines = []
    for kind in dict.fromkeys(episode for episode, _, _ in METRICS.values()):  # a table each: in 80 columns
        names = [name for name, (episode, _, _) in METRICS.items() if episode == kind]
        lines += ["", f"{'measured (published)':21}" + "".join(f"{name:>19}" for name in names)]
        for i, name in enumerate(rounds):
            measured = {one.episode.name: one.metrics() for one in report.episodes[i * episodes : (i + 1) * episodes]}
            row = published(CASE, controller_type(name)) if name in COMPARED else None
            lines.append(f"{name:21}" + "".join(_cell(measured, row, *METRICS[metric]) for metric in names))
    lines += [
        "",
        "This case does not come out exactly under the paper's stated conventions:",
        "docs/reproduction.md says why.",
    ]
    return "\n".join([*lines, *report.notes(), ""])


# The paper's name of each metric: the episode it is measured in, its name there and in the published row.
METRICS = {
    "M_p (%)": ("setpoint", "overshoot_percent", "overshoot_percent"),
    "t_s (s)": ("setpoint", "settling_time_s", "settling_time_s"),
    "IAE_SP": ("setpoint", "iae", "iae_setpoint"),
    "M_peak": ("disturbance", "peak", "peak"),
    "t_rcy (s)": ("disturbance", "recovery_time_s", "recovery_time_s"),
    "IAE_DIS": ("disturbance", "iae", "iae_disturbance"),
}


def _cell(measured: dict[str, Any], row: Any, episode: str, ours: str, theirs: str) -> str:
    value = getattr(measured.get(episode), ours, None)
    shown = "-" if value is None else f"{value:.4g}"
    return f"{shown if row is None else f'{shown} ({getattr(row, theirs):.4g})':>19}"
