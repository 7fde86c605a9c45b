"""Plans are read as written, and wrong lines are named."""

import time
import tracemalloc

import numpy as np
import pytest

from tdof_npid_ros.case import make_case
from tdof_npid_ros.loop import integrals
from tdof_npid_ros.scenario import Plan, PlanError, Segment, parse_plan

PERIOD_NS = 100_000_000


def test_steps_hold_until_the_next_line() -> None:
    signals = parse_plan(["0 setpoint 1", "0.5 disturbance -2", "1 setpoint 3", "2 end"], PERIOD_NS).sampled(PERIOD_NS)
    assert signals.steps == 20
    np.testing.assert_array_equal(signals.setpoint, [1.0] * 10 + [3.0] * 11)
    np.testing.assert_array_equal(signals.disturbance, [0.0] * 5 + [-2.0] * 16)


def test_a_ramp_goes_from_where_the_signal_is() -> None:
    signals = parse_plan(["0 setpoint 1", "1 setpoint ramp 3 over 1", "3 end"], PERIOD_NS).sampled(PERIOD_NS)
    np.testing.assert_allclose(signals.setpoint[10:21], np.linspace(1, 3, 11))
    assert signals.setpoint[-1] == 3.0


def test_a_sine_swings_about_where_the_signal_is_and_returns() -> None:
    lines = ["0 setpoint 2", "1 setpoint sine 0.5 period 2 for 4", "6 end"]
    signals = parse_plan(lines, PERIOD_NS).sampled(PERIOD_NS)
    np.testing.assert_allclose(signals.setpoint[10:50], 2 + 0.5 * np.sin(np.pi * np.arange(40) * 0.1))
    assert set(signals.setpoint[50:]) == {2.0}


def test_a_later_line_ends_a_ramp() -> None:
    lines = ["0 setpoint ramp 10 over 10", "1 setpoint 0", "2 end"]
    signals = parse_plan(lines, PERIOD_NS).sampled(PERIOD_NS)
    assert set(signals.setpoint[10:]) == {0.0}


def test_plant_parameters_divide_the_episode() -> None:
    signals = parse_plan(["0 plant.a 0.6", "1 plant.a 0.7", "2 end"], PERIOD_NS, ["a"]).sampled(PERIOD_NS)
    assert [(s.first, s.last, s.plant) for s in signals.segments] == [(0, 10, {"a": 0.6}), (10, 20, {"a": 0.7})]


def test_a_plans_name_depends_on_its_content_alone() -> None:
    one, same = (parse_plan(["0 setpoint 1", "2 end"], PERIOD_NS) for _ in range(2))
    other = parse_plan(["0 setpoint 1.0000000000000002", "2 end"], PERIOD_NS)
    assert one.digest == same.digest != other.digest


@pytest.mark.parametrize(
    ("lines", "word"),
    [
        ([], "end"),
        (["0 setpoint 1"], "end"),
        (["0 setpoint 1", "5 setpoint 2", "4 setpoint 3", "6 end"], "line 3 '4 setpoint 3'"),
        (["0 speed 1", "1 end"], "line 1 '0 speed 1'"),
        (["0 setpoint nan", "1 end"], "not finite"),
        (["0 setpoint inf", "1 end"], "not finite"),
        (["0 setpoint one", "1 end"], "not a number"),
        (["-1 setpoint 1", "1 end"], "negative"),
        (["0 setpoint", "1 end"], "line 1"),
        (["0 setpoint ramp 1", "1 end"], "line 1"),
        (["0 setpoint ramp 1 over -2", "1 end"], "above 0"),
        (["0 plant.b 1", "1 end"], "unknown plant parameter"),
        (["1 plant.a 1", "2 end"], "value at 0 s"),
        (["0 setpoint 1", "0 end"], "samples"),
        (["0 setpoint 1", "1 end", "2 setpoint 1"], "after the end"),
    ],
)
def test_a_bad_plan_is_refused_with_the_line_that_is_wrong(lines: list[str], word: str) -> None:
    with pytest.raises(PlanError, match=word):
        parse_plan(lines, PERIOD_NS, ["a"])


