"""`tdof-npid simulate`: a case in process."""

from __future__ import annotations

import argparse
import json
import warnings
from dataclasses import asdict, replace
from typing import Any

from tdof_npid_ros.advice import gravest
from tdof_npid_ros.case import Case, load_case
from tdof_npid_ros.cli.gains import add_gain_arguments, chosen_gains
from tdof_npid_ros.control.gains import PER_LANE, Gains


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this subcommand's arguments."""
    parser.add_argument("case", help="a case (p1-c0.5, …, sprott) or the path of a parameter file")
    add_gain_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Print the metrics of the case's setpoint and disturbance episodes."""
    case = load_case(arguments.case)
    gains = chosen_gains(case, arguments)
    report = response_report(case, gains) | advised(case, gains)
    print(json.dumps(report) if arguments.json else _table(report))
    return 0


def response_report(case: Case, gains: Gains) -> dict[str, Any]:
    """Metrics of both episodes and the objective (10), as the contract's JSON object."""
    setpoint, disturbance = case.setpoint_response(gains), case.disturbance_response(gains)
    return {
        "case": case.name,
        "controller": gains.type,
        "gains": {name: getattr(gains, name) for name in PER_LANE},
        "setpoint": _without_empty_reason(asdict(setpoint)),
        "disturbance": _without_empty_reason(asdict(disturbance)),
        "objective": setpoint.iae + case.weight * disturbance.iae,
    }


def advised(case: Case, gains: Gains) -> dict[str, Any]:
    """Warn of the gravest finding with these gains, if there is one; the same as a key for the JSON object."""
    found = gravest(replace(case, gains=gains))
    if found is None:
        return {}
    warnings.warn(found.line(), stacklevel=2)
    return {"warning": found._asdict()}


def _without_empty_reason(metrics: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in metrics.items() if name != "reason" or value is not None}


def _table(report: dict[str, Any]) -> str:
    gains = "  ".join(f"{name} {value:g}" for name, value in report["gains"].items())
    lines = [f"{report['case']}  {report['controller']}  {gains}"]
    for episode in ("setpoint", "disturbance"):
        for name, value in report[episode].items():
            shown = value if isinstance(value, str) else "-" if value is None else _number(value)
            lines.append(f"  {episode:12} {name:18} {shown}")
    return "\n".join([*lines, f"  objective {_number(report['objective'])}"])


def _number(value: float) -> str:
    return f"{value:.4f}" if abs(value) < 1e6 else f"{value:.3g}"  # a loop that diverges
