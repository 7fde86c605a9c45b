"""Which elements of a signal are the lanes, and whether they are valid."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tdof_npid_ros.compiled import entry_point


class Joints:
    """Picks the values of some joints out of arrays that go by a message's `name`.

    Args:
        names: of the joints, one per lane, in the order of the lanes; none: arrays hold the lanes, in their order.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self.names = [name for name in names if name]
        self._of: Sequence[str] = ()
        self._indices: list[int] = []

    def selected(self, names: Sequence[str], field: np.ndarray) -> np.ndarray:
        """The values of the joints, (lanes,); everything if no joints were named, here or in the message.

        Raises:
            ValueError: a joint is not among the names.
        """
        if not self.names or not names:
            return field
        if names != self._of:
            missing = [name for name in self.names if name not in names]
            if missing:
                raise ValueError(f"has no joint {', '.join(missing)}: it has {', '.join(names)}")
            self._indices, self._of = [names.index(name) for name in self.names], names
        return field[self._indices] if len(field) == len(names) else field[:0]


def fault_of(topic: str, values: np.ndarray, lanes: int, largest: float) -> tuple[str, str] | None:
    """What is wrong with a signal that must have one value for each of `lanes`, none beyond `largest`; None if nothing.

    Returns:
        The refusal, which is the same for all of its kind, and what to add to it.
    """
    if len(values) != lanes:
        return f"{topic} refused", f": it has {len(values)} values for {lanes} lanes"
    return None if all_within(values, largest) else (f"{topic} that is not finite refused", "")


@entry_point
def all_within(values: np.ndarray, largest: float) -> bool:
    """Whether every value's magnitude is at most `largest`; that of nan is not."""
    for value in values:  # noqa: SIM110  compiled
        if not abs(value) <= largest:
            return False
    return True
