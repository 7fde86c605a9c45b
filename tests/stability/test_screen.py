"""Margins of many candidates at once, against matrices and dense grids."""

from __future__ import annotations

import os

import numpy as np
import pytest
from loops import Loop, closed_loop_matrix, open_loop, random_loop, spectral_radius

from tdof_npid_ros.case import load_case
from tdof_npid_ros.control.gains import Gains, gains_from_candidates
from tdof_npid_ros.paper.tables import published
from tdof_npid_ros.plants.linear import TransferFunction
from tdof_npid_ros.stability import StabilityError
from tdof_npid_ros.stability.plant import loop_plant
from tdof_npid_ros.stability.pulse import pulse_transfer
from tdof_npid_ros.stability.screen import MOST_POINTS, Screen

LONG = bool(os.environ.get("TDOF_NPID_LONG"))
LOOPS = 1000 if LONG else 80
pytestmark = pytest.mark.timeout(3600 if LONG else 120)
MOST_DELAY = 300  # samples: of what is compared with eigenvalues


def screen_of(loop: Loop) -> Screen:
    return Screen(pulse_transfer(loop.sampled, loop.period))


def largest(loop: Loop) -> tuple[float, float]:
    """M_s and M_t from a dense grid."""
    omega = np.union1d(np.geomspace(1e-7, np.pi, 20000), np.linspace(1e-3, np.pi, 40000))
    found = []
    for size in (lambda L: 1 / abs(1 + L), lambda L: abs(L / (1 + L))):
        peak = int(np.argmax(size(open_loop(loop, omega))))
        near = np.linspace(omega[max(peak - 1, 0)], omega[min(peak + 1, len(omega) - 1)], 2001)
        found.append(float(np.max(size(open_loop(loop, near)))))
    return found[0], found[1]


