"""`tdof-npid experiment`: a step, doublet or relay on a loop that runs, under its controller's guard."""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tdof_npid_ros.cli.loop_client import observed
from tdof_npid_ros.identification.excitation import KINDS, By, Proposal, Rest, proposed, relay_point
from tdof_npid_ros.interruption import heeded
from tdof_npid_ros.output_file import new_folder

if TYPE_CHECKING:
    from tdof_npid_ros.graph.experimenter import LoopAtWork
    from tdof_npid_ros.graph.observer import LoopObserver, NodeState

RECORDER_PATIENCE = 30.0  # s
HOLD, DURATION = (600.0, 3000), (3600.0, 18_000)  # of a level, of an experiment at the most: s, or so many samples


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this subcommand's arguments."""
    parser.add_argument("namespace", nargs="?", default="/", help="of the loop (default: /)")
    parser.add_argument("--kind", choices=KINDS, default="doublet", help="default: doublet, up, down and back")
    add_experiment_arguments(parser)


def add_experiment_arguments(parser: argparse.ArgumentParser) -> None:
    """Add what an experiment may do; `commission` has them, too."""
    parser.add_argument(
        "--by",
        choices=("setpoint", "effort"),
        help="what is moved: the setpoint in the closed loop, or the effort by hand (default: effort in manual mode)",
    )
    parser.add_argument("--size", type=float, metavar="X", help="of a level, in its unit (default: from the noise)")
    for what, text in (("output", "leaves"), ("effort", "would leave")):
        parser.add_argument(
            f"--safe-{what}",
            type=float,
            nargs=2,
            metavar=("LOW", "HIGH"),
            help=f"all is restored at once when the {what} {text} this range (default: the controller's safe_range)",
        )
    for what, limit, of in (("hold", HOLD, "a level"), ("duration", DURATION, "the experiment")):
        told = f"of {of} at the most (default: {limit[0]:g}, or {limit[1]} samples where that is longer)"
        parser.add_argument(f"--{what}", type=float, metavar="S", help=told)
    parser.add_argument("--patience", type=float, default=30.0, metavar="S", help="to wait for rest (default: 30)")
    parser.add_argument(
        "--bag", type=Path, metavar="DIR", help="record to this new folder (default: in bags/, by the date)"
    )


def run(arguments: argparse.Namespace) -> int:
    """Make the experiment, and say what became of it."""
    from tdof_npid_ros.graph.experimenter import Hold, LoopAtWork, record_of

    bag = new_folder(arguments.bag or Path("bags") / f"experiment-{time.strftime('%Y%m%d-%H%M%S')}")
    with heeded(), observed(arguments.namespace) as observer, recorded(observer, arguments.namespace, bag):
        loop = LoopAtWork(observer)
        rest = at_rest(loop, arguments)
        proposal = proposal_of(loop, rest, arguments, arguments.kind)
        if not arguments.json:
            print(told(proposal, rest), flush=True)
        longest_level, longest = longest_of(loop, arguments)
        excitation = proposal.excitation(rest.noise, longest_level)
        with Hold(loop, "experiment", proposal.safe_output, proposal.safe_effort, longest) as hold:
            hold.follow(excitation, proposal.by, rest.output)
        record = record_of(hold.taken, "experiment", 1, loop.effort_limits)
    stretch = record.stretch
    point = relay_point(stretch.time, stretch.effort, stretch.output) if proposal.kind == "relay" else None
    begun = hold.taken[0].time
    report = {
        "experiment": hold.name,
        **asdict(proposal),
        "safe_effort": [end if math.isfinite(end) else None for end in proposal.safe_effort],
        "noise": rest.noise,
        "samples": len(stretch.time),
        "duration_s": float(stretch.time[-1]),
        "levels": [[round(at - begun, 9), level] for at, level in excitation.changes],
        "output_moved": [float(stretch.output.min()), float(stretch.output.max())],
        "relay": None if point is None else asdict(point),
        "bag": str(bag),
    }
    report["swing"] = proposal.swing if math.isfinite(proposal.swing) else None
    print(json.dumps(report) if arguments.json else _done(report))
    return 0


