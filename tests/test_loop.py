"""There is one closed loop: stepped, run alone or run in blocks of lanes, it gives the same bits (distributed =
local)."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tdof_npid_ros.case import Case, load_case
from tdof_npid_ros.control.controller import Controller
from tdof_npid_ros.control.gains import ANTI_WINDUP, CONTROLLER_TYPES, Gains
from tdof_npid_ros.loop import integrals, simulate
from tdof_npid_ros.paper.tables import CASES
from tdof_npid_ros.plants.lockstep import Episode
from tdof_npid_ros.plants.plant import PlantError
from tdof_npid_ros.plants.simulator import PlantSimulator
from tdof_npid_ros.robustness.spread import spreads_of
from tdof_npid_ros.scenario import parse_plan
from tdof_npid_ros.wire import EpisodeLabel

UNLIMITED = (-math.inf, math.inf)
STEPS = 700


def shortened(case: Case) -> Case:
    """The case with episodes of a few hundred steps, plant parameters changing on the way where they can."""
    end = f"{STEPS * case.sample_period:g} end"
    middle = f"{STEPS // 3 * case.sample_period:g}"
    episodes = {"setpoint": ("0 setpoint 1", end), "disturbance": ("0 disturbance 1", end)}
    if case.model == "sprott":
        episodes["change"] = ("0 setpoint 1", "0 plant.a 0.6", f"{middle} plant.a 0.72", end)
    return dataclasses.replace(case, episodes=episodes)


def stepped(case: Case, episode: str, gains: Gains) -> tuple[np.ndarray, np.ndarray]:
    """The episode as the nodes run it: plant and controller apart, one step at a time."""
    simulator = PlantSimulator(case.plant_at({}), case.sample_period_ns, gains.lanes, case.effort_limits)
    run = Episode(case.plans[episode], simulator, case.plant_at, EpisodeLabel(case.plans[episode].digest, "a", 1))
    controller = Controller(gains, case.sample_period_ns)
    outputs, efforts, running = [], [], True
    while running:
        r = case.plans[episode].value_at("setpoint", run.stamp_ns)
        controller.answer(run.stamp_ns, np.full(gains.lanes, r), simulator.output)
        outputs.append(simulator.output.copy())
        efforts.append(controller.effort.copy())
        running = run.answer(controller.effort)
    return np.array(outputs), np.array(efforts)


@pytest.mark.parametrize("kind", CONTROLLER_TYPES)
@pytest.mark.parametrize("name", CASES)
def test_stepping_gives_the_bits_of_the_compiled_loop(name: str, kind: str) -> None:
    case = shortened(load_case(name))
    one = case.gains.with_values(type=kind)
    several = one.with_values(kp=tuple(case.gains.kp * f for f in (1.0, 0.9, 0.5)))  # type: ignore[operator]
    for episode in case.episodes:
        for gains in (one, several):
            trajectory = case.simulate(episode, gains)
            outputs, efforts = stepped(case, episode, gains)
            np.testing.assert_array_equal(outputs, trajectory.output)
            np.testing.assert_array_equal(efforts, trajectory.control_effort)


@pytest.mark.parametrize(
    ("name", "own"),
    [
        ("p1-c4", {"gain": [1.0, 1.2, 0.9], "time_constant": [4.0, 5.0, 6.0], "dead_time": [0.0, 0.203, 4.0]}),
        ("p1-c4", {"gain": [1.0, 1.2, 0.9], "noise": 0.01, "noise_seed": 3}),
        ("sprott", {"a": [0.6, 0.7, 0.8], "b": [1.2, 1.1, 1.0]}),
    ],
)
def test_stepping_lanes_with_a_plant_each_gives_the_bits_of_the_compiled_loop(name: str, own: dict[str, Any]) -> None:
    case = shortened(load_case(name))
    case = dataclasses.replace(case, plant_values={**case.plant_values, **own})
    several = case.gains.with_values(kp=tuple(case.gains.kp * f for f in (1.0, 0.9, 0.5)))  # type: ignore[operator]
    for episode in case.episodes:
        trajectory = case.simulate(episode, several)
        outputs, efforts = stepped(case, episode, several)
        np.testing.assert_array_equal(outputs, trajectory.output)
        np.testing.assert_array_equal(efforts, trajectory.control_effort)
        assert len(np.unique(outputs[-1])) == 3
    alone = case.alone[1].simulate("setpoint", case.gains.with_values(kp=several.per_lane("kp")[1]))
    np.testing.assert_array_equal(alone.output[:, 0], case.simulate("setpoint", several).output[:, 1])


def test_what_is_of_one_plant_refuses_a_case_with_several_in_one_line() -> None:
    case = load_case("p1-c4")
    case = dataclasses.replace(case, plant_values={**case.plant_values, "gain": [1.0, 2.0]})
    for refuses in (case.setpoint_response, lambda: case.plant, lambda: spreads_of(case, ["gain 1 %"])):
        with pytest.raises(PlantError, match="each of 2 lanes has a plant of its own") as error:
            refuses()
        assert "\n" not in str(error.value)
    with pytest.raises(PlantError, match="gain has 2 values, but dead_time has 3"):
        dataclasses.replace(case, plant_values={**case.plant_values, "dead_time": [0.1, 0.2, 0.3]}).simulate("setpoint")


@pytest.mark.parametrize("name", ["p1-c4", "p2-c2", "p3-c1", "sprott"])
@pytest.mark.parametrize("lanes", [2, 17, 40, 70])
def test_lanes_side_by_side_give_the_bits_of_each_alone(name: str, lanes: int) -> None:
    case = shortened(load_case(name))
    rng = np.random.default_rng(lanes)
    values = {n: tuple(getattr(case.gains, n) * rng.uniform(0.5, 1.0, lanes)) for n in ("kp", "ki", "kd")}
    together = case.simulate("setpoint", case.gains.with_values(**values))
    summed = case.integrals("setpoint", case.gains.with_values(**values))
    for j in range(0, lanes, 5):
        gains = case.gains.with_values(**{n: v[j] for n, v in values.items()})
        np.testing.assert_array_equal(case.simulate("setpoint", gains).output[:, 0], together.output[:, j])
        assert case.integrals("setpoint", gains).iae[0] == summed.iae[j]


@pytest.mark.parametrize("anti_windup", ANTI_WINDUP)
def test_lanes_with_limits_of_their_own_give_the_bits_of_each_alone(anti_windup: str) -> None:
    case = shortened(load_case("p1-c0.5"))
    least, most = (-1.0, -1.0, -0.5, -math.inf, -math.inf), (1.5, 1.5, 2.0, 2.0, math.inf)
    gains = case.gains.with_values(effort_min=least, effort_max=most, anti_windup=anti_windup)
    together, summed = case.simulate("setpoint", gains), case.integrals("setpoint", gains)
    outputs, efforts = stepped(case, "setpoint", gains)
    np.testing.assert_array_equal(outputs, together.output)
    np.testing.assert_array_equal(efforts, together.control_effort)
    for j in range(5):
        alone = gains.with_values(effort_min=least[j], effort_max=most[j])
        trajectory = case.simulate("setpoint", alone)
        np.testing.assert_array_equal(trajectory.control_effort[:, 0], together.control_effort[:, j])
        assert case.integrals("setpoint", alone).iae[0] == summed.iae[j]
    assert np.max(together.control_effort, axis=0)[:4].tolist() == list(most[:4])


def test_the_integral_is_that_of_the_trajectory() -> None:
    case = shortened(load_case("p1-c0.5"))
    gains = case.gains
    assert case.integrals("setpoint", gains).iae[0] == case.setpoint_response(gains).iae


def test_an_unstable_lane_stays_finite_and_is_told_from_the_sound_ones() -> None:
    case = load_case("p1-c4")
    kp = (1.0, 4e5, 4e7)
    result = case.integrals("setpoint", Gains("pid", kp, 0.3, 0.0))
    assert np.isfinite(result.iae).all()
    assert result.finite_fraction[0] == 1.0
    assert 1.0 > result.finite_fraction[1] > result.finite_fraction[2]


def delayed_reference(gains: Gains, lag: float, dead_time: float, end: float, times: np.ndarray) -> np.ndarray:
    """First-order plus dead time under the continuous law (2)-(7), by the method of steps with solve_ivp."""
    kp, ki, kd, alpha, beta, sigma = (float(getattr(gains, n)) for n in ("kp", "ki", "kd", "alpha", "beta", "sigma"))
    filter_time = kd / (kp * gains.n)

    def effort(x: np.ndarray) -> np.ndarray:
        e_d = (1 - beta) - x[0]
        return kp * ((1 - alpha) - x[0]) + x[1] + kp * gains.n * (e_d - x[2])

    past, pieces = None, []
    state, start = np.zeros(3), 0.0
    while start < end:
        stop = min(start + dead_time, end)
        before = past

        def slope(t: float, x: np.ndarray, before=before) -> list[float]:  # type: ignore[no-untyped-def]
            u = 0.0 if before is None else float(effort(before(t - dead_time)))
            e = 1.0 - x[0]
            zeta = math.exp(-(e**2) / (2 * sigma**2)) * e
            return [(u - x[0]) / lag, ki * zeta, ((1 - beta) - x[0] - x[2]) / filter_time]

        solution = solve_ivp(slope, (start, stop), state, rtol=1e-10, atol=1e-12, dense_output=True, max_step=0.02)
        inside = (times >= start) & (times < stop)
        pieces.append(solution.sol(times[inside])[0])
        past, state, start = solution.sol, solution.y[:, -1], stop
    return np.concatenate(pieces)


def test_the_loop_converges_to_the_continuous_one_with_first_order() -> None:
    gains = Gains("tdof_npid2", 5.0, 3.0, 1.5, 0.3, 0.2)
    times = np.arange(0, 8, 0.1)
    exact = delayed_reference(gains, 5.0, 0.5, 8.0, times)
    case = load_case("p1-c0.5")
    errors = []
    for period_ns in (10_000_000, 5_000_000, 2_500_000, 1_250_000):
        signals = parse_plan(["0 setpoint 1", "8 end"], period_ns).sampled(period_ns)
        y = simulate(case.plant_at, gains, signals, UNLIMITED).output[:, 0]
        errors.append(np.max(np.abs(y[np.round(times / (period_ns / 1e9)).astype(int)] - exact)))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    print("errors", errors, "orders", orders)
    assert errors[-1] < 2e-3
    assert np.all(orders > 0.8)


def test_effort_limits_of_the_plant_hold_in_the_loop() -> None:
    case = dataclasses.replace(shortened(load_case("p1-c0.5")), effort_limits=(-0.5, 0.5))
    free = load_case("p1-c0.5").simulate("setpoint", case.gains).output[:STEPS]
    limited = case.simulate("setpoint", case.gains).output[:STEPS]
    assert np.max(limited) < np.max(free)
    assert integrals(case.plant_at, case.gains, case.signals["setpoint"], case.effort_limits).finite_fraction[0] == 1.0
