"""`tdof-npid new`: a commented parameter file for a plant of one's own."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from tdof_npid_ros.case import Case, load_case
from tdof_npid_ros.control.gains import CONTROLLER_TYPES, controller_type
from tdof_npid_ros.draft import Draft, Process, process_of, significant
from tdof_npid_ros.output_file import OutputError, check_writable
from tdof_npid_ros.parameter_file import ParameterFileError
from tdof_npid_ros.parameters import GAINS
from tdof_npid_ros.plants.catalog import make_plant, named_model
from tdof_npid_ros.plants.ode import Ode
from tdof_npid_ros.stability.margins import margins

RUN = "run {0} --gains tuned.yaml --bag bags/first"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this subcommand's arguments."""
    parser.add_argument("file", type=Path, metavar="FILE", help="the parameter file to write; it must not be there yet")
    plant = parser.add_argument_group("the plant (asked for, if neither is given, in a terminal)")
    plant.add_argument("--gain", type=float, metavar="K", help="output per effort; of an integrating plant, per second")
    plant.add_argument(
        "--time-constant", type=float, nargs="+", metavar="T", help="s; one for each lag; negative: unstable"
    )
    plant.add_argument("--dead-time", type=float, default=0.0, metavar="L", help="s (default: 0)")
    plant.add_argument("--integrating", action="store_true", help="the output goes on moving: a position, a level")
    plant.add_argument("--model", metavar="MODULE:CLASS", help="a class of your own, in place of gain and times")
    loop = parser.add_argument_group("the loop")
    loop.add_argument("--effort", type=float, nargs=2, metavar=("MIN", "MAX"), help="what the actuator can do")
    loop.add_argument("--step", type=float, metavar="S", help="the largest change of the setpoint")
    loop.add_argument("--at", type=float, metavar="Y", help="the output where it begins, at rest (default: 0)")
    loop.add_argument("--at-effort", type=float, metavar="U", help="the effort there (default: 0)")
    loop.add_argument("--unit", default="", help="of the output, for axes and tables: K, rad, m")
    loop.add_argument("--effort-unit", default="", metavar="UNIT", help="of the effort: %%, V, N")
    loop.add_argument("--sample-period", type=float, metavar="H", help="s (default: chosen)")
    loop.add_argument("--controller", default=GAINS["type"].default, metavar="TYPE", help=", ".join(CONTROLLER_TYPES))


def run(arguments: argparse.Namespace) -> int:
    """Write the file and say what to do with it."""
    path: Path = arguments.file
    if path.exists():
        raise OutputError(f"{path} exists and is not overwritten: give another name")
    if path.suffix not in (".yaml", ".yml"):
        raise OutputError(f"{path}: a parameter file's name ends with .yaml")
    check_writable(path)
    if arguments.model is None and arguments.gain is None and sys.stdin.isatty() and not arguments.json:
        _ask(arguments)
    draft = _draft(arguments)
    path.write_text(draft.text(), encoding="utf-8")
    try:
        if (ms := _reachable(load_case(path), draft.ms)) != draft.ms:
            path.write_text(replace(draft, ms=ms).text(), encoding="utf-8")
    except ValueError:
        path.unlink()  # it would be our own mistake, and must not be left to the user
        raise
    if arguments.json:
        gains = draft.process.first_gains(draft.period)
        first = {name: getattr(gains, name) for name in ("rule", "kp", "ki", "kd")}
        print(json.dumps({"file": str(path), "sample_period": draft.period, "horizon_s": draft.horizon, **first}))
    else:
        print(f"written: {path}")
        for line in ("check {0}", "simulate {0} --plot response.png", "tune {0} --out tuned.yaml", RUN):
            print(f"next     tdof-npid {line.format(path)}")
    return 0


def _reachable(case: Case, ms: float | None) -> float | None:
    """The limit of M_s, or a wider one where even the first gains are beyond it; None where there are no margins."""
    found = margins(case, case.gains)
    if found.m_s is None or ms is None:
        return None
    return ms if found.m_s <= ms else significant(1.1 * found.m_s, 2)


