"""What `set`, `get` and `reset` share: a client of a loop that runs."""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from tdof_npid_ros.names import meant_hint

if TYPE_CHECKING:
    from tdof_npid_ros.graph.observer import LoopObserver
    from tdof_npid_ros.graph.runtime.parameter_client import RemoteNode

FOUND = 5.0  # s until topics of a loop that runs have been found


def add_loop_arguments(parser: argparse.ArgumentParser, with_node: bool = True) -> None:
    """Add which loop, and which of its nodes."""
    parser.add_argument("--namespace", default="/", help="of the loop (default: /)")
    if with_node:
        parser.add_argument("--node", default="controller", help="default: controller")


class LoopClient:
    """A loop that runs, for a moment."""

    def __init__(self, observer: LoopObserver) -> None:
        self._observer = observer

    def remote(self, node: str) -> RemoteNode:
        """One of its nodes."""
        return self._observer.remote(node)

    def set_parameters(self, node: str, values: dict[str, Any]) -> None:
        """Set parameters together.

        Raises:
            ValueError: the node does not have one of them.
            RuntimeError: it refuses them, or does not answer.
        """
        self.check_names(node, values)
        self.remote(node).set_parameters(values)

    def check_names(self, node: str, names: Iterable[str]) -> None:
        """Make sure that a node has these parameters.

        Raises:
            ValueError: it does not; the message names the one that is meant.
        """
        known = self.remote(node).parameter_names()
        for name in names:
            if name not in known:
                raise ValueError(f"{node} has no parameter {name}{meant_hint(name, known)}")

    def publish(self, topic: str, value: float) -> None:
        """Publish a value once somebody hears it.

        Raises:
            RuntimeError: nobody does.
        """
        self._wait(lambda: self._observer.heard(topic), f"nobody in this namespace listens to {topic}: start the loop")
        self._observer.publish(topic, [value])
        self._observer.flush(topic)

    def setpoint(self) -> float:
        """The setpoint that the controller acts on, of the first lane.

        Raises:
            RuntimeError: no answer of it comes.
        """
        self._wait(lambda: self._observer.count > 0, "no control_effort comes: start the loop")
        rows, _ = self._observer.rows_since(self._observer.count - 1)
        return float(rows[-1].setpoint[0])

    def diagnostics(self) -> dict[str, str]:
        """What its nodes say of themselves, by their names.

        Raises:
            RuntimeError: none says anything.
        """
        self._wait(lambda: bool(self._observer.nodes), "no node of this namespace says anything: start the loop")
        time.sleep(1.2)  # each says so once a second
        return {name: state.text for name, state in sorted(self._observer.nodes.items())}

    @staticmethod
    def _wait(condition: Any, otherwise: str) -> None:
        end = time.monotonic() + FOUND
        while not condition():
            if time.monotonic() > end:
                raise RuntimeError(otherwise)
            time.sleep(0.02)


@contextmanager
def observed(namespace: str) -> Iterator[LoopObserver]:
    """A loop that runs, seen and steered through ROS 2 alone."""
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    from tdof_npid_ros.graph.observer import LoopObserver

    observer = LoopObserver(namespace)
    try:
        yield observer
    finally:
        observer.close()


@contextmanager
def client_of(arguments: argparse.Namespace) -> Iterator[LoopClient]:
    """A client of the loop that the arguments name.

    Raises:
        RuntimeError: none of that name answers, or it refuses what is asked; the message says what to do.
    """
    with observed(arguments.namespace) as observer:
        from tdof_npid_ros.graph.runtime.parameter_client import NoAnswerError

        try:
            yield LoopClient(observer)
        except NoAnswerError as error:
            raise RuntimeError(f"{error}: start the loop, or name the one that runs, as --namespace /live") from error
