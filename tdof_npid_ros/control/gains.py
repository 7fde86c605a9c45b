"""Gains: one validated, frozen value that a controller is built from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from tdof_npid_ros.parameter import ParameterError, Table, check_limits
from tdof_npid_ros.parameters import ANTI_WINDUP as ANTI_WINDUP
from tdof_npid_ros.parameters import CONTROLLER_TYPES as CONTROLLER_TYPES
from tdof_npid_ros.parameters import GAINS, TUNED_GAINS
from tdof_npid_ros.parameters import LARGEST_GAIN as LARGEST_GAIN
from tdof_npid_ros.parameters import LARGEST_SIGNAL as LARGEST_SIGNAL
from tdof_npid_ros.parameters import AntiWindup as AntiWindup
from tdof_npid_ros.parameters import ControllerType as ControllerType

TUNED: dict[ControllerType, tuple[str, ...]] = {
    "pid": ("kp", "ki", "kd"),
    "npid": ("kp", "ki", "kd"),
    "tdof_npid1": ("kp", "ki", "kd", "alpha"),
    "tdof_npid2": ("kp", "ki", "kd", "alpha", "beta"),
}  # the gains that the paper tunes for each type (section 3.3)
PER_LANE = TUNED_GAINS
LIMITS_PER_LANE = ("effort_min", "effort_max")
ALL_PER_LANE = PER_LANE + LIMITS_PER_LANE

Lanes = float | tuple[float, ...]


class GainsError(ValueError):
    """Gains that no controller can be built from; the message names the gain, its value and the remedy."""


@dataclass(frozen=True)
class Gains:
    """The parameters of the control law, valid as a whole or refused.

    `kp ki kd alpha beta sigma effort_min effort_max` are numbers, or tuples with one number per lane.

    Units: u and y are the effort's and the output's; kp in u/y, ki in u/(y s), kd in u s/y, alpha and beta 1,
    sigma in y, n 1, limits in u, tracking_time in s. A reverse-acting controller has kp, ki, kd <= 0.
    With full_unwinding, k(e) = 1 wherever that makes the integral action smaller.

    Raises:
        GainsError: a value is not finite or out of its range, or the gains contradict each other.
    """

    type: ControllerType = GAINS["type"].default
    kp: Lanes = GAINS["kp"].default
    ki: Lanes = GAINS["ki"].default
    kd: Lanes = GAINS["kd"].default
    alpha: Lanes = GAINS["alpha"].default
    beta: Lanes = GAINS["beta"].default
    sigma: Lanes = GAINS["sigma"].default
    n: float = GAINS["n"].default
    effort_min: Lanes = GAINS["effort_min"].default
    effort_max: Lanes = GAINS["effort_max"].default
    anti_windup: AntiWindup = GAINS["anti_windup"].default
    tracking_time: float = GAINS["tracking_time"].default
    integral_min: float = GAINS["integral_min"].default
    integral_max: float = GAINS["integral_max"].default
    full_unwinding: bool = GAINS["full_unwinding"].default

    def __post_init__(self) -> None:
        try:
            take_checked(self, GAINS)
            for low, high in (LIMITS_PER_LANE, ("integral_min", "integral_max")):
                check_limits(low, getattr(self, low), high, getattr(self, high))
        except ParameterError as error:
            raise GainsError(str(error)) from None
        self._check_lanes()
        self._check_signs()

    def _check_lanes(self) -> None:
        lanes = self.lanes
        for name in ALL_PER_LANE:
            length = len(_as_tuple(getattr(self, name)))
            if length not in (1, lanes):
                raise GainsError(f"{name} has {length} values, but there are {lanes} lanes: give one, or one per lane")

    def _check_signs(self) -> None:
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
    return base.with_values(**{name: tuple(candidates[:, i].tolist()) for i, name in enumerate(names)})


def gains_from_mapping(values: Mapping[str, Any]) -> Gains:
    """Gains from parameters by name; other parameters in `values` are passed over.

    Gains that are all single numbers serve every joint of `joint_names`, where that is among the values.

    Raises:
        GainsError: a value has the wrong type or range.
    """
    gains = Gains(**{name: values[name] for name in GAIN_NAMES if name in values})
    joints = sum(1 for name in values.get("joint_names") or () if name)
    return gains.with_values(kp=(gains.kp,) * joints) if gains.lanes == 1 < joints else gains


def controller_type(value: object) -> ControllerType:
    """A controller type by name.

    Raises:
        GainsError: there is no such type.
    """
    for known in CONTROLLER_TYPES:
        if value == known:
            return known
    raise GainsError(f"no controller type {value!r}: the types are {', '.join(CONTROLLER_TYPES)}")


def take_checked(values: Any, its: Table) -> None:
    """Replace the fields of a frozen dataclass by what their parameters make of them; lists become tuples.

    Raises:
        ParameterError: a field has a value that its parameter cannot have.
    """
    for field in fields(values):
        value = its[field.name].checked(getattr(values, field.name))
        if isinstance(value, list):
            value = tuple(value) if len(value) > 1 else value[0]
        object.__setattr__(values, field.name, value)


def _as_tuple(value: Lanes) -> tuple[float, ...]:
    return value if isinstance(value, tuple) else (value,)
