"""Margins of one loop: against python-control, eigenvalues, the simulation, and what people would ask."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import control
import numpy as np
import pytest
from loops import Loop, closed_loop_matrix, random_loop

from tdof_npid_ros import loop as closed_loop
from tdof_npid_ros.case import Case, load_case, make_case
from tdof_npid_ros.cli import main
from tdof_npid_ros.control.gains import Gains
from tdof_npid_ros.control.law import KD_H, KI_H, KP, PHI, coefficients
from tdof_npid_ros.control.options import ControllerOptions
from tdof_npid_ros.paper.tuned import tuned
from tdof_npid_ros.plants.linear import TransferFunction
from tdof_npid_ros.scenario import parse_plan
from tdof_npid_ros.stability import StabilityError
from tdof_npid_ros.stability.characteristic import characteristic
from tdof_npid_ros.stability.margins import linear_margins, margins
from tdof_npid_ros.stability.plant import linear_loop_plants, loop_plant, operating_point
from tdof_npid_ros.stability.pulse import pulse_transfer

MOST_DELAY = 300  # samples: of what is compared with eigenvalues


def case_of(plant: dict[str, Any], gains: Gains, **options: Any) -> Case:
    """A case without a file, sampled every 10 ms; the plant's parameters as YAML would give them."""
    return Case(
        "mine",
        10_000_000,
        plant["model"],
        plant,
        (-math.inf, math.inf),
        gains,
        {},
        options=ControllerOptions(**options),
    )


FIRST_ORDER = {"model": "first_order", "time_constant": 1.0, "dead_time": 0.1}


def controller_of(gains: Gains, h: float) -> control.TransferFunction:
    """The law with k(e) = 1 from the error to the effort, as python-control has it."""
    c = coefficients(gains, h)[:, 0]
    z = control.tf("z")
    z.dt = h
    return c[KP] + c[KI_H] / (z - 1) + c[KD_H] * (z - 1) / (z - c[PHI])


@pytest.mark.parametrize(
    ("plant", "gains"),
    [
        (TransferFunction((1.0,), (1.0, 3.0, 3.0, 1.0)), Gains("pid", 3.0, 1.5, 1.0)),
        (TransferFunction((-1.0, 1.0), (1.0, 3.0, 3.0, 1.0)), Gains("pid", 1.2, 0.5, 1.0)),
        (TransferFunction((2.0,), (1.0, 0.2, 4.0)), Gains("pid", 0.4, 0.8, 0.2)),
        (TransferFunction((1.0,), (1.0, 0.5, 0.0)), Gains("pid", 2.0, 0.3, 1.0)),
        (TransferFunction((-1.0,), (1.0, 1.0, 1.0)), Gains("pid", -1.0, -0.5, -0.4)),
    ],
)
def test_margins_of_loops_without_dead_time_are_those_of_python_control(plant: TransferFunction, gains: Gains) -> None:
    h = 0.05
    found = linear_margins(pulse_transfer(plant.sampled(50_000_000), h), gains)  # type: ignore[arg-type]
    sampled = control.sample_system(control.tf(plant.numerator, plant.denominator), h, method="zoh")
    open_loop = sampled * controller_of(gains, h)
    gain, phase, sensitivity, _, crossover, _ = control.stability_margins(open_loop, method="frd")
    assert found.gain_margin == pytest.approx(gain, rel=1e-3)
    assert found.phase_margin_deg == pytest.approx(phase, rel=1e-3)
    assert found.m_s == pytest.approx(1 / sensitivity, rel=2e-3)
    assert found.delay_margin_s == pytest.approx(math.radians(phase) / crossover, rel=1e-3)