def at_rest(loop: LoopAtWork, arguments: argparse.Namespace) -> Rest:
    """The loop at rest, waited for."""
    return loop.rest(0.01 * loop.scale, arguments.patience)


def longest_of(loop: LoopAtWork, arguments: argparse.Namespace) -> tuple[float, float]:
    """How long a level and the experiment may last, s: as given, else as a loop with this sample period needs."""
    period = float(loop.values["sample_period"])
    limits = (arguments.hold, HOLD), (arguments.duration, DURATION)
    level, whole = (max(s, n * period) if given is None else float(given) for given, (s, n) in limits)
    return level, whole


def proposal_of(loop: LoopAtWork, rest: Rest, arguments: argparse.Namespace, kind: Any, times: float = 1.0) -> Proposal:
    """The experiment that suits the loop and the arguments."""
    by: By = arguments.by or ("effort" if loop.options.manual else "setpoint")
    ranges = {}
    for what, ends in (("output", (-math.inf, math.inf)), ("effort", loop.effort_limits)):
        given = getattr(arguments, f"safe_{what}") or loop.values[f"safe_range.{what}"]
        if not given[0] < given[1]:
            raise ValueError(f"--safe-{what} {given[0]:g} {given[1]:g}: the lower end comes first")
        ranges[what] = max(given[0], ends[0]), min(given[1], ends[1])
    return proposed(rest, by, kind, loop.scale, ranges["output"], ranges["effort"], arguments.size, times)


def told(proposal: Proposal, rest: Rest) -> str:
    """A proposal in a sentence or two."""
    how = "in the closed loop" if proposal.by == "setpoint" else "by hand"
    turns = (
        f", turning round when the output has moved by {proposal.swing:.4g}" if math.isfinite(proposal.swing) else ""
    )
    (y0, y1), (u0, u1) = proposal.safe_output, proposal.safe_effort
    return (
        f"The loop rests at output {rest.output:.5g} with effort {rest.effort:.5g}; noise {rest.noise:.3g}.\n"
        f"Experiment: a {proposal.kind} of the {proposal.by} {how}, {proposal.base:.5g} by {proposal.size:.4g}"
        f"{turns}.\n"
        f"It ends, and all is as before, if the output leaves {y0:.5g} to {y1:.5g} or the effort {u0:.5g} to {u1:.5g}."
    )


def _done(report: dict[str, Any]) -> str:
    lines = [
        f"done     {report['samples']} samples in {report['duration_s']:.6g} s of the loop; all is as before",
        f"output   {report['output_moved'][0]:.6g} to {report['output_moved'][1]:.6g}, noise {report['noise']:.3g}",
    ]
    if report["relay"]:
        point = report["relay"]
        lines.append(f"relay    period {point['period']:.5g} s: |G| {point['gain']:.5g}, phase {point['phase']:.1f}°")
    return "\n".join(
        [*lines, f"bag      {report['bag']}", f"next     tdof-npid identify {report['bag']} --out plant.yaml"]
    )


@contextmanager
def recorded(observer: LoopObserver, namespace: str, bag: Path) -> Iterator[None]:
    """Record the loop to a new bag meanwhile.

    Raises:
        RuntimeError: the recorder does not start.
    """
    from tdof_npid_ros.graph.processes import NodeProcesses
    from tdof_npid_ros.parameter_file import find_parameter_file

    with ExitStack() as stack:
        processes = stack.enter_context(NodeProcesses(find_parameter_file("p1-c0.5"), namespace))
        processes.start("recorder", {"bag": str(bag)})
        end = time.monotonic() + RECORDER_PATIENCE
        while not records_to(bag, observer.nodes.get("recorder")):
            processes.check()
            if time.monotonic() > end:
                raise RuntimeError(f"the recorder does not record to {bag} within {RECORDER_PATIENCE:g} s")
            time.sleep(0.02)
        yield


def records_to(bag: Path, state: NodeState | None) -> bool:
    """Whether a recorder says that it records there; it says so even when it has lost messages."""
    return state is not None and state.facts.get("bag") == str(bag)
