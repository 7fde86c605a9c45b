"""Operating points and episodes that begin at rest: plant and controller are settled, alike in every way of running."""

from __future__ import annotations

import numpy as np
import pytest

from tdof_npid_ros import loop
from tdof_npid_ros.control.gains import Gains
from tdof_npid_ros.control.options import ControllerOptions
from tdof_npid_ros.plants.catalog import make_plant
from tdof_npid_ros.plants.linear import TransferFunction
from tdof_npid_ros.plants.ode import Sprott
from tdof_npid_ros.plants.plant import Plant, PlantError
from tdof_npid_ros.scenario import PlanError, SampledPlan, parse_plan

PERIOD_NS = 10_000_000
FREE = (-np.inf, np.inf)
GAINS = Gains("tdof_npid2", kp=0.02, ki=0.01, kd=0.01, alpha=0.3, beta=0.5, sigma=40.0)
PLANTS: dict[str, Plant] = {
    "first order": TransferFunction((0.8,), (1.8, 1.0), 0.255),
    "with a zero": TransferFunction((1.0, -2.0), (3.0, 1.0, 4.0), 0.3),
    "integrator": TransferFunction((2.0, 1.0), (3.0, 1.0, 0.0), 0.3),
    "operating point": TransferFunction((0.8,), (1.8, 1.0), 0.255, output_offset=20.0, effort_offset=5.0),
    "circuit": Sprott(),
}


def plan(*lines: str) -> SampledPlan:
    return parse_plan(lines, PERIOD_NS).sampled(PERIOD_NS)


@pytest.mark.parametrize("plant", PLANTS.values(), ids=PLANTS)
def test_what_begins_at_rest_stays_there(plant: Plant) -> None:
    run = loop.simulate(lambda _: plant, GAINS, plan("0 start 60", "20 end"), FREE)
    assert run.setpoint[0] == run.output[0, 0] == 60.0
    assert np.abs(run.output - 60.0).max() < 1e-9
    assert np.ptp(run.control_effort) < 1e-9


@pytest.mark.parametrize("plant", PLANTS.values(), ids=PLANTS)
@pytest.mark.parametrize("lines", [("0 start 60", "1 setpoint 61", "9 end"), ("0 setpoint 3", "9 end")])
def test_the_compiled_loop_and_the_nodes_classes_begin_alike(plant: Plant, lines: tuple[str, ...]) -> None:
    for gains in (GAINS, GAINS.with_values(kp=(0.02, 0.03), ki=(0.01, 0.0))):
        compiled = loop.simulate(lambda _: plant, gains, plan(*lines), FREE)
        stepped = loop.simulate_operated(lambda _: plant, gains, ControllerOptions(), plan(*lines), FREE)
        assert compiled.output.tobytes() == stepped.output.tobytes()
        assert compiled.control_effort.tobytes() == stepped.control_effort.tobytes()


def test_a_model_about_an_operating_point_is_the_plain_one_moved_there() -> None:
    values = {"numerator": [0.8], "denominator": [1.8, 1.0], "dead_time": 0.255}
    plain = make_plant("transfer_function", values)
    moved = make_plant("transfer_function", {**values, "output_offset": 20.0, "effort_offset": 5.0})
    steps = plan("0 start 4", "1 setpoint 5", "3 disturbance 0.5", "9 end")
    there = plan("0 start 24", "1 setpoint 25", "3 disturbance 0.5", "9 end")
    expected = loop.simulate(lambda _: plain, GAINS, steps, FREE).output
    assert np.allclose(loop.simulate(lambda _: moved, GAINS, there, FREE).output - 20.0, expected, rtol=0, atol=1e-11)


def test_without_a_start_the_loop_begins_at_the_operating_point_without_a_kick() -> None:
    plant = PLANTS["operating point"]
    run = loop.simulate(lambda _: plant, GAINS, plan("0 setpoint 20", "9 end"), FREE)
    assert np.abs(run.output - 20.0).max() < 1e-9 and np.abs(run.control_effort - 5.0).max() < 1e-9


def test_a_ramp_of_the_setpoint_begins_at_rest() -> None:
    plant, options = PLANTS["first order"], ControllerOptions(setpoint_rate=1.0)
    run = loop.simulate_operated(lambda _: plant, GAINS, options, plan("0 start 60", "0 setpoint 61", "9 end"), FREE)
    assert abs(run.control_effort[0, 0] - 75.0) < 0.01


@pytest.mark.parametrize(
    ("lines", "why"),
    [
        (("0 start 1", "0 start 2", "9 end"), "once, at 0 s"),
        (("1 start 1", "9 end"), "once, at 0 s"),
        (("0 start ramp 2 over 5", "9 end"), "one value"),
        (("0 start nan", "9 end"), "not finite"),
    ],
)
def test_a_start_that_cannot_be_meant_is_refused(lines: tuple[str, ...], why: str) -> None:
    with pytest.raises(PlanError, match=why):
        plan(*lines)


def test_a_start_that_no_effort_holds_is_refused() -> None:
    limited = PLANTS["first order"]
    with pytest.raises(PlantError, match=r"rests there with an effort of 75, beyond its limits 0 to 50"):
        loop.simulate(lambda _: limited, GAINS, plan("0 start 60", "9 end"), (0.0, 50.0))
    with pytest.raises(PlantError, match="no effort holds the output at 60"):
        TransferFunction((1.0, 0.0), (1.0, 2.0, 1.0)).at_rest(60.0)
