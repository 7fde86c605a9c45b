"""Conducts a running loop from outside: waits for its nodes, changes gains, plays its scenario."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from tdof_npid_ros.graph.runtime.messages import stamp_ns
from tdof_npid_ros.graph.runtime.middleware import use_fast_dds_profile

POLL = 0.02  # s


class LoopError(RuntimeError):
    """A loop that does not do what it was asked to."""


class Conductor:
    """A client of one loop's nodes.

    Args:
        namespace: of the loop.
        check: called while waiting; raises if waiting is in vain.
    """

    def __init__(self, namespace: str, check: Callable[[], None]) -> None:
        use_fast_dds_profile()
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)  # else Ctrl-C would end the context under our feet
        self._node = rclpy.create_node("conductor", namespace=namespace, start_parameter_services=False)
        self._check = check
        self._facts: dict[str, dict[str, str]] = {}
        self.time_ns = 0
        self._node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 100)
        self._node.create_subscription(Clock, "/clock", self._on_clock, 10)

    def close(self) -> None:
        """Leave the graph."""
        self._node.destroy_node()
        rclpy.try_shutdown()

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self._facts[status.name] = {pair.key: pair.value for pair in status.values}

    def _on_clock(self, message: Clock) -> None:
        self.time_ns = stamp_ns(message.clock)

    def fact(self, node: str, key: str) -> str:
        """What a node's diagnostics say of `key`; empty if nothing yet."""
        return self._facts.get(self._node.resolve_topic_name(node), {}).get(key, "")

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
            rclpy.spin_once(self._node, timeout_sec=POLL)

    def wait_for_subscriptions(self, counts: Mapping[str, int], timeout: float) -> None:
        """Wait until each topic has at least so many subscribers."""
        self.wait(
            lambda: all(self._node.count_subscribers(topic) >= count for topic, count in counts.items()),
            f"subscription of {', '.join(counts)}",
            timeout,
        )

    def set_parameters(self, node: str, parameters: Mapping[str, Any], timeout: float = 10.0) -> None:
        """Set a node's parameters as a whole.

        Raises:
            LoopError: refused, with the node's reason.
        """
        request = SetParametersAtomically.Request()
        request.parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in parameters.items()]
        result = self.call(SetParametersAtomically, f"{node}/set_parameters_atomically", request, timeout).result
        if not result.successful:
            raise LoopError(f"{node} refused {', '.join(parameters)}: {result.reason}")

    def trigger(self, service: str, timeout: float = 10.0) -> None:
        """Call a trigger service.

        Raises:
            LoopError: it reports a failure.
        """
        response = self.call(Trigger, service, Trigger.Request(), timeout)
        if not response.success:
            raise LoopError(f"{service}: {response.message}")

    def call(self, kind: Any, service: str, request: Any, timeout: float = 10.0) -> Any:
        """A service's answer.

        Args:
            kind: the service's type.

        Raises:
            LoopError: there is none within `timeout` seconds.
        """
        client = self._node.create_client(kind, service)
        try:
            self.wait(client.service_is_ready, f"the service {service}", timeout)
            future = client.call_async(request)
            self.wait(future.done, f"an answer of {service}", timeout)
            return future.result()
        finally:
            self._node.destroy_client(client)
