"""The plant of a case as the margins see it: linear, with the controller's filter behind it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tdof_npid_ros.case import Case
from tdof_npid_ros.control.gains import Gains
from tdof_npid_ros.control.law import ALPHA, KP, coefficients
from tdof_npid_ros.plants.kernels import SampledLinear, SampledOffset
from tdof_npid_ros.plants.linear import TransferFunction, sampled_lanes
from tdof_npid_ros.plants.linearise import has_kink, linearised
from tdof_npid_ros.plants.noise import noiseless
from tdof_npid_ros.plants.ode import Ode, Sprott
from tdof_npid_ros.plants.plant import PlantError
from tdof_npid_ros.stability import StabilityError
from tdof_npid_ros.stability.pulse import PulseTransfer, pulse_transfer

NEARBY = 1e3  # times the setpoint's size, within which the output of a loop without integral action is looked for


@dataclass(frozen=True)
class OperatingPoint:
    """Where a loop rests, and what it is linearised about.

    Attributes:
        setpoint: r, in y.
        disturbance: d, in u.
        output: y at rest; the setpoint itself, if there is integral action. None where nothing rests.
        effort: u at rest; None where nothing rests.
        linear: whether the plant is linear, so that the margins are the same at any other point.
    """

    setpoint: float
    disturbance: float
    output: float | None
    effort: float | None
    linear: bool


def operating_point(
    case: Case, gains: Gains, setpoint: float | None = None, disturbance: float | None = None
) -> OperatingPoint:
    """Where the loop comes to rest under a constant setpoint and disturbance, no limit being active.

    Args:
        setpoint, disturbance: by default those that the episode `setpoint` ends with, or else the first episode.

    Raises:
        StabilityError: nothing rests there, for a nonlinear plant.
    """
    case = case.as_played
    r, d = (
        told if told is not None else usual for told, usual in zip((setpoint, disturbance), _usual(case), strict=True)
    )
    r = min(max(r, case.options.setpoint_min), case.options.setpoint_max)
    plant = case.plant
    if isinstance(plant, TransferFunction):
        return _linear_point(plant, case, gains, r, d)
    integrates = gains.per_lane("ki")[0] != 0.0
    assert isinstance(plant, (Ode, Sprott))
    output = r if integrates else _offset_output(case, plant, gains, r, d)
    return OperatingPoint(r, d, output, _at_rest(case, plant, output, d).initial_effort, linear=False)


def loop_plant(case: Case, point: OperatingPoint | None = None) -> PulseTransfer:
    """From the controller's effort to the output that its law is given, sampled as the loop is.

    A nonlinear plant is linearised where the loop rests, by default where it does with integral action: there it does
    not depend on the gains.

    Args:
        point: see `operating_point`.

    Raises:
        StabilityError: nothing rests there, or the plant has a kink or a jump there.

    Example:
        >>> from tdof_npid_ros.case import load_case
        >>> loop_plant(load_case("p1-c4")).lag
        401
    """
    case = case.as_played
    plant, h = case.plant, case.sample_period
    sampled = plant.sampled(case.sample_period_ns)
    if isinstance(sampled, SampledLinear | SampledOffset):
        return _linear(case, sampled)
    assert isinstance(plant, (Ode, Sprott))
    point = point or operating_point(case, case.gains.with_values(ki=1.0, kp=1.0, kd=0.0))
    assert point.output is not None
    resting = _at_rest(case, plant, point.output, point.disturbance)
    if has_kink(resting, point.disturbance):
        raise StabilityError(
            f"the plant has a kink or a jump where the output is {point.output:g}, so it has no linear model there: "
            "ask for another --setpoint or --disturbance"
        )
    a, b, _, c = linearised(resting, point.disturbance)
    substeps = resting.substeps if isinstance(resting, Ode) else 1
    phi, gamma = _runge_kutta(a, b, h / substeps, substeps)
    linear = SampledLinear(tuple(map(tuple, phi.tolist())), (0.0,) * len(c), tuple(gamma.tolist()), 0)
    return pulse_transfer(linear, h, c.tolist()).filtered(case.options.filter_time)


def linear_loop_plants(case: Case, changes: Sequence[Mapping[str, Any]]) -> list[PulseTransfer]:
    """`loop_plant` of a case with a linear plant, for each set of changed parameters."""
    played = case.set_by_plan
    plants = [noiseless(case.plant_at({**changed, **played})) for changed in changes]
    linear = [plant for plant in plants if isinstance(plant, TransferFunction)]
    assert len(linear) == len(plants)
    return [_linear(case, sampled) for sampled in sampled_lanes(linear, case.sample_period_ns)]


def _linear(case: Case, sampled: SampledLinear | SampledOffset) -> PulseTransfer:
    """The sampled plant, of deviations from its operating point, and the controller's filter behind it."""
    return pulse_transfer(SampledLinear(*sampled[:4]), case.sample_period).filtered(case.options.filter_time)


