"""How far the plant's parameters may be from the model's, and samples of them."""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal, get_args

import numpy as np

from tdof_npid_ros.case import Case
from tdof_npid_ros.names import meant_hint
from tdof_npid_ros.one_line import one_line
from tdof_npid_ros.parameter import Parameter, ParameterError
from tdof_npid_ros.parameters import NOISE
from tdof_npid_ros.plants.catalog import model_table
from tdof_npid_ros.robustness import RobustError

Sampling = Literal["uniform", "latin", "normal", "corners"]
SAMPLINGS: Final[tuple[Sampling, ...]] = get_args(Sampling)

HALF_WIDTH = 2.0  # standard deviations of a normal sample that a spread stands for: 95 % lie within it
LARGEST_DEVIATION = 3.0  # standard deviations: a normal sample is cut off there
MOST_CORNERS = 16  # spreads: 65,536 corners
MOST_SAMPLES = 10_000_000

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_SPREAD = re.compile(
    rf"(?P<name>[A-Za-z_]\w*(?:\[\d+\])?)\s+(?:(?P<low>{_NUMBER})\s*\.\.\s*(?P<high>{_NUMBER})|"
    rf"(?P<around>{_NUMBER})\s*(?P<percent>%?))"
)
_ELEMENT = re.compile(r"(\w+)\[(\d+)\]")
FORMS = "'gain 20 %' (of the value), 'gain 0.1' (in its unit, both ways), or 'gain 0.8 .. 1.3'"


@dataclass(frozen=True)
class Spread:
    """A parameter of the plant and where it lies.

    Attributes:
        name: of the parameter; `denominator[1]` for an element of a list.
        low, high: the ends, in the parameter's unit.
        nominal: the case's value.
    """

    name: str
    low: float
    high: float
    nominal: float


def spreads_of(case: Case, texts: Sequence[str], sampling: Sampling = "uniform") -> tuple[Spread, ...]:
    """The spreads that a user writes.

    Args:
        texts: as `gain 20 %` (of the value), `gain 0.1` (in its unit, both ways), `gain 0.8 .. 1.3`.
        sampling: what the ends are checked for: a normal sample goes beyond them.

    Raises:
        RobustError: a text is none, names no parameter of the plant, or the plant cannot have a value in it.
        PlantError: each lane of the case has a plant of its own.

    Example:
        >>> from tdof_npid_ros.case import load_case
        >>> spreads_of(load_case("p1-c0.5"), ["dead_time 30 %"])
        (Spread(name='dead_time', low=0.35, high=0.65, nominal=0.5),)
    """
    _ = case.plant  # refuses a case in which each lane has its own
    spreads = tuple(_spread(case, text, sampling) for text in texts)
    names = [spread.name for spread in spreads]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice:
        raise RobustError(f"{twice} has two spreads: give one")
    played = {name for signals in case.signals.values() for one in signals.segments for name in one.plant}
    if fixed := next((name for name in names if name in played), None):
        raise RobustError(f"{fixed} is what the episodes' plans set, so a spread of it would not be played")
    if not spreads:
        raise RobustError(f"no spread is given: say how far the plant may be from the model, as {FORMS}")
    return spreads


def samples(spreads: Sequence[Spread], count: int, sampling: Sampling, seed: int) -> np.ndarray:
    """Values of the parameters, (samples, spreads); the same for the same arguments.

    Args:
        count: how many; of corners there are as many as there are, 2 for each spread.
        sampling: `uniform`: independent between the ends; `latin`: likewise, but evenly along each parameter;
            `normal`: the ends are two standard deviations off the middle, cut off at three; `corners`: the ends alone.
        seed: from 0 on.

    Raises:
        RobustError: too many or too few.

    Example:
        >>> samples([Spread("gain", 0.5, 1.5, 1.0)], 1, "corners", 0).tolist()
        [[0.5], [1.5]]
    """
    dimensions = len(spreads)
    if sampling == "corners":
        if dimensions > MOST_CORNERS:
            raise RobustError(f"{dimensions} spreads have 2**{dimensions} corners: take another sampling")
        unit = np.array(list(itertools.product((0.0, 1.0), repeat=dimensions)))
    else:
        if not 1 <= count <= MOST_SAMPLES:
            raise RobustError(f"{count} samples: from 1 to {MOST_SAMPLES:,}")
        if not 0 <= seed < 2**63:
            raise RobustError(f"seed {seed}: it must not be negative")
        unit = _unit(dimensions, count, sampling, seed)
    low, high = np.array([spread.low for spread in spreads]), np.array([spread.high for spread in spreads])
    values: np.ndarray = low + unit * (high - low)
    return values


