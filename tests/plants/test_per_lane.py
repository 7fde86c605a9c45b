"""Lanes may each have a plant of their own: the bits of each alone, and as fast as the rest of the loop allows."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, ClassVar

import numpy as np
import pytest

from tdof_npid_ros.case import Case, make_case
from tdof_npid_ros.control.gains import GainsError
from tdof_npid_ros.plants.catalog import make_plant
from tdof_npid_ros.plants.linear import TransferFunction, sampled_lanes
from tdof_npid_ros.plants.ode import load_class
from tdof_npid_ros.plants.plant import PlantError
from tdof_npid_ros.plants.simulator import PlantSimulator

Changes = dict[str, Any]


class Tank:
    parameters: ClassVar = {"area": 2.0, "outflow": 0.5}
    initial_state = (1.0,)

    @staticmethod
    def derivative(x, u, d, p):  # type: ignore[no-untyped-def]
        return ((u + d - p[1] * x[0]) / p[0],)

    @staticmethod
    def output(x, p):  # type: ignore[no-untyped-def]
        return x[0]


def short(plant: Changes, **more: Any) -> Case:
    plan = {"setpoint": ["0 setpoint 1", "1 disturbance 0.3", "3 end"]} | more.pop("plans", {})
    return make_case(plant, {"type": "tdof_npid2", "kp": 2.0, "ki": 1.0, "kd": 0.3, "sigma": 1.0} | more, plan)


def alone(case: Case, changed: Changes) -> Case:
    return dataclasses.replace(case, plant_values={**case.plant_values, **changed})


def check_each_lane(case: Case, changes: list[Changes], episode: str = "setpoint") -> None:
    plants = case.lane_plants(episode, changes)
    together, summed = case.simulate(episode, None, plants), case.integrals(episode, case.gains, plants)
    for j, changed in enumerate(changes):
        one = alone(case, changed)
        trajectory, integrals = one.simulate(episode), one.integrals(episode, one.gains)
        np.testing.assert_array_equal(trajectory.output[:, 0], together.output[:, j], err_msg=str(changed))
        np.testing.assert_array_equal(trajectory.control_effort[:, 0], together.control_effort[:, j])
        for field in dataclasses.fields(integrals):
            assert getattr(integrals, field.name)[0] == getattr(summed, field.name)[j], field.name


def varied(rng: np.random.Generator, nominal: Changes, lanes: int) -> list[Changes]:
    return [{name: value * rng.uniform(0.7, 1.3) for name, value in nominal.items()} for _ in range(lanes)]


@pytest.mark.parametrize(
    ("model", "nominal"),
    [
        ("first_order", {"gain": 1.5, "time_constant": 2.0, "dead_time": 0.105}),
        ("second_order", {"gain": 1.5, "time_constant": 0.5}),
        ("first_order", {"dead_time": 0.1, "output_offset": 20.0, "effort_offset": 5.0}),
        ("sprott", {"a": 0.6, "b": 1.2, "c": 2.0}),
    ],
)
def test_each_lane_has_the_bits_of_its_plant_alone(model: str, nominal: Changes) -> None:
    changes = varied(np.random.default_rng(1), nominal, 5)
    if "dead_time" in nominal:
        changes[1]["dead_time"], changes[2]["dead_time"] = 0.0, 0.004  # none, and less than a sample
    else:
        check_each_lane(short({"model": model, **nominal}), changes[:1])
    check_each_lane(short({"model": model, **nominal}), changes)


def test_several_blocks_of_lanes_have_the_bits_of_each_alone() -> None:
    nominal = {"gain": 1.5, "time_constant": 2.0, "dead_time": 0.105}
    check_each_lane(short({"model": "first_order"}), varied(np.random.default_rng(2), nominal, 70))


def test_a_users_class_has_parameters_of_its_own_in_each_lane() -> None:
    load_class(f"{__name__}:Tank")
    case = short({"model": f"{__name__}:Tank", "substeps": 2})
    check_each_lane(case, varied(np.random.default_rng(0), {"area": 2.0, "outflow": 0.5}, 5))


def test_each_lane_may_have_noise_of_its_own_and_some_none() -> None:
    case = short({"model": "first_order", "dead_time": 0.05})
    check_each_lane(case, [{"noise": 0.02 * j, "noise_seed": j, "dead_time": 0.02 * j} for j in range(4)])


def test_lanes_begin_at_rest_each_with_its_own_effort() -> None:
    plans = {"setpoint": ["0 start 2", "0 setpoint 3", "2 end"]}
    case = short({"model": "first_order", "dead_time": 0.1, "output_offset": 1.0}, plans=plans)
    check_each_lane(case, [{"gain": 1.0 + 0.1 * j, "output_offset": 0.5 * j} for j in range(4)])


def test_parameters_that_a_plan_changes_stay_each_lanes_own_otherwise() -> None:
    plans = {"setpoint": ["0 setpoint 1", "0 plant.gain 1", "0.5 plant.gain 2", "2 end"]}
    case = short({"model": "first_order", "dead_time": 0.1}, plans=plans)
    check_each_lane(case, [{"time_constant": 1.0 + j, "dead_time": 0.03 * j} for j in range(4)])


def test_lanes_with_gains_and_plants_of_their_own() -> None:
    case = short({"model": "first_order", "dead_time": 0.1})
    changes: list[Changes] = [{"gain": 1.0 + 0.1 * j, "dead_time": 0.02 * j} for j in range(20)]
    kp, most = tuple(np.linspace(1.0, 3.0, 20)), (1.5,) * 10 + (math.inf,) * 10
    plants = case.lane_plants("setpoint", changes)
    together = case.simulate("setpoint", case.gains.with_values(kp=kp, effort_max=most), plants)
    for j in range(20):
        gains = case.gains.with_values(kp=kp[j], effort_max=most[j])
        run = alone(case, changes[j]).simulate("setpoint", gains)
        np.testing.assert_array_equal(run.output[:, 0], together.output[:, j])


def test_what_lanes_cannot_differ_in_is_refused() -> None:
    case = short({"model": "transfer_function"})
    with pytest.raises(PlantError, match="states"):
        case.lane_plants("setpoint", [{"denominator": [1.0, 1.0]}, {"denominator": [1.0, 1.0, 1.0]}])
    with pytest.raises(GainsError, match="gains for 3 lanes, but plants for 2"):
        case.simulate("setpoint", case.gains.with_values(kp=(1.0, 2.0, 3.0)), case.lane_plants("setpoint", [{}, {}]))
    with pytest.raises(GainsError, match="law alone"):
        short({"model": "first_order"}, dead_band=0.1).simulate("setpoint", None, case.lane_plants("setpoint", [{}]))


def test_a_simulator_takes_plants_for_its_own_lanes_alone() -> None:
    """Compiled code does not look: it would read past the end of what the plants differ in."""
    simulator = PlantSimulator(make_plant("first_order", {"gain": [1.0, 2.0, 3.0]}), 10_000_000, 3, (-1.0, 1.0))
    for gain in ([1.0, 2.0], [1.0, 2.0, 3.0, 4.0]):
        with pytest.raises(PlantError, match=f"lanes is 3, but there are plants for {len(gain)}"):
            simulator.change_plant(make_plant("first_order", {"gain": gain}))
    simulator.change_plant(make_plant("first_order", {"gain": [3.0, 2.0, 1.0]}))


@pytest.mark.parametrize("order", [1, 2, 3, 5])
def test_many_plants_are_sampled_to_the_bits_of_each_alone(order: int) -> None:
    rng = np.random.default_rng(order)
    plants = [
        TransferFunction(
            tuple(rng.uniform(-2.0, 2.0, rng.integers(1, order + 1))),
            tuple(np.poly(-rng.uniform(0.0, scale, order))),
            float(rng.choice([0.0, 0.05, rng.uniform(0.0, 1.0)])),
            output_offset=float(rng.choice([0.0, 20.0])),
        )
        for scale in (0.1, 3.0, 1000.0)  # the last is beyond the series
        for _ in range(8)
    ]
    plants += [TransferFunction((1.0,), (*[1.0] * order, 0.0), 0.013)]  # integrating
    for period_ns in (1_000_000, 12_345_678):
        assert sampled_lanes(plants, period_ns) == [plant.sampled(period_ns) for plant in plants]
