"""The initial parameters of the loop's nodes, asked for once, so that a bag explains itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rcl_interfaces.msg import Parameter, ParameterEvent
from rclpy.node import Node

from tdof_npid_ros.graph.runtime.parameter_client import Question, RemoteNode
from tdof_npid_ros.names import in_namespace

SERVICE = "/list_parameters"  # ends the name of a service that every node with parameters has


@dataclass
class _Asked:
    """A node that is asked, or was.

    Attributes:
        servers: how many serve its parameters, so that one that comes back is noticed.
        question: the latest.
    """

    remote: RemoteNode
    servers: int
    question: Question[Any]


class ParameterSnapshots:
    """Asks each node of a namespace for all its parameters and hands them over as a `ParameterEvent`.

    Which nodes there are, it knows from their services: one that has left may stay on the list of nodes for ever.

    Args:
        take: gets each event and when its values were asked for, in ns since the epoch: a change that was published
            after that time is not older than the values.
    """

    def __init__(self, node: Node, take: Callable[[ParameterEvent, int], None]) -> None:
        self._node = node
        self._take = take
        self._asked: dict[str, _Asked] = {}

    def look(self) -> None:
        """Ask the nodes that have appeared since the last look, also those that come back."""
        present = self._present()
        for gone in self._asked.keys() - present.keys():
            self._forget(gone)
        for name, servers in present.items():
            asked = self._asked.get(name)
            if asked is None or servers > asked.servers:
                self._ask(name, servers)
            else:
                asked.servers = servers
                asked.question.look()

    def stop(self) -> None:
        """Ask nobody any more."""
        for name in list(self._asked):
            self._forget(name)

    def _present(self) -> dict[str, int]:
        """The nodes of the namespace by their full names, and how many serve each one's parameters."""
        namespace = in_namespace(self._node.get_namespace())
        services = [service for service, _ in self._node.get_service_names_and_types() if service.endswith(SERVICE)]
        names = [service.removesuffix(SERVICE) for service in services]
        return {
            name: self._node.count_services(name + SERVICE)
            for name in names
            if name.startswith(namespace) and not name.rpartition("/")[2].startswith("_")
        }

    def _ask(self, name: str, servers: int) -> None:
        if name in self._asked:
            self._forget(name)
        remote = RemoteNode(self._node, name)
        names = remote.ask_names()
        asked = self._asked[name] = _Asked(remote, servers, names)
        names.then(lambda: self._ask_values(asked, names.answer))

    def _ask_values(self, asked: _Asked, names: list[str]) -> None:
        values = asked.remote.ask_values(names)
        asked.question = values
        values.then(lambda: self._hand_over(asked, names, values))

    def _hand_over(self, asked: _Asked, names: list[str], values: Question[Any]) -> None:
        if len(values.answer) < len(names):  # one was undeclared in between
            asked.servers = 0  # so it is asked again
            return
        event = ParameterEvent(node=asked.remote.name, stamp=self._node.get_clock().now().to_msg())
        event.new_parameters = [
            Parameter(name=name, value=value) for name, value in zip(names, values.answer, strict=True)
        ]
        self._take(event, values.asked_ns)

    def _forget(self, name: str) -> None:
        asked = self._asked.pop(name)
        asked.question.drop()
        asked.remote.destroy()
