"""A parameter file drafted from a few facts about a plant: what `tdof-npid new` and `identify` write."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import yaml

from tdof_npid_ros.case import SIGMA_BOUNDS
from tdof_npid_ros.control.gains import ControllerType
from tdof_npid_ros.plants.linearise import linearised
from tdof_npid_ros.plants.ode import Ode, Sprott
from tdof_npid_ros.plants.plant import PlantError
from tdof_npid_ros.tuning.rules import RuleGains, imc_oscillating, simc, unstable_first_order

SAMPLES_PER_TIME_CONSTANT = 50  # of the plant's fastest lag that matters
SAMPLES_PER_CLOSED_LOOP_TIME = 10
SETTLED = 12.0  # closed-loop times until a step has settled, with room
SWINGS = 4.0  # as SETTLED, times this, where the rule does not design the closed loop's time
RECOVERED = 8.0  # integral times until a disturbance has gone, with room
SPREAD = 20.0  # tuner's bounds: the first gains divided and multiplied by it
DISTURBANCE = 0.1  # of the effort's range, or of the effort that the step takes


@dataclass(frozen=True)
class Process:
    """gain (zero s + 1)/Π(T s + 1) · exp(-dead_time s), with a further 1/s if integrating.

    Attributes:
        gain: output/effort; of an integrating process output/(effort s).
        time_constants: s. One that is negative is an unstable pole.
        dead_time: s.
        zero: s; negative: inverse response.
        oscillation: (period, damping) of a further factor 1/(period² s² + 2 damping period s + 1); period in s, not 2π
            times it.
    """

    gain: float
    time_constants: tuple[float, ...] = ()
    dead_time: float = 0.0
    zero: float = 0.0
    integrating: bool = False
    oscillation: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if not math.isfinite(self.gain) or self.gain == 0.0:
            raise PlantError(f"gain is {self.gain}: it must be finite and not 0")
        if not 0.0 <= self.dead_time < math.inf:
            raise PlantError(f"dead_time is {self.dead_time} s: it must be finite and not negative")
        if any(t == 0.0 or not math.isfinite(t) for t in self.time_constants):
            raise PlantError(f"time_constants are {list(self.time_constants)} s: each must be finite and not 0")
        if not self.time_constants and not self.integrating and self.oscillation is None:
            raise PlantError("the process has no lag: give a time constant, or say that it is integrating")

    @property
    def times(self) -> tuple[float, ...]:
        """All its time scales without the dead time, s, largest first."""
        period = () if self.oscillation is None else (self.oscillation[0],)
        return tuple(sorted((*map(abs, self.time_constants), *period), reverse=True))

    def transfer_function(self) -> dict[str, Any]:
        """The plant's parameters: `model: transfer_function` and what belongs to it."""
        numerator = [self.gain * self.zero, self.gain] if self.zero else [self.gain]
        denominator = np.array([1.0])
        for t in self.time_constants:
            denominator = np.convolve(denominator, [t, 1.0] if t > 0 else [-t, -1.0])
        if self.oscillation is not None:
            period, damping = self.oscillation
            denominator = np.convolve(denominator, [period**2, 2.0 * damping * period, 1.0])
        if self.integrating:
            denominator = np.append(denominator, 0.0)
        return {
            "model": "transfer_function",
            "numerator": numerator,
            "denominator": [float(c) for c in denominator],
            "dead_time": self.dead_time,
        }

    def first_gains(self, sample_period: float = 0.0) -> RuleGains:
        """Gains by a published rule.

        Raises:
            TuningError: no rule gives any.
        """
        if any(t < 0 for t in self.time_constants):
            unstable = next(-t for t in self.time_constants if t < 0)
            lags = sum(t for t in self.time_constants if t > 0)
            return unstable_first_order(self.gain, unstable, self.dead_time + lags, sample_period=sample_period)
        if self.oscillation is not None:
            period, damping = self.oscillation
            delay = self.dead_time + sum(self.time_constants)
            damping = max(damping, 0.05)
            return imc_oscillating(self.gain, period, damping, delay, zero=self.zero, sample_period=sample_period)
        return simc(
            self.gain,
            self.time_constants,
            self.dead_time,
            zero=self.zero,
            integrating=self.integrating,
            sample_period=sample_period,
        )


def process_of(plant: Ode | Sprott) -> Process:
    """A nonlinear plant as a process near where it begins: its poles there, the slowest three.

    Raises:
        PlantError: the effort does not move the output there.
    """
    from scipy.signal import ss2tf

    a, b, _, c = linearised(plant)
    numerator, denominator = ss2tf(a, b[:, None], c[None, :], np.zeros((1, 1)))
    zeros, poles = np.roots(_trimmed(numerator[0])), np.roots(denominator)
    fastest = max(np.abs(poles).max(initial=0.0), 1e-12)
    at_origin = np.abs(poles) < 1e-6 * fastest
    steady = _trimmed(numerator[0])
    if not steady.size:
        raise PlantError("the effort does not move the output where the plant begins: give another --at")
    real = poles[~at_origin]
    value = np.prod(-zeros) * steady[0] / np.prod(-real) if real.size else np.prod(-zeros) * steady[0]
    pairs = real[real.imag > 1e-9 * fastest]
    lags = [float(-1.0 / pole.real) for pole in real if abs(pole.imag) <= 1e-9 * fastest]
    oscillation = None
    for pole in pairs:
        period, damping = 1.0 / abs(pole), float(-pole.real / abs(pole))
        if oscillation is None and damping < 0.7:
            oscillation = (float(period), damping)
        else:
            lags += [float(period), float(period)]
    inverse = float(sum(-1.0 / zero.real for zero in zeros if zero.real > 0))
    return Process(float(np.real(value)), tuple(lags), 0.0, inverse, bool(at_origin.any()), oscillation)


