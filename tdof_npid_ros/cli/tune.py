"""`tdof-npid tune`: find the gains of a case."""

from __future__ import annotations

import argparse
import json
import signal
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from tdof_npid_ros.advice import USUAL_M_S
from tdof_npid_ros.case import Case, load_case
from tdof_npid_ros.cli import INTERRUPTED
from tdof_npid_ros.cli.robust import add_spread_argument
from tdof_npid_ros.cli.scheduler import add_scheduler_argument
from tdof_npid_ros.cli.simulate import (
    add_output_arguments,
    advised,
    outputs_of,
    response_report,
    title,
    write_responses,
    written,
)
from tdof_npid_ros.control.gains import CONTROLLER_TYPES, Gains, controller_type
from tdof_npid_ros.metrics import in_units
from tdof_npid_ros.output_file import check_outputs
from tdof_npid_ros.parameter_file import check_replaceable, find_parameter_file, write_parameters
from tdof_npid_ros.parameters import TUNER
from tdof_npid_ros.robustness.result import RobustResult, finite, sweep_plants
from tdof_npid_ros.robustness.spread import spreads_of
from tdof_npid_ros.stability.margins import Margins, margins
from tdof_npid_ros.tuning import TuningError
from tdof_npid_ros.tuning.judge import Constraints
from tdof_npid_ros.tuning.objective import Objective
from tdof_npid_ros.tuning.optimizers import ALGORITHMS
from tdof_npid_ros.tuning.perturbed import Perturbed
from tdof_npid_ros.tuning.price import price_of_ms
from tdof_npid_ros.tuning.problem import GENERATIONS, POLISH, POPULATION, TuningProblem
from tdof_npid_ros.tuning.study import Study, TuningResult
from tdof_npid_ros.workers import Workers, WorkersError, workers

UNSEEN = 10_000  # other plants, for which robust gains are verified


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this subcommand's arguments."""
    parser.add_argument("case", help="a case (p1-c0.5, …, sprott) or the path of a parameter file")
    parser.add_argument("--controller", metavar="TYPE", help=f"{', '.join(CONTROLLER_TYPES)} (default: the case's)")
    seed, algorithm = TUNER["seed"].default, TUNER["algorithm"].default
    parser.add_argument("--seed", type=int, default=seed, help=f"the same seed gives the same result (default: {seed})")
    parser.add_argument("--free", choices=["sigma"], help="tune the width of k(e) too")
    parser.add_argument("--weight", type=float, help="w of IAE_SP + w·IAE_DIS (default: the case's)")
    parser.add_argument("--algorithm", default=algorithm, metavar="|".join(ALGORITHMS), help=f"default: {algorithm}")
    parser.add_argument("--population", type=int, default=POPULATION, metavar="N", help=f"default: {POPULATION}")
    length = parser.add_mutually_exclusive_group()
    length.add_argument(
        "--generations", type=int, metavar="N", help=f"of a whole population each (default: {GENERATIONS})"
    )
    length.add_argument("--budget", type=int, metavar="N", help="evaluations, instead of --generations")
    parser.add_argument(
        "--polish",
        type=int,
        default=POLISH,
        metavar="N",
        help=f"candidates in a step of the HGA's polish, 0: none (default: {POLISH})",
    )
    parser.add_argument(
        "--until-converged",
        action="store_true",
        help="end before the budget is spent, once two rounds begun anywhere have ended within 0.1 %% of the best",
    )
    parser.add_argument("--cold", action="store_true", help="do not begin with the case's own gains")
    add_constraint_arguments(parser)
    _add_robust_arguments(parser)
    parser.add_argument("--checkpoint", type=Path, metavar="FILE", help="saved after each generation")
    parser.add_argument("--resume", action="store_true", help="go on from the checkpoint, if it is there")
    parser.add_argument("--out", type=Path, metavar="FILE", help="write the gains as a ROS parameter file")
    add_output_arguments(parser)