def changes_of(case: Case, spreads: Sequence[Spread], values: Sequence[float], index: int) -> dict[str, Any]:
    """The plant's parameters of one sample, as a parameter file gives them; noise has a seed of the sample's own.

    Args:
        values: (spreads,).
        index: of the sample.
    """
    changed: dict[str, Any] = {}
    for spread, value in zip(spreads, values, strict=True):
        if (element := _ELEMENT.fullmatch(spread.name)) is None:
            changed[spread.name] = float(value)
            continue
        name = element[1]
        changed.setdefault(name, list(_configured(case, name, model_table(case.model)[name])))
        changed[name][int(element[2])] = float(value)
    if changed.get("noise") or case.plant_values.get("noise"):
        first = int(case.plant_values.get("noise_seed", NOISE["noise_seed"].default))
        changed["noise_seed"] = (first + index) % 2**31
    return changed


def _unit(dimensions: int, count: int, sampling: Sampling, seed: int) -> np.ndarray:
    """Points in the unit cube, (count, dimensions); of normal samples beyond it, too."""
    random = np.random.default_rng(seed)
    if sampling == "latin":
        from scipy.stats import qmc

        return np.asarray(qmc.LatinHypercube(dimensions, seed=random).random(count))
    unit = random.random((count, dimensions))
    if sampling == "uniform":
        return unit
    from scipy.special import ndtr, ndtri

    least = ndtr(-LARGEST_DEVIATION)
    deviations = ndtri(least + unit * (1.0 - 2.0 * least))
    return np.asarray(0.5 + 0.5 * deviations / HALF_WIDTH)


def _spread(case: Case, text: str, sampling: Sampling) -> Spread:
    told = one_line(text, 100)
    found = _SPREAD.fullmatch(text.strip())
    if found is None:
        raise RobustError(f"spread {told!r} is none: write {FORMS}")
    name = found["name"]
    parameter, nominal = _parameter(case, name, told)
    if found["around"] is None:
        low, high = float(found["low"]), float(found["high"])
    else:
        part = float(found["around"]) / 100.0 if found["percent"] else float(found["around"])
        half = part * abs(nominal) if found["percent"] else part
        if half == 0.0 and part:
            raise RobustError(
                f"spread {told!r}: {name} is 0, and so is every part of it: give a range, '{name} 0 .. 1'"
            )
        low, high = nominal - half, nominal + half
    if not low < high:
        raise RobustError(
            f"spread {told!r}: it reaches from {low:g} to {high:g}: the upper end must be above the lower"
        )
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    widest = LARGEST_DEVIATION / HALF_WIDTH if sampling == "normal" else 1.0
    for end in (middle - widest * half, middle + widest * half):
        try:
            if parameter.is_list:
                assert np.isfinite(end)
            else:
                parameter.checked(end)
        except ParameterError as error:
            raise RobustError(f"spread {told!r} reaches a plant that cannot be: {error}") from None
    return Spread(name, low, high, nominal)


def _parameter(case: Case, name: str, told: str) -> tuple[Parameter, float]:
    """The parameter that a spread is of, and the case's value."""
    known = {**model_table(case.model), "noise": NOISE["noise"], "quantum": NOISE["quantum"]}
    element = _ELEMENT.fullmatch(name)
    base = element[1] if element else name
    if base not in known or known[base].is_whole:
        spreadable = [one for one, parameter in known.items() if not parameter.is_whole]
        raise RobustError(
            f"spread {told!r}: the plant has no such parameter{meant_hint(base, spreadable)}: {', '.join(spreadable)}"
        )
    parameter = known[base]
    value = _configured(case, base, parameter)
    if parameter.is_list != (element is not None):
        how = f"{base} is a list: name an element, as '{base}[0] 10 %'" if parameter.is_list else f"{base} is no list"
        raise RobustError(f"spread {told!r}: {how}")
    if element is None:
        return parameter, float(value)
    if int(element[2]) >= len(value):
        raise RobustError(f"spread {told!r}: {base} has {len(value)} elements, the first one is {base}[0]")
    return parameter, float(value[int(element[2])])


def _configured(case: Case, name: str, parameter: Parameter) -> Any:
    return case.plant_values.get(name, parameter.default)