@pytest.mark.parametrize("seed", range(4))
def test_random_loops_have_the_stability_and_the_peaks_of_plain_computations(seed: int) -> None:
    rng = np.random.default_rng(seed)
    stable = 0
    for _ in range(LOOPS // 4):
        loop = random_loop(rng)
        if loop.sampled.delay > MOST_DELAY:
            continue
        found, radius = screen_of(loop)(loop.gains), spectral_radius(loop)
        assert found.stable[0] == (radius < 1.0), loop
        if not found.stable[0]:
            assert np.isnan(found.m_s[0])
            continue
        stable += 1
        m_s, m_t = largest(loop)
        assert found.m_s[0] == pytest.approx(m_s, rel=1e-2), loop
        assert found.m_t[0] == pytest.approx(m_t, rel=1e-2), loop
        assert found.time_constant[0] == pytest.approx(-loop.period / np.log(radius), rel=1e-3), loop
    assert stable > LOOPS // 16


@pytest.mark.parametrize("seed", range(2))
def test_beyond_a_margin_the_loop_is_unstable_and_within_it_is_not(seed: int) -> None:
    rng = np.random.default_rng(100 + seed)
    tried = 0
    while tried < LOOPS // 4:
        loop = random_loop(rng)
        if loop.sampled.delay > MOST_DELAY:
            continue
        found = screen_of(loop)(loop.gains)
        if not found.stable[0]:
            continue
        tried += 1
        gains = loop.gains
        low, high = found.gain_margin_low[0], found.gain_margin[0]
        for k, stable in ((0.999 * high, True), (1.001 * high, False), (1.001 * low, True), (0.999 * low, False)):
            if 1e-3 < k < 1e3:
                scaled = gains.with_values(kp=gains.kp * k, ki=gains.ki * k, kd=gains.kd * k)  # type: ignore[operator]
                assert (spectral_radius(loop._replace(gains=scaled)) < 1.0) == stable, (loop, k)
        samples = found.delay_margin[0] / loop.period
        if samples + loop.sampled.delay < MOST_DELAY / 2:
            for extra in (int(samples * 0.995), int(samples * 1.005) + 1):
                radius = radius_with_delay(loop, extra)
                assert (radius < 1.0) == (extra < samples), (loop, samples, extra)


def radius_with_delay(loop: Loop, samples: int) -> float:
    delay = (round(loop.plant.dead_time * 1e9) + samples * round(loop.period * 1e9)) / 1e9
    later = TransferFunction(loop.plant.numerator, loop.plant.denominator, delay)
    return float(np.max(np.abs(np.linalg.eigvals(closed_loop_matrix(loop._replace(plant=later))))))


def test_the_phase_margin_is_the_angle_by_which_a_turned_loop_meets_minus_one() -> None:
    loop = Loop(TransferFunction((1.0,), (1.0, 1.0, 0.0), 0.1), Gains("pid", 1.0, 0.1, 0.3), 0.01)
    margin = screen_of(loop)(loop.gains).phase_margin[0]
    omega = np.geomspace(1e-4, np.pi, 400_000)
    response = open_loop(loop, omega)
    crossovers = np.flatnonzero(np.diff(np.abs(response) > 1))
    angles = np.abs(np.angle(-response[crossovers]))
    assert margin == pytest.approx(np.min(angles), rel=1e-3)


def test_a_sharp_resonance_is_seen_at_its_height() -> None:
    plant = TransferFunction((1.0,), (1.0, 1.0), 0.5)
    loop = Loop(plant, Gains("pid", 3.0, 0.5), 0.01)
    screen = screen_of(loop)
    edge = 3.0 * screen(loop.gains).gain_margin[0]
    for short in (1e-1, 1e-2, 1e-3):
        near = loop._replace(gains=Gains("pid", edge * (1 - short), 0.5))
        found = screen(near.gains)
        assert found.m_s[0] == pytest.approx(largest(near)[0], rel=1e-2)


@pytest.mark.parametrize(
    ("case", "controller", "m_s", "m_t"),
    [
        ("p1-c0.5", "pid", 3.56, 2.57),
        ("p1-c4", "tdof_npid2", 2.46, 1.49),
        ("p2-c2", "tdof_npid1", 2.24, 1.42),
        ("p2-c5", "tdof_npid1", 2.03, 1.84),
        ("p3-c1", "tdof_npid2", 3.15, 2.23),
    ],
)
def test_printed_rows_have_their_margins(case: str, controller: str, m_s: float, m_t: float) -> None:
    row = published(case, controller)  # type: ignore[arg-type]
    assert row is not None
    found = Screen(loop_plant(load_case(case)))(row.gains)
    assert found.m_s[0] == pytest.approx(m_s, abs=0.005)
    assert found.m_t[0] == pytest.approx(m_t, abs=0.005)


def test_lanes_do_not_depend_on_each_other() -> None:
    case = load_case("p2-c5")
    screen = Screen(loop_plant(case))
    rng = np.random.default_rng(1)
    candidates = np.column_stack([rng.uniform(*case.bounds[name], 200) for name in ("kp", "ki", "kd")])
    candidates[::7, 1] = 0.0
    candidates[::5, 2] = 0.0
    together = screen(gains_from_candidates(case.gains, ("kp", "ki", "kd"), candidates))
    assert 0 < np.count_nonzero(together.stable) < 200
    for lane in range(200):
        alone = screen(gains_from_candidates(case.gains, ("kp", "ki", "kd"), candidates[lane : lane + 1]))
        for name in ("stable", "m_s", "m_t", "gain_margin", "phase_margin", "delay_margin", "time_constant"):
            np.testing.assert_array_equal(getattr(alone, name)[0], getattr(together, name)[lane])


def test_a_mode_on_the_circle_is_not_stable() -> None:
    oscillator = TransferFunction((1.0,), (1.0, 0.0, 1.0))
    integrator = TransferFunction((1.0,), (1.0, 0.0))
    for plant, gains in ((oscillator, Gains("pid", 0.0, 0.0)), (integrator, Gains("pid", 0.0, 0.1))):
        assert not screen_of(Loop(plant, gains, 0.01))(gains).stable[0]


def test_a_hidden_unstable_mode_is_not_stable() -> None:
    plant = TransferFunction((1.0, -1.0), (1.0, 0.0, -1.0))  # (s - 1)/((s - 1)(s + 1))
    loop = Loop(plant, Gains("pid", 2.0, 1.0), 0.01)
    assert not screen_of(loop)(loop.gains).stable[0]


def test_a_dead_time_of_too_many_samples_is_refused() -> None:
    samples = MOST_POINTS
    with pytest.raises(StabilityError, match="take a longer sample_period"):
        screen_of(Loop(TransferFunction((1.0,), (1.0, 1.0), samples * 1e-3), Gains(), 1e-3))
