"""`tdof-npid pareto`: fronts of tracking against rejection, of a case or of the paper's Figure 6."""

from __future__ import annotations

import argparse
import csv
import json
import math
from pathlib import Path
from typing import Any

from tdof_npid_ros.case import Case, load_case
from tdof_npid_ros.cli.scheduler import add_scheduler_argument
from tdof_npid_ros.cli.simulate import written
from tdof_npid_ros.cli.tune import add_constraint_arguments, constraints_of
from tdof_npid_ros.control.gains import CONTROLLER_TYPES, ControllerType, controller_type
from tdof_npid_ros.output_file import check_writable
from tdof_npid_ros.paper.output import claim_folder, kept_until_written
from tdof_npid_ros.parameter_file import write_parameters
from tdof_npid_ros.tuning import TuningError
from tdof_npid_ros.tuning.pareto import (
    GENERATIONS,
    RATIOS,
    Front,
    FrontSearch,
    Loop,
    case_of,
    chain_points,
    chains_of,
    check_installed,
    fronts_of,
)
from tdof_npid_ros.workers import ChunkCheckpoint, Workers, workers

SUBCOMMAND = "pareto"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this subcommand's arguments."""
    parser.add_argument(
        "case", nargs="?", help="a case (p1-c0.5, …) or the path of a parameter file (default: Figure 6's loops)"
    )
    parser.add_argument(
        "--ratio", type=float, nargs="+", metavar="L/T", help="of Figure 6's loops (default: 0.1 0.5 1)"
    )
    parser.add_argument(
        "--controller", nargs="+", default=list(CONTROLLER_TYPES), metavar="TYPE", help="default: all four"
    )
    parser.add_argument("--seed", type=int, default=0, help="of NSGA-II (default: 0)")
    parser.add_argument("--generations", type=int, default=GENERATIONS, metavar="N", help=f"default: {GENERATIONS}")
    parser.add_argument("--out", type=Path, metavar="DIR", help="write fronts.csv, fronts.json and fronts.png there")
    parser.add_argument(
        "--write",
        type=Path,
        metavar="FILE",
        help="write one point as a ROS parameter file (of one front)",
    )
    add_constraint_arguments(parser)
    add_scheduler_argument(parser)
    selected = parser.add_mutually_exclusive_group()
    selected.add_argument("--index", type=int, metavar="N", help="of the point to write, by increasing IAE_SP")
    selected.add_argument(
        "--weight",
        type=float,
        metavar="W",
        help="write the point with the least IAE_SP + W·IAE_DIS (default: 1)",
    )


def run(arguments: argparse.Namespace) -> int:
    """Find the fronts, print them, and write what was asked for."""
    controllers = [controller_type(name) for name in dict.fromkeys(arguments.controller)]
    if arguments.case is not None and arguments.ratio is not None:
        raise TuningError("--ratio is of Figure 6's loops: give it, or a case")
    case = None if arguments.case is None else load_case(arguments.case)
    loops: list[Loop] = list(dict.fromkeys(arguments.ratio or RATIOS)) if case is None else [case]
    _refuse_bad_arguments(arguments, len(controllers) * len(loops))
    check_installed()
    for loop in loops:
        case_of(loop)
    if arguments.out:
        claim_folder(arguments.out, SUBCOMMAND)
    search = FrontSearch(arguments.seed, arguments.generations, constraints_of(arguments, case))
    with workers(arguments.scheduler) as where:
        if arguments.out:
            with kept_until_written(arguments.out, _work(search, loops, controllers)) as checkpoint:
                fronts = _find(search, loops, controllers, where, checkpoint)
                _write(fronts, arguments.out)
        else:
            fronts = _find(search, loops, controllers, where)
    rows = [row for front in fronts for row in front.rows()]
    if arguments.write:
        weight = 1.0 if arguments.weight is None else arguments.weight
        index = fronts[0].best(weight) if arguments.index is None else arguments.index
        write_parameters(arguments.write, fronts[0].parameters(index))
    lines = [_table(fronts), *written([path for path in (arguments.out, arguments.write) if path])]
    print(json.dumps({"seed": arguments.seed, "points": rows}) if arguments.json else "\n".join(lines))
    return 0


def _refuse_bad_arguments(arguments: argparse.Namespace, fronts: int) -> None:
    """Before minutes are spent on what could not be selected or written in the end."""
    path, index, weight = arguments.write, arguments.index, arguments.weight
    if arguments.seed < 0:
        raise TuningError(f"--seed {arguments.seed}: it must not be below 0")
    if arguments.generations < 1:
        raise TuningError(f"--generations {arguments.generations}: at least 1")
    if index is not None and index < 0:
        raise TuningError(f"--index {index}: points are numbered from 0")
    if weight is not None and not 0.0 <= weight < math.inf:
        raise TuningError(f"--weight {weight}: it must be finite and not below 0")
    if path is None and (index, weight) != (None, None):
        raise TuningError("--index and --weight pick the point to write: give --write FILE too")
    if path is None:
        return
    if fronts != 1:
        raise TuningError(
            f"--write takes a point of one front, but there are {fronts}: give one --controller, and one --ratio or "
            "a case"
        )
    if path.exists():
        raise TuningError(f"{path} exists: give another file")
    check_writable(path)


def _find(
    search: FrontSearch,
    loops: list[Loop],
    controllers: list[ControllerType],
    where: Workers,
    checkpoint: ChunkCheckpoint | None = None,
) -> list[Front]:
    """The fronts by loop and type, in the order in which they were asked for."""
    chains = chains_of(loops, controllers)
    search = search._replace(threads=where.threads_in(len(chains)))
    sizes = [len(chain.controllers) for chain in chains]
    points = where.map(chain_points, search, chains, unit="front", sizes=sizes, checkpoint=checkpoint)
    fronts = fronts_of(chains, points)
    ratios = [None if isinstance(loop, Case) else loop for loop in loops]
    return [fronts[ratio, controller] for ratio in ratios for controller in controllers]


def _work(search: FrontSearch, loops: list[Loop], controllers: list[ControllerType]) -> dict[str, Any]:
    """What the fronts depend on, as JSON holds it."""
    constraints = search.constraints.given if search.constraints else {}
    return {
        "fronts": [repr(loop.parameters()) if isinstance(loop, Case) else loop for loop in loops],
        "controllers": controllers,
        "seed": search.seed,
        "generations": search.generations,
        "constraints": constraints,
    }


def _write(fronts: list[Front], folder: Path) -> None:
    from tdof_npid_ros.paper.figures import draw_fronts

    rows = [row for front in fronts for row in front.rows()]
    with (folder / "fronts.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    (folder / "fronts.json").write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    draw_fronts(fronts, folder / "fronts.png")


def _table(fronts: list[Front]) -> str:
    lines = [f"{'loop':12}{'controller':12}{'points':>8}{'IAE_SP':>18}{'IAE_DIS':>20}{'least sum':>12}"]
    for front in fronts:
        lines.append(
            f"{front.title:12}{front.controller:12}{len(front.gains):8d}"
            + "".join(
                f"{low:12.4f} .. {high:.4f}"
                for low, high in zip(front.iae.min(axis=0), front.iae.max(axis=0), strict=True)
            )
            + f"{front.iae[front.best()].sum():12.4f}"
        )
    return "\n".join(lines)
