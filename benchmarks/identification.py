"""What identifying a plant costs, and how well it is found, beside sysidentpy."""

from __future__ import annotations

import warnings
from importlib.util import find_spec
from typing import Any

import numpy as np

from benchmarks.harness import Result, Table, Verdict, main, plural, seconds, summary
from tdof_npid_ros.case import Case, make_case
from tdof_npid_ros.identification.fit import Stretch
from tdof_npid_ros.identification.identify import Identified, identify
from tdof_npid_ros.identification.result import process_of

TITLE = "Identification"
METHOD = (
    "Records in closed loop, the setpoint stepping between 0 and 1 every 12.5 s, sampled every 50 ms, white noise of "
    "1 % of the step on what is recorded: first order (K = 2, T = 5 s, L = 0.5 s) and second order with damping 1. "
    "`identify` compares all its structures and fits the best to all samples; beside it, the same record simulated "
    "once by the model found. sysidentpy fits linear NARX models by FROLS, 20 lags of the effort and 5 of the output, "
    "the number of terms by AIC: the dead time is unknown to it, as to ours. What was found is judged by the response "
    "of the plant alone to a step of the effort. sysidentpy is compared where it is installed (`pip install --no-deps "
    "sysidentpy==0.9.0`): it asks for an older NumPy than the other tools here."
)
PEERS = ("sysidentpy",)
NOTES = (
    "sippy-unipi is not compared: it needs NumPy below 2.4, which the type stubs of this environment do not take.",
    "FROLS minimises the error of the prediction of one step, which noise biases, above all in a closed loop; ours "
    "simulates.",
)

PERIOD, HOLD = 0.05, 12.5  # s
NOISE = 0.01
PLANTS = {
    "first order": {"model": "first_order", "gain": 2.0, "time_constant": 5.0, "dead_time": 0.5},
    "second order": {"model": "second_order", "gain": 2.0, "time_constant": 2.0, "dead_time": 0.5},
}
SHORT, LONG = 2_000, 1_000_000  # samples
LAGS = (5, 20)  # of output and effort, for the peer
STEP_TIME = 40.0  # s


def run(size: str) -> Result:
    """Short records by both, a long one by ours."""
    full = size == "full"
    repeats, long = (5, LONG) if full else (1, 20_000)
    result, rows = Result(), []
    peer = find_spec("sysidentpy") is not None
    ratios: dict[int, list[float]] = {SHORT: [], long: []}
    for name, plant in PLANTS.items() if full else list(PLANTS.items())[:1]:
        case = _case(plant, SHORT)
        record, truth = _record(case, seed=1), _step_of(dict(plant))
        found = identify([record])  # compiles
        ours = [seconds(lambda record=record: identify([record])) for _ in range(repeats)]  # type: ignore[misc]
        ratios[SHORT].append(min(ours) / _simulation(found))
        result.rates.append(summary(f"{name}, {plural(SHORT, 'sample')}", "s", ours, ours=True))
        off = _rms(_step_of(process_of(found).transfer_function()) - truth) / float(np.ptp(truth))
        if not peer:
            rows.append([name, f"{100.0 * off:.2g}", "not installed"])
            continue
        theirs = [seconds(lambda record=record: _frols(record)) for _ in range(repeats)]  # type: ignore[misc]
        result.rates.append(summary(f"sysidentpy FROLS, {name}, {plural(SHORT, 'sample')}", "s", theirs))
        off_peer = _rms(_frols_step(_frols(record)) - truth) / float(np.ptp(truth))
        rows.append([name, f"{100.0 * off:.2g}", f"{100.0 * off_peer:.2g}"])
        claim = f"{name}: error of the step response, times that of sysidentpy"
        result.verdicts.append(Verdict(claim, off / off_peer, None, at_most=True))
    record = _record(_case(PLANTS["first order"], long), seed=2)
    found = identify([record])
    times = [seconds(lambda: identify([record])) for _ in range(min(repeats, 3))]
    ratios[long].append(min(times) / _simulation(found))
    result.rates.append(summary(f"first order, {plural(long, 'sample')}", "s", times, ours=True))
    for (samples, values), goal in zip(ratios.items(), (3000.0, 300.0), strict=True):
        claim = f"identification of {samples:,} samples, times simulating that record once"
        result.verdicts.append(Verdict(claim, max(values), goal, at_most=True))
    header = ["plant", "tdof_npid_ros", "sysidentpy"]
    result.tables.append(Table("Error of the plant's step response, root mean square in per cent of it", header, rows))
    return result


def _case(plant: dict[str, Any], samples: int) -> Case:
    """A PI loop whose setpoint steps up and down."""
    end = samples * PERIOD
    steps = [f"{k * HOLD} setpoint {1 - k % 2}" for k in range(int(np.ceil(end / HOLD)))]
    controller = {"type": "pid", "kp": 0.8, "ki": 0.2, "kd": 0.2}
    return make_case(plant, controller, {"record": [*steps, f"{end} end"]}, sample_period=PERIOD)


def _record(case: Case, seed: int) -> Stretch:
    ran = case.simulate("record")
    noise = np.random.default_rng(seed).normal(0.0, NOISE, len(ran.time))
    return Stretch(ran.time, ran.control_effort[:, 0].copy(), ran.output[:, 0] + noise, True, 0.0, True)


def _simulation(found: Identified) -> float:
    """Time to simulate the record once by the model found."""
    return min(seconds(lambda: found.problem.residuals(found.solution)) for _ in range(20))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _step_of(plant: dict[str, Any]) -> np.ndarray:
    """A plant's output under an effort of 1, from rest, (samples,)."""
    by_hand = {"type": "pid", "manual": True, "manual_effort": 1.0}
    held = make_case(plant, by_hand, {"step": [f"{STEP_TIME} end"]}, sample_period=PERIOD)
    return held.simulate("step").output[:, 0]


def _frols(record: Stretch) -> Any:
    """The peer's model."""
    from sysidentpy.basis_function import Polynomial
    from sysidentpy.model_structure_selection import FROLS

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = FROLS(
            order_selection=True, n_info_values=12, info_criteria="aic", ylag=LAGS[0], xlag=LAGS[1],
            basis_function=Polynomial(degree=1),
        )  # fmt: skip
        model.fit(X=record.effort[:, None], y=record.output[:, None])
    return model


def _frols_step(model: Any) -> np.ndarray:
    """Its free run under an effort of 1, from rest."""
    samples = round(STEP_TIME / PERIOD) + 1
    rest = max(LAGS)
    effort = np.concatenate([np.zeros(rest), np.ones(samples)])[:, None]
    return np.asarray(model.predict(X=effort, y=np.zeros((rest, 1))))[rest:, 0]


if __name__ == "__main__":
    main("identification")