@pytest.mark.parametrize("seed", range(3))
def test_the_modes_are_the_eigenvalues_of_the_loop_s_matrix(seed: int) -> None:
    rng = np.random.default_rng(seed)
    for _ in range(15):
        loop = random_loop(rng)
        if loop.sampled.delay > MOST_DELAY:
            continue
        modulus = np.abs(np.linalg.eigvals(closed_loop_matrix(loop)))
        plant = pulse_transfer(loop.sampled, loop.period)
        function = characteristic(plant, loop.gains)
        for beyond in (0.0, -1e-3, -1e-2, 1e-3):
            assert function.modes_outside(beyond) == np.count_nonzero(modulus > 1 + beyond), loop
        found = linear_margins(plant, loop.gains)
        assert found.stable == (modulus.max() < 1)
        assert found.spectral_radius is not None
        assert found.spectral_radius - 1 == pytest.approx(modulus.max() - 1, rel=1e-5, abs=1e-12), loop


def test_the_slowest_mode_is_what_is_left_of_the_simulation_in_the_end() -> None:
    case = load_case("p2-c5")
    gains = case.gains.with_values(type="pid")
    found = margins(case, gains)
    assert found.time_constant_s is not None
    signals = parse_plan(["0 setpoint 1", "150 end"], case.sample_period_ns).sampled(case.sample_period_ns)
    run = closed_loop.simulate(case.plant_at, gains, signals, case.effort_limits)
    error = np.abs(run.output[:, 0] - 1.0)
    late = [error[(run.time >= start) & (run.time < start + 20)].max() for start in (60, 110)]
    assert 50 / math.log(late[0] / late[1]) == pytest.approx(found.time_constant_s, rel=0.02)


def test_a_tuned_row_that_is_unstable_is_told_to_be() -> None:
    case, row = load_case("p3-c2"), Gains("tdof_npid2", 0.8366819494762695, 0.617872515857525, 0.580581397359785)
    found = margins(case, row)
    assert found.stable is False
    assert found.m_s is None and found.gain_margin is None and found.delay_margin_s is None
    assert found.spectral_radius == pytest.approx(1.00035, abs=5e-6)
    assert "unstable" in str(found.reason)
    assert found.time_constant_s is not None and found.time_constant_s < 0


def test_every_tuned_row_has_margins_or_a_reason() -> None:
    for name in ("p1-c0.5", "p3-c2", "sprott"):
        row = tuned(name, "pid")
        assert row is not None
        found = margins(load_case(name), row.gains)
        assert (found.m_s is None) == (found.reason is not None)


def test_the_filter_of_the_output_is_part_of_the_loop() -> None:
    case = case_of(FIRST_ORDER, Gains("pid", 3.0, 3.0), filter_time=0.2)
    # The same loop with the filter counted to the plant, for which the sampled filter is not sampled exactly.
    twice = case_of(
        {"model": "transfer_function", "numerator": [1.0], "denominator": [0.2, 1.2, 1.0], "dead_time": 0.1},
        Gains("pid", 3.0, 3.0),
    )
    filtered, counted = margins(case, case.gains), margins(twice, twice.gains)
    without = margins(replace(case, options=ControllerOptions()), case.gains)
    assert filtered.m_s == pytest.approx(counted.m_s, rel=0.03)
    assert filtered.m_s is not None and without.m_s is not None and filtered.m_s > 1.15 * without.m_s


def test_an_unstable_plant_needs_a_gain_within_two_margins() -> None:
    plant = {"model": "transfer_function", "numerator": [1.0], "denominator": [1.0, -1.0], "dead_time": 0.2}
    case = case_of(plant, Gains("pid", 2.5, 0.5, 0.2))
    found = margins(case, case.gains)
    assert found.gain_margin is not None and found.gain_margin_low is not None
    for factor, stable in ((found.gain_margin * 0.99, True), (found.gain_margin * 1.01, False),
                           (found.gain_margin_low * 1.01, True), (found.gain_margin_low * 0.99, False)):  # fmt: skip
        assert margins(case, Gains("pid", 2.5 * factor, 0.5 * factor, 0.2 * factor)).stable == stable


