"""The certificate: that a loop comes to rest from every state, under every constant setpoint and disturbance."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any, Literal

from tdof_npid_ros.case import Case
from tdof_npid_ros.control.gains import Gains
from tdof_npid_ros.control.law import ALPHA, KP, TRACKING, coefficients
from tdof_npid_ros.plants.linear import TransferFunction
from tdof_npid_ros.stability import StabilityError
from tdof_npid_ros.stability.creep import (
    ACCURATE_FROM,
    creep_time,
    error_left,
    fastest_disturbance_ramp,
    fastest_setpoint_ramp,
)
from tdof_npid_ros.stability.criteria import (
    Circle,
    Multiplier,
    circle,
    limited_without_integral,
    multiplier,
    with_limits,
)
from tdof_npid_ros.stability.margins import Margins, margins, one_lane
from tdof_npid_ros.stability.pd_loop import PdLoop
from tdof_npid_ros.stability.plant import loop_plant
from tdof_npid_ros.stability.pulse import PulseTransfer

Status = Literal["certified", "not certified", "not covered"]
Method = Literal["circle", "multiplier", "linear"]
CREEP_FROM = (2.0, 3.0, 4.0, 5.0)  # σ, of which the creep time down to 1 σ is told


@dataclass(frozen=True)
class Creep:
    """How the integral action of a nonlinear law deals with large errors and with ramps.

    Attributes:
        time_constant_s: τ = 1/(K_i Q(1)), of a small error that only the integral action brings down.
        from_sigma_s: seconds that the error takes from so many σ down to 1 σ; within some 4 % from 3 σ on.
        largest_step: of the setpoint in the case's plans, in y; `error_left` what the rest of the loop leaves of it,
            and `step_s` the seconds from there down to 1 σ: 0 if it leaves less.
            Of both None is a time beyond all numbers.
        setpoint_ramp, disturbance_ramp: the fastest that the integral action can follow, in y/s and u/s. None: any.
    """

    time_constant_s: float
    from_sigma_s: dict[str, float | None]
    largest_step: float
    error_left: float
    step_s: float | None
    setpoint_ramp: float | None
    disturbance_ramp: float


@dataclass(frozen=True)
class Certificate:
    """What is known of a loop's coming to rest.

    Attributes:
        status: `certified`; `not certified`: the criteria do not hold, which need not mean that the loop is unstable;
            `not covered`: the loop has a feature that they say nothing about.
        method: the criterion by which the loop itself, its features aside, is certified; None if by none.
        limits: whether the certificate covers the controller's effort limits, which the loop has.
        reasons: why it is not certified, or which features are not covered and what to do; a sentence each.
        claim: what is claimed, in plain words; `not_claimed` what is not. A sentence each.
        k_max: by what factor K_i may grow, the same criterion holding; None if by any, or without a criterion.
        delta: 1 + the least Re G, as proved; None without integral action.
        re_g_zero, re_g_least: Re G for ω → 0, and the least, at `re_g_least_at` rad/s.
        q, q_low, q_high: the multiplier in samples, and those that serve (`q_high` None: any larger one); None: not
            needed.
        pd_stable: whether the loop without its integral action is stable, which every criterion needs.
        margins: of the loop near the setpoint; None where the plant is not linear.
        creep: None for `pid`, whose integral action is linear, and where it is not certified.
    """

    status: Status
    method: Method | None = None
    limits: bool = False
    reasons: tuple[str, ...] = ()
    claim: tuple[str, ...] = ()
    not_claimed: tuple[str, ...] = ()
    k_max: float | None = None
    delta: float | None = None
    re_g_zero: float | None = None
    re_g_least: float | None = None
    re_g_least_at: float | None = None
    q: float | None = None
    q_low: float | None = None
    q_high: float | None = None
    pd_stable: bool | None = None
    margins: Margins | None = None
    creep: Creep | None = None

    @property
    def is_certified(self) -> bool:
        """Whether it is."""
        return self.status == "certified"

    def as_dict(self) -> dict[str, Any]:
        """Name to value, for JSON: numbers, null, texts, lists."""
        margins = self.margins.as_dict() if self.margins else None
        lists = {name: list(getattr(self, name)) for name in ("reasons", "claim", "not_claimed")}
        return {**asdict(self), **lists, "margins": margins}

    def lines(self) -> list[str]:
        """For people."""
        by = f" by {_METHODS[self.method]}" if self.method and self.is_certified else ""
        lines = [f"{self.status}{by}", *(f"  {reason}" for reason in self.reasons)]
        if self.re_g_least is not None:
            lines.append(f"  least Re G         {self.re_g_least:.4f} at {self.re_g_least_at:.4g} rad/s")
        if self.delta is not None and self.method == "circle":
            lines.append(f"  delta              {self.delta:.4f}")
        if self.method in ("circle", "multiplier"):
            lines.append(f"  K_i may grow by    {'any factor' if self.k_max is None else f'{self.k_max:.3f}'}")
        if self.q is not None:
            high = "any larger one" if self.q_high is None else f"{self.q_high:.4g}"
            lines.append(f"  multiplier q       {self.q:.4g} samples; those from {self.q_low:.4g} to {high} serve")
        return [*lines, "", *self.claim, *self.not_claimed]


_METHODS: dict[str, str] = {
    "circle": "the circle criterion",
    "multiplier": "a multiplier",
    "linear": "the modes of the loop, which is linear",
}


def certify(case: Case, gains: Gains, lane: int = 0) -> Certificate:
    """What can be claimed of a case's loop with some gains.

    What is proved is proved for all frequencies: on each interval between grid points the functions are enclosed, and
    intervals are halved until the enclosure decides; where it does not, the loop is not certified.

    Args:
        case: plant, sample period, limits and controller options.
        gains: in units of the case; `lane` says which lane's.

    Example:
        >>> from tdof_npid_ros.case import load_case
        >>> case = load_case("p1-c4")
        >>> found = certify(case, case.gains)
        >>> found.status, found.method, round(found.k_max, 2)
        ('certified', 'circle', 1.68)
    """
    alone = one_lane(gains, lane)
    if not isinstance(case.plant, TransferFunction):
        return Certificate(
            "not covered",
            reasons=(f"the plant {case.model} is not linear: only its margins are known, see tdof-npid margins",),
            not_claimed=_NOTHING,
            margins=margins(case, alone),
        )
    if case.options.manual:
        return Certificate("not covered", reasons=("in manual mode there is no loop",), not_claimed=_NOTHING)
    try:
        plant = loop_plant(case)
        linear = margins(case, alone)
        found = _without_features(PdLoop(plant, alone), alone, linear)
    except StabilityError as error:
        return Certificate("not certified", reasons=(str(error),), not_claimed=_NOTHING)
    features = _features(case, alone)
    limited = _is_limited(alone)
    if found.is_certified and not features and limited:
        found = _limited(plant, alone, found)
    if found.is_certified and features:
        values = {**_fields(found), "status": "not covered", "reasons": tuple(features), "claim": ()}
        aside = f"Without {'these features' if len(features) > 1 else 'this feature'} the loop would be certified."
        return Certificate(**{**values, "not_claimed": (*_NOTHING, aside)})
    if not found.is_certified:
        return Certificate(**{**_fields(found), "reasons": (*found.reasons, *features), "not_claimed": _NOTHING})
    creep = _creep(case, plant, alone, found) if alone.type != "pid" and alone.ki != 0.0 else None
    claim, not_claimed = _words(found, alone, creep)
    notes = (f"{note[0].upper()}{note[1:]}." for note in linear.notes)
    return Certificate(**{**_fields(found), "claim": claim, "not_claimed": (*notes, *not_claimed), "creep": creep})


_NOTHING = ("Nothing is claimed of this loop.",)


def _fields(certificate: Certificate) -> dict[str, Any]:
    return {name: getattr(certificate, name) for name in certificate.__dataclass_fields__}


def _without_features(loop: PdLoop, gains: Gains, linear: Margins) -> Certificate:
    """The loop as if no limit, dead band or the like were there."""
    known: dict[str, Any] = {"pd_stable": loop.is_stable, "margins": linear}
    if not loop.is_stable:
        why = "too near the border to tell whether it is stable" if loop.is_stable is None else "unstable"
        return Certificate(
            "not certified",
            reasons=(f"without its integral action the loop is {why}: the criteria need it to be stable",),
            **known,
        )
    if gains.ki == 0.0:
        return Certificate("certified", "linear", **known)
    if not loop.integral * loop.dc > 0.0:
        return Certificate(
            "not certified",
            reasons=(
                "the integral action pushes the wrong way, or nowhere: K_i times the PD loop's gain is not above 0",
            ),
            **known,
        )
    if not linear.stable:
        return Certificate("not certified", reasons=(str(linear.reason),), **known)
    round_ = circle(loop)
    rate = 1.0 / loop.plant.sample_period
    known |= {"delta": round_.delta, "re_g_zero": round_.re_g_zero, "re_g_least": round_.re_g_least,
              "re_g_least_at": round_.omega * rate}  # fmt: skip
    if round_.delta > 0.0:
        return Certificate("certified", "circle", k_max=_or_none(round_.k_max), **known)
    fixed = not gains.full_unwinding or gains.type == "pid"  # k(e) depends on the error alone
    found = multiplier(loop) if fixed else None
    if found is not None:
        return Certificate("certified", "multiplier", **known, **_of_multiplier(found))
    if gains.type == "pid":
        return Certificate("certified", "linear", **known)
    aside = "multipliers do not cover full_unwinding" if not fixed else "no multiplier was found"
    return Certificate("not certified", reasons=(_no_criterion(round_, rate, aside),), **known)


def _no_criterion(found: Circle, rate: float, aside: str) -> str:
    if not math.isfinite(found.at_least):
        return "1 + Re G could not be enclosed between all frequencies, so nothing is proved"
    return (
        f"1 + Re G falls to {1.0 + found.re_g_least:.4g} at {found.omega * rate:.4g} rad/s, and {aside}; "
        f"with K_i below {found.k_max:.3f} of its value the circle criterion holds"
    )


def _of_multiplier(found: Multiplier) -> dict[str, Any]:
    return {
        "q": found.q,
        "q_low": found.low,
        "q_high": _or_none(found.high),
        "k_max": _or_none(found.k_max),
    }


def _or_none(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _is_limited(gains: Gains) -> bool:
    return not (gains.effort_min == -math.inf and gains.effort_max == math.inf)


def _features(case: Case, gains: Gains) -> list[str]:
    """What of the loop the criteria say nothing about, and what to do."""
    options, found = case.options, []
    if options.dead_band:
        found.append("the dead band is not covered: within it nothing controls the output")
    if options.angle:
        found.append("angles are not covered: the error jumps half a turn away")
    for name in ("setpoint_rate", "effort_rate"):
        if getattr(options, name) != math.inf:
            found.append(f"the ramp of {name} is not covered: take it out to have the loop itself looked at")
    if (gains.integral_min, gains.integral_max) != (-math.inf, math.inf):
        found.append("limits of the integral action are not covered: limit the effort instead, with back-calculation")
    low, high = case.effort_limits
    assert isinstance(gains.effort_min, float) and isinstance(gains.effort_max, float)
    if low > gains.effort_min or high < gains.effort_max:
        found.append(
            f"the plant limits the effort to {low:g} … {high:g}, which the controller does not know: "
            "give it the same effort_min and effort_max"
        )
    if _is_limited(gains) and gains.anti_windup == "conditional" and gains.ki != 0.0:
        found.append("conditional integration is not covered: anti_windup: back_calculation is")
    return found


def _limited(plant: PulseTransfer, gains: Gains, found: Certificate) -> Certificate:
    """The same loop with the controller's effort limits."""
    values = {**_fields(found), "status": "not certified", "limits": True, "k_max": None}

    def refused(reason: str) -> Certificate:
        return Certificate(**{**values, "reasons": (reason,)})

    loop = PdLoop(plant, gains)
    open_ = PdLoop(plant, gains.with_values(kp=0.0, kd=0.0))
    if not open_.is_stable:
        return refused("with effort limits the plant itself must be stable, and it is not")
    if gains.ki == 0.0:
        if limited_without_integral(loop):
            return Certificate(**{**values, "status": "certified"})
        return refused("with effort limits, Re S of the PD loop must be above 0 at all frequencies, and it is not")
    if gains.anti_windup == "none":
        return refused("with effort limits and without anti-windup no criterion can hold: take back_calculation")
    if found.method != "circle":
        return refused("with effort limits the circle criterion must hold without them, and it does not")
    tracking = float(coefficients(gains, plant.sample_period)[TRACKING, 0])
    if with_limits(loop, tracking):
        return Certificate(**{**values, "status": "certified"})
    return refused(
        "with its effort limits the loop does not meet the criterion for two nonlinearities; "
        "without limits it is certified"
    )


