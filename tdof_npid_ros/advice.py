"""What an experienced colleague would say of a parameter file: what is wrong or unwise in it, and what to do."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, Literal, NamedTuple

import numpy as np

from tdof_npid_ros.case import Case
from tdof_npid_ros.control.gains import TUNED
from tdof_npid_ros.control.session import FAR_IN_SIGMA
from tdof_npid_ros.loop import LARGEST_OUTPUT, Trajectory
from tdof_npid_ros.metrics import RECOVERY_BAND, SETTLING_BAND
from tdof_npid_ros.plants.linear import TransferFunction
from tdof_npid_ros.plants.linearise import linearised
from tdof_npid_ros.plants.ode import Ode
from tdof_npid_ros.plants.plant import PlantError
from tdof_npid_ros.stability.margins import Margins, margins, one_lane

Severity = Literal["error", "warning", "hint"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "hint")
INACCURATE = 0.01  # of an episode's range, by which half the integration step may change it
RUNGE_KUTTA = 2.78  # |λ| times the step up to which the fourth-order method is stable on the real axis
USUAL_M_S = 2.0  # largest M_s that is usual
ACCURATE = 0.5  # |λ| times the step up to which its error is below 1e-3 a time constant
COARSE, FINE = 10.0, 20_000.0  # samples per closed-loop time that are too few, and more than serve anything
ODD_EFFORT = (1e-3, 1e3)  # effort that a step takes, as a fraction of the limits' distance, beyond which units differ
AT_LIMIT = 0.9  # fraction of an episode's samples at a limit that count as throughout


class Advice(NamedTuple):
    """One finding.

    Attributes:
        severity: error: the numbers cannot be trusted or the loop cannot do it; warning: it will disappoint; hint.
        about: the parameter or episode.
        text: what is so, in one sentence.
        remedy: what to do.
    """

    severity: Severity
    about: str
    text: str
    remedy: str

    def line(self) -> str:
        """In one line."""
        return f"{self.about}: {self.text}: {self.remedy}"


def advice(case: Case, its_margins: Margins | None = None) -> list[Advice]:
    """All that is to be said of a case, the gravest first; of each lane where each has a plant of its own.

    Args:
        its_margins: of its gains, where they are known already.

    Example:
        >>> from tdof_npid_ros.case import load_case
        >>> [one.severity for one in advice(load_case("p1-c0.5"))]  # M_s is 2.35
        ['hint']
    """
    found: list[Advice] = []
    if len(case.alone) > 1:
        for lane, alone in enumerate(case.alone):
            gains = one_lane(case.gains, min(lane, case.gains.lanes - 1))
            its = advice(replace(alone, gains=gains))
            found += [one._replace(about=f"lane {lane}, {one.about}") for one in its]
        return sorted(found, key=lambda one: SEVERITIES.index(one.severity))
    for look in LOOKS_AT_THE_FILE:
        found += look(case)
    if case.gains.lanes == 1:
        found += _margins(its_margins or margins(case, case.gains))
    if not any(one.severity == "error" for one in found):
        for name in case.plans:
            run = case.simulate(name)
            found += [*_episode(case, name, run), *_accuracy(case, name, run)]
    return sorted(found, key=lambda one: SEVERITIES.index(one.severity))


def _integration(case: Case) -> Iterator[Advice]:
    """Whether a nonlinear plant's fixed step is stable and accurate where it begins."""
    plant = case.plant
    if not isinstance(plant, Ode):
        return
    model = linearised(plant)
    fastest = float(np.abs(np.linalg.eigvals(model.a)).max(initial=0.0))
    step = case.sample_period / plant.substeps
    needed = math.ceil(fastest * case.sample_period / ACCURATE)
    if fastest * step > RUNGE_KUTTA:
        yield Advice(
            "error", "substeps",
            f"the plant's fastest time constant is {1 / fastest:.3g} s, but it is integrated in steps of {step:.3g} s: "
            "the integration is unstable, and its numbers mean nothing",
            f"set substeps to {needed} or more, or leave the fast part out of the model",
        )  # fmt: skip
    elif fastest * step > ACCURATE:
        yield Advice(
            "hint", "substeps",
            f"steps of {step:.3g} s are coarse for a time constant of {1 / fastest:.3g} s",
            f"set substeps to {needed} for an accuracy of about 0.1 %",
        )  # fmt: skip