def _add_robust_arguments(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("many plants at once")
    group.add_argument("--robust", type=int, metavar="N", help="tune for N plants near the case's (usual: 50)")
    add_spread_argument(group)
    group.add_argument(
        "--robust-by",
        default="mean",
        metavar="mean|worst|Q",
        help="what is minimised over the plants: the mean (default), the worst, or a quantile, as 0.9",
    )
    add_scheduler_argument(group)


def add_constraint_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the margins that the loop must have."""
    group = parser.add_argument_group("margins that the loop must have")
    group.add_argument(
        "--ms", type=float, metavar="M", help="largest M_s, the peak of the sensitivity (usual: 1.4 to 2)"
    )
    group.add_argument("--mt", type=float, metavar="M", help="largest M_t, the peak of T")
    group.add_argument("--gain-margin", type=float, metavar="FACTOR", help="least factor on the gains (usual: 2 to 5)")
    group.add_argument("--phase-margin", type=float, metavar="DEGREES", help="least (usual: 30 to 60)")
    group.add_argument("--delay-margin", type=float, metavar="S", help="least additional dead time")


def constraints_of(arguments: argparse.Namespace, case: Case | None = None) -> Constraints:
    """What `add_constraint_arguments` were given, or else the case's file gives the tuner."""
    asked = {field.name: getattr(arguments, field.name) for field in fields(Constraints)}
    of_case = Constraints.of_search(case.search if case else {})
    return replace(of_case, **{name: value for name, value in asked.items() if value is not None})


def run(arguments: argparse.Namespace) -> int:
    """Tune, print the optimum's metrics, and write what was asked for."""
    _check_outputs(arguments)
    problem = _problem(arguments)
    _check_episodes(problem)
    for reason in problem.restless.values():
        warnings.warn(f"{reason}, so no loop comes to rest in it and none is asked to", stacklevel=2)
    study = Study(problem, arguments.checkpoint, arguments.resume)
    started = time.monotonic()
    with workers(arguments.scheduler) as where:
        objective = Objective(problem, where=where if arguments.scheduler else None)
        try:
            with _interrupt_requested() as interrupted, _progress(study, shown=not arguments.json) as show:
                study.run(objective, lambda study: show(study) or not interrupted())
            if not study.done:
                _say_interrupted(study, arguments)
                return INTERRUPTED
            study.require_feasible()
            unseen = _unseen(problem, study.result.gains, where)
        except WorkersError as error:
            raise WorkersError(f"{error}, {_how_to_go_on(arguments)}") from None
    result = study.result
    found = margins(problem.case, result.gains)
    report = response_report(problem.case, result.gains)
    report |= {"evaluations": result.evaluations, "elapsed_s": round(time.monotonic() - started, 3)}
    report |= _search_report(study) | {"margins": found.as_dict(), "price": _price(problem, result, found)}
    report |= advised(problem.case, result.gains, found)
    if unseen is not None:
        report |= {"robust": _robust_report(problem, result.objective, unseen)}
    if arguments.out:
        write_parameters(arguments.out, {"controller": result.gains.as_dict()})
    if outputs_of(arguments):
        write_responses(problem.case, _compared(problem, result.gains), arguments)
    lines = [_summary(report, found), *(_robust_lines(report["robust"], unseen) if unseen is not None else [])]
    lines += written([*([arguments.out] if arguments.out else []), *outputs_of(arguments)])
    print(json.dumps(report) if arguments.json else "\n".join(lines))
    return 0


def _unseen(problem: TuningProblem, gains: Gains, where: Workers) -> RobustResult | None:
    """What the gains achieve on other plants of the spreads than they were tuned for."""
    if problem.perturbed is None:
        return None
    seed = problem.perturbed.seed + 1
    return sweep_plants(where, problem.case, gains, problem.perturbed.spreads, count=UNSEEN, seed=seed)


def _robust_report(problem: TuningProblem, objective: float, unseen: RobustResult) -> dict[str, Any]:
    """The number that was minimised, over the plants that were tuned for, and the same over the others."""
    perturbed = problem.perturbed
    assert perturbed is not None
    others = float(perturbed.together(unseen.metrics["objective"][:, None])[0])
    return {
        "by": perturbed.by,
        "plants": perturbed.plants,
        "objective": objective,
        "unseen_objective": finite(others),
        "unseen": unseen.as_dict(),
    }


def _robust_lines(robust: dict[str, Any], unseen: RobustResult) -> list[str]:
    by = f"quantile {robust['by']:g}" if isinstance(robust["by"], float) else robust["by"]
    others = robust["unseen_objective"]
    told = "none, for some are unstable" if others is None else in_units(others)
    return [
        f"  objective over the {robust['plants']} plants tuned for, {by}: {in_units(robust['objective'])}",
        f"  over {len(unseen.unstable)} others: {told}; {unseen.unstable_line()}",
    ]


def _search_report(study: Study) -> dict[str, Any]:
    """What the search began with, how it ended, and what it was held to."""
    problem, result = study.problem, study.result
    before = response_report(problem.case, problem.case.gains)
    return {
        "start": "case" if problem.warm else "cold",
        "before": {name: before[name] for name in ("controller", "gains", "objective")},
        "at_bounds": problem.at_bounds(result.gains),
        "constraints": problem.constraints.given,
        "converged": result.converged,
        "evaluations_saved": study.budget - result.evaluations,
    }


def _problem(arguments: argparse.Namespace) -> TuningProblem:
    case = load_case(arguments.case)
    controller = controller_type(arguments.controller or case.gains.type)
    if arguments.weight is not None:
        case = replace(case, weight=arguments.weight)
    generations = GENERATIONS if arguments.generations is None else arguments.generations
    if arguments.budget is not None:
        if arguments.budget < arguments.population:
            raise TuningError(f"a budget of {arguments.budget} is less than one population of {arguments.population}")
        generations = arguments.budget // max(arguments.population, 1)
    perturbed = _perturbed(case, arguments)
    free = arguments.free or (case.search.get("free") if controller != "pid" else None)
    extra = (free,) if free else ()
    return TuningProblem(
        case,
        controller,
        extra,
        case.weight,
        arguments.algorithm,
        arguments.seed,
        arguments.population,
        generations,
        arguments.polish,
        constraints_of(arguments, case),
        warm=not arguments.cold,
        until_converged=arguments.until_converged,
        perturbed=perturbed,
    )


def _perturbed(case: Case, arguments: argparse.Namespace) -> Perturbed | None:
    """The plants to tune for at once.

    Raises:
        TuningError, RobustError: some but not all is given, or there are no such plants.
    """
    if arguments.robust is None:
        if arguments.spread or arguments.robust_by != "mean":
            raise TuningError("--spread and --robust-by are of the plants that --robust N tunes for: give it too")
        if arguments.scheduler:
            raise TuningError("--scheduler is for the many plants of --robust N: without them, threads are faster")
        return None
    by: str | float = arguments.robust_by
    if by not in ("mean", "worst"):
        try:
            by = float(by)
        except ValueError:
            raise TuningError(f"--robust-by {by}: take mean, worst, or a quantile as a fraction, 0.9") from None
    return Perturbed(spreads_of(case, arguments.spread), arguments.robust, by)


def _check_episodes(problem: TuningProblem) -> None:
    """Refuse episodes whose metrics could not be told at the end, whatever the gains."""
    response_report(problem.case, problem.gains(np.array([low for low, _ in problem.bounds])))


def _check_outputs(arguments: argparse.Namespace) -> None:
    """Refuse outputs that cannot be written before hours are spent on what goes there."""
    if arguments.resume and not arguments.checkpoint:
        raise TuningError("--resume needs --checkpoint FILE: what to go on from")
    written = [path for path in (arguments.checkpoint, arguments.out) if path] + outputs_of(arguments)
    check_outputs(written, [find_parameter_file(arguments.case)])
    if arguments.out:
        check_replaceable(arguments.out, "controller", Gains().as_dict())


@contextmanager
def _interrupt_requested() -> Iterator[Callable[[], bool]]:
    """Whether Ctrl-C was pressed: the first time asks to end with the generation, the second ends at once."""
    requests = []

    def request(number: int, frame: FrameType | None) -> None:
        requests.append(number)
        signal.signal(signal.SIGINT, before)

    before = signal.signal(signal.SIGINT, request)
    try:
        yield lambda: bool(requests)
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def _progress(study: Study, shown: bool) -> Iterator[Callable[[Study], None]]:
    from tqdm import tqdm

    with tqdm(
        total=study.budget, initial=study.evaluations, unit=" evaluations", disable=None if shown else True
    ) as bar:

        def show(study: Study) -> None:
            bar.set_description(f"generation {study.generation}, {study.best_told}", refresh=False)
            bar.update(study.evaluations - bar.n)

        yield show


def _how_to_go_on(arguments: argparse.Namespace) -> str:
    return "go on with --resume" if arguments.checkpoint else "nothing kept, for there is no --checkpoint"


def _say_interrupted(study: Study, arguments: argparse.Namespace) -> None:
    print(
        f"tdof-npid tune: interrupted after {study.evaluations} of {study.budget} evaluations, "
        f"{study.best_told}: {_how_to_go_on(arguments)}",
        file=sys.stderr,
    )


def _summary(report: dict[str, Any], found: Margins) -> str:
    setpoint, disturbance, before = report["setpoint"], report["disturbance"], report["before"]
    ends = report["at_bounds"]
    gains = [
        f"  {name:10} {value:<12.6g} before: {before['gains'][name]:.6g}"
        + (f"   at the {ends[name]} bound of the search" if name in ends else "")
        for name, value in report["gains"].items()
    ]
    was = f"before: {before['objective']:.6g} with {before['controller']}"
    ended = ", converged" if report["converged"] else ""
    saved = f", {report['evaluations_saved']} saved" if report["evaluations_saved"] else ""
    began = "the case's gains and random ones" if report["start"] == "case" else "random gains"
    return "\n".join(
        [
            f"{report['case']}  {report['controller']}: objective {report['objective']:.6g}, {was}",
            *gains,
            f"  setpoint: overshoot {setpoint['overshoot_percent']:.2f} %, IAE {in_units(setpoint['iae'])}",
            f"  disturbance: peak {in_units(disturbance['peak'])}, IAE {in_units(disturbance['iae'])}",
            *(f"  {line}" for line in found.lines()),
            *([f"  {_warning(report)}"] if _is_near(found) else []),
            f"  {report['evaluations']} evaluations in {report['elapsed_s']:.1f} s, from {began}{ended}{saved}",
        ]
    )


def _is_near(found: Margins) -> bool:
    """Whether the loop is nearer to instability than is usual."""
    return found.m_s is not None and found.m_s > 1.01 * USUAL_M_S


def _price(problem: TuningProblem, result: TuningResult, found: Margins) -> dict[str, float] | None:
    """What it costs to keep M_s within what is usual; None where it is, or was asked for, or nothing was found.

    Nor is it told of gains for many plants: M_s is that of the case's own.
    """
    if problem.constraints.ms is not None or problem.perturbed or not _is_near(found):
        return None
    held = price_of_ms(problem, result.gains, USUAL_M_S)
    if held is None:
        return None
    return {
        "ms": USUAL_M_S,
        "objective": held.objective,
        "percent": 100.0 * (held.objective / result.objective - 1.0),
    }


def _warning(report: dict[str, Any]) -> str:
    price = report["price"]
    near = f"M_s is above {USUAL_M_S:g}, nearer to instability than is usual: --ms {USUAL_M_S:g} keeps away from it"
    return near + (f", objective at most {price['objective']:.6g} ({price['percent']:+.1f} %)" if price else "")


def _compared(problem: TuningProblem, tuned: Gains) -> dict[str, Gains]:
    """What the tuned gains stand beside in a picture: those of the file, and PID tuned in the same way."""
    before = problem.case.gains
    curves = {f"{title(before)} before": before, f"{title(tuned)} tuned": tuned}
    if tuned.type != "pid":
        study = Study(replace(problem, controller="pid", extra=()))
        study.run(Objective(study.problem))
        if study.feasible:
            curves["PID tuned"] = study.result.gains
        else:
            warnings.warn("no PID with the margins that were asked for was found to stand beside", stacklevel=2)
    return curves
