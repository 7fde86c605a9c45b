"""`tdof-npid robust`: how gains do on many plants near the model."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import cast

from tdof_npid_ros.case import load_case
from tdof_npid_ros.cli.gains import add_gain_arguments, chosen_gains, headline
from tdof_npid_ros.cli.scheduler import add_scheduler_argument
from tdof_npid_ros.cli.simulate import written
from tdof_npid_ros.output_file import check_outputs
from tdof_npid_ros.parameter_file import find_parameter_file, write_parameters
from tdof_npid_ros.robustness import RobustError
from tdof_npid_ros.robustness.picture import draw, page
from tdof_npid_ros.robustness.result import WORST, sweep_plants
from tdof_npid_ros.robustness.spread import FORMS, SAMPLINGS, Sampling, spreads_of
from tdof_npid_ros.workers import workers

SAMPLES = 10_000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this subcommand's arguments."""
    parser.add_argument("case", help="a case (p1-c0.5, …, sprott) or the path of a parameter file")
    add_spread_argument(parser)
    parser.add_argument("--samples", type=int, default=SAMPLES, metavar="N", help=f"plants (default: {SAMPLES:,})")
    parser.add_argument(
        "--sampling",
        choices=SAMPLINGS,
        default=SAMPLINGS[0],
        help="uniform between the ends (default); latin: evenly along each parameter; normal: the ends are two "
        "standard deviations off; corners: the ends alone",
    )
    parser.add_argument("--seed", type=int, default=0, help="the same seed gives the same plants (default: 0)")
    add_gain_arguments(parser)
    add_scheduler_argument(parser)
    parser.add_argument("--checkpoint", type=Path, metavar="FILE", help="keeps what is done")
    parser.add_argument("--resume", action="store_true", help="go on from the checkpoint, if it is there")
    parser.add_argument("--out", type=Path, metavar="DIR", help="write the worst plants there, files for simulate")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="picture: fans of responses, histograms")
    parser.add_argument("--html", type=Path, metavar="FILE", help="one page with interactive plots, for any browser")


def add_spread_argument(parser: argparse._ActionsContainer) -> None:
    """Add how far the plant may be from the model."""
    parser.add_argument(
        "--spread",
        action="append",
        default=[],
        metavar="SPREAD",
        help=f"of a parameter of the plant, once or more: {FORMS}".replace("%", "%%"),
    )


def run(arguments: argparse.Namespace) -> int:
    """Run the sweep, print its report, and write what was asked for."""
    if arguments.resume and not arguments.checkpoint:
        raise RobustError("--resume needs --checkpoint FILE: what to go on from")
    outputs = [path for path in (arguments.plot, arguments.html, arguments.checkpoint) if path]
    worst_files = _worst_files(arguments.out)
    check_outputs(outputs + worst_files, [find_parameter_file(arguments.case)])
    case = load_case(arguments.case)
    gains = chosen_gains(case, arguments)
    sampling = cast(Sampling, arguments.sampling)
    spreads = spreads_of(case, arguments.spread, sampling)
    with workers(arguments.scheduler) as here:
        result = sweep_plants(
            here, case, gains, spreads, count=arguments.samples, sampling=sampling, seed=arguments.seed,
            checkpoint=arguments.checkpoint, resume=arguments.resume,
        )  # fmt: skip
    worst = dict(zip(worst_files, result.worst(), strict=False))
    for path, index in worst.items():
        write_parameters(path, result.parameters(index))
    if arguments.plot:
        draw(result, arguments.plot)
    if arguments.html:
        page(result).write(arguments.html)
    lines = [headline(case, gains), *result.lines()]
    lines += written([path for path in (*worst, arguments.plot, arguments.html) if path])
    print(json.dumps(result.as_dict()) if arguments.json else "\n".join(lines))
    return 0


def _worst_files(folder: Path | None) -> list[Path]:
    """Where the worst plants are written.

    Raises:
        RobustError: the folder cannot be made.
    """
    if folder is None:
        return []
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RobustError(f"{folder} cannot be made: {error.strerror}") from error
    return [folder / f"worst-{number}.yaml" for number in range(1, WORST + 1)]
