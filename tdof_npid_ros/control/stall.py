"""Whether a loop has been driven off: its error so large beside sigma that the integral action hardly sees it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tdof_npid_ros.control.controller import Controller
from tdof_npid_ros.control.law import TERMS

DEAD = 0.0111  # k(3 sigma): an error that is scaled down below it is hardly integrated
SHRINKS = 0.9  # fraction of itself that an error falls to if it shrinks
PATIENCE_NS = 5_000_000_000
PATIENCE_PERIODS = 50
_ERROR, _SCALED, _INTEGRAL, _UNLIMITED = (
    TERMS.index(name) for name in ("error", "scaled_error", "integral", "unlimited_effort")
)


class Stall(NamedTuple):
    """A lane that has been driven off.

    Attributes:
        error: in y.
        in_sigma: the error's absolute value.
        scale: k(e).
        rate: of the integral action, in u/s.
        unwinds: whether it moves towards 0: then `full_unwinding` makes it fast.
    """

    lane: int
    error: float
    in_sigma: float
    scale: float
    rate: float
    unwinds: bool

    def __str__(self) -> str:
        return (
            f"lane {self.lane} was driven off: its error is {self.in_sigma:.3g} sigma and does not shrink; k(e) is "
            f"{self.scale:.2g}, so the integral action moves by {self.rate:.2g} a second"
        )


class StallWatch:
    """Looks at a controller now and then, about once a second.

    A lane has been driven off when its error has not shrunk by a tenth for 5 s, and for 50 sample periods, while k(e)
    was below that of 3 sigma, and while no limit of the effort kept the controller from doing more.
    """

    def __init__(self) -> None:
        self._since: np.ndarray | None = None  # ns, (lanes,)
        self._error = np.zeros(0)  # (lanes,): how large it was then

    def forget(self) -> None:
        """Begin anew."""
        self._since = None

    def look(self, controller: Controller) -> Stall | None:
        """The lane that is furthest off, if any has been driven off."""
        now, gains = controller.stamp_ns, controller.gains
        if now is None or controller.options.manual or gains.lanes != controller.terms.shape[1]:
            self.forget()
            return None
        terms, ki = controller.terms, gains.per_lane("ki")
        error = np.abs(terms[_ERROR])
        held = (terms[_UNLIMITED] - controller.effort) * ki * terms[_ERROR] > 0
        dead = (np.abs(terms[_SCALED]) < DEAD * error) & (ki != 0) & ~held
        if self._since is None or len(self._since) != len(error) or (self._since > now).any():
            self._since, self._error = np.full(len(error), now), error.copy()
        anew = ~dead | (error < SHRINKS * self._error)
        self._since[anew], self._error[anew] = now, error[anew]
        patience = max(PATIENCE_NS, PATIENCE_PERIODS * controller.sample_period_ns)
        driven_off = dead & (now - self._since >= patience)
        if not driven_off.any():
            return None
        in_sigma = error / gains.per_lane("sigma")
        lane = int(np.argmax(np.where(driven_off, in_sigma, -1.0)))
        signed, scaled = float(terms[_ERROR, lane]), float(terms[_SCALED, lane])
        rate = float(ki[lane]) * scaled
        return Stall(
            lane, signed, float(in_sigma[lane]), scaled / signed, rate, bool(rate * terms[_INTEGRAL, lane] < 0)
        )