def _sample_period(case: Case) -> Iterator[Advice]:
    plant, h = case.plant, case.sample_period
    if not isinstance(plant, TransferFunction):
        return
    poles = np.roots(plant.denominator)
    slow = np.abs(poles[np.abs(poles) > 1e-12 * max(np.abs(poles).max(initial=0.0), 1.0)])
    lag = 1.0 / slow.min() if slow.size else math.inf
    time = max(plant.dead_time, 0.05 * lag) if math.isfinite(lag) else plant.dead_time
    if math.isfinite(lag) and h > lag / COARSE:
        yield Advice(
            "warning", "sample_period",
            f"{h:g} s is long beside the plant's time constant of {lag:.3g} s",
            f"take {lag / 50:.2g} s or less",
        )  # fmt: skip
    elif plant.dead_time and 2.0 * h > plant.dead_time and h > lag / 50.0:
        yield Advice(
            "hint", "sample_period",
            f"{h:g} s is as long as the dead time of {plant.dead_time:g} s, and adds half of itself to it",
            f"take {plant.dead_time / 10:.2g} s",
        )  # fmt: skip
    if time and h < time / FINE:
        yield Advice(
            "hint", "sample_period",
            f"{h:g} s is far shorter than anything in this plant ({time:.3g} s)",
            "a hundredth of the closed loop's time constant serves as well, and runs faster",
        )  # fmt: skip


def _sigma(case: Case) -> Iterator[Advice]:
    if case.gains.type == "pid":
        return
    sigma = float(np.min(case.gains.per_lane("sigma")))
    step = case.largest_step
    if step > FAR_IN_SIGMA * sigma:
        yield Advice(
            "warning", "sigma",
            f"{sigma:g}, but the setpoint moves by {step:g}: such an error is integrated at "
            f"{100 * math.exp(-((step / sigma) ** 2) / 2):.2g} % of its size, so the output may stop short of it",
            f"set sigma to the largest change of the setpoint, {step:g}",
        )  # fmt: skip


def _limits(case: Case) -> Iterator[Advice]:
    low, high = case.effort_limits
    gains_low, gains_high = (case.gains.per_lane(name) for name in ("effort_min", "effort_max"))
    if bool(np.any(gains_low < low)) or bool(np.any(gains_high > high)):
        yield Advice(
            "warning", "effort_min, effort_max",
            f"the plant's effort is limited to {low:g} .. {high:g}, but the controller does not know: its anti-windup "
            "does not see the limit, so it overshoots and recovers late",
            "give the limits once, to /**, so that plant and controller both have them",
        )  # fmt: skip


def _reach(case: Case) -> Iterator[Advice]:
    """Whether the actuator can hold what the plans ask for, and in which units."""
    low = max(case.effort_limits[0], float(np.min(case.gains.per_lane("effort_min"))))
    high = min(case.effort_limits[1], float(np.max(case.gains.per_lane("effort_max"))))
    if not (math.isfinite(low) or math.isfinite(high)):
        return
    for name, signals in case.signals.items():
        levels = np.unique(signals.setpoint)
        if len(levels) > 100:
            levels = np.array([levels.min(), levels.max()])
        for level in levels:
            try:
                effort = case.plant_at(signals.segments[0].plant).at_rest(float(level)).initial_effort
            except PlantError:
                continue
            if low <= effort <= high:
                continue
            wide = high - low
            odd = math.isfinite(wide) and wide > 0 and abs(effort) > ODD_EFFORT[1] * wide
            yield Advice(
                "warning", f"episode {name}",
                f"to hold {level:g} takes an effort of {effort:.4g}, beyond the limits {low:g} .. {high:g}",
                "check the units of gain and limits" if odd else "ask for less, or give the actuator more",
            )  # fmt: skip
            break


def _bounds(case: Case) -> Iterator[Advice]:
    for name in TUNED[case.gains.type]:
        if name not in case.bounds:
            continue
        low, high = case.bounds[name]
        values = case.gains.per_lane(name)
        if np.any((values < low) | (values > high)):
            yield Advice(
                "hint", f"bounds.{name}",
                f"the file's own {name} of {', '.join(f'{v:g}' for v in values)} is outside [{low:g}, {high:g}]",
                "widen them, or the tuner cannot come back to it",
            )  # fmt: skip


