"""What is said about one parameter, once: its default, unit, range or choices; and the check of a value by it."""

from __future__ import annotations

import math
import numbers
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

from tdof_npid_ros.names import meant_hint
from tdof_npid_ros.one_line import one_line

LONGEST_SLIDER: Final = 1e6  # from end to end; of a longer one every point is too coarse
LONGEST_VALUE: Final = 100  # characters of a value that a message quotes


class ParameterError(ValueError):
    """A value that a parameter cannot have; the message is one line: name, value, what it must be."""


class Range(NamedTuple):
    """The numbers from `low` to `high`; an end that is not closed does not belong to them.

    `words` say it better than `from low to high` where there are some.
    """

    low: float = -math.inf
    high: float = math.inf
    closed_low: bool = True
    closed_high: bool = True
    words: str = ""

    def holds(self, value: float) -> bool:
        """Whether a number is within; nan never is."""
        return (self.low <= value if self.closed_low else self.low < value) and (
            value <= self.high if self.closed_high else value < self.high
        )

    @property
    def is_finite(self) -> bool:
        """Whether both ends are."""
        return math.isfinite(self.low) and math.isfinite(self.high)

    def __str__(self) -> str:
        """As it goes on after `a number`; empty for all numbers."""
        if self.words:
            return self.words
        if self.is_finite and self.closed_low and self.closed_high:
            return f"from {_exact(self.low)} to {_exact(self.high)}"
        parts = []
        if math.isfinite(self.low):
            parts.append(f"{'not below' if self.closed_low else 'above'} {_exact(self.low)}")
        if math.isfinite(self.high):
            parts.append(f"{'not above' if self.closed_high else 'below'} {_exact(self.high)}")
        lowest_out = self.low == -math.inf and not self.closed_low
        if lowest_out or (self.high == math.inf and not self.closed_high):
            parts.append("finite")
        return ", ".join(parts)


def _exact(number: float) -> str:
    short = f"{number:g}"
    return short if float(short) == number else repr(number)


ANY: Final = Range()
FINITE: Final = Range(closed_low=False, closed_high=False)
ABOVE_0: Final = Range(0.0, closed_low=False)
ABOVE_0_FINITE: Final = Range(0.0, closed_low=False, closed_high=False)
FROM_0: Final = Range(0.0, closed_high=False)


@dataclass(frozen=True)
class Parameter:
    """A parameter of a node.

    Attributes:
        name: as in a parameter file.
        default: its value where none is given; its kind (true or false, whole number, number, text, or a list of one
            of these) is the parameter's. None: there is none here; `otherwise` says what holds then.
        description: one line.
        unit: of its value; empty for none.
        within: the range of numbers, each one of a list.
        choices: of a text; empty for any.
        is_whole: a float whose values are whole numbers.
        fixed: read at the start only.
        per_lane: a number, or a list with one for each lane.
        length: of a list; None for any.
        is_interval: the list is a lower and an upper number, in this order.
        of_loop: may be given to all nodes of a loop at once; those without it pass over it.
        example: a value of its kind, where there is no default.
        otherwise: what holds where nothing is given and there is no default.
    """

    name: str
    default: Any
    description: str
    unit: str = ""
    within: Range = ANY
    choices: tuple[str, ...] = ()
    is_whole: bool = False
    fixed: bool = False
    per_lane: bool = False
    length: int | None = None
    is_interval: bool = False
    of_loop: bool = False
    example: Any = None
    otherwise: str = ""

    @property
    def is_list(self) -> bool:
        """Whether its value always is a list."""
        return isinstance(self._like, list)

    @property
    def kind(self) -> type:
        """Of its value, or of each one in the list: bool, int, float or str."""
        like = self._like
        return type(like[0] if isinstance(like, list) else like)

    @property
    def is_slider(self) -> bool:
        """Whether a slider from one end of its range to the other is of use."""
        low, high, closed_low, closed_high, _ = self.within
        return high - low <= LONGEST_SLIDER and closed_low and closed_high

    @property
    def _like(self) -> Any:
        return self.example if self.default is None else self.default

    def checked(self, value: Any) -> Any:
        """The value, with whole numbers as floats where it is a float, and any sequence as a list.

        Raises:
            ParameterError: it is of another kind, out of its range, or none of the choices.
        """
        is_sequence = hasattr(value, "__len__") and not isinstance(value, (str, bytes, Mapping))
        if is_sequence != self.is_list and not (is_sequence and self.per_lane):
            raise self._error(value)
        if not is_sequence:
            return self._one(value, value, self.kind)
        if self.length not in (None, len(value)) or (self.per_lane and not len(value)):
            raise self._error(value)
        kind = self.kind
        values = [self._one(one, value, kind) for one in value]
        if self.is_interval and not values[0] < values[1]:
            raise self._error(value)
        return values

    def _one(self, one: Any, whole: Any, kind: type) -> Any:
        if kind is float:
            if type(one) is not float:  # the usual case first: there may be thousands
                one = self._float(one, whole)
            if self.within.holds(one) and not (self.is_whole and not one.is_integer()):
                return one
        elif kind is int:
            if isinstance(one, numbers.Integral) and not isinstance(one, bool) and self.within.holds(int(one)):
                return int(one)
        elif isinstance(one, kind) and (not self.choices or one in self.choices):
            return one
        raise self._error(whole)

    def _float(self, one: Any, whole: Any) -> float:
        try:
            if isinstance(one, (float, numbers.Real)) and not isinstance(one, bool):
                return float(one)
        except OverflowError:  # a whole number of hundreds of digits
            pass
        raise self._error(whole)

    def _error(self, value: Any) -> ParameterError:
        shown = value.tolist() if hasattr(value, "tolist") else value
        try:
            shown = repr(shown)
        except ValueError:  # a whole number of thousands of digits
            shown = "too large a number"
        return ParameterError(f"{self.name} is {one_line(shown, LONGEST_VALUE)}: it must be {self.wanted}")

    @property
    def wanted(self) -> str:
        """What a value must be, in words."""
        unit = f", in {self.unit}" if self.unit else ""
        if self.choices:
            one = f"one of {', '.join(choice or repr(choice) for choice in self.choices)}"
        elif self.kind is bool:
            one = "true or false"
        elif self.kind is str:
            one = "text, in quotes if it looks like a number"
        else:
            what, within = "whole number" if self.kind is int or self.is_whole else "number", str(self.within)
            what = f"a finite {what}" if within == "finite" else f"a {what} {within}".rstrip()
            one = f"{what}{unit}"
        if self.is_interval:
            finite = ", both finite" if self.within == FINITE else ""
            return f"[lower, upper] with lower < upper{finite}{unit}"
        if self.is_list:
            count = "" if self.length is None else f" of {self.length}"
            return f"a list{count}, each of it {one}"
        return f"{one}, or a list of such, one per lane" if self.per_lane else one

    @property
    def constraints(self) -> str:
        """What a value must be, for people, with when it is read and what holds if it is not given."""
        parts = [self.wanted]
        if self.otherwise:
            parts.append(f"not given: {self.otherwise}")
        if self.fixed:
            parts.append("read at the start only")
        return "; ".join(parts)


