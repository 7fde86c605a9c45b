"""One loop, seen and steered from outside through ROS 2 alone: its signals as they come, its parameters, its services.

A thread of its own takes the messages, so whoever looks on may be as slow as he likes: the loop never waits for him.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState

from tdof_npid_ros.control.joints import Joints
from tdof_npid_ros.control.law import TERMS
from tdof_npid_ros.graph.runtime.messages import given_message, node_of
from tdof_npid_ros.graph.runtime.middleware import use_fast_dds_profile
from tdof_npid_ros.graph.runtime.parameter_client import RemoteNode
from tdof_npid_ros.graph.runtime.tap import Taken, Tap, TapThread
from tdof_npid_ros.wire import JOINT_STATE, SECOND, Sample, SignalReader

KEPT = 20_000  # rows that are kept for those who look on
# Who looks on takes what comes; the loop's writers never repeat anything for him.
LOOKING_ON = QoSProfile(depth=2000, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.BEST_EFFORT)
TOLD = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
NODES = ("plant", "controller", "scenario", "tuner", "recorder")
T = TypeVar("T")
WITHOUT_ANSWER = 1.0  # s after which a loop counts as standing still


class Row(NamedTuple):
    """One answer of the controller with what it answers.

    Attributes:
        time: s, of the loop; goes on where an episode begins again.
        episode: counts the episodes that were seen; 0 for the first.
        setpoint, output, effort, applied: (lanes,); `applied` is empty where the plant tells none. Of a robot's output,
            the joints that the controller has.
        stamp_ns: of the output.
    """

    time: float
    episode: int
    setpoint: np.ndarray
    output: np.ndarray
    effort: np.ndarray
    applied: np.ndarray
    stamp_ns: int


class Terms(NamedTuple):
    """What an answer is made of.

    Attributes:
        time: s, as in `Row`.
        values: (terms, lanes), in the order of `control.law.TERMS`.
    """

    time: float
    values: np.ndarray


@dataclass
class NodeState:
    """What a node's diagnostics say."""

    level: int
    text: str
    facts: dict[str, str]
    seen: float


