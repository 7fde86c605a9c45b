"""Margins of one loop: how far it is from instability, with its sampling and its exact dead time."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from tdof_npid_ros.case import Case
from tdof_npid_ros.control.gains import LIMITS_PER_LANE, PER_LANE, Gains
from tdof_npid_ros.control.options import ControllerOptions
from tdof_npid_ros.stability import StabilityError
from tdof_npid_ros.stability.characteristic import Characteristic, characteristic
from tdof_npid_ros.stability.plant import OperatingPoint, loop_plant, operating_point
from tdof_npid_ros.stability.pulse import PulseTransfer
from tdof_npid_ros.stability.screen import Screen

ON_BORDER = 1e-12  # distance of a mode to the circle, below which nobody can tell on which side it lies


@dataclass(frozen=True)
class Margins:
    """Margins of a loop in which k(e) = 1 and no limit is active: near the setpoint, that is any type of controller.

    Attributes:
        stable: None if that is not known; `reason` says why.
        reason: why there are no margins; None if there are.
        m_s, m_t: largest magnitudes of the sensitivity S = 1/(1 + L) and of T = L S over all frequencies.
        gain_margin: the least factor above 1 on K_p, K_i and K_d together at which the loop is no longer stable; None:
            no such factor, or no margins.
        gain_margin_low: the largest factor below 1 of that kind; None: none, as for most stable plants.
        phase_margin_deg: None: L never has the magnitude 1, or no margins.
        delay_margin_s, delay_margin_samples: the least additional dead time at which the loop is no longer stable;
            exact in whole samples. None: none is too long, or no margins.
        spectral_radius: the largest modulus of the loop's modes, delay and filter included.
        time_constant_s: of the slowest mode, -h/ln(spectral radius); negative for an unstable loop, in which deviations
            grow by e in its magnitude. None on the border.
        operating_point: where the loop rests; a nonlinear plant is linearised there.
        notes: what limits the meaning of the numbers, a sentence each.
    """

    stable: bool | None
    reason: str | None
    m_s: float | None = None
    m_t: float | None = None
    gain_margin: float | None = None
    gain_margin_low: float | None = None
    phase_margin_deg: float | None = None
    delay_margin_s: float | None = None
    delay_margin_samples: float | None = None
    spectral_radius: float | None = None
    time_constant_s: float | None = None
    operating_point: OperatingPoint | None = None
    notes: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Name to value, for JSON: numbers, null, texts."""
        return {**asdict(self), "notes": list(self.notes)}

    def lines(self) -> list[str]:
        """For people."""
        shown = [] if self.stable else [f"stable             {_yes_no(self.stable)}: {self.reason}"]
        if self.stable:
            shown += [
                f"M_s                {self.m_s:.3f}",
                f"M_t                {self.m_t:.3f}",
                f"gain margin        {_factor(self.gain_margin, self.gain_margin_low)}",
                f"phase margin       {_or_none(self.phase_margin_deg, '{:.1f}°', 'none: the loop gain never is 1')}",
                f"delay margin       {self._delay()}",
            ]
        if self.spectral_radius is not None:
            shown.append(f"spectral radius    {self.spectral_radius:.8g}")
        if self.time_constant_s is not None:
            slow = f"{abs(self.time_constant_s):.4g} s"
            shown.append(f"slowest mode       {slow}" if self.stable else f"grows by e in      {slow}")
        return [*shown, *(f"note: {note}" for note in self.notes)]

    def _delay(self) -> str:
        if self.delay_margin_s is None:
            return "none: no dead time is too long"
        return f"{self.delay_margin_s:.4g} s, {self.delay_margin_samples:.4g} samples"


def margins(
    case: Case, gains: Gains, lane: int = 0, setpoint: float | None = None, disturbance: float | None = None
) -> Margins:
    """The margins of a case's loop with some gains.

    Exact for linear plants. A nonlinear one is linearised where the loop rests under a constant setpoint and
    disturbance. For what has no margins (manual mode, a plant that cannot rest there) the numbers are None, with the
    reason.

    Args:
        case: plant, sample period and controller options; a `filter_time` is part of the loop.
        gains: in units of the case; `lane` says which lane's.
        setpoint, disturbance: the operating point, in y and u; by default what the episode `setpoint` ends with.

    Raises:
        StabilityError: setpoint or disturbance is not finite.

    Example:
        >>> from tdof_npid_ros.case import load_case
        >>> case = load_case("p1-c4")
        >>> round(margins(case, case.gains).m_s, 2)
        2.46
    """
    for name, value in (("setpoint", setpoint), ("disturbance", disturbance)):
        if value is not None and not math.isfinite(value):
            raise StabilityError(f"{name} is {value}: it must be finite")
    alone = one_lane(gains, lane)
    if case.options.manual:
        return Margins(None, "in manual mode there is no loop")
    try:
        point = operating_point(case, alone, setpoint, disturbance)
        plant = loop_plant(case, point)
        found = linear_margins(plant, alone)
    except StabilityError as error:
        return Margins(None, str(error))
    return Margins(**{**_fields(found), "operating_point": point, "notes": tuple(_notes(case, alone, point))})


