"""The initial parameters of the loop's nodes, asked for once, so that a bag explains itself."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rcl_interfaces.msg import Parameter, ParameterEvent
from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.node import Node

from tdof_npid_ros.names import in_namespace


class ParameterSnapshots:
    """Asks each node of a namespace for all its parameters and hands them over as a `ParameterEvent`.

    Args:
        take: gets each event and when its values were asked for, in ns since the epoch: a change that was published
            after that time is not older than the values.
    """

    def __init__(self, node: Node, take: Callable[[ParameterEvent, int], None]) -> None:
        self._node = node
        self._take = take
        self._asked: dict[str, list[Any]] = {}

    def look(self) -> None:
        """Ask the nodes that have appeared since the last look, also those that come back."""
        namespace = in_namespace(self._node.get_namespace())
        present = {in_namespace(its, name) for name, its in self._node.get_node_names_and_namespaces()}
        for gone in self._asked.keys() - present:
            self._forget(gone)
        for full_name in present - self._asked.keys():
            if full_name.startswith(namespace) and not full_name.rpartition("/")[2].startswith("_"):
                self._ask(full_name)

    def _ask(self, full_name: str) -> None:
        lister = self._node.create_client(ListParameters, f"{full_name}/list_parameters")
        getter = self._node.create_client(GetParameters, f"{full_name}/get_parameters")
        if not (lister.service_is_ready() and getter.service_is_ready()):
            self._node.destroy_client(lister)
            self._node.destroy_client(getter)
            return  # not up yet: the next look asks again
        self._asked[full_name] = [lister, getter]
        asked_ns = 0

        def listed(future: Any) -> None:
            nonlocal asked_ns
            if self._asked.get(full_name) != [lister, getter]:
                return  # the node has gone, or the recorder has stopped
            asked_ns = time.time_ns()
            names = list(future.result().result.names)
            getter.call_async(GetParameters.Request(names=names)).add_done_callback(lambda f: got(names, f))

        def got(names: list[str], future: Any) -> None:
            values = future.result().values
            if len(values) < len(names):  # one was undeclared in between
                self._forget(full_name)
                return
            event = ParameterEvent(node=full_name, stamp=self._node.get_clock().now().to_msg())
            event.new_parameters = [
                Parameter(name=name, value=value) for name, value in zip(names, values, strict=True)
            ]
            self._take(event, asked_ns)

        lister.call_async(ListParameters.Request()).add_done_callback(listed)

    def stop(self) -> None:
        """Ask nobody any more."""
        for full_name in list(self._asked):
            self._forget(full_name)

    def _forget(self, full_name: str) -> None:
        for client in self._asked.pop(full_name):
            self._node.destroy_client(client)
