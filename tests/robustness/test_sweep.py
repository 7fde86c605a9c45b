"""A sweep's numbers are those of an independent simulation, whoever computes them and however often it is resumed."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from robustness import independent

from tdof_npid_ros import margins, robust
from tdof_npid_ros.case import Case, load_case, make_case
from tdof_npid_ros.robustness.result import QUANTILES, RobustResult, sweep_plants
from tdof_npid_ros.robustness.spread import spreads_of
from tdof_npid_ros.robustness.sweep import CHUNK
from tdof_npid_ros.workers import WorkersError, workers

SWEEPS = int(os.environ.get("TDOF_ROBUST_SWEEPS", "3"))
PLANTS = 60
PERIOD = 0.05
END = 10.0
METRICS = ("overshoot_percent", "settling_time_s", "iae_setpoint", "peak", "recovery_time_s", "iae_disturbance")


def random_case(rng: np.random.Generator) -> tuple[Case, list[str]]:
    """A loop with gains so lively that a part of the plants near it is unstable."""
    model = ("first_order", "second_order", "third_order")[int(rng.integers(3))]
    plant: dict[str, Any] = {"model": model, "gain": rng.uniform(0.5, 2.0), "time_constant": rng.uniform(0.5, 1.5)}
    plant["dead_time"] = float(rng.choice([0.0, 0.2, rng.uniform(0.05, 0.5)]))
    kp = {"first_order": 2.0, "second_order": 1.2, "third_order": 0.6}[model] / plant["gain"]
    if model == "third_order":
        plant["zero_time_constant"] = rng.uniform(0.1, 0.5)
    controller: dict[str, Any] = {
        "type": "tdof_npid2",
        "kp": kp,
        "ki": kp * rng.uniform(0.3, 1.0),
        "kd": kp * rng.uniform(0.0, 0.3),
    }
    controller |= {"alpha": rng.uniform(0.0, 0.5), "beta": rng.uniform(0.0, 0.5), "sigma": rng.uniform(0.5, 3.0)}
    plans = {"setpoint": ["0 setpoint 1", f"{END} end"], "disturbance": ["0 disturbance 1", f"{END} end"]}
    case = make_case(plant, controller, plans, sample_period=PERIOD)
    factor = (margins(case, case.gains).gain_margin or 1.0) * rng.uniform(0.6, 0.95)
    controller |= {name: controller[name] * factor for name in ("kp", "ki", "kd")}
    case = make_case(plant, controller, plans, sample_period=PERIOD)
    spreads = ["gain 40 %", "time_constant 30 %", *(["dead_time 50 %"] if plant["dead_time"] else [])]
    return case, spreads


def transfer(case: Case, changed: dict[str, Any]) -> tuple[list[float], list[float], float]:
    p = {**case.plant_values, **changed}
    k, t = p["gain"], p["time_constant"]
    if case.model == "first_order":
        return [k], [t, 1.0], p["dead_time"]
    if case.model == "second_order":
        return [k], [t * t, 2.0 * t, 1.0], p["dead_time"]
    return [-k * p["zero_time_constant"], k], [t**3, 3.0 * t * t, 3.0 * t, 1.0], p["dead_time"]


def expected(case: Case, result: RobustResult) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    steps = round(END / PERIOD)
    unstable, rows = [], []
    for index in range(len(result.unstable)):
        plant = independent.discretised(*transfer(case, result.changes(index)), PERIOD)
        unstable.append(independent.is_unstable(plant, case.gains, PERIOD))
        y_r = independent.simulated(plant, case.gains, PERIOD, 1.0, 0.0, steps)
        y_d = independent.simulated(plant, case.gains, PERIOD, 0.0, 1.0, steps)
        rows.append(independent.setpoint_metrics(y_r, PERIOD) + independent.disturbance_metrics(y_d, PERIOD))
    values = np.where(np.array(unstable)[:, None], np.inf, np.array(rows))
    return np.array(unstable), dict(zip(METRICS, values.T, strict=True))


@pytest.mark.timeout(3600 if SWEEPS > 20 else 300)
def test_random_sweeps_agree_with_an_independent_simulation_and_with_eigenvalues() -> None:
    unstable_plants = 0
    for number in range(SWEEPS):
        case, spreads = random_case(np.random.default_rng(number))
        result = robust(case, spreads, samples=PLANTS, seed=number)
        unstable, metrics = expected(case, result)
        np.testing.assert_array_equal(result.unstable, unstable, err_msg=f"sweep {number}")
        for name, values in metrics.items():
            for q in QUANTILES:
                theirs = float(np.quantile(values, q, method="inverted_cdf"))
                ours = result.quantile(name, q)
                assert ours == theirs or abs(ours - theirs) <= 1e-3 * abs(theirs), (number, name, q, ours, theirs)
        unstable_plants += int(unstable.sum())
    assert 0 < unstable_plants < SWEEPS * PLANTS  # the sweeps tell stable plants from unstable ones


def small(name: str = "p1-c0.5", **more: Any) -> Case:
    case = load_case(name)
    plans = {"setpoint": ["0 setpoint 1", "2 end"], "disturbance": ["0 disturbance 1", "2 end"]}
    plant = {name: value for name, value in case.plant_values.items() if name != "sample_period"}
    return make_case({**plant, **more}, case.gains.as_dict(), plans, sample_period=0.02, name=name)


def same(one: RobustResult, other: RobustResult) -> bool:
    return (
        np.array_equal(one.unstable, other.unstable)
        and all(np.array_equal(one.metrics[name], other.metrics[name]) for name in one.metrics)
        and all(np.array_equal(one.fans[name], other.fans[name]) for name in one.fans)
    )


def test_killed_and_resumed_a_sweep_ends_as_one_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    case, path = small(), tmp_path / "sweep.json"
    its = spreads_of(case, ["gain 20 %", "dead_time 30 %"])
    count = 2 * CHUNK + 7
    with workers(threads=1) as here:
        alone = sweep_plants(here, case, case.gains, its, count=count)
    calls = []

    def dies(shared: Any, chunk: Any) -> Any:
        calls.append(chunk.first)
        if len(calls) > 1:
            raise WorkersError("killed")
        return measure(shared, chunk)

    from tdof_npid_ros.robustness import result as module

    measure = module.measured
    monkeypatch.setattr(module, "measured", dies)
    with workers(threads=1) as here, pytest.raises(WorkersError, match="killed"):
        sweep_plants(here, case, case.gains, its, count=count, checkpoint=path)
    monkeypatch.setattr(module, "measured", measure)
    with workers(threads=2) as here:
        resumed = sweep_plants(here, case, case.gains, its, count=count, checkpoint=path, resume=True)
    assert same(alone, resumed)


def test_the_worst_plant_as_a_file_has_the_metrics_of_the_sweep(tmp_path: Path) -> None:
    from tdof_npid_ros.parameter_file import write_parameters

    result = robust(small(noise=0.001), ["gain 20 %", "dead_time 30 %"], samples=5)
    index = result.worst()[0]
    write_parameters(tmp_path / "worst.yaml", result.parameters(index))
    case = load_case(tmp_path / "worst.yaml")
    assert case.plant_values["noise_seed"] == index
    assert case.setpoint_response().iae == result.metrics["iae_setpoint"][index]
    assert case.disturbance_response().peak == result.metrics["peak"][index]


def test_each_sample_has_noise_of_its_own_and_the_same_each_time() -> None:
    case = small(noise=0.01)
    nearly_the_model = ["gain 0.999999 .. 1.000001", "dead_time 0.4999 .. 0.5001"]
    one = robust(case, nearly_the_model, samples=5)
    again = robust(case, nearly_the_model, samples=5)
    assert same(one, again)
    assert np.ptp(one.metrics["iae_setpoint"]) > 1e-4


def test_a_nonlinear_plant_is_judged_by_its_outputs() -> None:
    case = make_case(
        {"model": "sprott"},
        {"type": "pid", "kp": 20.0, "ki": 30.0, "kd": 8.0},
        {"setpoint": ["0 setpoint 1", "8 end"], "disturbance": ["0 disturbance 1", "8 end"]},
        sample_period=0.005,
    )
    result = robust(case, ["a -3 .. 0.9"], samples=16, sampling="latin")
    assert "outputs" in result.judged_by and "m_s" not in result.metrics
    assert 0 < result.unstable_fraction < 1
    assert result.unstable[np.argmin(result.values[:, 0])] and not result.unstable[np.argmax(result.values[:, 0])]


def test_sensitivity_finds_what_a_metric_depends_on() -> None:
    result = robust(small(), ["gain 20 %", "dead_time 30 %"], samples=400, sampling="latin")
    found = result.sensitivity("peak")
    assert found["dead_time"].correlation > 0.5 and found["dead_time"].explained > 0.4
    assert sum(one.explained for one in found.values()) < 1.1
    flat = robust(small(), ["gain 20 %", "dead_time 0.4999 .. 0.5001"], samples=400).sensitivity("peak")
    assert flat["dead_time"].explained < 0.05 and flat["gain"].explained > 0.9


def test_noise_may_have_a_spread() -> None:
    case = load_case("p1-c0.5")
    found = robust(case, ["noise 0 .. 0.01"], samples=20)
    assert found.unstable_fraction == 0.0
    assert np.isfinite(found.metrics["iae_disturbance"]).all()
