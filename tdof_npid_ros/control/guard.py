"""An experiment on a running loop: who has the loop, within what it must stay, what ends it, and what is restored then.

The guard is the controller's, not the tool's that experiments: whatever becomes of the tool, it stands. It knows no
ROS.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from tdof_npid_ros.parameters import EXPERIMENT, GAINS, LARGEST_SIGNAL, OPTIONS

NOT_MOVED: Final = math.inf  # of `experiment_setpoint` and `experiment_effort`
AT_REST: Final[dict[str, Any]] = {
    "experiment": "",
    "experiment_setpoint": NOT_MOVED,
    "experiment_effort": NOT_MOVED,
}
OPERATORS: Final = frozenset((*GAINS, *OPTIONS))  # whoever else changes them ends the experiment
LIMITS: Final = tuple(name for name in EXPERIMENT if name not in AT_REST)  # what ends it by itself
RESTORED: Final = (*GAINS, *OPTIONS, *LIMITS)  # as they were before, whatever ends the experiment
MODE: Final = ("manual", "manual_effort")


class Guard:
    """Of one loop.

    Its parameters are the controller's (`EXPERIMENT`). An experiment begins where `experiment` gets a name, and goes on
    as long as it, or what it moves, is set again within `experiment_lease`. Somebody else's change of the controller
    ends it, and stays.

    Attributes:
        name: of the experiment that has the loop; empty: none has.
        setpoint: that it gives, in place of the operator's; None: it gives none.
        integral: the integral action before it, (lanes,).
        ended: the name of the latest that has ended, and `why`.
    """

    def __init__(self) -> None:
        self.name = self.ended = self.why = ""
        self.setpoint: float | None = None
        self.integral = np.zeros(0)
        self._before: dict[str, Any] = {}  # `RESTORED` before the experiment
        self._now: dict[str, Any] = {}  # before the changes that were completed last
        self._breach = ""
        self._renewed_ns = self._output_ns = 0
        self._answers = self._seen = 0
        self._settings: dict[str, Any] = {}

    # Parameters

    def completed(self, changes: Mapping[str, Any], now: Mapping[str, Any]) -> dict[str, Any]:
        """Changes of parameters with what belongs to them: mode and effort where the experiment moves the effort,
        all that is restored where it ends.

        Args:
            now: all of `RESTORED`.
        """
        self._now = dict(now)
        wanted = changes.get("experiment", self.name)
        if not self.name and not wanted:
            return dict(changes)
        if self.name and not self._is_of_experiment(changes):
            return {**self._before, **changes, **AT_REST}
        before = self._before if self.name else now
        return {**self._mode(changes.get("experiment_effort"), before), **changes}

    def _is_of_experiment(self, changes: Mapping[str, Any]) -> bool:
        """Whether they leave the experiment the loop: they bear its name, or are none that matter."""
        if "experiment" in changes:
            return bool(changes["experiment"])  # another name is refused
        return not changes.keys() & (OPERATORS | {"setpoint"})

    @staticmethod
    def _mode(effort: float | None, before: Mapping[str, Any]) -> dict[str, Any]:
        if effort is None:
            return {}
        if effort == NOT_MOVED:
            return {name: before[name] for name in MODE}
        return {"manual": True, "manual_effort": effort}

    def check(self, changes: Mapping[str, Any], settings: Mapping[str, Any]) -> None:
        """Refuse what an experiment cannot be.

        Args:
            settings: `EXPERIMENT` as it would be.

        Raises:
            ValueError: the reason.
        """
        name = changes.get("experiment", self.name)
        if name and self.name and name != self.name:
            raise ValueError(f"experiment {self.name} has the loop: wait for its end, or end it: set experiment to ''")
        if name and name == self.ended:
            raise ValueError(f"experiment {name} has ended: {self.why}; the next one needs another name")
        for kind, moved in (("output", "experiment_setpoint"), ("effort", "experiment_effort")):
            value, (low, high) = settings[moved], settings[f"safe_range.{kind}"]
            if value == NOT_MOVED:
                continue
            if not name:
                raise ValueError(
                    f"{moved} is of an experiment, but none has the loop: set experiment to its name first"
                )
            if not max(low, -LARGEST_SIGNAL) <= value <= min(high, LARGEST_SIGNAL):
                raise ValueError(f"{moved} {value:g} is beyond safe_range.{kind}, {low:g} to {high:g}")

    def check_begin(self, output: np.ndarray, effort: np.ndarray, settings: Mapping[str, Any]) -> None:
        """Refuse to begin beyond the safe ranges: of the loop's present output and effort, (lanes,).

        Raises:
            ValueError: it is.
        """
        for kind, values in (("output", output), ("effort", effort)):
            if breach := _beyond(kind, values, settings):
                raise ValueError(f"no experiment can begin: {breach}")

    def take(
        self,
        changes: Mapping[str, Any],
        settings: Mapping[str, Any],
        integral: np.ndarray,
        now_ns: int,
    ) -> bool:
        """Take over changes, completed and accepted; whether the experiment has ended, and the loop must go back to the
        integral action of before.

        Args:
            settings: `EXPERIMENT` after them.
            integral: the integral action now, (lanes,).
            now_ns: on a clock that is never set.
        """
        name = settings["experiment"]
        if name and not self.name:
            self.name, self._before, self.integral = name, self._now, integral.copy()
            self._answers, self._seen, self._output_ns, self._breach = 0, 0, now_ns, ""
        elif self.name and not name:
            kept = sorted(n for n in OPERATORS & changes.keys() if changes[n] != self._before[n])
            moved = self.setpoint is not None or any(self._now[n] != self._before[n] for n in MODE)
            goes_back = bool(self._breach) or (moved and not kept)
            self.why = self._breach or (f"{', '.join(kept)} set" if kept else "it was asked to end")
            self.ended, self.name, self.setpoint, self._breach = self.name, "", None, ""
            return goes_back
        elif self.name and "experiment" not in changes:  # not the experiment's own, so they stay
            self._before = {**self._before, **{n: changes[n] for n in LIMITS if n in changes}}
        if self.name and changes.keys() & EXPERIMENT.keys():
            self._renewed_ns = now_ns
            self._settings = dict(settings)
            setpoint = settings["experiment_setpoint"]
            self.setpoint = None if setpoint == NOT_MOVED else setpoint
        return False

    # In the loop

    def note(self, breach: str) -> None:
        """Why the experiment is about to be ended."""
        self._breach = breach

    def breach_of_output(self, output: np.ndarray, period_ns: int) -> str:
        """Why the experiment must end at an output, (lanes,), before it is answered; empty: it need not."""
        self._answers += 1
        longest = self._settings["experiment_duration"]
        if self._answers * period_ns > longest * 1e9:
            return f"it has taken longer than experiment_duration, {longest:g} s"
        return _beyond("output", output, self._settings)

    def breach_of_effort(self, effort: np.ndarray) -> str:
        """Likewise of an effort, (lanes,), before it is published."""
        return _beyond("effort", effort, self._settings)

    def overdue(self, now_ns: int, silent: bool) -> str:
        """Why the experiment must end though nothing comes; empty: it need not. Asked again and again.

        Args:
            now_ns: as for `take`.
            silent: the loop has fallen silent.
        """
        lease = self._settings["experiment_lease"]
        if self._answers != self._seen:
            self._seen, self._output_ns = self._answers, now_ns
        if silent or now_ns - self._output_ns > lease * 1e9:
            return "no output comes"
        if now_ns - self._renewed_ns > lease * 1e9:
            return f"whoever makes it has not been heard of for experiment_lease, {lease:g} s"
        return ""


def _beyond(kind: str, values: np.ndarray, settings: Mapping[str, Any]) -> str:
    low, high = settings[f"safe_range.{kind}"]
    for value in values.tolist():
        if not low <= value <= high:
            return f"{kind} {value:g} is beyond safe_range.{kind}, {low:g} to {high:g}"
    return ""
