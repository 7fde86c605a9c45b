"""What gains are predicted to do in a case: responses to look at, and numbers to compare, before they run a loop."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from tdof_npid_ros.case import Case
from tdof_npid_ros.control.gains import LIMITS_PER_LANE, PER_LANE, Gains
from tdof_npid_ros.loop import Trajectory
from tdof_npid_ros.metrics import effort_use, in_units
from tdof_npid_ros.plotting import Curve, Panel
from tdof_npid_ros.stability.margins import Margins, margins

METRICS = {  # titles and units
    ("setpoint", "overshoot_percent"): ("setpoint: overshoot", "%"),
    ("setpoint", "settling_time_s"): ("setpoint: settling time", "s"),
    ("setpoint", "iae"): ("setpoint: IAE", "{output} s"),
    ("setpoint", "effort_peak"): ("setpoint: largest |u|", "{effort}"),
    ("setpoint", "saturated_percent"): ("setpoint: at limit", "%"),
    ("disturbance", "peak"): ("disturbance: peak", "{output}"),
    ("disturbance", "recovery_time_s"): ("disturbance: recovery time", "s"),
    ("disturbance", "iae"): ("disturbance: IAE", "{output} s"),
    ("disturbance", "effort_peak"): ("disturbance: largest |u|", "{effort}"),
    ("disturbance", "saturated_percent"): ("disturbance: at limit", "%"),
}
Runs = dict[str, dict[str, Trajectory]]
"""By episode, by what the gains are called."""


def simulated(case: Case, of: Mapping[str, Gains]) -> Runs:
    """Every episode of a case under every one of these gains.

    Args:
        of: gains of one lane, by what they are called.
    """
    return {name: {label: case.simulate(name, gains) for label, gains in of.items()} for name in case.plans}


def panels(case: Case, runs: Runs) -> list[Panel]:
    """A picture's panel for each episode."""
    limits = tightest_limits(case, case.gains)
    return [
        Panel(
            name,
            [curve_of(label, run) for label, run in under.items()],
            limits,
            units=case.units,
        )
        for name, under in runs.items()
    ]


def curve_of(label: str, run: Trajectory) -> Curve:
    """A run of one lane as a picture's curve."""
    return Curve(label, run.time, run.output[:, 0], run.control_effort[:, 0], run.setpoint, run.disturbance)


def tightest_limits(case: Case, gains: Gains) -> tuple[float, float]:
    """Between which the effort is, whether plant or controller limits it."""
    low, high = (float(gains.per_lane(limit)[0]) for limit in LIMITS_PER_LANE)
    return max(low, case.effort_limits[0]), min(high, case.effort_limits[1])


def measured(case: Case, gains: Gains) -> dict[str, dict[str, Any]]:
    """The metrics of both episodes, each with what its control costs, as `analyze` calls it: the sum of |Δu|, the
    largest |u|, and for how much of the time the effort is at a limit.

    Raises:
        PlanError, GainsError: the case's episodes are not what the metrics are of.
    """
    step = case.response("setpoint", gains)
    tracking = asdict(case.setpoint_metrics(step.output[:, 0]))
    push = case.response("disturbance", gains)
    rejection = asdict(case.disturbance_metrics(push.output[:, 0]))
    return {
        "setpoint": tracking | _control_cost(case, gains, step),
        "disturbance": rejection | _control_cost(case, gains, push),
    }


def _control_cost(case: Case, gains: Gains, run: Trajectory) -> dict[str, float | None]:
    use = effort_use(run.control_effort[:, 0], tightest_limits(case, gains))
    at_limit = None if use.saturated_share is None else 100.0 * use.saturated_share
    return {"effort_variation": use.total_variation, "effort_peak": use.peak, "saturated_percent": at_limit}


def numbers(case: Case, of: Mapping[str, Gains]) -> list[list[str]]:
    """Metrics and margins as a table, titles first, one column for each of the gains.

    Raises:
        PlanError, GainsError: the case's episodes are not what the metrics are of.
    """
    found = {label: measured(case, gains) for label, gains in of.items()}
    rows = [
        [
            case.units.titled(*title),
            *("-" if (v := each[episode][name]) is None else shown(name, v) for each in found.values()),
        ]
        for (episode, name), title in METRICS.items()
    ]
    each_margins = [margins(case, gains) for gains in of.values()]
    rows += [
        [title, *(_margin(one, name) for one in each_margins)]
        for name, title in {"m_s": "M_s", "delay_margin_s": "delay margin (s)"}.items()
    ]
    return [["", *of], *rows]


def gains_table(of: Mapping[str, Gains]) -> list[list[str]]:
    """The gains side by side, titles first."""
    return [["", *of], *([name, *(f"{getattr(gains, name):g}" for gains in of.values())] for name in PER_LANE)]


def shown(name: str, value: float) -> str:
    """A metric for people; a percentage needs no digits below the table's."""
    return f"{value:.4f}" if name.endswith("_percent") and abs(value) < 1e6 else in_units(value)


def _margin(found: Margins, name: str) -> str:
    value: Any = getattr(found, name)
    if not found.stable:
        return "unstable" if found.stable is False else "not known"
    return "no limit" if value is None else f"{value:.3g}"
