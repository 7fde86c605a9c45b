"""Which elements of a robot's joint states are the lanes of a controller."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


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
