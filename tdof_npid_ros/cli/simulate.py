"""`tdof-npid simulate`: a case in process."""

from __future__ import annotations

import argparse
import csv
import json
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tdof_npid_ros.advice import gravest
from tdof_npid_ros.case import Case, load_case
from tdof_npid_ros.cli.gains import add_gain_arguments, chosen_gains, headline, loop_report
from tdof_npid_ros.cli.terminal import say
from tdof_npid_ros.control.gains import Gains
from tdof_npid_ros.interactive import Page, response_plots
from tdof_npid_ros.metrics import in_units
from tdof_npid_ros.output_file import check_outputs
from tdof_npid_ros.parameter_file import find_parameter_file
from tdof_npid_ros.plotting import Panel, draw_responses
from tdof_npid_ros.prediction import gains_table, measured, numbers, panels, shown, simulated
from tdof_npid_ros.stability.margins import Margins, margins


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this subcommand's arguments."""
    parser.add_argument("case", help="a case (p1-c0.5, …, sprott) or the path of a parameter file")
    add_gain_arguments(parser)
    add_output_arguments(parser)


def add_output_arguments(parser: argparse.ArgumentParser) -> None:
    """Add what can be written of simulated responses."""
    parser.add_argument("--plot", type=Path, metavar="FILE", help="picture of the responses")
    parser.add_argument("--html", type=Path, metavar="FILE", help="one page with interactive plots, for any browser")
    parser.add_argument("--csv", type=Path, metavar="FILE", help="the responses, a row for each sample of each episode")


def run(arguments: argparse.Namespace) -> int:
    """Print the metrics of the case's setpoint and disturbance episodes, and the margins."""
    check_outputs(outputs_of(arguments), [find_parameter_file(arguments.case)])
    case = load_case(arguments.case)
    gains = chosen_gains(case, arguments)
    found = margins(case, gains)
    report = response_report(case, gains) | {"margins": found.as_dict()} | advised(case, gains, found)
    write_responses(case, {title(gains): gains}, arguments)
    lines = [headline(case, gains), *_table(report), *(f"  margins      {line}" for line in found.lines())]
    lines += written(outputs_of(arguments))
    if arguments.json:
        print(json.dumps(report))
    else:
        say(lines)
    return 0


def written(paths: Sequence[Path]) -> list[str]:
    """Where the things are that were written, a line for each."""
    return [f"  written: {path}" for path in paths]


def outputs_of(arguments: argparse.Namespace) -> list[Path]:
    """The files that `add_output_arguments` are to be written to."""
    return [path for path in (arguments.plot, arguments.html, arguments.csv) if path]


def title(gains: Gains) -> str:
    """A controller's type as the paper writes it: TDOF-NPID2."""
    return gains.type.replace("_", "-").upper()


def write_responses(case: Case, of: Mapping[str, Gains], arguments: argparse.Namespace) -> None:
    """Write the picture and the table that the arguments ask for.

    Args:
        of: gains by what their curves are called.
    """
    if not outputs_of(arguments):
        return
    runs = simulated(case, of)
    drawn = panels(case, runs)
    if arguments.plot:
        draw_responses(drawn, arguments.plot, title=case.name)
    if arguments.html:
        _page(case, of, drawn).write(arguments.html)
    if arguments.csv:
        with arguments.csv.open("w", newline="", encoding="utf-8") as file:
            table = csv.writer(file)
            table.writerow(("episode", "controller", "time", "setpoint", "disturbance", "output", "control_effort"))
            for name, curves in runs.items():
                for label, run in curves.items():
                    columns = (run.time, run.setpoint, run.disturbance, run.output[:, 0], run.control_effort[:, 0])
                    table.writerows((name, label, *row) for row in zip(*map(np.ndarray.tolist, columns), strict=True))


def _page(case: Case, of: Mapping[str, Gains], drawn: Sequence[Panel]) -> Page:
    page = Page(case.name)
    page.table(numbers(case, of))
    for panel in drawn:
        page.heading(panel.title)
        page.plot(*response_plots(panel))
    page.heading("Gains")
    page.table(gains_table(of))
    return page


def response_report(case: Case, gains: Gains) -> dict[str, Any]:
    """Metrics of both episodes and the objective (10), as the contract's JSON object."""
    found = measured(case, gains)
    return {
        **loop_report(case, gains),
        **{episode: _without_empty_reason(metrics) for episode, metrics in found.items()},
        "objective": found["setpoint"]["iae"] + case.weight * found["disturbance"]["iae"],
    }


def advised(case: Case, gains: Gains, its_margins: Margins) -> dict[str, Any]:
    """Warn of the gravest finding with these gains, if there is one; the same as a key for the JSON object."""
    found = gravest(replace(case, gains=gains), its_margins)
    if found is None:
        return {}
    warnings.warn(found.line(), stacklevel=2)
    return {"warning": found._asdict()}


def _without_empty_reason(metrics: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in metrics.items() if name != "reason" or value is not None}


def _table(report: dict[str, Any]) -> list[str]:
    lines = []
    for episode in ("setpoint", "disturbance"):
        for name, value in report[episode].items():
            told = value if isinstance(value, str) else "-" if value is None else shown(name, value)
            lines.append(f"  {episode:12} {name:18} {told}")
    return [*lines, f"  objective {in_units(report['objective'])}"]