def _trimmed(coefficients: np.ndarray) -> np.ndarray:
    small = np.abs(coefficients) < 1e-9 * np.abs(coefficients).max(initial=1e-300)
    return np.trim_zeros(np.where(small, 0.0, coefficients), "f")


@dataclass(frozen=True)
class Draft:
    """What goes into a drafted file.

    Attributes:
        process: what first gains, sample period and horizon follow from.
        plant: the plant's parameters, `model` among them.
        step: of the setpoint, in the output's unit; not 0.
        at: the output where the episodes begin, at rest.
        rest_effort: the effort that holds it there.
        effort: limits of the effort, either may be infinite.
        unit, effort_unit: of output and effort, for axes, tables and comments; empty: not told.
        sample_period: s; None: chosen.
        disturbance: of the second episode, in the effort's unit; None: chosen.
        controller: the type.
        ms: largest M_s of tuned gains; None: any, where the plant has no margins.
        title: the first line, a comment.
    """

    process: Process
    plant: Mapping[str, Any]
    step: float
    at: float = 0.0
    rest_effort: float = 0.0
    effort: tuple[float, float] = (-math.inf, math.inf)
    unit: str = ""
    effort_unit: str = ""
    sample_period: float | None = None
    disturbance: float | None = None
    controller: ControllerType = "tdof_npid2"
    ms: float | None = 2.0
    title: str = "A loop"
    notes: tuple[str, ...] = field(default=())

    def __post_init__(self) -> None:
        low, high = self.effort
        if not low < high:
            raise PlantError(f"effort is {low:g} to {high:g}: the lower limit must be below the upper one")
        if self.step == 0.0 or not math.isfinite(self.step):
            raise PlantError(f"step is {self.step}: it must be finite and not 0, in the output's unit")
        needed = self.effort_at(self.at + self.step)
        for level, effort in ((self.at, self.rest_effort), (self.at + self.step, needed)):
            if not low <= effort <= high:
                raise PlantError(
                    f"to hold the output at {level:g} takes an effort of {effort:.4g}, beyond the limits {low:g} to "
                    f"{high:g}: give a smaller step, wider limits, or check the gain's unit"
                )

    def effort_at(self, level: float) -> float:
        """The effort that holds the output at a level, by the linear model."""
        if self.process.integrating:
            return self.rest_effort
        sign = -1.0 if sum(t < 0 for t in self.process.time_constants) % 2 else 1.0
        return self.rest_effort + sign * (level - self.at) / self.process.gain

    @property
    def period(self) -> float:
        """The sample period, s: as given, or a round number that suits the plant's lags and dead time."""
        if self.sample_period is not None:
            return self.sample_period
        wanted = self.process.first_gains().closed_loop_time or self.process.times[-1]
        scales = [wanted / SAMPLES_PER_CLOSED_LOOP_TIME]
        if self.process.times:
            scales.append(self.process.times[0] / SAMPLES_PER_TIME_CONSTANT)
        return rounded_down(max(min(scales), 1e-9))

    @property
    def horizon(self) -> float:
        """Length of the episodes, s: until a step has settled and a disturbance has gone, with room."""
        gains = self.process.first_gains(self.period)
        closed = gains.closed_loop_time or self.process.times[0]
        integral = gains.kp / gains.ki if gains.ki else 0.0
        if gains.closed_loop_time is None:  # an unstable plant, whose loop swings for long
            closed *= SWINGS
        return rounded_up(max(SETTLED * (closed + self.process.dead_time), RECOVERED * integral) + self._slew())

    def _slew(self) -> float:
        """How long the step takes with the effort at its limit, s."""
        rest, needed = self.rest_effort, self.effort_at(self.at + self.step)
        towards = self.effort[1] if (self.step > 0) == (self.process.gain > 0) else self.effort[0]
        room = abs(towards - rest)
        if not math.isfinite(room) or room == 0.0:
            return 0.0
        if self.process.integrating:
            return abs(self.step / (self.process.gain * room))
        used = min(abs(needed - rest) / room, 0.999)
        return -math.log1p(-used) * (self.process.times[0] if self.process.times else 0.0)

    @property
    def load(self) -> float:
        """The disturbance of the second episode, in the effort's unit."""
        if self.disturbance is not None:
            return self.disturbance
        low, high = self.effort
        taken = abs(self.effort_at(self.at + self.step) - self.rest_effort)
        width = high - low if math.isfinite(high - low) else 4.0 * taken
        if not width:
            width = abs(self.step * self.process.first_gains(self.period).kp)
        return significant(-DISTURBANCE * width if (self.step > 0) == (self.process.gain > 0) else DISTURBANCE * width)

    def text(self) -> str:
        """The file: YAML with a comment at each choice."""
        gains = self.process.first_gains(self.period)
        sigma, end = abs(self.step), f"{self.horizon:g} end"
        low, high = self.effort
        start, level = f"0 start {self.at:.6g}", f"{self.at + self.step:.6g}"
        kp, ki, kd = (significant(value) for value in (gains.kp, gains.ki, gains.kd))
        where, its_effort = self.unit or "the output's unit", self.effort_unit or "the effort's unit"
        units = {"output_unit": self.unit, "effort_unit": self.effort_unit}
        plant = {**self.plant, **{name: unit for name, unit in units.items() if unit}}
        used = {"kp": kp, "ki": ki, "kd": kd}
        lines = [
            f"# {self.title}",
            *(f"# {note}" for note in self.notes),
            "/**:",
            "  ros__parameters:",
            f"    sample_period: {_yaml(self.period)}  # s",
            "    mode: lockstep  # realtime: on a steady clock, as the real plant",
        ]
        if math.isfinite(low) or math.isfinite(high):
            lines += [
                f"    effort_min: {_yaml(low)}  # what the actuator can do; plant and controller both go by it",
                f"    effort_max: {_yaml(high)}",
            ]
        lines += ["/**/plant:", "  ros__parameters:"]
        lines += [f"    {name}: {_yaml(value)}" for name, value in plant.items()]
        lines += [
            "/**/controller:",
            "  ros__parameters:",
            f"    type: {self.controller}",
            f"    kp: {_yaml(kp)}  # first gains: {gains.rule}; then run tdof-npid tune",
            f"    ki: {_yaml(ki)}",
            f"    kd: {_yaml(kd)}",
            "    alpha: 0.0  # setpoint weights, 0 to 1: the larger, the gentler a step of the setpoint",
            "    beta: 0.0",
            f"    sigma: {_yaml(significant(sigma))}  # the largest change of the setpoint",
            "    anti_windup: back_calculation",
            "/**/scenario:",
            "  ros__parameters:",
            "    episodes: [setpoint, disturbance]  # what simulate, tune and run play, and what is measured",
            "    plan:",
            f'      setpoint: ["{start}", "0 setpoint {level}", "{end}"]  # in {where}',
            f'      disturbance: ["0 start {level}", "0 disturbance {self.load:g}", "{end}"]  # in {its_effort}',
            "/**/tuner:",
            "  ros__parameters:",
            "    weight: 1.0  # of the disturbance episode's error, beside the setpoint episode's",
            "    free: sigma  # searched, too, where the type has one",
            *(
                [f"    ms: {self.ms:g}  # gains with a larger M_s, nearer to instability, are not taken"]
                if self.ms
                else []
            ),
            "    bounds:",
        ]
        lines += [f"      {name}: {_yaml(self._bounds(name, value, used))}" for name, value in used.items()]
        lines += [
            "      alpha: [0.0, 1.0]",
            "      beta: [0.0, 1.0]",
            f"      sigma: {_yaml([significant(factor * sigma) for factor in SIGMA_BOUNDS])}",
        ]
        return "\n".join(lines) + "\n"

    def _bounds(self, name: str, value: float, used: Mapping[str, float]) -> list[float]:
        """The search of a gain: around the first one; without a first one, around what the time scales make of kp."""
        if value == 0.0:
            kp = used["kp"] or 1.0 / self.process.gain
            slow, fast = (max(self.process.times, default=1.0), max(self.process.dead_time, self.period))
            value = kp / slow if name == "ki" else kp * max(fast, 0.1 * slow)
        ends = (significant(value / SPREAD) if name == "kp" else 0.0, significant(value * SPREAD))
        return sorted(ends)


def rounded_down(value: float) -> float:
    """The next number below of 1, 2 or 5 times a power of ten."""
    scale = 10.0 ** math.floor(math.log10(value) + 1e-9)
    return float(f"{max(m for m in (1.0, 2.0, 5.0) if m * scale <= value * (1 + 1e-9)) * scale:.1g}")


def rounded_up(value: float) -> float:
    """The next number above of two digits."""
    scale = 10.0 ** (math.floor(math.log10(value)) - 1)
    return float(f"{math.ceil(value / scale - 1e-9) * scale:.3g}")


def significant(value: float, digits: int = 4) -> float:
    """A number to so many digits; 0 has no sign."""
    return float(f"{value:.{digits}g}") + 0.0


def _yaml(value: Any) -> str:
    """A value as it stands in a parameter file; numbers as floats, which ROS wants where the default is one."""
    if isinstance(value, float):
        if math.isinf(value):
            return ".inf" if value > 0 else "-.inf"
        text = repr(value)
        return text if "." in text or "e" not in text else text.replace("e", ".0e")
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_yaml(one) for one in value) + "]"
    return str(yaml.safe_dump(value, default_flow_style=True)).removesuffix("...\n").strip()
