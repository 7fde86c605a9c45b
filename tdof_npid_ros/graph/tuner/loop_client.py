"""A loop in lockstep as the tuner uses it: one lane per candidate, one episode at a time."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

from diagnostic_msgs.msg import KeyValue
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile
from trajectory_msgs.msg import JointTrajectory

from tdof_npid_ros.case import Case
from tdof_npid_ros.control.gains import GAIN_NAMES, PER_LANE, Gains, gains_from_candidates, gains_from_mapping
from tdof_npid_ros.graph.runtime.messages import plan_message
from tdof_npid_ros.graph.runtime.qos import LATCHED_QOS
from tdof_npid_ros.graph.runtime.tap import Taken, Tap, TapThread
from tdof_npid_ros.graph.tuner.patience import POLL
from tdof_npid_ros.graph.tuner.tuned_node import TunedNode
from tdof_npid_ros.loop import Integrals
from tdof_npid_ros.names import in_namespace
from tdof_npid_ros.parameters import NOISE
from tdof_npid_ros.plants.catalog import model_parameters
from tdof_npid_ros.scenario import Plan
from tdof_npid_ros.tuning.ask_tell import Array
from tdof_npid_ros.tuning.live import EpisodeOutputs, LoopLostError
from tdof_npid_ros.tuning.problem import TuningProblem
from tdof_npid_ros.wire import JOINT_STATE, EpisodeLabel, SignalReader

ATTEMPTS = 5  # at an episode that something else cuts short
TUNED_PARAMETERS = ("type", *PER_LANE)
OUTPUT_QOS = QoSProfile(history=HistoryPolicy.KEEP_ALL)


class WrongCaseError(LoopLostError):
    """A loop that is not the case that is tuned; the message names the parameter and both values."""


class LoopClient:
    """The plant and the controller of one namespace.

    Args:
        node: through which everything goes; its executor, which must know callback groups, spins in another thread.
        namespace: of the loop.
        problem: what is tuned.
        answer_timeout: s until a silent loop counts as lost.
        check: called while waiting; raises to give up.
    """

    def __init__(
        self, node: Node, namespace: str, problem: TuningProblem, answer_timeout: float, check: Callable[[], None]
    ) -> None:
        self.namespace = namespace
        self._node = node
        self._problem = problem
        self._answer_timeout = answer_timeout
        self._check = check
        self.plant = TunedNode(node, in_namespace(namespace, "plant"), answer_timeout, check)
        self.controller = TunedNode(node, in_namespace(namespace, "controller"), answer_timeout, check)
        self._outputs: EpisodeOutputs | None = None
        self._moved = threading.Condition()  # an episode has begun, or ended
        self._episode: EpisodeLabel | None = None  # the latest that the plant has told of
        self._plan_publisher = node.create_publisher(
            JointTrajectory, in_namespace(namespace, "scenario_plan"), LATCHED_QOS
        )
        self._episodes = node.create_subscription(
            KeyValue, in_namespace(namespace, "episode"), self._on_episode, LATCHED_QOS
        )
        self._tap = Tap(node, in_namespace(namespace, "output"), JOINT_STATE, OUTPUT_QOS)
        self._reader = SignalReader()
        self._taps = TapThread(self._tap.take, self._on_outputs)

    def destroy(self) -> None:
        """Leave the graph; no executor may spin the node now."""
        self._taps.stop()
        self._tap.close()
        self._node.destroy_publisher(self._plan_publisher)
        self._node.destroy_subscription(self._episodes)
        self.plant.destroy()
        self.controller.destroy()

    # What the tuner asks for

    def check_case(self) -> None:
        """Make sure that the loop is the case's, but for the gains that are tuned.

        Raises:
            WrongCaseError: it is not.
            LoopLostError: no answer.
        """
        case = self._problem.case
        _compare(self.plant, _plant_parameters(case), case.name)
        fixed = {name: value for name, value in self._problem.base.as_dict().items() if name not in TUNED_PARAMETERS}
        _compare(self.controller, {"sample_period": case.sample_period, **fixed}, case.name)

    def gains(self) -> Gains:
        """The controller's gains now. Raises LoopLostError if it does not answer."""
        return gains_from_mapping(self.controller.parameters(GAIN_NAMES))

    def apply(self, gains: Gains) -> None:
        """Set the gains, and as many lanes as they are for.

        Raises:
            TuningError: refused, with the reason.
            LoopLostError: no answer.
        """
        self.plant.set_parameters({"lanes": gains.lanes})
        self.controller.set_parameters(tuned_parameters(gains))

    def run_episode(self, episode: str, candidates: Array) -> Integrals:
        """Integrals, (n,), of an episode with one lane for each of the candidates (n, gains).

        Raises:
            TuningError: the controller refused a gain.
            WrongCaseError: the loop is not the case's any more.
            LoopLostError: the loop stopped answering, or something else drives it.
        """
        gains = gains_from_candidates(self._problem.base, self._problem.names, candidates)
        for _ in range(ATTEMPTS):
            self.apply(gains)
            outputs = self._play(episode, gains.lanes)
            if not outputs.cut and self._is_unchanged(gains):
                return outputs.integrals
        raise LoopLostError(
            f"{ATTEMPTS} episodes were cut short or their gains changed: something else drives the loop"
        )

    # An episode

    def _play(self, episode: str, lanes: int) -> EpisodeOutputs:
        """Run an episode; returns its outputs, complete or cut."""
        plan = self._problem.case.plans[episode]
        outputs = EpisodeOutputs(plan.digest, self._problem.case.signals[episode], lanes)
        self._outputs = outputs
        before = self._episode
        try:
            self._plan_publisher.publish(plan_message(plan, 0))
            outputs.started(self._begun(plan, before))
            self._wait_for_end(outputs)
        finally:
            self._outputs = None
        return outputs

    def _begun(self, plan: Plan, before: EpisodeLabel | None) -> EpisodeLabel:
        """The episode that the plant has begun with the plan, once it tells."""
        end = time.monotonic() + self._answer_timeout
        with self._moved:
            while self._episode is None or self._episode == before or self._episode.plan != plan.digest:
                self._moved.wait(POLL)
                self._check()
                if time.monotonic() > end:
                    raise LoopLostError(f"{self.plant.name} did not begin the plan within {self._answer_timeout:g} s")
            return self._episode

    def _on_episode(self, message: KeyValue) -> None:
        with self._moved:
            self._episode = EpisodeLabel.parse(message.key)
            self._moved.notify()

    def _wait_for_end(self, outputs: EpisodeOutputs) -> None:
        received, moved = outputs.received, time.monotonic()
        with self._moved:
            while not (outputs.complete or outputs.cut):
                self._moved.wait(POLL)
                self._check()
                now = time.monotonic()
                if outputs.received != received:
                    received, moved = outputs.received, now
                elif now - moved > self._answer_timeout:
                    raise LoopLostError(f"no new output for {self._answer_timeout:g} s, after {received} of an episode")

    def _on_outputs(self, found: list[Taken]) -> None:
        outputs = self._outputs
        if outputs is None:
            return
        for taken in found:
            try:
                output = self._reader.read(taken.data)
            except ValueError:
                continue  # nothing that a plant has published
            outputs.take(EpisodeLabel.parse(output.frame_id), output.stamp_ns, output.position)
        if outputs.complete or outputs.cut:
            with self._moved:
                self._moved.notify()

    def _is_unchanged(self, gains: Gains) -> bool:
        """Whether the loop still is as it was set up, so that what was measured counts."""
        self.check_case()
        return self.controller.parameters(TUNED_PARAMETERS) == tuned_parameters(gains)


def tuned_parameters(gains: Gains) -> dict[str, Any]:
    """The controller's parameters that tuning changes."""
    values = {name: getattr(gains, name) for name in TUNED_PARAMETERS}
    return {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}


def _plant_parameters(case: Case) -> dict[str, Any]:
    """What the plant's parameters must be for the loop to be the case's."""
    effort_min, effort_max = case.effort_limits
    model = {name: case.plant_values.get(name, value) for name, value in model_parameters(case.model).items()}
    noise = {name: case.plant_values.get(name, one.default) for name, one in NOISE.items()}
    return {
        "mode": "lockstep",
        "model": case.model,
        "sample_period": case.sample_period,
        "effort_min": effort_min,
        "effort_max": effort_max,
        **model,
        **noise,
    }


def _compare(remote: TunedNode, wanted: dict[str, Any], case: str) -> None:
    # Another model has other parameters, and a node gives none if it lacks one: so these first.
    first = [name for name in ("mode", "model") if name in wanted]
    for names in (first, [name for name in wanted if name not in first]):
        found = remote.parameters(names) if names else {}
        for name, value in found.items():
            if value != wanted[name]:
                raise WrongCaseError(f"{remote.name} has {name} {value}, but {case} has {wanted[name]}")
