"""Evaluating a candidate on a plant that cannot be reset: one step of the setpoint between two levels.

It knows no ROS; times are the outputs' stamps in s.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Literal

import numpy as np

from tdof_npid_ros.case import Bounds
from tdof_npid_ros.tuning import TuningError
from tdof_npid_ros.tuning.judge import DIVERGED

Outcome = Literal["", "measured", "unsettled", "unsafe"]

NOISE = 3.0
"""Standard errors: a mean error below them is none."""

FAILED = 1e30
"""The objective of a trial that ended at once is twice this."""

RESTLESS = 1.0
"""The violation of an error that stays, or is not settled within the time limit."""

DECAYING = 0.9
"""Of the mean error half a settle_time before: an error that has not fallen below this does not decay."""


@dataclass(frozen=True)
class StepTest:
    """How candidates are tested.

    Attributes:
        levels: the two setpoints.
        settle_band: an output is near the setpoint within this fraction of the step between the levels.
        settle_time: s that it must stay there to be settled.
        time_limit: s in which it must settle.
        safe_output, safe_effort: ranges that end a trial when they are left.

    Raises:
        TuningError: values that no trial can be run with.
    """

    levels: tuple[float, float]
    settle_band: float
    settle_time: float
    time_limit: float
    safe_output: Bounds
    safe_effort: Bounds

    def __post_init__(self) -> None:
        if not all(map(math.isfinite, self.levels)) or self.levels[0] == self.levels[1]:
            raise TuningError(f"levels are {list(self.levels)}: give two different setpoints")
        low, high = self.safe_output
        if not all(low < level < high for level in self.levels):
            raise TuningError(f"levels {list(self.levels)} must lie inside safe_range.output {[low, high]}")
        if not self.safe_effort[0] < self.safe_effort[1]:
            raise TuningError(f"safe_range.effort is {list(self.safe_effort)}: the lower must be below the upper")
        if not (0 < self.settle_band < 1 and 0 < self.settle_time < self.time_limit):
            raise TuningError(
                f"settle_band {self.settle_band}, settle_time {self.settle_time} s, time_limit {self.time_limit} s: "
                "need 0 < settle_band < 1 and 0 < settle_time < time_limit"
            )

    @property
    def step(self) -> float:
        """The distance of the levels."""
        return abs(self.levels[1] - self.levels[0])

    def is_safe(self, output: float, effort: float | None) -> bool:
        """Whether both are in their ranges; an effort that is not known counts as safe."""
        low, high = self.safe_output
        safe = low <= output <= high
        return safe and (effort is None or self.safe_effort[0] <= effort <= self.safe_effort[1])


class Settling:
    """Whether an output has settled at a setpoint, within the time limit that begins with the first output."""

    def __init__(self, test: StepTest, setpoint: float) -> None:
        self._test = test
        self._setpoint = setpoint
        self._began: float | None = None
        self._near_since: float | None = None
        self.settled = self.too_late = False
        self.elapsed = 0.0

    def take(self, time: float, output: float) -> None:
        """Take an output at its time in s."""
        self._began = time if self._began is None else self._began
        self.elapsed = time - self._began
        if abs(output - self._setpoint) > self._test.settle_band * self._test.step:
            self._near_since = None
        elif self._near_since is None:
            self._near_since = time
        self.settled = self._near_since is not None and time - self._near_since >= self._test.settle_time
        self.too_late = not self.settled and self.elapsed >= self._test.time_limit


class Trial:
    """One candidate: it settles at the level where the plant is, then steps to the other and settles there.

    Attributes:
        before: the level where it begins.
        setpoint: what the setpoint is to be now.
        outcome: empty while it runs; `unsettled` and `unsafe` are failures.
        iae: of the step, by the trapezoidal rule, for a step of 1; with what would still come, told from how the error
            decays while it settles.
        fraction: how far a failed trial came, below 1; 1 for one that did not fail.
        rests: whether the error has come to rest, or decays; False also for one that has not settled in time.
    """

    def __init__(self, test: StepTest, before: float, after: float) -> None:
        self._test = test
        self._after = after
        self.before = before
        self._settling = Settling(test, before)
        self.setpoint = before
        self.outcome: Outcome = ""
        self._errors: deque[tuple[float, float]] = deque()  # times and errors of the last settle_time
        self.iae = 0.0
        self.fraction = 0.0
        self.rests = False

    @property
    def value(self) -> float:
        """The candidate's objective: the IAE, or for a failed trial one above all of these, the earlier the larger."""
        return self.iae if self.outcome == "measured" else FAILED * (2.0 - self.fraction)

    @property
    def violation(self) -> float:
        """How far the candidate is from one that may win: 0 for one that settles and comes to rest."""
        if self.outcome == "measured":
            return 0.0 if self.rests else RESTLESS
        return DIVERGED + 1.0 - self.fraction

    def take(self, time: float, output: float, effort: float | None) -> None:
        """Take an output and the effort on the plant, at a time in s."""
        if self.outcome:
            return
        stepped = self.setpoint == self._after
        if not self._test.is_safe(output, effort):
            self.outcome = "unsafe"
            self.fraction = min(self._settling.elapsed / self._test.time_limit, 0.999) if stepped else 0.0
            return
        self._settling.take(time, output)
        if stepped:
            self._integrate(time, self._after - output)
        if self._settling.settled and not stepped:
            self.setpoint, self._settling = self._after, Settling(self._test, self._after)
        elif self._settling.settled or (self._settling.too_late and stepped):
            self.outcome, self.fraction = "measured", 1.0  # a slow one pays by its IAE over the whole time limit
            if self._settling.settled:
                self._judge_rest()
        elif self._settling.too_late:
            self.outcome = "unsettled"

    def _integrate(self, time: float, error: float) -> None:
        if self._errors:
            before, its_error = self._errors[-1]
            self.iae += 0.5 * (time - before) * (abs(error) + abs(its_error)) / self._test.step
        self._errors.append((time, error))
        while self._errors[0][0] < time - self._test.settle_time:
            self._errors.popleft()

    def _judge_rest(self) -> None:
        """Compare the error's means over the halves of the last settle_time, beyond what noise can do."""
        times, errors = np.array(self._errors).T
        late = times >= times[-1] - 0.5 * self._test.settle_time
        before, after = abs(float(errors[~late].mean())) if not late.all() else 0.0, abs(float(errors[late].mean()))
        noise = float(errors[late].std()) / math.sqrt(np.count_nonzero(late))
        if after <= NOISE * noise:
            self.rests = True
        elif after < DECAYING * before:
            self.rests = True
            self.iae += 0.5 * self._test.settle_time * after * after / (before - after) / self._test.step
