"""The initial parameters of the loop's nodes, asked for once, so that a bag explains itself."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rcl_interfaces.msg import Parameter, ParameterEvent
from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.node import Node


class ParameterSnapshots:
    """Asks each node of a namespace for all its parameters and hands them over as a `ParameterEvent`."""

    def __init__(self, node: Node, take: Callable[[ParameterEvent], None]) -> None:
        self._node = node
        self._take = take
        self._asked: dict[str, Any] = {}

    def look(self) -> None:
        """Ask the nodes that have appeared since the last look."""
        namespace = self._node.get_namespace()
        for name, its_namespace in self._node.get_node_names_and_namespaces():
            full_name = f"{its_namespace.rstrip('/')}/{name}"
            if its_namespace == namespace and full_name not in self._asked and not name.startswith("_"):
                self._ask(full_name)

    def _ask(self, full_name: str) -> None:
        lister = self._node.create_client(ListParameters, f"{full_name}/list_parameters")
        getter = self._node.create_client(GetParameters, f"{full_name}/get_parameters")
        if not (lister.service_is_ready() and getter.service_is_ready()):
            self._node.destroy_client(lister)
            self._node.destroy_client(getter)
            return  # not up yet: the next look asks again
        self._asked[full_name] = (lister, getter)

        def listed(future: Any) -> None:
            names = list(future.result().result.names)
            getter.call_async(GetParameters.Request(names=names)).add_done_callback(lambda f: got(names, f))

        def got(names: list[str], future: Any) -> None:
            event = ParameterEvent(node=full_name, stamp=self._node.get_clock().now().to_msg())
            event.new_parameters = [
                Parameter(name=name, value=value) for name, value in zip(names, future.result().values, strict=True)
            ]
            self._take(event)

        lister.call_async(ListParameters.Request()).add_done_callback(listed)
