"""An experiment on a loop that runs, as whoever makes it does: through ROS 2 alone, under the controller's guard."""

from __future__ import annotations

import math
import secrets
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import ExitStack
from typing import Any, TypeVar

import numpy as np

from tdof_npid_ros.control.gains import GAIN_NAMES, Gains, gains_from_mapping
from tdof_npid_ros.control.options import OPTION_NAMES, ControllerOptions, options_from_mapping
from tdof_npid_ros.graph.observer import LoopObserver, Row
from tdof_npid_ros.graph.runtime.parameter_client import NoAnswerError, RefusedError
from tdof_npid_ros.identification.excitation import By, Excitation, Rest, rest_of
from tdof_npid_ros.identification.fit import Stretch
from tdof_npid_ros.identification.records import Record, is_even
from tdof_npid_ros.interruption import afterwards, check
from tdof_npid_ros.parameters import EXPERIMENT, GAINS

POLL = 0.005  # s
LEASE = 8.0  # s, of wall time, for a busy machine lets a tool wait for seconds; renewed four times in it
REST_SAMPLES = 200
LEAST_REST_SAMPLES = 50
ATTEMPTS = 3  # to reach a controller that may be busy
FOUND = 1.0  # s until a simulated plant, if there is one, has been found
SILENCE = 3.0  # s of wall time
RENEWS = 0.1  # s between two looks whether the lease is to be renewed, while something is computed
SETTINGS = ("sample_period", "setpoint", "joint_names", *GAIN_NAMES, *OPTION_NAMES, *EXPERIMENT)

_T = TypeVar("_T")


class ExperimentError(RuntimeError):
    """An experiment that cannot be made or was ended; the loop is as it was before. The message is one line."""


class LoopAtWork:
    """A loop that runs: what an experiment must know of it before it begins.

    Args:
        observer: of the loop.

    Raises:
        ExperimentError: there is none, or it has several lanes.
    """

    def __init__(self, observer: LoopObserver) -> None:
        self.observer = observer
        self.values = self._controllers()
        if self.values["experiment"] is None:
            raise ExperimentError("the controller knows no experiments: it is of an older version")
        if self.values["experiment"]:
            raise ExperimentError(f"experiment {self.values['experiment']} has the loop: wait for its end")
        lanes = max(self.gains.lanes, len(self.values["joint_names"]))  # one gain may serve all joints
        if lanes > 1:
            raise ExperimentError(f"the loop has {lanes} lanes: an experiment is of one; give that one a controller")
        self.plant = self._plant_limits()

    @property
    def gains(self) -> Gains:
        """The controller's."""
        return gains_from_mapping(self.values)

    @property
    def options(self) -> ControllerOptions:
        """The controller's."""
        return options_from_mapping(self.values)

    @property
    def scale(self) -> float:
        """The largest change of the setpoint that is usual; 0: nothing tells it."""
        gains, (low, high) = self.gains, self.values["safe_range.output"]
        if gains.type != "pid" or gains.sigma != GAINS["sigma"].default:
            return float(gains.per_lane("sigma")[0])
        return 0.1 * (high - low) if math.isfinite(high - low) else 0.0

    @property
    def effort_limits(self) -> tuple[float, float]:
        """Of the controller, and of the plant where it tells its own."""
        gains = self.gains
        low, high = self.plant
        return max(low, float(gains.per_lane("effort_min")[0])), min(high, float(gains.per_lane("effort_max")[0]))

    def _controllers(self) -> dict[str, Any]:
        for patience in reversed(range(ATTEMPTS)):
            try:
                return self.observer.remote("controller").parameters(SETTINGS)
            except NoAnswerError as error:
                if not patience:
                    raise ExperimentError(f"{error}: start the loop, or name the one that runs") from None
        raise AssertionError

    def _plant_limits(self) -> tuple[float, float]:
        remote = self.observer.remote("plant")
        end = time.monotonic() + FOUND
        while not remote.serves("reset"):
            if time.monotonic() > end:
                return -math.inf, math.inf
            time.sleep(POLL)
        try:
            found = remote.parameters(["effort_min", "effort_max"])
        except NoAnswerError:
            return -math.inf, math.inf
        low, high = found["effort_min"], found["effort_max"]
        return (-math.inf if low is None else float(low)), (math.inf if high is None else float(high))

    def rest(self, tolerance: float, patience: float) -> Rest:
        """The loop at rest, waited for.

        Args:
            tolerance: a drift of the output that is none.
            patience: s of wall time to wait for rest.

        Raises:
            ExperimentError: no outputs come, or it does not come to rest.
        """
        end, begun = time.monotonic() + patience, time.monotonic()
        _, first = self.observer.rows_since(self.observer.count)
        while True:
            time.sleep(20 * POLL)
            rows, _ = self.observer.rows_since(max(first, self.observer.count - REST_SAMPLES))
            enough = len(rows) >= REST_SAMPLES or (
                len(rows) >= LEAST_REST_SAMPLES and time.monotonic() - begun > 0.25 * patience
            )
            if enough:
                found = rest_of(*signals_of(rows), tolerance)
                if found.is_rest:
                    return found
            if time.monotonic() > end:
                if not enough:
                    raise ExperimentError(
                        "no control_effort comes with an output: start the loop, or look after the plant"
                    )
                raise ExperimentError(
                    f"the loop is not at rest: its output drifts by {found.drift:.3g} within {len(rows)} samples; "
                    "wait, hold setpoint and load still, or take it to manual mode first"
                )


