"""`tdof-npid demo`: the paper's first process over ROS 2, end to end."""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import time
from pathlib import Path
from typing import Any

from tqdm import tqdm

from tdof_npid_ros.case import Case, find_parameter_file, load_case
from tdof_npid_ros.cli.gains import gains_by_source
from tdof_npid_ros.control.gains import PER_LANE
from tdof_npid_ros.paper.tables import COMPARED, published

CASE = "p1-c0.5"
NAMESPACE = "/demo"
START_TIMEOUT = 60.0  # s; the first start compiles
PLAY_TIMEOUT = 120.0  # s
SUBSCRIBERS = {"output": 2, "control_effort": 2, "controller_state": 1, "scenario_plan": 3}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this subcommand's arguments."""
    parser.add_argument("--bag", type=Path, help="folder of the bag (default: bags/demo-<time>)")


def run(arguments: argparse.Namespace) -> int:
    """Run the demo."""
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    from tdof_npid_ros.analysis.report import analyze
    from tdof_npid_ros.graph.conductor import Conductor
    from tdof_npid_ros.graph.processes import NodeProcesses

    case = load_case(CASE)
    bag = arguments.bag or Path("bags") / f"demo-{time.strftime('%Y%m%d-%H%M%S')}"
    if bag.exists():
        raise FileExistsError(f"{bag} exists already and is not overwritten: choose another --bag")
    with NodeProcesses(find_parameter_file(CASE), NAMESPACE) as nodes:
        nodes.start("recorder", {"bag": bag, "lossless": True})
        for node in ("plant", "controller"):
            nodes.start(node, {"lossless": True})
        nodes.start("scenario", {"play": False})
        conductor = Conductor(NAMESPACE, nodes.check)
        try:
            _say(arguments, f"Starting plant, controller, scenario and recorder in {NAMESPACE} …")
            conductor.wait_for_subscriptions(SUBSCRIBERS, START_TIMEOUT)
            _play(conductor, case, quiet=arguments.json)
        finally:
            conductor.close()
    report = analyze([bag])
    picture = bag / "responses.png"
    report.picture(picture)
    if arguments.json:
        print(json.dumps({"bag": str(bag), "picture": str(picture), "episodes": report.as_json()["episodes"]}))
    else:
        print(_comparison(report))
        print(f"bag      {bag}\npicture  {picture}")
        program = "tdof-npid" if shutil.which("tdof-npid") else sys.argv[0]
        print(f"next     {program} verify {bag}")
        print(f"         {program} analyze {bag} --html report.html")
    return 0


def _say(arguments: argparse.Namespace, text: str) -> None:
    if not arguments.json:
        print(text, flush=True)


def _play(conductor: Any, case: Case, quiet: bool) -> None:
    """Play the case's episodes once for each compared controller, with a progress bar in simulated seconds."""
    episode_s = [plan.end_ns / 1e9 for plan in case.plans.values()]
    with tqdm(total=len(COMPARED) * sum(episode_s), unit=" s", disable=quiet, bar_format=_BAR) as bar:
        for round_, controller in enumerate(COMPARED):
            gains = gains_by_source(case, controller, "published")
            bar.set_description(f"{controller:10}")
            conductor.set_parameters("controller", {"type": gains.type, **{n: getattr(gains, n) for n in PER_LANE}})
            conductor.trigger("scenario/play")

            def played(round_: int = round_) -> bool:
                done = int(conductor.fact("plant", "episode") or 0) - 1 - round_ * len(episode_s)
                if 0 <= done < len(episode_s):
                    position = round_ * sum(episode_s) + sum(episode_s[:done]) + conductor.time_ns / 1e9
                    bar.update(max(0.0, min(position, bar.total) - bar.n))
                return bool(conductor.fact("scenario", "played") == str(round_ + 1))

            conductor.wait(played, f"the end of the episodes with {controller}", PLAY_TIMEOUT)
        bar.update(bar.total - bar.n)


_BAR = "{desc} {percentage:3.0f}% |{bar:30}| {n:.0f}/{total:.0f} simulated s [{elapsed}]"


def _comparison(report: Any) -> str:
    """The paper's metrics of each controller's episodes, measured from the bag, beside the published ones."""
    measured: dict[tuple[str, str], Any] = {
        (one.episode.controller, one.episode.name): one.metrics() for one in report.episodes
    }
    lines = ["", f"{'measured (published)':21}" + "".join(f"{name:>20}" for name in METRICS)]
    for controller in COMPARED:
        row = published(CASE, controller)
        lines.append(f"{controller:21}" + "".join(_cell(measured, controller, row, *METRICS[name]) for name in METRICS))
    lines.append("This row of the paper does not come out exactly under its stated conventions: docs/reproduction.md says why.")
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


def _cell(measured: dict[tuple[str, str], Any], controller: str, row: Any, episode: str, ours: str, theirs: str) -> str:
    value = getattr(measured.get((controller, episode)), ours, None)
    shown = "-" if value is None else f"{value:.4g}"
    return f"{f'{shown} ({getattr(row, theirs):.4g})':>20}"