def _creep(case: Case, plant: PulseTransfer, gains: Gains, found: Certificate) -> Creep:
    c = coefficients(gains, case.sample_period)[:, 0]
    kp, alpha = float(c[KP]), float(c[ALPHA])
    ki, sigma = float(gains.per_lane("ki")[0]), float(gains.per_lane("sigma")[0])
    gain = plant.gain
    tau = abs((1.0 / gain + kp) / ki)
    assert found.re_g_zero is not None

    def down_to_sigma(error: float) -> float | None:
        return _or_none(creep_time(error, sigma, sigma, tau, found.re_g_zero or 0.0)) if error > sigma else 0.0

    step = case.largest_step
    left = error_left(step, kp, alpha, gain)
    return Creep(
        tau,
        {f"{times:g}": down_to_sigma(times * sigma) for times in CREEP_FROM},
        step,
        left,
        down_to_sigma(left),
        _or_none(fastest_setpoint_ramp(ki, sigma, kp, alpha, gain)),
        fastest_disturbance_ramp(ki, sigma),
    )


def _words(found: Certificate, gains: Gains, creep: Creep | None) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """What is claimed and what is not, in sentences."""
    where = "comes to rest with the output at the setpoint" if gains.ki != 0.0 else "comes to rest"
    within = ", the effort limited as configured," if found.limits else ""
    claim = [
        f"Under every constant setpoint and every constant disturbance, and from every state, the loop{within} {where}."
    ]
    if found.limits:
        claim.append("That holds as long as the effort that rests there lies within the limits, not at or beyond them.")
    if gains.ki == 0.0:
        claim.append("Without integral action an error remains in general.")
    if found.method == "circle":
        claim.append(
            "It still does if sigma changes while the loop runs, as long as it stays above some value, and if the type "
            "changes between pid and npid, or full_unwinding; kp, ki and kd must stay as they are."
        )
    elif found.method == "multiplier":
        claim.append("Type, sigma and gains must stay as they are while the loop runs.")
    not_claimed = [
        "It is a statement about the model: not about a plant that differs from it, and not about measurement noise, "
        "lost messages, quantised signals or a setpoint that goes on changing. For these there are the margins.",
    ]
    if creep is not None:
        if gains.full_unwinding:
            not_claimed.append("With full_unwinding, what is said of creeping holds where the integral action grows.")
        not_claimed.append(
            "No speed is claimed: of errors much larger than sigma the law integrates next to nothing. From 5 sigma "
            f"to 1 sigma the output creeps for {_seconds(creep.from_sigma_s['5'])}, from 3 sigma for "
            f"{_seconds(creep.from_sigma_s[f'{ACCURATE_FROM:g}'])}. The largest setpoint step of the plans, "
            f"{creep.largest_step:g}, leaves an error of {creep.error_left:.3g} to the integral action"
            + (
                ", below sigma."
                if creep.step_s == 0.0
                else f", which takes {_seconds(creep.step_s)} to come down to sigma."
            )
        )
        ramp = "" if creep.setpoint_ramp is None else f"a setpoint ramp of {creep.setpoint_ramp:.3g} per second or "
        not_claimed.append(
            f"The integral action cannot follow more than {ramp}a disturbance ramp of {creep.disturbance_ramp:.3g} per "
            "second: from faster ones the output runs away for as long as they last."
        )
    return tuple(claim), tuple(not_claimed)


def _seconds(time: float | None) -> str:
    return "longer than any number" if time is None else f"{time:.3g} s"