class Hold:
    """The loop in the hands of an experiment, under the controller's guard. What `move` and `apply` change is restored
    at the end, unless `keep` ends it. Ctrl-C comes between two answers, so that each request is made whole.

    Args:
        loop: at work.
        name: of the experiment; a number is added to it, for each has a name of its own.
        safe_output, safe_effort: that end it when they are left.
        duration: s of the loop's time, after which it ends.
        tell: given the loop's time since the beginning, s, now and then.

    Attributes:
        taken: the answers so far, from somewhat before the beginning on.
    """

    def __init__(
        self,
        loop: LoopAtWork,
        name: str,
        safe_output: tuple[float, float],
        safe_effort: tuple[float, float],
        duration: float,
        tell: Callable[[float], None] = lambda seconds: None,
    ) -> None:
        self.name = f"{name}-{secrets.token_hex(3)}"
        self._observer, self._tell = loop.observer, tell
        self._controller = loop.observer.remote("controller")
        self._settings = {
            "experiment_lease": LEASE,
            "experiment_duration": duration,
            "safe_range.output": list(safe_output),
            "safe_range.effort": list(safe_effort),
        }
        self._stack = ExitStack()
        self._ended = False
        self._renew_at = 0.0
        self.taken: list[Row] = []

    def __enter__(self) -> Hold:
        with ExitStack() as stack:
            stack.enter_context(afterwards())
            check()
            self.taken, self._seen = self._observer.rows_since(max(0, self._observer.count - REST_SAMPLES))
            self._set({})
            stack.callback(self._end)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def _end(self) -> None:
        if not self._ended:
            self._ended = True
            self._set({"experiment": ""}, named=False)

    def move(self, setpoint: float | None = None, effort: float | None = None) -> None:
        """Give a setpoint, or an effort by hand."""
        moved = {"experiment_setpoint": setpoint, "experiment_effort": effort}
        self._set({name: float(value) for name, value in moved.items() if value is not None})

    def apply(self, values: Mapping[str, Any]) -> None:
        """Set gains and options, all at once and without a jump; for as long as the experiment lasts."""
        self._set(values)

    def keep(self, values: Mapping[str, Any]) -> None:
        """End the experiment; these gains stay, all else is restored."""
        check()
        self._ended = True
        self._set({"experiment": "", **values}, named=False)

    def follow(self, excitation: Excitation, by: By, rest: float) -> None:
        """Let an excitation of the setpoint or of the effort have its way; the output rests at `rest`.

        Raises:
            ExperimentError: the controller has ended the experiment, or no outputs come.
        """
        excitation.begin(self.taken[-1].time, rest)
        self.move(**{by: excitation.level})
        for row in self.rows():
            if excitation.take(row.time, float(row.output[0])):
                if excitation.done:
                    return
                self.move(**{by: excitation.level})

    def renew(self) -> None:
        """Keep the lease, while nothing else is asked of the loop."""
        check()
        if time.monotonic() > self._renew_at:
            self._set({})

    def during(self, compute: Callable[[], _T]) -> _T:
        """What `compute` returns, however long it takes: the lease is renewed meanwhile.

        Raises:
            ExperimentError: the controller has ended the experiment.
        """
        with ThreadPoolExecutor(1) as pool:
            computed = pool.submit(compute)
            while wait([computed], timeout=RENEWS).not_done:
                self.renew()
        return computed.result()

    def wait(self, seconds: float) -> None:
        """Let the loop run for so much of its time."""
        first: float | None = None
        for row in self.rows():
            first = row.time if first is None else first
            if row.time - first >= seconds:
                return

    def rows(self) -> Iterator[Row]:
        """The answers as they come, for ever; the lease is renewed meanwhile.

        Raises:
            ExperimentError: the controller has ended the experiment, or no outputs come.
        """
        heard, begun = time.monotonic(), None
        while True:
            self.renew()
            new, self._seen = self._observer.rows_since(self._seen)
            if not new:
                if time.monotonic() - heard > SILENCE:
                    raise ExperimentError(f"no output has come for {SILENCE:g} s: look after the plant")
                time.sleep(POLL)
                continue
            heard = time.monotonic()
            begun = new[0].time if begun is None else begun
            self.taken += new
            yield from new
            self._tell(new[-1].time - begun)

    def _set(self, values: Mapping[str, Any], named: bool = True) -> None:
        """Named, with the safe ranges each time: a controller that was started again knows neither."""
        named_settings = {"experiment": self.name, **self._settings} if named else {}
        try:
            self._controller.set_parameters({**named_settings, **values})
        except NoAnswerError as error:
            self._ended = True
            raise ExperimentError(f"{error}: the controller ends the experiment by itself") from None
        except RefusedError as error:
            reason = str(error).partition(": ")[2] or str(error)
            self._ended = self._ended or "has ended" in reason
            raise ExperimentError(reason) from None
        self._renew_at = time.monotonic() + 0.25 * LEASE


