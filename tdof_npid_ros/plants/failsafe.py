"""What an actuator does when its controller falls silent, and when it comes back."""

from __future__ import annotations

import numpy as np


class FailSafe:
    """The newest effort, as long as it is fresh.

    After `timeout_ns` without an effort, the actuator takes the `fallback` effort, or holds the latest one. When
    efforts
    come again, it goes over to them within `return_ns`, so that nothing jumps. Before the first effort it takes the
    fallback effort, or 0. Times are of a steady clock.

    Attributes:
        silent: whether efforts have stopped coming.
    """

    def __init__(self, lanes: int, timeout_ns: int, fallback: float | None, return_ns: int) -> None:
        """Args: timeout_ns: 0 for none; fallback: None to hold."""
        self._timeout_ns, self._return_ns, self._fallback = timeout_ns, return_ns, fallback
        self._effort = np.full(lanes, fallback or 0.0)
        self._from = self._effort
        self._latest_ns: int | None = None
        self._returned_ns: int | None = None
        self.silent = False

    @property
    def is_driven(self) -> bool:
        """Whether an effort has ever come."""
        return self._latest_ns is not None

    def change(self, timeout_ns: int, fallback: float | None, return_ns: int) -> None:
        """Go on with other settings; where the fallback effort is in force, the new one is now."""
        self._timeout_ns, self._return_ns, self._fallback = timeout_ns, return_ns, fallback
        if fallback is not None and (self.silent or not self.is_driven):
            self._effort = np.full(self._effort.shape, fallback)

    def take(self, effort: np.ndarray, now_ns: int) -> bool:
        """Take a new effort, (lanes,), finite. Returns whether it ends a silence."""
        ends_silence = self.silent
        if ends_silence:
            self.silent = False
            self._from, self._returned_ns = self._effort, now_ns
        self._effort, self._latest_ns = effort, now_ns
        return ends_silence

    def effort_at(self, now_ns: int) -> np.ndarray:
        """The effort to apply now, (lanes,)."""
        if self._latest_ns is None:
            return self._effort
        if not self.silent and 0 < self._timeout_ns < now_ns - self._latest_ns:
            held = self._effort if self._returned_ns is None else self._blended(now_ns)
            self.silent, self._returned_ns = True, None
            self._effort = held if self._fallback is None else np.full(held.shape, self._fallback)
        if self._returned_ns is None:
            return self._effort
        return self._blended(now_ns)

    def _blended(self, now_ns: int) -> np.ndarray:
        assert self._returned_ns is not None
        passed = now_ns - self._returned_ns
        if passed >= self._return_ns:
            self._returned_ns = None
            return self._effort
        fraction = passed / self._return_ns
        return np.asarray(self._from * (1.0 - fraction) + self._effort * fraction)
