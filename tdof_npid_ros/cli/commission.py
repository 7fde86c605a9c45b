"""`tdof-npid commission`: from a running loop to gains: experiment, identify, tune, apply, confirm."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from tdof_npid_ros.cli.experiment import add_experiment_arguments, at_rest, longest_of, proposal_of, recorded, told
from tdof_npid_ros.cli.loop_client import observed
from tdof_npid_ros.commissioning.confirm import Confirmed, confirmed, settling_time
from tdof_npid_ros.commissioning.design import SET, Design, check_relay, designed, identified
from tdof_npid_ros.commissioning.report import Commissioning, lines_of
from tdof_npid_ros.control.gains import controller_type
from tdof_npid_ros.identification import IdentificationError
from tdof_npid_ros.identification.excitation import KINDS, rest_of
from tdof_npid_ros.interruption import afterwards, heeded
from tdof_npid_ros.output_file import OutputError, check_outputs, new_folder
from tdof_npid_ros.plants.plant import PlantError
from tdof_npid_ros.tuning import TuningError
from tdof_npid_ros.tuning.judge import Constraints

if TYPE_CHECKING:
    from tdof_npid_ros.graph.experimenter import LoopAtWork

MOST_EXPERIMENTS = 3
GROWS = 1.5  # times larger is each experiment than the one before
TIGHT = 0.9  # of M_s - 1 asked for: where the model is held to less, the plant is not known well enough yet
SETTLES = 0.3  # of the horizon: so long the new gains hold the loop before it is stepped
REST_SAMPLES = 100
NOT_KEPT = 1  # exit status


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this subcommand's arguments."""
    parser.add_argument("namespace", nargs="?", default="/", help="of the loop (default: /)")
    parser.add_argument("--yes", action="store_true", help="do not ask; keep the gains if the step is as predicted")
    parser.add_argument("--controller", metavar="TYPE", default="tdof_npid2", help="to tune (default: tdof_npid2)")
    parser.add_argument("--ms", type=float, default=1.8, metavar="M", help="largest M_s (default: 1.8)")
    parser.add_argument("--kind", choices=KINDS, default="doublet", help="of the experiment (default: doublet)")
    add_experiment_arguments(parser)
    parser.add_argument("--html", type=Path, metavar="FILE", help="the report (default: commission.html in the bag)")
    parser.add_argument("--out", type=Path, metavar="FILE", help="write the plant as a parameter file")


def run(arguments: argparse.Namespace) -> int:
    """Commission, and say what became of it."""
    from tdof_npid_ros.graph.experimenter import LoopAtWork

    if arguments.json and not arguments.yes:
        raise ValueError("--json asks nothing: give --yes, too")
    # What no gains could have is refused before anything touches the plant.
    controller_type(arguments.controller)
    Constraints(ms=arguments.ms)
    bag = new_folder(arguments.bag or Path("bags") / f"commission-{time.strftime('%Y%m%d-%H%M%S')}")
    if arguments.out is not None and arguments.out.exists():
        raise OutputError(f"{arguments.out} exists and is not overwritten: give another name")
    check_outputs([path for path in (arguments.html, arguments.out) if path])
    work = Commissioning(arguments.namespace, str(bag))
    say: Callable[[str], None] = (lambda text: None) if arguments.json else (lambda text: print(text, flush=True))
    html = arguments.html or bag / "commission.html"
    with heeded(), observed(arguments.namespace) as observer:
        loop = LoopAtWork(observer)
        before = {name: loop.values[name] for name in SET}
        try:
            with recorded(observer, arguments.namespace, bag):
                _commission(loop, work, arguments, say)
            work.page().write(html)
            if arguments.out is not None and work.design is not None:
                arguments.out.write_text(work.design.draft.text(), encoding="utf-8")
        except KeyboardInterrupt:
            if work.outcome == "kept":
                with afterwards():
                    observer.remote("controller").set_parameters(before)
            raise
    say(f"{work.outcome}: {work.reason}\nreport   {html}\nbag      {bag}")
    if arguments.json:
        print(json.dumps(work.as_json() | {"report": str(html)}, allow_nan=False))
    return 0 if work.outcome == "kept" else NOT_KEPT


