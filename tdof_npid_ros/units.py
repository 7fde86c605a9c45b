"""Units of a loop's signals, for axes and tables."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple


class Units(NamedTuple):
    """Units of a loop's signals, for axes and tables; empty: not known.

    Example:
        >>> Units("K", "%").titled("IAE", "{output} s"), Units().titled("IAE", "{output} s")
        ('IAE (K s)', 'IAE')
    """

    output: str = ""
    effort: str = ""

    @classmethod
    def of(cls, plant: Mapping[str, object]) -> Units:
        """What a plant's parameters tell."""
        return cls(str(plant.get("output_unit", "")), str(plant.get("effort_unit", "")))

    def titled(self, name: str, unit: str) -> str:
        """A name with its unit, a format of `output` and `effort`; the name alone where a part of it is not known."""
        known = self._asdict()
        whole = unit and all(known[part] for part in known if f"{{{part}}}" in unit)
        return f"{name} ({unit.format(**known)})" if whole else name


def common_units(of: Iterable[Units]) -> Units:
    """The units of several things, where all have the same."""
    found = set(of)
    return found.pop() if len(found) == 1 else Units()
