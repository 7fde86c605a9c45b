"""What an operator sets around the control law: setpoint shaping, filter, dead band, effort rate, manual mode."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from tdof_npid_ros.control.gains import Gains, GainsError, Lanes, check_limits, lanes_of, number_of


@dataclass(frozen=True)
class ControllerOptions:
    """How the law is operated, valid as a whole or refused. By default nothing is done to setpoint, output and effort.

    Attributes:
        manual: the effort is `manual_effort`, within its limits, instead of the law's.
        manual_effort: a number, or one per lane.
        setpoint_min, setpoint_max: the setpoint is kept within; in y.
        setpoint_rate: the setpoint moves no faster; in y/s. It starts from the output.
        effort_rate: the effort moves no faster, from 0 or from the effort that the plant has; in u/s.
        dead_band: an error within it counts as 0, a larger one by what is beyond; in y.
        filter_time: time constant of the output's first-order filter; in s, 0: none.
        angle: setpoint and output are angles in rad: the error is the shorter way round.
        bumpless: a change of gains, of the type or back from manual mode does not move the effort.

    Raises:
        GainsError: a value is out of its range.
    """

    manual: bool = False
    manual_effort: Lanes = 0.0
    setpoint_min: float = -math.inf
    setpoint_max: float = math.inf
    setpoint_rate: float = math.inf
    effort_rate: float = math.inf
    dead_band: float = 0.0
    filter_time: float = 0.0
    angle: bool = False
    bumpless: bool = True

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name in SWITCHES:
                if not isinstance(value, bool):
                    raise GainsError(f"{field.name} is {value!r}: it must be true or false")
            elif field.name == "manual_effort":
                object.__setattr__(self, field.name, lanes_of(field.name, value))
            else:
                object.__setattr__(self, field.name, number_of(field.name, value))
        if not np.isfinite(self.manual_effort).all():
            raise GainsError(f"manual_effort is {self.manual_effort}: it must be finite")
        check_limits(self, "setpoint_min", "setpoint_max")
        for name in ("setpoint_rate", "effort_rate"):
            if not getattr(self, name) > 0:
                raise GainsError(f"{name} is {getattr(self, name)}: it must be above 0 (inf: no limit)")
        for name in ("dead_band", "filter_time"):
            if not 0 <= getattr(self, name) < math.inf:
                raise GainsError(f"{name} is {getattr(self, name)}: it must be finite and not below 0")

    @property
    def is_plain(self) -> bool:
        """Whether the law alone makes the effort."""
        return self == replace(PLAIN, manual_effort=self.manual_effort, bumpless=self.bumpless)

    def check_lanes(self, gains: Gains) -> None:
        """Raise GainsError unless the manual effort fits the gains' lanes."""
        if isinstance(self.manual_effort, tuple) and len(self.manual_effort) != gains.lanes:
            raise GainsError(
                f"manual_effort has {len(self.manual_effort)} values, but there are {gains.lanes} lanes: "
                "give one, or one per lane"
            )

    def as_dict(self) -> dict[str, Any]:
        """Name to value, in the order of the fields."""
        return {field.name: getattr(self, field.name) for field in fields(self)}


SWITCHES = ("manual", "angle", "bumpless")
PLAIN = ControllerOptions()
OPTION_NAMES = tuple(field.name for field in fields(ControllerOptions))


def options_from_mapping(values: Mapping[str, Any]) -> ControllerOptions:
    """The options from parameters by name; other parameters in `values` are passed over.

    Raises:
        GainsError: a value has the wrong type or range.
    """
    return ControllerOptions(**{name: values[name] for name in OPTION_NAMES if name in values})
