"""The controller: the law with its state, answering each output once.

It knows no ROS. The controller node calls `answer` for each message, `verify` for each message of a bag.
"""

from __future__ import annotations

import hashlib
from functools import lru_cache

import numpy as np

from tdof_npid_ros.control.gains import Gains
from tdof_npid_ros.control.law import TERMS, answer_lanes, coefficients


class Controller:
    """A sampled TDOF-NPID controller for one lane or many.

    Attributes:
        effort: the latest answer u, (lanes,).
        terms: of the latest answer, (6, lanes): see `TERMS`.
        stamp_ns: of the output that the latest answer was for; None before the first.
    """

    def __init__(self, gains: Gains, sample_period_ns: int) -> None:
        self.sample_period_ns = sample_period_ns
        self.gains = gains
        self._allocate()
        self.change_gains(gains)

    @property
    def lanes(self) -> int:
        """Number of independent loops."""
        return self.gains.lanes

    @property
    def digest(self) -> str:
        """The name of the parameters that answers are computed with."""
        return self._digest

    def change_gains(self, gains: Gains) -> None:
        """Go on with other gains. The state is kept, unless the number of lanes changes."""
        changed_lanes = gains.lanes != self.gains.lanes
        self.gains = gains
        self._digest = parameters_digest(gains, self.sample_period_ns)
        c, self._limits = coefficients(gains, self.sample_period_ns / 1e9)
        self._c = c.ravel()
        if changed_lanes:
            self._allocate()

    def reset(self) -> None:
        """Forget the state and the latest answer."""
        self._state[:] = 0.0
        self.stamp_ns = None

    def answer(self, stamp_ns: int, setpoint: np.ndarray, output: np.ndarray) -> bool:
        """Answer the output of `stamp_ns`; the answer is in `effort` and `terms`.

        The same stamp again leaves everything as it is, so the answer is the same and no state advances.

        Args:
            setpoint, output: (lanes,), finite.

        Returns:
            Whether this was a new stamp.
        """
        if stamp_ns == self.stamp_ns:
            return False
        self.stamp_ns = stamp_ns
        answer_lanes(self._c, self._limits, setpoint, output, self._state, self.effort, self.terms)
        return True

    def _allocate(self) -> None:
        lanes = self.gains.lanes
        self.stamp_ns: int | None = None
        self._state = np.zeros((2, lanes))
        self.effort = np.zeros(lanes)
        self.terms = np.zeros((len(TERMS), lanes))


@lru_cache(maxsize=1024)
def parameters_digest(gains: Gains, sample_period_ns: int) -> str:
    """A name for what answers are computed with: 12 hexadecimal digits made from the values alone."""
    content = repr((sorted(gains.as_dict().items()), sample_period_ns))
    return hashlib.sha256(content.encode()).hexdigest()[:12]
