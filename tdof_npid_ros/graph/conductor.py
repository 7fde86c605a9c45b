"""Conducts a running loop from outside: waits for its nodes, changes gains, plays its scenario."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState

from tdof_npid_ros.graph.runtime.messages import given_message, node_of, stamp_ns
from tdof_npid_ros.graph.runtime.middleware import use_fast_dds_profile
from tdof_npid_ros.graph.runtime.parameter_client import RefusedError, RemoteNode
from tdof_npid_ros.graph.runtime.qos import LATCHED_QOS
from tdof_npid_ros.names import in_namespace
from tdof_npid_ros.wire import EpisodeLabel

POLL = 0.02  # s between two looks at what is waited for
FOUND = 3.0  # s in which a new publisher is found by those who listen


class LoopError(RuntimeError):
    """A loop that does not do what it was asked to."""


class Conductor:
    """A client of one loop's nodes. It spins while it waits, so one thread is enough.

    Args:
        namespace: of the loop.
        check: called while waiting; raises if waiting is in vain.

    Attributes:
        node: its node, for publishers and subscriptions of one's own; they are served while it waits.
        time_ns: of the present episode, as /clock tells.
        label, phase: what the plant says of its episode; None and empty before it has said anything.
    """

    def __init__(self, namespace: str, check: Callable[[], None]) -> None:
        use_fast_dds_profile()
        self._context = rclpy.Context()  # its own: a script may have another; Ctrl-C does not end it under our feet
        rclpy.init(context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        self.node = rclpy.create_node(
            "conductor", namespace=namespace, context=self._context, start_parameter_services=False
        )
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._check = check
        self._facts: dict[str, dict[str, str]] = {}
        self._warnings: dict[str, str] = {}
        self._remotes: dict[str, RemoteNode] = {}
        self._publishers: dict[str, Any] = {}
        self.time_ns = 0
        self._began_ns: int | None = None  # on /clock: the episode
        self.label: EpisodeLabel | None = None
        self.phase = ""
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 100)
        self.node.create_subscription(Clock, "/clock", self._on_clock, 10)
        self.node.create_subscription(KeyValue, "episode", self._on_episode, LATCHED_QOS)

    def close(self) -> None:
        """Leave the graph."""
        nodes = self._executor.get_nodes()
        self._executor.shutdown()
        for node in nodes:
            node.destroy_node()
        rclpy.shutdown(context=self._context)

    def add_node(self, node: Node) -> None:
        """Serve a further node of this context while it waits, and destroy it at the end."""
        self._executor.add_node(node)

    def remote(self, node: str) -> RemoteNode:
        """One of the loop's nodes, `controller` say: its parameters and services."""
        if node not in self._remotes:
            name = self.node.resolve_topic_name(node)
            self._remotes[node] = RemoteNode(self.node, name, check=self._check, pass_time=self._spin)
        return self._remotes[node]

    # What it hears

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self._facts[node_of(status)] = {pair.key: pair.value for pair in status.values}
            self._warnings[node_of(status)] = "" if status.level == DiagnosticStatus.OK else status.message

    def _on_clock(self, message: Clock) -> None:
        now_ns = stamp_ns(message.clock)
        if self._began_ns is None:  # in lockstep the loop's time is that of the episode
            self._began_ns = 0 if self.label is None or self.label.plan else now_ns
        self.time_ns = now_ns - self._began_ns

    def _on_episode(self, message: KeyValue) -> None:
        label, self.phase = EpisodeLabel.parse(message.key), message.value
        if label != self.label:
            self.label, self._began_ns = label, None

    @property
    def episodes_finished(self) -> int:
        """How many episodes the plant in lockstep has run to their end since its activation."""
        if self.label is None:
            return 0
        return self.label.number - (self.phase != "finished" and self.label.number > 0)

    def fact(self, node: str, key: str) -> str:
        """A figure in a node's latest diagnostics; empty if there is none yet."""
        return self._facts.get(self.node.resolve_topic_name(node), {}).get(key, "")

    def complaints(self) -> list[str]:
        """What the loop's nodes warn of in their latest diagnostics, each with the node's name."""
        inside = in_namespace(self.node.get_namespace())
        return [f"{name}: {text}" for name, text in self._warnings.items() if text and name.startswith(inside)]

    # Waiting

    def wait(self, condition: Callable[[], bool], what: str, timeout: float) -> None:
        """Serve callbacks until a condition holds.

        Raises:
            LoopError: it does not within `timeout` seconds.
        """
        end = time.monotonic() + timeout
        while not condition():
            self._check()
            if time.monotonic() > end:
                raise LoopError(f"{what} did not happen within {timeout:g} s")
            self._executor.spin_once(timeout_sec=POLL)

    def wait_for_subscriptions(self, counts: Mapping[str, int], timeout: float) -> None:
        """Wait until each topic has at least so many subscribers."""
        self.wait(
            lambda: all(self.node.count_subscribers(topic) >= count for topic, count in counts.items()),
            f"subscription of {', '.join(counts)}",
            timeout,
        )

    # Asking for something

    def set_parameters(self, node: str, parameters: Mapping[str, Any]) -> None:
        """Set a node's parameters as a whole.

        Raises:
            RefusedError: with the node's reason.
            NoAnswerError: it does not answer.
        """
        self.remote(node).set_parameters(parameters)

    def prepare_to_publish(self, *topics: str) -> None:
        """Let those who listen to these topics find their publisher ahead: whoever has not found it hears nothing."""
        for topic in topics:
            if topic not in self._publishers:
                self._publishers[topic] = self.node.create_publisher(JointState, topic, 10)

    def publish(self, topic: str, values: Sequence[float], joints: Sequence[str], timeout: float) -> None:
        """Give a setpoint, a disturbance or a manual effort on its topic, once somebody hears it.

        Args:
            joints: which of the joints a setpoint is for; none: all.

        Raises:
            LoopError: nobody does within `timeout` seconds.
        """
        self.prepare_to_publish(topic)
        publisher, patient_until = self._publishers[topic], time.monotonic() + FOUND

        def is_heard() -> bool:
            """By all who listen, as far as they can be had: by the controller, not by a recorder alone."""
            heard = publisher.get_subscription_count()
            return bool(heard) and (heard >= self.node.count_subscribers(topic) or time.monotonic() > patient_until)

        self.wait(is_heard, f"subscription of {topic}", timeout)
        publisher.publish(given_message(topic, values, self.node, joints))

    def play(self, timeout: float) -> None:
        """Let the scenario play its episodes, once it has ended those that it plays now; returns when it has begun.

        Raises:
            LoopError: it has not within `timeout` seconds.
        """
        before = self.label
        scenario = self.remote("scenario")
        asked = scenario.ask_trigger("play")

        def begun() -> bool:
            nonlocal asked
            if not asked.look():
                return self.label != before
            try:
                return bool(asked.answer)
            except RefusedError:  # still playing
                asked = scenario.ask_trigger("play")
                return False

        self.wait(begun, "the scenario's beginning", timeout)

    def _spin(self, event: threading.Event, seconds: float) -> None:
        self._executor.spin_once(timeout_sec=seconds)
