"""Which gains a subcommand runs with: its arguments, and what it says of them."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from tdof_npid_ros.case import Case, load_case
from tdof_npid_ros.control.gains import (
    CONTROLLER_TYPES,
    PER_LANE,
    Gains,
    GainsError,
    controller_type,
    gains_from_mapping,
)
from tdof_npid_ros.paper.tables import published
from tdof_npid_ros.paper.tuned import tuned
from tdof_npid_ros.parameter_file import ParameterFileError, read_parameters


def add_gain_arguments(parser: argparse.ArgumentParser) -> None:
    """Add --controller, --gains and one option per gain."""
    parser.add_argument("--controller", metavar="TYPE", help=f"{', '.join(CONTROLLER_TYPES)} (default: the case's)")
    parser.add_argument(
        "--gains",
        default=None,
        metavar="published|tuned|FILE",
        help="where the gains come from (default: published, or the case's own)",
    )
    for name in PER_LANE:
        parser.add_argument(f"--{name}", type=float, help=f"override {name}")


def chosen_gains(case: Case, arguments: argparse.Namespace) -> Gains:
    """The gains that the arguments ask for; limits and anti-windup stay the case's.

    Raises:
        ParameterFileError, GainsError: there are no such gains, or they are not valid.
    """
    overrides = {name: getattr(arguments, name) for name in PER_LANE if getattr(arguments, name) is not None}
    return gains_by_source(case, arguments.controller, arguments.gains).with_values(**overrides)


def asked_for(arguments: argparse.Namespace) -> dict[str, Any]:
    """The type and gains as a controller's parameters, where the arguments ask for some of their case; else nothing.

    Raises:
        ParameterFileError, GainsError: as `chosen_gains`.
    """
    if all(getattr(arguments, name) is None for name in ("controller", "gains", *PER_LANE)):
        return {}
    gains = chosen_gains(load_case(arguments.case), arguments)
    return {name: getattr(gains, name) for name in ("type", *PER_LANE)}


def gains_by_source(case: Case, kind: str | None, source: str | None) -> Gains:
    """Gains of a controller type: `published`, `tuned`, from a parameter file, or (None) published or else the case's.

    Without a type, it is the file's or else the case's.
    """
    if source not in (None, "published", "tuned"):
        values = read_parameters(Path(source), "controller")
        if not values.keys() & case.gains.as_dict().keys():
            raise ParameterFileError(f"{source}: no parameters of a controller in it")
        type_ = controller_type(kind or values.get("type", case.gains.type))
        return gains_from_mapping({**case.gains.as_dict(), **values, "type": type_})
    type_ = controller_type(kind or case.gains.type)
    table = {"published": published, "tuned": tuned}[source or "published"]
    row = table(case.name, type_)
    if row is None and source is None:
        return case.gains.with_values(type=type_)
    if row is None:
        raise GainsError(f"there are no {source} gains for {type_} on {case.name}: give --gains FILE, or --kp …")
    return case.gains.with_values(type=type_, **{name: getattr(row.gains, name) for name in PER_LANE})


def loop_report(case: Case, gains: Gains) -> dict[str, Any]:
    """What a report on a loop begins with."""
    return {
        "case": case.name,
        "controller": gains.type,
        "gains": {name: getattr(gains, name) for name in PER_LANE},
    }


def headline(case: Case, gains: Gains) -> str:
    """The same, in one line for people."""
    shown = "  ".join(f"{name} {getattr(gains, name):g}" for name in PER_LANE)
    return f"{case.name}  {gains.type}  {shown}"
