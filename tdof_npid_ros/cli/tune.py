"""`tdof-npid tune`: find the gains of a case."""

from __future__ import annotations

import argparse
import json
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from tdof_npid_ros.case import load_case
from tdof_npid_ros.cli import INTERRUPTED
from tdof_npid_ros.cli.simulate import (
    add_output_arguments,
    advised,
    outputs_of,
    response_report,
    title,
    write_responses,
)
from tdof_npid_ros.control.gains import CONTROLLER_TYPES, Gains, controller_type
from tdof_npid_ros.output_file import check_outputs
from tdof_npid_ros.parameter_file import check_replaceable, find_parameter_file, write_parameters
from tdof_npid_ros.parameters import TUNER
from tdof_npid_ros.tuning import TuningError
from tdof_npid_ros.tuning.objective import Objective
from tdof_npid_ros.tuning.optimizers import ALGORITHMS
from tdof_npid_ros.tuning.problem import GENERATIONS, POLISH, POPULATION, TuningProblem
from tdof_npid_ros.tuning.study import Study


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this subcommand's arguments."""
    parser.add_argument("case", help="a case (p1-c0.5, …, sprott) or the path of a parameter file")
    parser.add_argument("--controller", required=True, metavar="TYPE", help=", ".join(CONTROLLER_TYPES))
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
    parser.add_argument("--checkpoint", type=Path, metavar="FILE", help="saved after each generation")
    parser.add_argument("--resume", action="store_true", help="go on from the checkpoint, if it is there")
    parser.add_argument("--out", type=Path, metavar="FILE", help="write the gains as a ROS parameter file")
    add_output_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Tune, print the optimum's metrics, and write what was asked for."""
    _check_outputs(arguments)
    problem = _problem(arguments)
    _check_episodes(problem)
    study = Study(problem, arguments.checkpoint, arguments.resume)
    started = time.monotonic()
    with _interrupt_requested() as interrupted, _progress(study, shown=not arguments.json) as show:
        study.run(Objective(problem), lambda study: show(study) or not interrupted())
    if not study.done:
        _say_interrupted(study, arguments)
        return INTERRUPTED
    result = study.result
    report = response_report(problem.case, result.gains)
    report |= {"evaluations": result.evaluations, "elapsed_s": round(time.monotonic() - started, 3)}
    report |= advised(problem.case, result.gains)
    if arguments.out:
        write_parameters(arguments.out, {"controller": result.gains.as_dict()})
    write_responses(problem.case, _compared(problem, result.gains), arguments)
    print(json.dumps(report) if arguments.json else _summary(report))
    return 0


def _problem(arguments: argparse.Namespace) -> TuningProblem:
    controller = controller_type(arguments.controller)
    case = load_case(arguments.case)
    if arguments.weight is not None:
        case = replace(case, weight=arguments.weight)
    generations = GENERATIONS if arguments.generations is None else arguments.generations
    if arguments.budget is not None:
        if arguments.budget < arguments.population:
            raise TuningError(f"a budget of {arguments.budget} is less than one population of {arguments.population}")
        generations = arguments.budget // max(arguments.population, 1)
    extra = (arguments.free,) if arguments.free else ()
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
    )


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

    with tqdm(total=study.budget, initial=study.evaluations, unit=" evaluations", disable=not shown) as bar:

        def show(study: Study) -> None:
            bar.set_description(f"generation {study.generation}, best {study.best_value:.6g}", refresh=False)
            bar.update(study.evaluations - bar.n)

        yield show


def _say_interrupted(study: Study, arguments: argparse.Namespace) -> None:
    how = "go on with --resume" if arguments.checkpoint else "nothing kept, for there is no --checkpoint"
    print(
        f"tdof-npid tune: interrupted after {study.evaluations} of {study.budget} evaluations, "
        f"best {study.best_value:.6g}: {how}",
        file=sys.stderr,
    )


def _summary(report: dict[str, Any]) -> str:
    gains = [f"  {name:10} {value:.6g}" for name, value in report["gains"].items()]
    setpoint, disturbance = report["setpoint"], report["disturbance"]
    return "\n".join(
        [
            f"{report['case']}  {report['controller']}: objective {report['objective']:.6g}",
            *gains,
            f"  setpoint: overshoot {setpoint['overshoot_percent']:.2f} %, IAE {setpoint['iae']:.4f}",
            f"  disturbance: peak {disturbance['peak']:.4f}, IAE {disturbance['iae']:.4f}",
            f"  {report['evaluations']} evaluations in {report['elapsed_s']:.1f} s",
        ]
    )


def _compared(problem: TuningProblem, tuned: Gains) -> dict[str, Gains]:
    """What the tuned gains stand beside in a picture: those of the file."""
    before = problem.case.gains
    return {f"{title(before)} before": before, f"{title(tuned)} tuned": tuned}
