"""The latest step of the setpoint as it unfolds, and the one before it, with their numbers. It knows no ROS."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from tdof_npid_ros.metrics import SetpointMetrics, setpoint_metrics

MOST = 20_000  # samples of a step that are kept; a longer one is thinned by half
LEAST = 1e-9  # of the setpoint's size: a smaller change is no step


@dataclass
class StepResponse:
    """A step of one lane's setpoint.

    Attributes:
        before, after: the setpoint's values; `before` is the output at that moment where no setpoint came before.
        time: s since the step.
        output: y at these times.
    """

    before: float
    after: float
    time: list[float] = field(default_factory=list)
    output: list[float] = field(default_factory=list)

    def metrics(self, period: float) -> SetpointMetrics | None:
        """Its numbers so far; None while there is too little of it.

        Args:
            period: from one sample to the next, s.
        """
        if len(self.output) < 3 or self.before == self.after:
            return None
        return setpoint_metrics(np.array(self.output), self.before, self.after, period)


class Steps:
    """Follows a lane: feed it each answer in order.

    Attributes:
        latest, previous: the steps; None before there are any.
    """

    def __init__(self) -> None:
        self.latest: StepResponse | None = None
        self.previous: StepResponse | None = None
        self._setpoint: float | None = None
        self._episode: int | None = None
        self._started = 0.0
        self._stride, self._count = 1, 0

    def take(self, time: float, episode: int, setpoint: float, output: float) -> None:
        """Note an answer."""
        is_new = episode != self._episode
        before = output if is_new else self._setpoint
        if self._setpoint is None or before is None:  # how long this setpoint has stood is not known
            before = setpoint
        size = max(abs(before), abs(setpoint), LEAST)
        if abs(setpoint - before) > LEAST * size:
            if self.latest is not None:
                self.previous = self.latest
            self.latest, self._started, self._stride, self._count = StepResponse(before, setpoint), time, 1, 0
        self._setpoint, self._episode = setpoint, episode
        if self.latest is None or self.latest.after != setpoint or (is_new and time != self._started):
            return
        if self._count % self._stride == 0:
            self.latest.time.append(time - self._started)
            self.latest.output.append(output)
        self._count += 1
        if len(self.latest.time) >= MOST:
            del self.latest.time[1::2], self.latest.output[1::2]
            self._stride *= 2

    @property
    def stride(self) -> int:
        """Of how many answers one is kept."""
        return self._stride