class LoopObserver:
    """A client of one loop's nodes, in its own threads.

    Args:
        namespace: of the loop.

    Attributes:
        rows: the latest answers, oldest first; `count` of them have come in all.
        terms: what they are made of; `term_count` have come in all.
        lane_names: of the loop's lanes, as its output names them, or their numbers; empty before it has been heard.
        nodes: what the nodes' diagnostics say, by the node's name without its namespace.
    """

    def __init__(self, namespace: str) -> None:
        use_fast_dds_profile()
        self._context = rclpy.Context()
        rclpy.init(context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        self.node = rclpy.create_node(
            "observer", namespace=namespace, context=self._context, start_parameter_services=False
        )
        self._lock = threading.Lock()
        self.rows: deque[Row] = deque(maxlen=KEPT)
        self.terms: deque[Terms] = deque(maxlen=KEPT)
        self.count = self.term_count = 0
        self.lane_names: tuple[str, ...] = ()
        self.nodes: dict[str, NodeState] = {}
        self._outputs: dict[int, Sample] = {}
        self._early: dict[int, Sample] = {}  # answers whose output, sent to the controller first, is not here yet
        self._labels: dict[str, int] = {}
        self._label: str | None = None  # of the latest output; a robot may bear none
        self._base = self._last = 0.0  # s: when the present label came, and the latest answer
        self._began_ns = 0  # the label's first stamp
        self._latest_answer = 0.0
        self._remotes: dict[str, RemoteNode] = {}
        self._publishers = {
            topic: self.node.create_publisher(JointState, topic, TOLD) for topic in ("setpoint", "disturbance")
        }
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 100)
        self._readers = {topic: SignalReader() for topic in ("output", "control_effort", "controller_state")}
        self._taps = [
            Tap(self.node, self.node.resolve_topic_name(topic), JOINT_STATE, LOOKING_ON) for topic in self._readers
        ]
        self._take_from = {tap: topic for tap, topic in zip(self._taps, self._readers, strict=True)}
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._stopping = False
        self._spinner = threading.Thread(target=self._spin, name="observer", daemon=True)
        self._spinner.start()
        self._tap_thread = TapThread(self._take, self._hand_over)

    def close(self) -> None:
        """Leave the graph; the loop stays as it is."""
        self._tap_thread.stop()
        self._stopping = True
        self._spinner.join()
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)

    def _spin(self) -> None:
        while not self._stopping:
            try:
                self._executor.spin_once(timeout_sec=0.1)
            except ExternalShutdownException:
                return

    # What it hears

    def _take(self) -> list[Taken]:
        """Answers are taken before outputs but handed over after them, so that each one's output is there."""
        taken = [tap.take() for tap in reversed(self._taps)]
        return [message for messages in reversed(taken) for message in messages]

    def _hand_over(self, messages: list[Taken]) -> None:
        with self._lock:
            for message in messages:
                topic = self._take_from[message.tap]
                try:
                    sample = self._readers[topic].read(message.data)
                except ValueError:
                    continue  # the nodes refuse it, and tell
                if topic == "output":
                    _keep(self._outputs, sample)
                    if (early := self._early.get(sample.stamp_ns)) is not None:
                        self._take_answer(early)
                elif topic == "control_effort":
                    self._take_answer(sample)
                elif len(sample.position) % len(TERMS) == 0:
                    self.terms.append(Terms(self._time_of(sample), sample.position.reshape(len(TERMS), -1)))
                    self.term_count += 1

    def _take_answer(self, answer: Sample) -> None:
        output = self._outputs.pop(answer.stamp_ns, None)
        if output is None:
            _keep(self._early, answer)
            return
        self._early.clear()  # the others' outputs came before this one, or never will
        if output.frame_id != self._label:
            self._label, self._began_ns = output.frame_id, answer.stamp_ns
            self._base = self._last
            self._labels[self._label] = len(self._labels)
        self._last = self._time_of(answer)
        if len(answer.name) == len(answer.effort):
            self.lane_names = answer.name
        elif len(self.lane_names) != len(answer.effort):
            self.lane_names = tuple(map(str, range(len(answer.effort))))
        self._latest_answer = time.monotonic()
        try:
            y, applied = lanes_of(output, answer)
        except ValueError:
            return  # another robot's
        self.rows.append(
            Row(self._last, self._labels[self._label], answer.position, y, answer.effort, applied, answer.stamp_ns)
        )
        self.count += 1

    def _time_of(self, sample: Sample) -> float:
        return self._base + (sample.stamp_ns - self._began_ns) / SECOND

    def rows_since(self, count: int) -> tuple[list[Row], int]:
        """The answers after the first `count` ones, as far as they are kept, and how many there have been in all."""
        with self._lock:
            return _latest(self.rows, self.count - count), self.count

    def terms_since(self, count: int) -> tuple[list[Terms], int]:
        """What the answers are made of, likewise."""
        with self._lock:
            return _latest(self.terms, self.term_count - count), self.term_count

    @property
    def latest(self) -> Row | None:
        """The latest answer."""
        with self._lock:
            return self.rows[-1] if self.rows else None

    @property
    def runs(self) -> bool:
        """Whether answers are coming."""
        return time.monotonic() - self._latest_answer < WITHOUT_ANSWER

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        namespace = self.node.get_namespace().rstrip("/") + "/"
        for status in message.status:
            name = node_of(status)
            if name.startswith(namespace) and (short := name.removeprefix(namespace)) in NODES:
                facts = {pair.key: pair.value for pair in status.values}
                self.nodes[short] = NodeState(status.level[0], status.message, facts, time.monotonic())

    # What it does

    def remote(self, node: str) -> RemoteNode:
        """One of the loop's nodes: its parameters and services."""
        if node not in self._remotes:
            self._remotes[node] = RemoteNode(self.node, self.node.resolve_topic_name(node), timeout=5.0)
        return self._remotes[node]

    def publish(self, topic: str, values: Sequence[float]) -> None:
        """Give a setpoint or a disturbance on its topic: one value, or one per lane."""
        self._publishers[topic].publish(given_message(topic, values, self.node))

    def heard(self, topic: str) -> bool:
        """Whether somebody listens to what is published on a topic."""
        return bool(self._publishers[topic].get_subscription_count())

    def flush(self, topic: str) -> None:
        """Wait until what was published has been received."""
        self._publishers[topic].wait_for_all_acked(Duration(seconds=2.0))


def lanes_of(output: Sample, answer: Sample) -> tuple[np.ndarray, np.ndarray]:
    """Position and effort of an output, (lanes,), in the order of the lanes of its answer.

    Raises:
        ValueError: there are not those lanes in it.
    """
    y, applied = output.position, output.effort
    if output.name == answer.name:
        return y, applied
    if len(y) == len(answer.effort) and not set(answer.name) <= set(output.name):
        return y, applied  # the lanes bear other names here and there
    joints = Joints(answer.name)
    return joints.selected(output.name, y), joints.selected(output.name, applied)


def _keep(kept: dict[int, Sample], sample: Sample) -> None:
    """Keep a sample by its stamp, and of many the latest ones."""
    kept[sample.stamp_ns] = sample
    if len(kept) > LOOKING_ON.depth:
        del kept[next(iter(kept))]


def _latest(kept: deque[T], number: int) -> list[T]:
    """So many of the last ones, as far as they are kept."""
    number = min(number, len(kept))
    return [kept[i] for i in range(-number, 0)]
