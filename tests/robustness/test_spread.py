"""Spreads: what may be written, and what samples of them are."""

from __future__ import annotations

import numpy as np
import pytest

from tdof_npid_ros.case import load_case, make_case
from tdof_npid_ros.robustness import RobustError
from tdof_npid_ros.robustness.spread import SAMPLINGS, changes_of, samples, spreads_of

PLANS = {"setpoint": ["0 setpoint 1", "2 end"]}
TRANSFER = {"model": "transfer_function", "numerator": [2.0], "denominator": [1.0, 3.0, 1.0]}


@pytest.mark.parametrize(
    ("text", "low", "high"),
    [
        ("gain 20 %", 0.8, 1.2),
        ("gain 20%", 0.8, 1.2),
        ("gain 0.1", 0.9, 1.1),
        ("gain -1 .. 2.5", -1.0, 2.5),
        ("noise 0 .. 0.01", 0.0, 0.01),
    ],
)
def test_a_spread_is_of_the_value_in_the_unit_or_a_range(text: str, low: float, high: float) -> None:
    (spread,) = spreads_of(load_case("p1-c0.5"), [text])
    assert (spread.low, spread.high) == pytest.approx((low, high))


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        ([], "no spread is given"),
        (["gain"], "'gain' is none: write"),
        (["gain 20 percent"], "is none: write"),
        (["gian 20 %"], "no such parameter.*gain"),
        (["noise_seed 10 %"], "no such parameter"),
        (["gain 1 %", "gain 2 %"], "gain has two spreads"),
        (["dead_time 130 %"], "reaches a plant that cannot be: dead_time"),
        (["output_offset 10 %"], "output_offset is 0"),
        (["gain 2 .. 1"], "upper end must be above"),
        (["gain[0] 1 %"], "gain is no list"),
    ],
)
def test_what_is_no_spread_is_refused_in_one_line(texts: list[str], message: str) -> None:
    with pytest.raises(RobustError, match=message) as error:
        spreads_of(load_case("p1-c0.5"), texts)
    assert "\n" not in str(error.value)


def test_a_normal_sample_is_checked_beyond_the_ends() -> None:
    assert spreads_of(load_case("p1-c0.5"), ["dead_time 80 %"])
    with pytest.raises(RobustError, match="cannot be"):
        spreads_of(load_case("p1-c0.5"), ["dead_time 80 %"], "normal")


def test_an_element_of_a_list_is_spread() -> None:
    case = make_case(TRANSFER, {"type": "pid", "kp": 1.0}, PLANS)
    spreads = spreads_of(case, ["denominator[1] 10 %", "numerator[0] 10 %"])
    assert changes_of(case, spreads, [3.1, 2.2], 0) == {"denominator": [1.0, 3.1, 1.0], "numerator": [2.2]}
    with pytest.raises(RobustError, match="name an element"):
        spreads_of(case, ["denominator 10 %"])
    with pytest.raises(RobustError, match="has 3 elements"):
        spreads_of(case, ["denominator[3] 10 %"])


@pytest.mark.parametrize("sampling", SAMPLINGS)
def test_samples_are_the_same_each_time_and_lie_where_they_should(sampling) -> None:  # type: ignore[no-untyped-def]
    spreads = spreads_of(load_case("p1-c0.5"), ["gain 20 %", "dead_time 0.1"], sampling)
    values = samples(spreads, 1000, sampling, 3)
    np.testing.assert_array_equal(values, samples(spreads, 1000, sampling, 3))
    gain = values[:, 0]
    reach = 1.5 if sampling == "normal" else 1.0
    assert np.all(np.abs(gain - 1.0) <= 0.2 * reach + 1e-12)
    if sampling == "corners":
        assert sorted(map(tuple, np.round(values, 6))) == [(0.8, 0.4), (0.8, 0.6), (1.2, 0.4), (1.2, 0.6)]
        return
    assert not np.array_equal(values, samples(spreads, 1000, sampling, 4))
    deviation = {"uniform": 0.2 / np.sqrt(3.0), "latin": 0.2 / np.sqrt(3.0), "normal": 0.1}[sampling]
    assert np.std(gain) == pytest.approx(deviation, rel=0.05)
    if sampling == "latin":
        assert np.all(np.bincount(((gain - 0.8) / 0.4 * 1000).astype(int).clip(0, 999)) == 1)


def test_too_many_samples_or_corners_are_refused() -> None:
    case = load_case("p1-c0.5")
    with pytest.raises(RobustError, match="samples: from 1"):
        samples(spreads_of(case, ["gain 1 %"]), 0, "uniform", 0)
    with pytest.raises(RobustError, match="corners"):
        samples(spreads_of(case, ["gain 1 %"]) * 17, 1, "corners", 0)


def test_what_the_plans_set_has_no_spread() -> None:
    plans = {"setpoint": ["0 setpoint 1", "0 plant.gain 2", "25 end"], "disturbance": ["0 disturbance 1", "25 end"]}
    case = make_case({"model": "first_order", "gain": 1.0, "dead_time": 0.1}, {"type": "pid", "kp": 1.0}, plans)
    with pytest.raises(RobustError, match="gain is what the episodes' plans set"):
        spreads_of(case, ["gain 20 %"])