Table = Mapping[str, Parameter]


def table(*parameters: Parameter) -> dict[str, Parameter]:
    """Parameters by name."""
    return {parameter.name: parameter for parameter in parameters}


def infinity_as_float(value: Any) -> Any:
    """A word for infinity, as a command line or a shell passes it, as a number, alone or in a list; anything else as it
    is."""
    if isinstance(value, list):
        return [infinity_as_float(one) for one in value]
    if isinstance(value, str) and value.lower().replace(".", "") in ("inf", "+inf", "-inf"):
        return float(value.replace(".", ""))
    return value


def unknown_parameters(given: Iterable[str], known: Collection[str], of_others: Collection[str]) -> list[str]:
    """What to warn of: names that a node is given and does not know, a misspelt one for instance.

    Args:
        known: the node's own.
        of_others: what may be given to all nodes, and so to one that does not need it; a name that ends with a dot
            stands for all that begin with it.
    """
    whole = {name for name in of_others if not name.endswith(".")}
    beginnings = tuple(name for name in of_others if name.endswith("."))
    warnings = []
    for name in given:
        if name not in known and name not in whole and not name.startswith(beginnings):
            warnings.append(
                f"parameter {one_line(name, LONGEST_VALUE)} is not one of this node's, and does nothing"
                f"{meant_hint(name, known)}"
            )
    return warnings


def check_limits(low: str, lowers: float | tuple[float, ...], high: str, uppers: float | tuple[float, ...]) -> None:
    """Make sure that finite numbers lie between two limits, in every lane.

    Args:
        low, high: names of the limits.
        lowers, uppers: their values, a number or one per lane.

    Raises:
        ParameterError: they do not, or the numbers of lanes differ.
    """
    many_lowers = lowers if isinstance(lowers, tuple) else (lowers,)
    many_uppers = uppers if isinstance(uppers, tuple) else (uppers,)
    lanes = max(len(many_lowers), len(many_uppers))
    if not {len(many_lowers), len(many_uppers)} <= {1, lanes}:
        raise ParameterError(
            f"{low} has {len(many_lowers)} values and {high} {len(many_uppers)}: give one, or one per lane"
        )
    for lane in range(lanes):
        lower, upper = many_lowers[lane % len(many_lowers)], many_uppers[lane % len(many_uppers)]
        if not lower <= upper:
            raise ParameterError(f"{low} is {lower} and {high} is {upper}: need {low} <= {high}")
        if lower == math.inf or upper == -math.inf:
            raise ParameterError(f"{low} is {lower} and {high} is {upper}: no finite number is within")
