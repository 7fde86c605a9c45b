"""Another node's parameters and services, called from a thread that may block while the executor spins elsewhere."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rcl_interfaces.srv import GetParameters, SetParametersAtomically
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python

from tdof_npid_ros.graph.runtime.node import plain
from tdof_npid_ros.tuning import TuningError
from tdof_npid_ros.tuning.live import LoopLostError

RESEND = 4.0  # s until a request is sent again, longer than DDS takes to repair a loss; all here may arrive twice


class RemoteNode:
    """One node of a loop, as its client sees it.

    Args:
        node: through which the calls go.
        name: full name of the other node.
        answer_timeout: s until a silent node counts as lost.
        check: called while waiting; raises to give up.
    """

    def __init__(self, node: Node, name: str, answer_timeout: float, check: Callable[[], None]) -> None:
        self.name = name
        self._node = node
        self._answer_timeout = answer_timeout
        self._check = check
        self._clients: dict[str, Any] = {}

    def destroy(self) -> None:
        """Leave the graph."""
        for client in self._clients.values():
            self._node.destroy_client(client)

    def parameters(self, names: Sequence[str]) -> dict[str, Any]:
        """Parameters by name; all are None if the node does not have one of them.

        Raises:
            LoopLostError: no answer.
        """
        request = GetParameters.Request(names=list(names))
        values = self.call(GetParameters, f"{self.name}/get_parameters", request).values
        if len(values) != len(names):
            return dict.fromkeys(names)
        return {name: plain(parameter_value_to_python(value)) for name, value in zip(names, values, strict=True)}

    def set_parameters(self, values: Mapping[str, Any]) -> None:
        """Set parameters as a whole.

        Raises:
            TuningError: refused, with the node's reason.
            LoopLostError: no answer.
        """
        result = self.call(*self._setting(values)).result
        if not result.successful:
            raise TuningError(f"{self.name} refused {', '.join(values)}: {result.reason}")

    def request_parameters(self, values: Mapping[str, Any]) -> None:
        """Ask for parameters to be set, without waiting for the answer."""
        kind, service, request = self._setting(values)
        self._client(kind, service).call_async(request)

    def _setting(self, values: Mapping[str, Any]) -> tuple[Any, str, Any]:
        parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        request = SetParametersAtomically.Request(parameters=parameters)
        return SetParametersAtomically, f"{self.name}/set_parameters_atomically", request

    def call(self, kind: Any, service: str, request: Any) -> Any:
        """The answer of a service.

        Raises:
            LoopLostError: no answer.
        """
        client = self._client(kind, service)
        end = time.monotonic() + self._answer_timeout
        while time.monotonic() < end:
            self._check()
            if not client.service_is_ready():
                time.sleep(0.02)
                continue
            answered = threading.Event()
            future = client.call_async(request)
            future.add_done_callback(lambda _, answered=answered: answered.set())
            if answered.wait(min(RESEND, end - time.monotonic())):
                return future.result()
            client.remove_pending_request(future)
        raise LoopLostError(f"{service} did not answer within {self._answer_timeout:g} s")

    def _client(self, kind: Any, service: str) -> Any:
        if service not in self._clients:
            self._clients[service] = self._node.create_client(kind, service)
        return self._clients[service]