def _angles(case: Case) -> Iterator[Advice]:
    if not case.options.angle:
        return
    most = max((float(np.abs(s.setpoint).max()) for s in case.signals.values()), default=0.0)
    if most > 4.0 * math.pi:
        yield Advice(
            "warning", "angle",
            f"the setpoint goes to {most:g}, and angles are in rad",
            "give radians, or set angle to false",
        )  # fmt: skip


def _margins(found: Margins) -> Iterator[Advice]:
    if found.stable is False:
        yield Advice("error", "gains", f"the loop is unstable ({found.reason})", "take smaller gains, or tune")
    elif found.m_s is not None and found.m_s > USUAL_M_S:
        yield Advice(
            "hint", "gains",
            f"M_s is {found.m_s:.2f}: the loop is nearer to instability than is usual (1.4 to {USUAL_M_S:g})",
            "tune with --ms 1.8 for more room",
        )  # fmt: skip


LOOKS_AT_THE_FILE: tuple[Callable[[Case], Iterator[Advice]], ...] = (
    _integration, _sample_period, _sigma, _limits, _reach, _bounds, _angles,
)  # fmt: skip


def _episode(case: Case, name: str, run: Trajectory) -> Iterator[Advice]:
    """What a simulated episode shows."""
    about, y, u = f"episode {name}", run.output, np.clip(run.control_effort, *case.effort_limits)
    if np.abs(y).max() >= LARGEST_OUTPUT:
        yield Advice("error", about, "the output grows without bound: the loop is unstable", "take smaller gains")
        return
    low = np.maximum(case.effort_limits[0], case.gains.per_lane("effort_min"))
    high = np.minimum(case.effort_limits[1], case.gains.per_lane("effort_max"))
    at_limit = float(np.mean((u <= low) | (u >= high)))
    if at_limit > AT_LIMIT:
        yield Advice(
            "warning", about,
            f"the effort is at its limit for {100 * at_limit:.0f} % of it, so it shows nothing of the controller",
            _remedy_at_limit(case, name),
        )  # fmt: skip
        return
    step = case.largest_step or float(np.ptp(y)) or 1.0
    tail = y[-max(2, len(y) // 20) :] - run.setpoint[-max(2, len(y) // 20) :, None]
    error, moves = float(np.abs(tail).max()), float(np.ptp(tail))
    moving = ", and moving" if moves > RECOVERY_BAND * step else ""
    if not case.options.angle and error > SETTLING_BAND * step:
        yield Advice(
            "warning", about,
            f"at its end the output is still {error:.3g} from the setpoint{moving}",
            "let it end later" if _approaches(run) else "look at the gains: the output swings or stands still",
        )  # fmt: skip


def _accuracy(case: Case, name: str, run: Trajectory) -> Iterator[Advice]:
    """Whether half the integration step gives the same episode."""
    if not isinstance(case.plant, Ode):
        return
    substeps = case.plant.substeps
    finer = replace(case, plant_values={**case.plant_values, "substeps": 2.0 * substeps}).simulate(name)
    off = float(np.abs(finer.output - run.output).max()) / (float(np.ptp(finer.output)) or 1.0)
    if off > INACCURATE:
        yield Advice(
            "warning", "substeps",
            f"with twice as many substeps, episode {name} differs by {100 * off:.2g} % of its range",
            f"set substeps to {4 * substeps}, and look again",
        )  # fmt: skip


def _remedy_at_limit(case: Case, name: str) -> str:
    signals: Any = case.signals[name]
    if signals.start is None and np.any(signals.disturbance):
        return "let the episode begin in the middle of the effort's range: '0 start VALUE' as its first line"
    return "ask for less, or give the actuator more"


def _approaches(run: Trajectory) -> bool:
    """Whether the error goes on becoming smaller towards the end."""
    error = np.abs(run.output - run.setpoint[:, None]).max(axis=1)
    third = len(error) // 3
    return bool(error[-third:].max() < 0.7 * error[third : 2 * third].max()) if third else False


def gravest(case: Case, its_margins: Margins | None = None) -> Advice | None:
    """What `simulate` and `tune` warn of: the gravest finding that is more than a hint."""
    return next((one for one in advice(case, its_margins) if one.severity != "hint"), None)