def _usual(case: Case) -> tuple[float, float]:
    """Setpoint and disturbance at the end of the episode `setpoint`, or of the first; zeros without episodes."""
    signals = case.usual_signals
    return (float(signals.setpoint[-1]), float(signals.disturbance[-1])) if signals else (0.0, 0.0)


def _linear_point(plant: TransferFunction, case: Case, gains: Gains, r: float, d: float) -> OperatingPoint:
    """y - y0 = K (u - u0 + d), and with integral action y = r, without it u = K_p ((1 - α) r - y)."""
    numerator, denominator = plant.numerator[-1], plant.denominator[-1]
    gain = numerator / denominator if denominator else math.copysign(math.inf, numerator)
    y0, u0 = plant.output_offset, plant.effort_offset
    if gains.per_lane("ki")[0] != 0.0:
        if np.isinf(gain):
            return OperatingPoint(r, d, r, u0 - d, linear=True)
        effort = u0 - d + (r - y0) / gain if gain else None
        return OperatingPoint(r, d, r if gain else None, effort, linear=True)
    c = coefficients(gains, case.sample_period)[:, 0]
    pushed = c[KP] * (1.0 - c[ALPHA]) * r
    if np.isinf(gain):
        effort = u0 - d
        output = (pushed - effort) / c[KP] if c[KP] else None
        return OperatingPoint(r, d, output, effort if c[KP] else None, linear=True)
    if 1.0 + gain * c[KP] == 0.0:
        return OperatingPoint(r, d, None, None, linear=True)
    output = float((y0 + gain * (pushed - u0 + d)) / (1.0 + gain * c[KP]))
    return OperatingPoint(r, d, output, float(pushed - c[KP] * output), linear=True)


def _offset_output(case: Case, plant: Ode | Sprott, gains: Gains, r: float, d: float) -> float:
    """Where a loop without integral action rests: the output whose effort at rest is the proportional action's."""
    c = coefficients(gains, case.sample_period)[:, 0]

    def unbalanced(y: float) -> float:
        return _at_rest(case, plant, y, d).initial_effort - float(c[KP] * ((1.0 - c[ALPHA]) * r - y))

    from scipy.optimize import brentq  # takes as long to import as NumPy and Numba together

    size = max(abs(r), 1e-3)
    low = high = r
    while high - low < NEARBY * size:
        low, high = low - 0.5 * size, high + 0.5 * size
        try:
            if unbalanced(low) * unbalanced(high) <= 0.0:
                return float(brentq(unbalanced, low, high, xtol=1e-12 * size))
        except StabilityError:
            break
    raise StabilityError(f"no output was found at which the loop rests without integral action (setpoint {r:g})")


def _at_rest(case: Case, plant: Ode | Sprott, output: float, disturbance: float) -> Ode | Sprott:
    try:
        return plant.at_rest(output, disturbance)
    except PlantError as error:
        raise StabilityError(f"{case.name}: {error}") from error


def _runge_kutta(a: np.ndarray, b: np.ndarray, step: float, substeps: int) -> tuple[np.ndarray, np.ndarray]:
    """One sample of dx/dt = a x + b u as the loop steps it: fourth-order steps, whose own error is so seen too."""
    m, identity = a * step, np.eye(len(b))
    series = identity + m / 2.0 @ (identity + m / 3.0 @ (identity + m / 4.0))
    phi_step, gamma_step = identity + m @ series, series @ b * step
    phi, gamma = identity, np.zeros(len(b))
    for _ in range(substeps):
        phi, gamma = phi_step @ phi, phi_step @ gamma + gamma_step
    return phi, gamma