@pytest.mark.parametrize(
    ("names", "times", "values", "word"),
    [
        (("setpoint",), (0,), ((1.0,),), "two points"),
        (("setpoint",), (5, 10), ((1.0,), (1.0,)), "first point"),
        (("setpoint",), (0, 10, 10), ((1.0,), (1.0,), (1.0,)), "not after"),
        (("setpoint", "setpoint"), (0, 10), ((1.0, 1.0), (1.0, 1.0)), "twice"),
        (("velocity",), (0, 10), ((1.0,), (1.0,)), "unknown"),
        (("setpoint",), (0, 10), ((1.0,), (float("nan"),)), "not finite"),
        (("setpoint",), (0, 10), ((1.0,), (1.0, 2.0)), "values"),
    ],
)
def test_a_plan_from_a_message_is_checked_too(names, times, values, word: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(PlanError, match=word):
        Plan(names, times, values)


def test_a_plan_of_ten_thousand_lines_is_read_at_once() -> None:
    lines = [f"{i} setpoint {i % 7}" for i in range(10_000)]
    began = time.monotonic()
    assert len(parse_plan([*lines, "10000 end"], 10_000_000).times_ns) == 10_001
    assert time.monotonic() - began < 5.0  # pairing each line with all others took a minute


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (["0 setpoint ramp 1 over 99999", "99999 end"], "values at most"),
        (["0 setpoint sine 1 period 1 for 99999", "99999 end"], "values at most"),
        ([*(f"0 plant.x{i} 0" for i in range(999)), "0 setpoint ramp 1 over 9", "9 end"], "values at most"),
        (["1e308 end"], "beyond 1e"),
        (["0 setpoint ramp 1 over 1e308", "1 end"], "longer than"),
        (["0 setpoint 1", "1e7 end"], "samples"),
        (["0 " + "x" * 100_000 + " 1", "1 end"], "unknown signal"),
        (["0 setpoint 1", "1 end" * 10_000], "line 2"),
    ],
)
def test_plans_beyond_all_bounds_are_refused_before_they_take_memory(lines: list[str], words: str) -> None:
    tracemalloc.start()
    try:
        with pytest.raises(PlanError, match=words):
            parse_plan(lines, 10_000_000)
        assert tracemalloc.get_traced_memory()[1] < 100e6
    finally:
        tracemalloc.stop()


def test_a_plan_of_many_columns_takes_no_memory_for_them() -> None:
    """Of a plant's parameters only the changes are kept, not a value per sample."""
    names = tuple(f"plant.x{i}" for i in range(101))
    plan = Plan(names, (0, 99_999 * 10**9), ((1.0,) * 101,) * 2)
    tracemalloc.start()
    try:
        assert len(plan.sampled(10_000_000).segments) == 1
        assert tracemalloc.get_traced_memory()[1] < 500e6  # two signals of ten million samples, not a hundred
    finally:
        tracemalloc.stop()


def test_overlapping_points_within_a_sample_leave_the_last() -> None:
    plan = parse_plan(
        ["0 plant.a 1", "0.0101 plant.a 2", "0.0102 plant.a 3", "0.02 setpoint 1", "0.05 end"], 10_000_000
    )
    sampled = plan.sampled(10_000_000)
    assert sampled.setpoint.tolist() == [0.0, 0.0, 1.0, 1.0, 1.0, 1.0]
    assert sampled.segments == (Segment(0, 2, {"a": 1.0}), Segment(2, 5, {"a": 3.0}))


def test_a_plan_that_ends_within_a_ramp_or_sine_samples_its_last_point() -> None:
    ramp = parse_plan(["0 setpoint ramp 2 over 2", "1 end"], PERIOD_NS).sampled(PERIOD_NS)
    np.testing.assert_allclose(ramp.setpoint, np.linspace(0, 1, 11))
    sine = parse_plan(["0 setpoint sine 1 period 4 for 8", "1 end"], PERIOD_NS).sampled(PERIOD_NS)
    np.testing.assert_allclose(sine.setpoint, np.sin(np.pi / 2 * np.arange(11) / 10))
    whole = parse_plan(["0 setpoint ramp 1 over 1", "1 end"], PERIOD_NS).sampled(PERIOD_NS)
    assert whole.setpoint[-1] == 1.0


@pytest.mark.parametrize("steps", range(1, 30))
def test_an_episode_of_any_length_is_simulated_and_integrated(steps: int) -> None:
    for lines in ([f"{steps} end"], [f"{steps - 1} setpoint 2", f"{steps} end"] if steps > 1 else [f"{steps} end"]):
        plans = {"setpoint": ["0 setpoint 1", *lines], "disturbance": ["0 disturbance 1", *lines]}
        plant = {"model": "first_order", "gain": 1.0, "time_constant": 5.0}
        case = make_case(plant, {"type": "pid", "kp": 1.0, "ki": 0.2}, plans, sample_period=1.0)
        signals = case.signals["setpoint"]
        found = integrals(case.plant_at, case.gains, signals, case.effort_limits)
        run = case.simulate("setpoint")
        error = np.abs(run.setpoint - run.output[:, 0])
        assert found.iae[0] == pytest.approx(float(error @ signals.weight), rel=1e-12)
