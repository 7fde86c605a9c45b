"""Margins and k_max of tuned and users' loops, against the formulas alone, with none of the product's computations.

The sampled plant is the sum of the continuous one over its aliases, P(z) = (1 - 1/z)/h Σ_k P(s_k)/s_k with
s_k = s + 2πjk/h; the controller is written out. Only numpy.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from tdof_npid_ros.case import Case, load_case
from tdof_npid_ros.control.gains import Gains
from tdof_npid_ros.paper.tuned import tuned
from tdof_npid_ros.stability.certificate import certify

Response = NDArray[np.complex128]
ALIASES = 100
GRID = 1500
SLOWEST = 1e-5  # rad per sample, far below all modes


class Process(NamedTuple):
    """A plant P(s) = numerator/denominator · e^(-dead_time s), highest powers first, sampled every `period` s."""

    numerator: tuple[float, ...]
    denominator: tuple[float, ...]
    dead_time: float
    period: float


PAPER = {
    "p1-c0.5": Process((1.0,), (5.0, 1.0), 0.5, 0.005),
    "p1-c4": Process((1.0,), (5.0, 1.0), 4.0, 0.01),
    "p2-c2": Process((1.0,), (4.0, 4.0, 1.0), 1.0, 0.004),
    "p2-c5": Process((1.0,), (25.0, 10.0, 1.0), 1.0, 0.004),
    "p3-c1": Process((-1.0, 1.0), (1.0, 3.0, 3.0, 1.0), 0.0, 0.01),
    "p3-c2": Process((-2.0, 1.0), (1.0, 3.0, 3.0, 1.0), 0.0, 0.01),
}
TUNED_ROWS = [(case, kind) for case in PAPER for kind in ("pid", "npid", "tdof_npid1", "tdof_npid2")]
USERS = {
    "tank": (Process((1.0,), (1.0, 0.0), 0.5, 0.01), Gains("npid", 1.0, 0.1, 0.2)),
    "dead time dominates": (Process((1.0,), (0.1, 1.0), 2.0, 0.01), Gains("npid", 0.1, 0.3)),
    "unstable": (Process((1.0,), (1.0, -1.0), 0.2, 0.01), Gains("npid", 2.5, 0.5, 0.2)),
    "kiln": (Process((2.0,), (3600.0, 1.0), 120.0, 1.0), Gains("npid", 8.0, 0.004, 200.0)),
    "cart": (Process((1.0,), (1.0, 0.0, 0.0), 0.0, 0.01), Gains("npid", 4.0, 1.0, 4.0)),
    "resonant": (Process((1.0,), (1.0, 0.4, 1.0), 0.2, 0.01), Gains("npid", 0.3, 0.3, 0.3)),
    "dead time of part of a sample": (Process((1.0,), (6.0, 5.0, 1.0), 0.4137, 0.02), Gains("npid", 2.0, 0.4, 1.0)),
}


def sampled(process: Process, omega: NDArray[np.float64]) -> Response:
    """P(e^(jω)) with the effort held, ω in rad per sample."""
    total = np.zeros(omega.size, dtype=complex)
    for k in range(-ALIASES, ALIASES + 1):
        s = 1j * (omega + 2 * math.pi * k) / process.period
        continuous = np.polyval(process.numerator, s) / np.polyval(process.denominator, s)
        total += continuous * np.exp(-s * process.dead_time) / s
    return -np.expm1(-1j * omega) / process.period * total


def proportional_derivative(gains: Gains, h: float, omega: NDArray[np.float64]) -> Response:
    kp, kd = float(gains.kp), float(gains.kd)  # type: ignore[arg-type]
    if kd == 0.0:
        return np.full(omega.size, kp, dtype=complex)
    phi = math.exp(-h * float(gains.n) * kp / kd)  # type: ignore[arg-type]
    z = np.exp(1j * omega)
    return kp + kd / h * (1 - phi) * (z - 1) / (z - phi)


def by_formula(process: Process, gains: Gains) -> tuple[float, float, float]:
    """M_s, M_t and the circle's k_max = -1/min Re G."""
    h, ki = process.period, float(gains.ki)  # type: ignore[arg-type]

    def values(omega: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
        plant, pd = sampled(process, omega), proportional_derivative(gains, h, omega)
        integral = h * ki / np.expm1(1j * omega)
        loop = plant * (pd + integral)
        return np.abs(1 / (1 + loop)), np.abs(loop / (1 + loop)), -np.real(integral * plant / (1 + plant * pd))

    omega = np.geomspace(SLOWEST, math.pi, GRID)
    largest = []
    for i, coarse in enumerate(values(omega)):
        peak = int(np.argmax(coarse))
        around = np.linspace(omega[max(peak - 1, 0)], omega[min(peak + 1, GRID - 1)], 301)
        largest.append(float(np.max(values(around)[i])))
    return largest[0], largest[1], 1.0 / largest[2]


def compare(case: Case, process: Process, gains: Gains) -> str:
    """The method of the certificate; its numbers must be those of the formulas, within 1 %."""
    found = certify(case, gains.with_values(type="npid"))
    m_s, m_t, k_max = by_formula(process, gains)
    assert found.margins is not None
    assert found.margins.m_s == pytest.approx(m_s, rel=0.01)
    assert found.margins.m_t == pytest.approx(m_t, rel=0.01)
    assert (found.method == "circle") == (k_max > 1.0)
    if found.method == "circle":
        assert found.k_max == pytest.approx(k_max, rel=0.01)
    elif found.method == "multiplier":
        assert found.k_max is not None and found.k_max > k_max
    return found.method or found.status


@pytest.mark.parametrize(("case", "kind"), TUNED_ROWS)
def test_tuned_rows_have_the_margins_and_the_bound_of_the_formulas(case: str, kind: str) -> None:
    row = tuned(case, kind)  # type: ignore[arg-type]
    assert row is not None
    compare(load_case(case), PAPER[case], row.gains)


@pytest.mark.parametrize("name", USERS)
def test_users_loops_have_the_margins_and_the_bound_of_the_formulas(name: str) -> None:
    process, gains = USERS[name]
    plant = {
        "numerator": list(process.numerator),
        "denominator": list(process.denominator),
        "dead_time": process.dead_time,
    }
    case = Case(
        name, round(process.period * 1e9), "transfer_function", plant, (-math.inf, math.inf), gains, {}
    )  # fmt: skip
    compare(case, process, gains)