def test_a_loop_without_feedback_has_the_plant_s_own_stability() -> None:
    case = case_of(FIRST_ORDER, Gains("pid", 0.0))
    assert margins(case, case.gains).stable
    unstable = {"model": "transfer_function", "numerator": [1.0], "denominator": [1.0, -1.0]}
    assert margins(case_of(unstable, case.gains), case.gains).stable is False
    pure_integral = margins(case, Gains("pid", 0.0, 0.5))
    assert pure_integral.stable and pure_integral.gain_margin is not None


def test_a_nonlinear_plant_is_linearised_where_it_rests() -> None:
    case = load_case("sprott")
    found = margins(case, case.gains)
    assert found.operating_point is not None and not found.operating_point.linear
    assert found.operating_point.effort == pytest.approx(-(2.0 - 1.2) / 0.6)
    assert any("linearised" in note for note in found.notes)
    # The circuit with its switched term held is linear: s³ + 0.6 s² + s + 1.2, from u (s + a).
    held = replace(case, model="transfer_function", episodes={},
                   plant_values={"numerator": [1.0, 0.6], "denominator": [1.0, 0.6, 1.0, 1.2]})  # fmt: skip
    linear = margins(held, case.gains, setpoint=1.0)
    for name in ("m_s", "m_t", "gain_margin", "phase_margin_deg", "delay_margin_s"):
        assert getattr(found, name) == pytest.approx(getattr(linear, name), rel=2e-3), name


def test_where_a_plant_jumps_there_is_no_linear_model() -> None:
    case = load_case("sprott")
    found = margins(case, case.gains, setpoint=0.0)
    assert found.stable is None and "kink or a jump" in str(found.reason)


def test_the_operating_point_is_where_the_simulation_ends() -> None:
    for gains in (Gains("pid", 300.0, 200.0, 40.0), Gains("tdof_npid1", 300.0, 0.0, 40.0, alpha=0.3)):
        case = load_case("sprott")
        point = operating_point(case, gains, 1.0, 0.7)
        signals = parse_plan(["0 setpoint 1", "0 disturbance 0.7", "40 end"], case.sample_period_ns)
        run = closed_loop.simulate(case.plant_at, gains, signals.sampled(case.sample_period_ns), case.effort_limits)
        assert run.output[-1, 0] == pytest.approx(point.output, abs=1e-4)
        assert run.control_effort[-1, 0] == pytest.approx(point.effort, abs=2e-2)


def test_what_the_numbers_leave_out_is_said() -> None:
    case = case_of(FIRST_ORDER, Gains("pid", 1.0, 1.0, effort_max=0.5), dead_band=0.1, effort_rate=1.0)
    said = " ".join(margins(case, case.gains, setpoint=1.0).notes)
    assert "dead band" in said and "rate limits" in said and "cannot rest" in said
    manual = case_of(FIRST_ORDER, Gains("pid", 1.0), manual=True)
    assert margins(manual, manual.gains).stable is None


def test_an_operating_point_that_is_no_number_is_refused() -> None:
    case = load_case("p1-c4")
    with pytest.raises(StabilityError, match="setpoint is nan"):
        margins(case, case.gains, setpoint=math.nan)


def test_lanes_have_their_own_margins() -> None:
    case = load_case("p1-c4")
    both = case.gains.with_values(kp=(1.0, 1.5))
    assert margins(case, both, lane=1) == margins(case, case.gains.with_values(kp=1.5))


