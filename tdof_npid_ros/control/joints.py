"""Which elements of a signal are the lanes, and whether they are valid."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tdof_npid_ros.compiled import entry_point

SHOWN_NAMES = 12  # of a message, in a log


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

    def merged(self, names: Sequence[str], field: np.ndarray, before: np.ndarray, largest: float) -> np.ndarray:
        """The values, (1,) or (lanes,), of a signal that may be for some of the joints: the others keep theirs.

        Args:
            names, field: the signal's; a value of nan, beside others, leaves that joint as it is.
            before: the values of now, (lanes,).
            largest: that a value may be.

        Raises:
            ValueError: it is for no joint, has a wrong number of values, or one that is beyond `largest`.
        """
        lanes = len(before)
        if self.names and names:
            if len(field) != len(names):
                raise ValueError(f"has {len(field)} values for {len(names)} names")
            if not (at := [lane for lane, name in enumerate(self.names) if name in names]):
                raise ValueError(f"has no joint of {', '.join(self.names)}: it has {', '.join(names)}")
            values = np.full(lanes, np.nan)
            values[at] = [field[names.index(self.names[lane])] for lane in at]
        elif len(field) in (1, lanes):
            values = field
        else:
            raise ValueError(f"has {len(field)} values for {lanes} lanes: give one, or one per lane")
        kept = np.isnan(values)
        if kept.all() or not all_within(values[~kept], largest):
            raise ValueError("is not finite" if not np.isfinite(values).any() else f"is beyond {largest:g}")
        return np.where(kept, before, values) if kept.any() else values


def fault_of(topic: str, values: np.ndarray, lanes: int, largest: float) -> tuple[str, str] | None:
    """What is wrong with a signal that must have one value for each of `lanes`, none beyond `largest`; None if nothing.

    Returns:
        The refusal, which is the same for all of its kind, and what to add to it.
    """
    if len(values) != lanes:
        return f"{topic} refused", f": it has {len(values)} values for {lanes} lanes"
    return None if all_within(values, largest) else (f"{topic} that is not finite refused", "")


def name_joints(names: Sequence[str]) -> str:
    """What to do about a message with more elements than lanes, to add to the refusal."""
    shown = ", ".join(names[:SHOWN_NAMES]) + (", …" if len(names) > SHOWN_NAMES else "")
    those = f", of {shown}" if names else ""
    return f"; name the joints to control in joint_names{those}, or give kp one value each"


@entry_point
def all_within(values: np.ndarray, largest: float) -> bool:
    """Whether every value's magnitude is at most `largest`; that of nan is not."""
    for value in values:  # noqa: SIM110  compiled
        if not abs(value) <= largest:
            return False
    return True