def _draft(arguments: argparse.Namespace) -> Draft:
    missing = [
        option
        for option, given in (
            ("--gain", arguments.model or arguments.gain is not None),
            ("--time-constant", arguments.model or arguments.time_constant or arguments.integrating),
            ("--step", arguments.step is not None),
        )
        if not given
    ]
    if missing:
        raise ParameterFileError(
            f"{', '.join(missing)} missing: a plant is --gain K --time-constant T [--dead-time L], or --model "
            "MODULE:CLASS, and --step is the largest change of the setpoint"
        )
    if arguments.model is not None and (arguments.gain is not None or arguments.time_constant):
        raise ParameterFileError(
            "--model is a class of your own: --gain and --time-constant do not go with it "
            "(an integrating plant is --gain K --integrating)"
        )
    common: dict[str, Any] = {
        "step": arguments.step,
        "effort": tuple(arguments.effort or (-math.inf, math.inf)),
        "unit": arguments.unit,
        "effort_unit": arguments.effort_unit,
        "sample_period": arguments.sample_period,
        "controller": controller_type(arguments.controller),
    }
    at = 0.0 if arguments.at is None else arguments.at
    rest = 0.0 if arguments.at_effort is None else arguments.at_effort
    if arguments.model is not None:
        return _of_class(named_model(arguments.model, arguments.file.parent), at, common)
    process = Process(
        arguments.gain, tuple(arguments.time_constant or ()), arguments.dead_time, integrating=arguments.integrating
    )
    plant = process.transfer_function()
    if at or rest:
        plant |= {"output_offset": at, "effort_offset": rest}
    kind = "integrating plant" if process.integrating else "plant"
    title = f"A {kind}: gain {process.gain:g}, lags {', '.join(f'{t:g}' for t in process.time_constants) or 'none'} s"
    title += f", dead time {process.dead_time:g} s"
    return Draft(process, plant, at=at, rest_effort=rest, title=title, **common)


def _of_class(model: str, at: float, common: dict[str, Any]) -> Draft:
    plant = make_plant(model, {})
    assert isinstance(plant, Ode)
    resting = plant.at_rest(at)
    there = resting.at_rest(at + common["step"])
    process = process_of(resting if resting.initial_effort else there)
    return Draft(
        process,
        {"model": model, "substeps": 4.0},
        at=at,
        rest_effort=resting.initial_effort,
        title=f"{model}: a class of your own",
        notes=(
            f"Near {at + (0.0 if resting.initial_effort else common['step']):g} it is like gain {process.gain:.4g}, "
            f"lags {', '.join(f'{t:.4g}' for t in process.time_constants) or 'none'} s"
            + (", integrating." if process.integrating else "."),
        ),
        **common,
    )


def _ask(arguments: argparse.Namespace) -> None:
    """The few facts that cannot be guessed, one question each; an empty answer takes what stands in brackets."""
    print("A plant of your own, near the output where it will work:")
    arguments.integrating = _answer("does the output go on moving under a constant effort? y/n [n]: ", str, "n") == "y"
    arguments.gain = _answer("gain, output per effort" + (" and second: " if arguments.integrating else ": "), float)
    if not arguments.integrating:
        arguments.time_constant = [_answer("time constant, s: ", float)]
    arguments.dead_time = _answer("dead time, s [0]: ", float, 0.0)
    arguments.step = _answer("largest change of the setpoint: ", float)
    arguments.at = _answer("output where it begins, at rest [0]: ", float, 0.0)
    low = _answer("least effort of the actuator [no limit]: ", float, -math.inf)
    arguments.effort = (low, _answer("most effort of the actuator [no limit]: ", float, math.inf))
    arguments.unit = _answer("unit of the output []: ", str, "")
    arguments.effort_unit = _answer("unit of the effort []: ", str, "")


def _answer(question: str, kind: Callable[[str], Any], otherwise: Any = None) -> Any:
    while True:
        try:
            given = input(question).strip()
        except EOFError:
            raise ParameterFileError("the input ended before all was asked: give options instead, see --help") from None
        if not given and otherwise is not None:
            return otherwise
        try:
            return kind(given)
        except ValueError:
            print("  a number is needed")
