"""Gains that were tried, to go back and forth between. It knows no ROS."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

Values = dict[str, Any]


class GainHistory:
    """What was in force, one after the other.

    Example:
        >>> history = GainHistory({"kp": 1.0})
        >>> history.note({"kp": 2.0})
        >>> history.undo()
        {'kp': 1.0}
        >>> history.redo()
        {'kp': 2.0}
        >>> history.redo() is None
        True
    """

    def __init__(self, first: Mapping[str, Any]) -> None:
        self._all: list[Values] = [dict(first)]
        self._at = 0

    @property
    def now(self) -> Values:
        """What is in force."""
        return dict(self._all[self._at])

    def note(self, values: Mapping[str, Any]) -> None:
        """Something new is in force; what was undone is forgotten."""
        if dict(values) == self._all[self._at]:
            return
        self._all[self._at + 1 :] = [dict(values)]
        self._at += 1

    def undo(self) -> Values | None:
        """Go back; None at the beginning."""
        if self._at == 0:
            return None
        self._at -= 1
        return self.now

    def redo(self) -> Values | None:
        """Go forth again; None at the end."""
        if self._at + 1 == len(self._all):
            return None
        self._at += 1
        return self.now
