"""A loop whose plant cannot be reset, as the tuner uses it: one candidate at a time, a step back and forth."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import JointState

from tdof_npid_ros.control.gains import GAIN_NAMES, Gains, gains_from_mapping
from tdof_npid_ros.control.joints import Joints
from tdof_npid_ros.graph.runtime.messages import signal_message, stamp_ns
from tdof_npid_ros.graph.runtime.qos import SIGNAL_QOS
from tdof_npid_ros.graph.tuner.loop_client import tuned_parameters
from tdof_npid_ros.graph.tuner.patience import POLL, Patience
from tdof_npid_ros.graph.tuner.tuned_node import TunedNode
from tdof_npid_ros.names import in_namespace
from tdof_npid_ros.tuning import TuningError
from tdof_npid_ros.tuning.alternate import Settling, StepTest, Trial
from tdof_npid_ros.tuning.ask_tell import Array, Scores
from tdof_npid_ros.tuning.live import LoopLostError
from tdof_npid_ros.tuning.problem import TuningProblem


class AlternateLoop:
    """The controller of one namespace and whatever plant it drives, which must be running.

    The last good gains are those on the controller before the tuning, then those of the best candidate so far. When a
    candidate fails, the loop goes back to them, to the level where it was settled, and to the integral action that it
    had there: without that, a nonlinear controller may stay where the failed one has wound it up to, for its integral
    action hardly moves at large errors.

    Args:
        node: through which everything goes; its executor spins in another thread.
        problem: what is tuned.
        test: how.
        namespace: of the loop.
        patience: with which it is waited for.
    """

    def __init__(
        self,
        node: Node,
        problem: TuningProblem,
        test: StepTest,
        namespace: str,
        patience: Patience,
    ) -> None:
        self._node = node
        self._problem = problem
        self._test = test
        self._namespace = namespace
        self._patience = patience
        name = in_namespace(namespace, "controller")
        self._controller = TunedNode(node, name, patience.for_an_answer, patience.check)
        self._joints = Joints(())
        self._good: Gains | None = None
        self._best = float("inf")
        self._level = test.levels[0]
        self._integral: float | None = None  # the latest on controller_state
        self._integral_at_rest: float | None = None
        self._watching: Settling | Trial | None = None
        self._outputs = 0
        self._first_ns: int | None = None  # the first output's stamp
        self._ended = threading.Event()
        self._setpoint_publisher = node.create_publisher(JointState, in_namespace(namespace, "setpoint"), SIGNAL_QOS)
        self._state_subscription = node.create_subscription(
            JointState, in_namespace(namespace, "controller_state"), self._on_controller_state, SIGNAL_QOS
        )
        self._output_subscription = node.create_subscription(
            JointState, in_namespace(namespace, "output"), self._on_output, SIGNAL_QOS
        )

    @property
    def in_use(self) -> list[str]:
        """The namespace, once the loop has been seen to run."""
        return [self._namespace] if self._good is not None else []

    def evaluate(self, candidates: Array) -> Scores:
        """Scores of candidates (n, gains) by the IAE of a step of 1; see `Trial`.

        Raises:
            TuningError: the loop is not there, does not settle with the last good gains, or refused a gain.
        """
        if self._good is None:
            self._begin()
        values, violations = np.array([self._evaluate_one(candidate) for candidate in candidates]).T
        return Scores(values, violations)

    def restore(self, gains: Gains | None, objective: float) -> tuple[Gains | None, bool]:
        """Set the best gains: these, with their objective, or better ones of a generation that was cut short.

        Without any, those before the tuning.

        Returns:
            The best gains, None without any, and whether they are set.
        """
        best = self._good if self._best < objective else gains
        self._watching = None
        if self._good is None:
            return best, best is None  # nothing was changed
        try:
            self._controller.set_parameters(self._settings(best or self._good))
            self._publish_setpoint(self._level)
        except (LoopLostError, TuningError) as error:
            self._node.get_logger().error(f"the controller is left as it is: {error}")
            return best, False
        return best, True

    def close(self) -> None:
        """Leave the graph; no executor may spin the node now."""
        self._node.destroy_subscription(self._output_subscription)
        self._node.destroy_subscription(self._state_subscription)
        self._node.destroy_publisher(self._setpoint_publisher)
        self._controller.destroy()

    # A candidate

    def _begin(self) -> None:
        end = time.monotonic() + self._patience.for_a_loop
        while not self._outputs:
            self._patience.check()
            if time.monotonic() > end:
                raise TuningError(
                    f"no loop to tune: no output in {self._namespace} within {self._patience.for_a_loop:g} s"
                )
            time.sleep(POLL)
        found = self._controller.parameters([*GAIN_NAMES, "joint_names"])
        good = gains_from_mapping(found)
        if good.integral_min == good.integral_max != 0.0:  # of 0, somebody wants no integral action
            raise TuningError(
                f"{self._controller.name} has integral_min and integral_max {good.integral_min:g}, as a tuner that was "
                "killed leaves them: set both as they were, -inf and inf for instance, and the gains, then start again"
            )
        self._joints = Joints(found["joint_names"] or ())
        self._limits = good.integral_min, good.integral_max
        self._good = good

    def _evaluate_one(self, candidate: Array) -> tuple[float, float]:
        self._settle_with_good_gains()
        trial = Trial(self._test, self._level, next(level for level in self._test.levels if level != self._level))
        self._watch(trial)
        self._apply(candidate)
        self._wait()
        if trial.outcome == "measured":
            self._level = trial.setpoint
        else:
            self._node.get_logger().warning(f"candidate {candidate.tolist()} was {trial.outcome}: back to good gains")
            self._recover()
        score = trial.value, trial.violation
        if trial.violation == 0.0 and trial.value < self._best:
            self._best, self._good = trial.value, self._problem.gains(candidate)
        return score

    def _settle_with_good_gains(self) -> None:
        self._controller.set_parameters(self._settings(self._good_gains))
        if not self._settles():
            raise TuningError(
                f"the output does not settle at {self._level:g} within {self._test.time_limit:g} s with the last good "
                "gains: tune by hand until it does, or widen settle_band or time_limit"
            )
        self._integral_at_rest = self._integral

    def _recover(self) -> None:
        """Go back to rest with the last good gains, the integral action held at what it was there."""
        self._controller.set_parameters(self._at_rest())
        self._settles()

    def _settles(self) -> bool:
        """Whether the output settles at the level within the time limit."""
        settling = Settling(self._test, self._level)
        self._watch(settling)
        self._publish_setpoint(self._level)
        self._wait()
        return settling.settled

    def _apply(self, candidate: Array) -> None:
        """Set a candidate's gains, which must be within the bounds whatever the optimiser says."""
        for name, value, (low, high) in zip(self._problem.names, candidate, self._problem.bounds, strict=True):
            if not low <= value <= high:
                raise TuningError(f"{name} {value} is outside its bounds {[low, high]}: not applied")
        self._controller.set_parameters(self._settings(self._problem.gains(candidate)))

    def _settings(self, gains: Gains) -> dict[str, Any]:
        """The controller's parameters for gains, with the integral action's limits of before the tuning."""
        return {**tuned_parameters(gains), "integral_min": self._limits[0], "integral_max": self._limits[1]}

    def _at_rest(self) -> dict[str, Any]:
        """The controller's parameters for the last good gains, with the integral action held as it was at rest."""
        settings = self._settings(self._good_gains)
        if self._integral_at_rest is not None:
            settings |= {"integral_min": self._integral_at_rest, "integral_max": self._integral_at_rest}
        return settings

    @property
    def _good_gains(self) -> Gains:
        assert self._good is not None
        return self._good

    # Watching

    def _watch(self, watching: Settling | Trial) -> None:
        self._ended.clear()
        self._watching = watching

    def _wait(self) -> None:
        """Until what is watched has ended; raises LoopLostError if no outputs come any more."""
        seen, moved = self._outputs, self._now_ns
        while not self._ended.wait(POLL):
            self._patience.check()
            if self._outputs != seen:
                seen, moved = self._outputs, self._now_ns
            elif self._now_ns - moved > self._patience.for_an_answer * 1e9:
                raise LoopLostError(f"no output in {self._namespace} for {self._patience.for_an_answer:g} s")

    @property
    def _now_ns(self) -> int:
        """Of a clock that is never set, or in simulated time, which may stand still."""
        clock = self._node.get_clock()
        return int(clock.now().nanoseconds) if clock.ros_time_is_active else time.monotonic_ns()

    def _on_output(self, message: JointState) -> None:
        output, effort = self._picked(message, message.position), self._picked(message, message.effort)
        if output is None:
            return
        self._outputs += 1
        stamp = stamp_ns(message.header.stamp)
        self._first_ns = stamp if self._first_ns is None else self._first_ns
        now = (stamp - self._first_ns) / 1e9  # small, so that it is exact
        watching = self._watching
        if isinstance(watching, Trial):
            before = watching.setpoint
            watching.take(now, output, effort)
            if watching.setpoint != before:
                self._publish_setpoint(watching.setpoint)
            if watching.outcome == "unsafe":
                self._controller.ask_to_set(self._at_rest())  # at once, from here
                self._publish_setpoint(watching.before)
            ended = watching.outcome != ""
        elif watching is not None:
            watching.take(now, output)
            ended = watching.settled or watching.too_late
        else:
            return
        if ended:
            self._watching = None
            self._ended.set()

    def _picked(self, message: JointState, field: Sequence[float]) -> float | None:
        """The value of the joint that the controller drives, the first one if it names none; None: there is none."""
        try:
            values = self._joints.selected(message.name, np.asarray(field))
        except ValueError:
            return None
        return float(values[0]) if len(values) else None

    def _on_controller_state(self, message: JointState) -> None:
        terms = dict(zip(message.name, message.position, strict=False))
        self._integral = terms.get("integral", self._integral)

    def _publish_setpoint(self, setpoint: float) -> None:
        message = signal_message("")
        message.position = [setpoint]
        self._setpoint_publisher.publish(message)
