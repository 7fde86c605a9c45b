"""Gains on many plants near the model, beside python-control plant by plant."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from benchmarks.harness import Curve, Result, Verdict, main, plural, seconds, summary
from benchmarks.loop_speed import vector_loop
from benchmarks.margins import python_control_margins
from tdof_npid_ros.case import Case, load_case
from tdof_npid_ros.control.gains import Gains
from tdof_npid_ros.robustness.result import RobustResult, sweep_plants
from tdof_npid_ros.robustness.spread import spreads_of
from tdof_npid_ros.workers import Workers, workers

TITLE = "Robust sweeps"
METHOD = (
    "`tdof-npid robust p1-c0.5` with gain and time constant spread by 20 %: for each plant the setpoint and the "
    "disturbance episode with their metrics, stability, and M_s, on all cores. python-control does less: the setpoint "
    "episode alone (`input_output_response` of the loop as one discrete `nlsys`) and the margins, plant by plant, on "
    "the first of the same plants. IAE and M_s must agree within 1e-6 and 1e-3, checked in the run. The exponent is "
    "that of the time with more and more plants: 1 is linear growth."
)
PEERS = ("control",)
NOTES: tuple[str, ...] = ()

CASE = "p1-c0.5"
SPREADS = ("gain 20 %", "time_constant 20 %")
CLOSE = {"iae_setpoint": 1e-6, "m_s": 1e-3}  # relative


def run(size: str) -> Result:
    """Ours with more and more plants, then the peer on some of them."""
    full = size == "full"
    counts, theirs = ([1000 * 2**i for i in range(5)], 10) if full else ([64, 128], 1)
    case = load_case(CASE)
    result = Result()
    with workers() as here:
        found = _sweep(here, case, counts[0])  # compiles
        times = [min(seconds(lambda count=count: _sweep(here, case, count)) for _ in range(2)) for count in counts]  # type: ignore[misc]
    ours = [count / time for count, time in zip(counts, times, strict=True)]
    cases = [replace(case, plant_values={**case.plant_values, **found.changes(index)}) for index in range(theirs)]
    peer = []
    for index, one in enumerate(cases):
        peer.append(1.0 / seconds(lambda one=one, index=index: _python_control(one, case.gains, found, index)))  # type: ignore[misc]
    result.rates += [
        summary(f"tdof_npid_ros, {plural(counts[0], 'plant')} and more", "plants/s", ours, ours=True),
        summary("python-control, setpoint episode and margins", "plants/s", peer),
    ]
    exponent = float(np.polyfit(np.log(counts), np.log(times), 1)[0])
    result.verdicts += [
        Verdict("plants a second, times python-control", float(np.median(ours) / np.median(peer)), None),
        Verdict(f"time with {counts[0]:,} to {counts[-1]:,} plants: exponent", exponent, 1.1, at_most=True),
    ]
    result.curves.append(Curve("robust sweep", "plants", [float(count) for count in counts], times))
    return result


def _sweep(where: Workers, case: Case, count: int) -> RobustResult:
    return sweep_plants(where, case, case.gains, spreads_of(case, SPREADS), count=count)


def _python_control(case: Case, gains: Gains, found: RobustResult, index: int) -> None:
    """One plant.

    Raises:
        AssertionError: what it gives is not what ours gave.
    """
    import control

    states, step = vector_loop(case)
    loop = control.nlsys(
        lambda t, x, u, p: step(x), lambda t, x, u, p: x[:1], inputs=1, outputs=1, states=states, dt=case.sample_period
    )
    time = case.signals["setpoint"].time
    output = control.input_output_response(loop, time, np.ones(len(time))).outputs
    theirs = {
        "iae_setpoint": case.setpoint_metrics(np.asarray(output)).iae,
        "m_s": python_control_margins(case, gains)["ms"],
    }
    for name, value in theirs.items():
        ours = float(found.metrics[name][index])
        assert math.isclose(value, ours, rel_tol=CLOSE[name]), (name, index, value, ours)


if __name__ == "__main__":
    main("robust")