def test_the_program_prints_and_draws_margins(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    picture = tmp_path / "margins.png"
    assert main(["margins", "p2-c5", "--controller", "tdof_npid1", "--json", "--plot", str(picture)]) == 0
    report = json.loads(capsys.readouterr().out)
    assert list(report) == ["case", "controller", "gains", "margins"]
    assert report["margins"]["m_s"] == pytest.approx(2.03, abs=0.005)
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert main(["margins", "p2-c5"]) == 0
    assert "M_s" in capsys.readouterr().out
    assert main(["margins", "p2-c5", "--setpoint", "nan"]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_loop_of_long_dead_time_takes_no_longer_than_a_breath() -> None:
    loop = Loop(TransferFunction((1.0,), (50.0, 1.0), 100.0), Gains("pid", 0.3, 0.005), 0.01)
    found = linear_margins(pulse_transfer(loop.sampled, loop.period), loop.gains)
    assert found.stable and found.delay_margin_samples is not None and found.delay_margin_samples > 100


def test_the_plant_s_own_operating_point_changes_no_margin() -> None:
    plain = case_of(FIRST_ORDER, Gains("pid", 1.0, 1.0))
    moved = case_of({**FIRST_ORDER, "output_offset": 20.0, "effort_offset": 3.0}, Gains("pid", 1.0, 1.0))
    assert loop_plant(plain) == loop_plant(moved)
    assert operating_point(moved, moved.gains, 25.0, 0.0).effort == pytest.approx(8.0)


def test_a_mode_so_near_the_border_that_nobody_can_tell_is_not_called_stable() -> None:
    for gains, plant in (
        (Gains("pid", 1.0, 1e-12), {"model": "first_order", "time_constant": 1.0, "dead_time": 0.1}),
        (
            Gains("pid", 0.5, 0.2),
            {"model": "transfer_function", "numerator": [1.0, 0.0], "denominator": [1.0, 2.0, 1.0]},
        ),
    ):
        case = case_of(plant, gains)
        found = margins(case, gains)
        assert found.stable is False and "border" in str(found.reason)
        assert found.time_constant_s is None and found.spectral_radius == pytest.approx(1.0)


def test_the_setpoint_s_own_limits_move_the_operating_point() -> None:
    case = case_of(FIRST_ORDER, Gains("pid", 1.0, 1.0), setpoint_max=0.5)
    assert operating_point(case, case.gains, 2.0, 0.0).output == 0.5


def test_modes_that_are_over_within_a_sample_are_no_error() -> None:
    plant = {"model": "first_order", "time_constant": 1e-3, "dead_time": 0.0}
    for gains in (Gains("pid", 0.05), Gains("pid", 0.0)):
        found = margins(case_of(plant, gains), gains)
        assert found.stable and found.time_constant_s is not None and found.time_constant_s < 0.01


def test_a_loop_above_one_at_half_the_sampling_frequency_does_not_bear_one_more_sample() -> None:
    plant = {"model": "first_order", "time_constant": 0.1, "dead_time": 1.0}
    gains = Gains("pid", 0.2, 0.0, 0.5)
    case = replace(case_of(plant, gains), sample_period_ns=1_000_000_000)
    found = margins(case, gains)
    assert found.stable and found.delay_margin_samples is not None and found.delay_margin_samples <= 1.0
    later = replace(case, plant_values={**plant, "dead_time": 2.0})
    assert margins(later, gains).stable is False


def test_margins_are_of_the_plant_as_the_plan_leaves_it() -> None:
    plans = {name: [f"0 {name} 1", "0 plant.gain 3", "25 end"] for name in ("setpoint", "disturbance")}
    controller = {"type": "pid", "kp": 2.0, "ki": 1.0}
    played = make_case({"model": "first_order", "gain": 1.0, "dead_time": 0.1}, controller, plans)
    plain = make_case({"model": "first_order", "gain": 3.0, "dead_time": 0.1}, controller, {})
    found, expected = margins(played, played.gains), margins(plain, plain.gains)
    assert (found.m_s, found.gain_margin) == (expected.m_s, expected.gain_margin)
    assert "the plant is as the plan leaves it: gain = 3" in found.notes
    (of_sweep,) = linear_loop_plants(played, [{"gain": 1.1}])
    assert of_sweep == loop_plant(plain)