def _commission(
    loop: LoopAtWork, work: Commissioning, arguments: argparse.Namespace, say: Callable[[str], None]
) -> None:
    """Experiment until gains have been confirmed, three times at the most.

    Raises:
        IdentificationError, PlantError, TuningError: the plant is not known well enough; nothing has changed.
        ExperimentError: an experiment was ended; nothing has changed.
    """
    controller = controller_type(arguments.controller)
    last: Exception | None = None
    for number in range(MOST_EXPERIMENTS):
        if not _experiment(loop, work, arguments, say, number):
            return
        try:
            found = identified(work.records)
            period = float(loop.values["sample_period"])
            if arguments.kind == "relay":
                check_relay(found, work.records[-1])
            design = designed(
                found, work.records, loop.gains, loop.options, controller, period, arguments.ms, loop.scale or None
            )
        except (IdentificationError, PlantError, TuningError) as error:
            last = error
            say(f"not yet: {error}")
            continue
        work.design = design
        if design.ms - 1.0 < TIGHT * (arguments.ms - 1.0) and number + 1 < MOST_EXPERIMENTS:
            more = "a larger experiment" if arguments.size is None else "another experiment"
            say(f"not yet: for what the record leaves open, M_s would have to be {design.ms:.3g}; {more}")
            continue
        say("\n".join([found.reason, *lines_of(design)]))
        if not _agreed(arguments, "Apply the new gains and confirm them by a step?"):
            work.outcome, work.reason = "declined", "the gains were not applied; all is as before"
            return
        step = _trial(loop, work, design, arguments, say)
        if work.outcome:
            return
        last = IdentificationError(f"{step.reason}: the gains were not kept")
        say(f"not yet: {step.reason}; the gains are those of before")
    assert last is not None
    raise type(last)(f"{last}; after {MOST_EXPERIMENTS} experiments nothing is changed: {WHAT_TO_DO}")


WHAT_TO_DO = "make larger ones (--size), one of another kind (--kind relay --by effort), or hold the load still"


def _experiment(
    loop: LoopAtWork, work: Commissioning, arguments: argparse.Namespace, say: Callable[[str], None], number: int
) -> bool:
    """One experiment, its record added; whether it was made."""
    from tdof_npid_ros.graph.experimenter import Hold, record_of

    rest = at_rest(loop, arguments)
    proposal = proposal_of(loop, rest, arguments, arguments.kind, GROWS**number)
    text = told(proposal, rest)
    say(text)
    if not _agreed(arguments, "Make this experiment?"):
        work.outcome, work.reason = "declined", "no experiment was made; all is as before"
        return False
    work.proposals.append(text)
    work.noise = work.noise or rest.noise
    longest_level, longest = longest_of(loop, arguments)
    excitation = proposal.excitation(rest.noise, longest_level)
    with Hold(loop, "commission", proposal.safe_output, proposal.safe_effort, longest) as hold:
        hold.follow(excitation, proposal.by, rest.output)
    work.records.append(record_of(hold.taken, f"experiment {number + 1}", len(work.records) + 1, loop.effort_limits))
    return True


def _trial(
    loop: LoopAtWork, work: Commissioning, design: Design, arguments: argparse.Namespace, say: Callable[[str], None]
) -> Confirmed:
    """Apply the gains, step the setpoint, compare, and keep or revert."""
    from tdof_npid_ros.graph.experimenter import Hold, record_of, signals_of

    rest = at_rest(loop, arguments)
    wanted = argparse.Namespace(**{**vars(arguments), "by": "setpoint", "size": None})
    base = rest.output if loop.options.manual else rest.setpoint
    proposal = proposal_of(loop, rest._replace(setpoint=base), wanted, "step")
    _, longest = longest_of(loop, arguments)
    target = base + proposal.size
    watched = settling_time(design, proposal.size)  # before the loop is held, for it may take some time
    with Hold(loop, "confirm", proposal.safe_output, proposal.safe_effort, longest) as hold:
        hold.apply({**design.settings, "manual": False, "experiment_setpoint": base})
        hold.wait(SETTLES * design.horizon)
        before = hold.taken[-REST_SAMPLES:]
        now = rest_of(*signals_of(before), tolerance=0.0)
        first = len(hold.taken)
        hold.move(setpoint=target)
        hold.wait(watched)
        rows = hold.taken[first:]
        rows = rows[next((i for i, row in enumerate(rows) if row.setpoint[0] == target), 0) :]
        y, _, r = signals_of(rows)
        times = [row.stamp_ns / 1e9 - rows[0].stamp_ns / 1e9 for row in rows]
        u = [float(row.effort[0]) for row in rows]
        step = hold.during(lambda: confirmed(design, times, r, y, u, (now.output, now.effort), now.noise))
        work.confirmed = step
        work.records.append(record_of(hold.taken, "confirming step", len(work.records) + 1, loop.effort_limits))
        say(
            f"The step: measured and predicted differ by {step.miss:.1%} of it; overshoot {step.overshoot:.1%}, "
            f"predicted {step.overshoot_predicted:.1%}."
        )
        hold.move(setpoint=base)
        good = not step.reason
        if not arguments.yes:
            good = _agreed(arguments, f"{step.reason or 'It is as predicted'}. Keep the new gains?", hold.renew)
        if good:
            hold.keep(design.settings)
            work.outcome = "kept"
            work.reason = f"the new gains are on the controller; the step was as predicted to {step.miss:.1%}"
        elif not arguments.yes:
            work.outcome, work.reason = "reverted", "the gains of before are on the controller"
    return step


def _agreed(arguments: argparse.Namespace, question: str, meanwhile: Callable[[], None] | None = None) -> bool:
    """Whether the user says yes; `meanwhile` is called again and again until he has."""
    if arguments.yes:
        return True
    import select

    print(f"{question} [y/N] ", end="", flush=True)
    while meanwhile is not None and not select.select([sys.stdin], [], [], 0.3)[0]:
        meanwhile()
    return sys.stdin.readline().strip().lower() in ("y", "yes")