def signals_of(rows: Sequence[Row]) -> tuple[list[float], list[float], list[float]]:
    """Output, effort and setpoint of the answers; the effort that the plant applied, where it tells it."""
    return (
        [float(row.output[0]) for row in rows],
        [float((row.applied if len(row.applied) else row.effort)[0]) for row in rows],
        [float(row.setpoint[0]) for row in rows],
    )


def record_of(rows: Sequence[Row], name: str, number: int, limits: tuple[float, float]) -> Record:
    """Rows as a record for identification.

    Raises:
        ExperimentError: there are next to none, or they are of several episodes.
    """
    if len(rows) < LEAST_REST_SAMPLES or rows[0].episode != rows[-1].episode:
        raise ExperimentError(f"{name}: {len(rows)} samples are too few, or the plant was reset")
    stamps = np.array([row.stamp_ns for row in rows])
    stamps, first = np.unique(stamps, return_index=True)
    kept = [rows[i] for i in first]
    time_ = (stamps - stamps[0]) / 1e9
    output = np.array([float(row.output[0]) for row in kept])
    if all(len(row.applied) for row in kept):  # what was applied until the output came
        until = np.array([float(row.applied[0]) for row in kept])
        effort = np.append(until[1:], until[-1])
    else:
        effort = np.array([float(row.effort[0]) for row in kept])
    stretch = Stretch(time_, effort, output, False, float(effort[0]), is_even(time_))
    return Record(name, number, stretch, np.array([float(row.setpoint[0]) for row in kept]), limits)