def linear_margins(plant: PulseTransfer, gains: Gains) -> Margins:
    """The margins of a linear plant with the gains of one lane.

    Raises:
        StabilityError: the dead time has too many samples.
    """
    screened = Screen(plant)(gains)
    loop = characteristic(plant, gains)
    if not any(plant.b):
        return Margins(None, "the effort does not move the output at this point")
    h, stable = plant.sample_period, bool(screened.stable[0])
    slow = float(screened.time_constant[0])
    beyond = loop.radius(math.expm1(-h / slow) if stable and slow > 0.0 else None)  # 0: no mode was found
    time_constant = -h / math.log1p(beyond) if abs(beyond) > ON_BORDER else None
    if not stable or beyond >= -ON_BORDER:
        return Margins(False, _unstable(beyond, h), spectral_radius=1.0 + beyond, time_constant_s=time_constant)
    delay = _limited(screened.delay_margin[0])
    phase = _limited(screened.phase_margin[0])
    return Margins(
        True,
        None,
        m_s=float(screened.m_s[0]),
        m_t=float(screened.m_t[0]),
        gain_margin=_limited(screened.gain_margin[0]),
        gain_margin_low=float(screened.gain_margin_low[0]) or None,
        phase_margin_deg=None if phase is None else math.degrees(phase),
        delay_margin_s=delay,
        delay_margin_samples=None if delay is None else delay / h,
        spectral_radius=1.0 + beyond,
        time_constant_s=time_constant,
    )


def one_lane(gains: Gains, lane: int = 0) -> Gains:
    """The gains of one lane, as numbers."""
    return gains.with_values(**{name: float(gains.per_lane(name)[lane]) for name in (*PER_LANE, *LIMITS_PER_LANE)})


def loop_of(case: Case, gains: Gains, point: OperatingPoint | None = None) -> Characteristic:
    """The characteristic function of a case's loop, for pictures: L, S and T at any frequency."""
    return characteristic(loop_plant(case, point), one_lane(gains))


def _fields(margins: Margins) -> dict[str, Any]:
    return {name: getattr(margins, name) for name in margins.__dataclass_fields__}


def _limited(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _unstable(beyond: float, h: float) -> str:
    if beyond <= ON_BORDER:
        return "a mode lies on the border of stability: what remains neither grows nor dies out"
    return f"the loop is unstable: deviations grow by e every {h / math.log1p(beyond):.4g} s"


def _notes(case: Case, gains: Gains, point: OperatingPoint) -> list[str]:
    """What the numbers leave out."""
    options, notes = case.options, []
    if case.set_by_plan:
        told = ", ".join(f"{name} = {value:g}" for name, value in case.set_by_plan.items())
        notes.append(f"the plant is as the plan leaves it: {told}")
    if not point.linear:
        notes.append(
            f"the plant is linearised where y = {point.output:g}, u = {point.effort:g}, d = {point.disturbance:g}; "
            "farther away it behaves otherwise"
        )
    low = max(float(gains.per_lane("effort_min")[0]), case.effort_limits[0])
    high = min(float(gains.per_lane("effort_max")[0]), case.effort_limits[1])
    if point.effort is not None and not low < point.effort < high:
        notes.append(
            f"the effort that rests at r = {point.setpoint:g}, {point.effort:.6g}, is not within its limits "
            f"{low:g} to {high:g}: the loop cannot rest there"
        )
    plain = ControllerOptions()
    if options.dead_band:
        notes.append("the dead band is left out: within it nothing controls the output")
    if (options.setpoint_rate, options.effort_rate) != (plain.setpoint_rate, plain.effort_rate):
        notes.append("the rate limits are left out: the margins hold while none is active")
    return notes


def _yes_no(stable: bool | None) -> str:
    return {True: "yes", False: "no", None: "not known"}[stable]


def _or_none(value: float | None, form: str, otherwise: str) -> str:
    return otherwise if value is None else form.format(value)


def _factor(high: float | None, low: float | None) -> str:
    up = "none: no factor is too large" if high is None else f"{high:.3f} ({20 * np.log10(high):.1f} dB)"
    return up if low is None else f"{up}, and not below {low:.3g}"
