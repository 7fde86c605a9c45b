"""What an operator sets around the control law: setpoint shaping, filter, dead band, effort rate, manual mode."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

from tdof_npid_ros.control.gains import Gains, GainsError, Lanes, take_checked
from tdof_npid_ros.parameter import ParameterError, check_limits
from tdof_npid_ros.parameters import OPTIONS


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

    manual: bool = OPTIONS["manual"].default
    manual_effort: Lanes = OPTIONS["manual_effort"].default
    setpoint_min: float = OPTIONS["setpoint_min"].default
    setpoint_max: float = OPTIONS["setpoint_max"].default
    setpoint_rate: float = OPTIONS["setpoint_rate"].default
    effort_rate: float = OPTIONS["effort_rate"].default
    dead_band: float = OPTIONS["dead_band"].default
    filter_time: float = OPTIONS["filter_time"].default
    angle: bool = OPTIONS["angle"].default
    bumpless: bool = OPTIONS["bumpless"].default

    def __post_init__(self) -> None:
        try:
            take_checked(self, OPTIONS)
            check_limits("setpoint_min", self.setpoint_min, "setpoint_max", self.setpoint_max)
        except ParameterError as error:
            raise GainsError(str(error)) from None

    @property
    def is_plain(self) -> bool:
        """Whether the law alone makes the effort."""
        return self == replace(PLAIN, manual_effort=self.manual_effort, bumpless=self.bumpless)

    @property
    def turn(self) -> float:
        """A whole turn, in the output's unit; 0 where setpoint and output are no angles."""
        return 2.0 * math.pi if self.angle else 0.0

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


PLAIN = ControllerOptions()
OPTION_NAMES = tuple(field.name for field in fields(ControllerOptions))


def options_from_mapping(values: Mapping[str, Any]) -> ControllerOptions:
    """The options from parameters by name; other parameters in `values` are passed over.

    Raises:
        GainsError: a value has the wrong type or range.
    """
    return ControllerOptions(**{name: values[name] for name in OPTION_NAMES if name in values})
