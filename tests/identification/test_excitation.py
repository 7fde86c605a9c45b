"""What an experiment moves and when, on plants of which it knows nothing."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tdof_npid_ros.identification.excitation import Excitation, Kind, relay_point, rest_of

H = 0.05


def first_order(gain: float, lag: float, dead_time: float, integrating: bool = False) -> tuple[float, float, int]:
    decay = 1.0 if integrating else math.exp(-H / lag)
    return decay, gain * H if integrating else gain * (1.0 - decay), round(dead_time / H)


def played(
    kind: Kind, plant: tuple[float, float, int], noise: float = 0.0, swing: float = math.inf, hold: float = 1e3
) -> tuple[Excitation, np.ndarray, np.ndarray, np.ndarray]:
    """An experiment by hand about effort 2 and output 5: it, and time, effort and output of each sample."""
    decay, input_gain, delay = plant
    random = np.random.default_rng(1)
    excitation = Excitation(kind, 2.0, 1.0, noise, hold, swing)
    x, pipe, rows = 0.0, [0.0] * (delay + 1), []
    excitation.begin(0.0, 5.0)
    for k in range(100_000):
        y = 5.0 + x + noise * float(random.standard_normal())
        rows.append((k * H, excitation.level, y))
        if excitation.take(k * H, y) and excitation.done:
            break
        pipe.append(excitation.level - 2.0)
        x = decay * x + input_gain * pipe.pop(0)
    return excitation, *np.array(rows).T


@pytest.mark.parametrize("lag", [0.5, 5.0, 50.0])
@pytest.mark.parametrize("dead_time", [0.0, 3.0])
@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_a_level_lasts_until_the_output_has_settled_whatever_the_time_scale(
    lag: float, dead_time: float, noise: float
) -> None:
    excitation, time, _, output = played("doublet", first_order(1.0, lag, dead_time), noise)
    assert [level for _, level in excitation.changes] == [3.0, 1.0, 2.0]
    ends = [t for t, _ in excitation.changes[1:]]
    for end, level in zip(ends, (6.0, 4.0), strict=True):
        assert abs(output[np.searchsorted(time, end)] - level) < 0.05 + 4.0 * noise
    assert time[-1] < 3 * (12.0 * lag + 3.0 * dead_time + 60 * H)


def test_an_output_that_would_run_away_turns_round_at_the_swing() -> None:
    _, _, effort, output = played("doublet", first_order(0.1, 1.0, 1.0, integrating=True), swing=0.5)
    assert output.min() > 4.3 and output.max() < 5.7
    assert set(effort) == {1.0, 2.0, 3.0}


def test_a_level_ends_at_the_latest_after_hold() -> None:
    excitation, time, _, _ = played("step", first_order(0.0, 1.0, 0.0), noise=0.1, hold=20.0)
    assert excitation.done and 20.0 < time[-1] < 20.2


@pytest.mark.parametrize(("lag", "dead_time"), [(5.0, 1.0), (2.0, 2.0)])
def test_the_describing_function_point_is_on_the_plants_frequency_response(lag: float, dead_time: float) -> None:
    excitation, time, effort, output = played("relay", first_order(2.0, lag, dead_time), swing=0.3)
    assert len(excitation.changes) == 9
    point = relay_point(time, effort, output)
    assert point is not None
    w = 2.0 * math.pi / point.period
    response = 2.0 * np.exp(-1j * w * (dead_time + H)) / (1j * w * lag + 1.0)  # + H: the effort of a row is the next's
    assert point.gain == pytest.approx(abs(response), rel=0.05)
    assert point.phase == pytest.approx(math.degrees(np.angle(response)), abs=6.0)


def test_rest_is_told_from_drift() -> None:
    random = np.random.default_rng(3)
    still, zeros = 5.0 + 0.1 * random.standard_normal(200), np.zeros(200)
    assert rest_of(still.tolist(), zeros.tolist(), zeros.tolist(), 0.0).is_rest
    assert rest_of(still.tolist(), zeros.tolist(), zeros.tolist(), 0.0).noise == pytest.approx(0.1, rel=0.3)
    assert not rest_of((still + np.linspace(0, 1, 200)).tolist(), zeros.tolist(), zeros.tolist(), 0.0).is_rest
