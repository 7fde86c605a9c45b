"""Gains: one validated, frozen value that a controller is built from."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, Literal, get_args

import numpy as np

ControllerType = Literal["pid", "npid", "tdof_npid1", "tdof_npid2"]
AntiWindup = Literal["none", "conditional", "back_calculation"]
CONTROLLER_TYPES: tuple[ControllerType, ...] = get_args(ControllerType)
ANTI_WINDUP: tuple[AntiWindup, ...] = get_args(AntiWindup)
TUNED: dict[ControllerType, tuple[str, ...]] = {
    "pid": ("kp", "ki", "kd"),
    "npid": ("kp", "ki", "kd"),
    "tdof_npid1": ("kp", "ki", "kd", "alpha"),
    "tdof_npid2": ("kp", "ki", "kd", "alpha", "beta"),
}  # the gains that the paper tunes for each type (section 3.3)
PER_LANE = ("kp", "ki", "kd", "alpha", "beta", "sigma")
LIMITS_PER_LANE = ("effort_min", "effort_max")
ALL_PER_LANE = PER_LANE + LIMITS_PER_LANE

# Within these bounds no effort overflows, whatever the gains, setpoints and outputs are.
LARGEST_GAIN = 1e50  # in SI units, of the absolute value; 1/LARGEST_GAIN is the smallest sigma
LARGEST_SIGNAL = 1e100  # of setpoints and outputs

Lanes = float | tuple[float, ...]


class GainsError(ValueError):
    """Gains that no controller can be built from; the message names the gain, its value and the remedy."""


@dataclass(frozen=True)
class Gains:
    """The parameters of the control law, valid as a whole or refused.

    `kp ki kd alpha beta sigma effort_min effort_max` are numbers, or tuples with one number per lane.

    Units: u and y are the effort's and the output's; kp in u/y, ki in u/(y s), kd in u s/y, alpha and beta 1,
    sigma in y, n 1, limits in u, tracking_time in s. A reverse-acting controller has kp, ki, kd <= 0.

    Raises:
        GainsError: a value is not finite or out of its range, or the gains contradict each other.
    """

    type: ControllerType = "tdof_npid2"
    kp: Lanes = 1.0
    ki: Lanes = 0.0
    kd: Lanes = 0.0
    alpha: Lanes = 0.0
    beta: Lanes = 0.0
    sigma: Lanes = 1.0
    n: float = 10.0
    effort_min: Lanes = -math.inf
    effort_max: Lanes = math.inf
    anti_windup: AntiWindup = "conditional"
    tracking_time: float = 0.0
    integral_min: float = -math.inf
    integral_max: float = math.inf

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name in ALL_PER_LANE:
                object.__setattr__(self, field.name, lanes_of(field.name, value))
            elif field.name not in ("type", "anti_windup"):
                object.__setattr__(self, field.name, number_of(field.name, value))
        self._validate()

    def _validate(self) -> None:
        _choice("type", self.type, CONTROLLER_TYPES)
        _choice("anti_windup", self.anti_windup, ANTI_WINDUP)
        for name in PER_LANE:
            for value in _as_tuple(getattr(self, name)):
                if not math.isfinite(value):
                    raise GainsError(f"{name} is {value}: it must be finite")
                if abs(value) > LARGEST_GAIN:
                    raise GainsError(f"{name} is {value}: it must be within +-{LARGEST_GAIN:g}")
        if any(sigma < 1.0 / LARGEST_GAIN for sigma in _as_tuple(self.sigma)):
            raise GainsError(
                f"sigma is {self.sigma}: it must be above 0, at least {1.0 / LARGEST_GAIN:g} "
                "(a large one makes the law nearly linear)"
            )
        if not 0 < self.n < math.inf:
            raise GainsError(f"n is {self.n}: the derivative filter needs a finite n above 0 (usual: 5 to 30)")
        if not 0 <= self.tracking_time < math.inf:
            raise GainsError(
                f"tracking_time is {self.tracking_time} s: it must be finite and not below 0 (0: automatic)"
            )
        for low, high in (LIMITS_PER_LANE, ("integral_min", "integral_max")):
            check_limits(self, low, high)
        lanes = self.lanes
        for name in ALL_PER_LANE:
            length = len(_as_tuple(getattr(self, name)))
            if length not in (1, lanes):
                raise GainsError(f"{name} has {length} values, but there are {lanes} lanes: give one, or one per lane")
        self._validate_signs()

    def _validate_signs(self) -> None:
        kp, ki, kd = (self.per_lane(name) for name in ("kp", "ki", "kd"))
        if np.any((kp == 0) & (kd != 0)):
            raise GainsError("kd is not 0 but kp is 0: the derivative time T_d = kd/kp needs kp")
        signs = np.sign(np.stack([kp, ki, kd]))
        if np.any((signs.max(axis=0) > 0) & (signs.min(axis=0) < 0)):
            raise GainsError(
                f"kp={self.kp}, ki={self.ki}, kd={self.kd} differ in sign: all >= 0 (direct) or all <= 0 (reverse "
                "action)"
            )

    @cached_property
    def lanes(self) -> int:
        """Number of lanes that the gains are for; 1 if every gain is a single number."""
        return max(len(_as_tuple(getattr(self, name))) for name in ALL_PER_LANE)

    def per_lane(self, name: str) -> np.ndarray:
        """The gain `name` for each lane, shape (lanes,)."""
        return np.broadcast_to(np.asarray(getattr(self, name), dtype=np.float64), (self.lanes,))

    def with_values(self, **changes: Any) -> Gains:
        """New gains with some values changed, validated as a whole."""
        try:
            return replace(self, **changes)
        except TypeError:
            unknown = sorted(set(changes) - {field.name for field in fields(self)})
            raise GainsError(f"unknown gain {', '.join(unknown)}: known are {', '.join(GAIN_NAMES)}") from None

    def as_dict(self) -> dict[str, Any]:
        """Name to value, in the order of the fields."""
        return {field.name: getattr(self, field.name) for field in fields(self)}


GAIN_NAMES = tuple(field.name for field in fields(Gains))


def gains_from_candidates(base: Gains, names: Sequence[str], candidates: np.ndarray) -> Gains:
    """Gains with one lane per row of `candidates` (lanes, len(names)); what is not named stays as in `base`."""
    return base.with_values(**{name: tuple(candidates[:, i]) for i, name in enumerate(names)})


def gains_from_mapping(values: Mapping[str, Any]) -> Gains:
    """Gains from parameters by name; other parameters in `values` are passed over.

    Raises:
        GainsError: a value has the wrong type or range.
    """
    return Gains(**{name: values[name] for name in GAIN_NAMES if name in values})


def check_limits(values: Any, low: str, high: str) -> None:
    """Raise GainsError unless there are finite numbers between the attributes `low` and `high`, in every lane."""
    lowers, uppers = np.atleast_1d(getattr(values, low)), np.atleast_1d(getattr(values, high))
    if len(lowers) != len(uppers) and 1 not in (len(lowers), len(uppers)):
        raise GainsError(f"{low} has {len(lowers)} values and {high} {len(uppers)}: give one, or one per lane")
    for lower, upper in np.broadcast(lowers, uppers):
        if not lower <= upper:
            raise GainsError(f"{low} is {lower} and {high} is {upper}: need {low} <= {high}")
        if lower == math.inf or upper == -math.inf:
            raise GainsError(f"{low} is {lower} and {high} is {upper}: no finite number is within")


def number_of(name: str, value: Any) -> float:
    """A parameter's value as a number; GainsError if it is none, or nan."""
    if isinstance(value, bool) or not isinstance(value, (int, float, np.floating, np.integer)):
        raise GainsError(f"{name} is {value!r}: it must be a number (.inf is infinity)")
    if math.isnan(value):
        raise GainsError(f"{name} is nan: it must be a number")
    return float(value)


def lanes_of(name: str, value: Any) -> Lanes:
    """A parameter's value as one number, or a tuple with one per lane; GainsError if it is neither."""
    if isinstance(value, (str, bytes)) or not hasattr(value, "__len__"):
        return number_of(name, value)
    if len(value) == 0:
        raise GainsError(f"{name} is an empty array: give one number, or one per lane")
    numbers = tuple(number_of(name, one) for one in value)
    return numbers if len(numbers) > 1 else numbers[0]


def _as_tuple(value: Lanes) -> tuple[float, ...]:
    return value if isinstance(value, tuple) else (value,)


def _choice(name: str, value: Any, known: tuple[str, ...]) -> None:
    if value not in known:
        raise GainsError(f"{name} is {value!r}: it must be one of {', '.join(known)}")
