"""The loops that a tuner has: which answer, which are the right case, and what is left on them at the end."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node

from tdof_npid_ros.control.gains import Gains
from tdof_npid_ros.graph.runtime.messages import node_of
from tdof_npid_ros.graph.tuner.loop_client import LoopClient, WrongCaseError
from tdof_npid_ros.graph.tuner.patience import POLL, Patience
from tdof_npid_ros.names import in_namespace
from tdof_npid_ros.tuning import TuningError
from tdof_npid_ros.tuning.ask_tell import Array, Scores
from tdof_npid_ros.tuning.live import LoopLostError, measure
from tdof_npid_ros.tuning.objective import scores
from tdof_npid_ros.tuning.problem import TuningProblem

OWN_LOOP, EVERY_LOOP = ".", "*"
GATHERING = 2.5  # s at the start for all loops to be heard: two of their reports and a little


@dataclass
class _Loop:
    """A loop that was heard of.

    Attributes:
        before: the gains that it had before the tuning; None until it was first used.
        out_since: when it was lost or refused (monotonic, s); it may come back once it is heard again.
        why_out: and why; empty for one that is in use.
        refused: it is not the case that is tuned.
    """

    client: LoopClient
    before: Gains | None = None
    out_since: float = -math.inf
    why_out: str = "not heard of yet"
    refused: bool = False


class LoopPool:
    """Evaluates candidates on every loop that can be used.

    A loop is used once its plant and its controller have been heard on /diagnostics since it was lost, and while it is
    the case that is tuned.

    Args:
        node: through which everything goes; its executor spins in another thread.
        problem: what is tuned.
        loops: namespaces; `.` is the node's own, `*` every one that is heard.
        patience: with which they are waited for.
    """

    def __init__(
        self,
        node: Node,
        problem: TuningProblem,
        loops: Sequence[str],
        patience: Patience,
    ) -> None:
        self._node = node
        self._problem = problem
        self._finds_loops = EVERY_LOOP in loops
        self._patience = patience
        self._heard: dict[str, float] = {}  # when each node was heard last (monotonic, s)
        self._gathered = 0.0  # when the tuning does not wait for further loops any more (monotonic, s)
        self._loops: dict[str, _Loop] = {}
        for loop in loops:
            if loop != EVERY_LOOP:
                self._add(node.get_namespace() if loop == OWN_LOOP else loop)
        self._subscription = node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 100)

    @property
    def in_use(self) -> list[str]:
        """Namespaces of the loops in use."""
        return [namespace for namespace, loop in self._loops.items() if not loop.why_out]

    def evaluate(self, candidates: Array) -> Scores:
        """The scores of candidates (n, gains).

        Raises:
            TuningError: no loop can be used, or a controller refused a gain.
        """
        return scores(self._problem, candidates, *measure(candidates, self._usable, self._on_lost))

    def restore(self, gains: Gains | None, objective: float) -> tuple[Gains | None, bool]:
        """Set these gains, or those before the tuning, and one lane on every loop in use.

        Returns:
            The gains, and whether all loops in use have what they are to have; one at least, if any ever was.
        """
        failed = not self.in_use and any(loop.before is not None for loop in self._loops.values())
        for namespace in self.in_use:
            loop = self._loops[namespace]
            try:
                loop.client.apply(gains or loop.before or self._problem.case.gains)
            except (LoopLostError, TuningError) as error:
                failed = True
                self._node.get_logger().error(f"loop {namespace} is left as it is: {error}")
        return gains, not failed

    def close(self) -> None:
        """Leave the graph; no executor may spin the node now."""
        for loop in self._loops.values():
            loop.client.destroy()

    # Which loops

    def _add(self, namespace: str) -> None:
        name = in_namespace(namespace).rstrip("/") or "/"
        client = LoopClient(self._node, name, self._problem, self._patience.for_an_answer, self._patience.check)
        self._loops[name] = _Loop(client)

    def _usable(self) -> list[LoopClient]:
        """The loops to use now; waits for one."""
        end = time.monotonic() + self._patience.for_a_loop
        self._gathered = self._gathered or time.monotonic() + GATHERING
        while True:
            self._patience.check()
            self._find()
            for namespace, loop in self._loops.items():
                if loop.why_out and self._is_heard(namespace):
                    self._join(namespace, loop)
            usable = [loop.client for loop in self._loops.values() if not loop.why_out]
            if usable and (time.monotonic() > self._gathered or self._knows_all()):
                return usable
            if time.monotonic() > end or self._knows_all():
                raise TuningError(f"no loop to tune: {self._why_none()}")
            time.sleep(POLL)

    def _knows_all(self) -> bool:
        """Whether no other loop is expected."""
        return not self._finds_loops and all(loop.refused or not loop.why_out for loop in self._loops.values())

    def _find(self) -> None:
        if self._finds_loops:
            plants = {name.removesuffix("/plant") for name in list(self._heard) if name.endswith("/plant")}
            for namespace in sorted(plants):
                if f"{namespace}/controller" in self._heard and (namespace or "/") not in self._loops:
                    self._add(namespace)

    def _is_heard(self, namespace: str) -> bool:
        """Whether plant and controller have been heard since the loop was lost."""
        names = [in_namespace(namespace, node) for node in ("plant", "controller")]
        return all(self._heard.get(name, -math.inf) > self._loops[namespace].out_since for name in names)

    def _join(self, namespace: str, loop: _Loop) -> None:
        try:
            loop.client.check_case()
            before = loop.client.gains()
        except LoopLostError as error:
            self._put_out(namespace, error)
            return
        if loop.before is None and before.lanes == 1:
            loop.before = before
        loop.why_out, loop.refused = "", False
        self._node.get_logger().info(f"loop {namespace} is used")

    def _on_lost(self, client: LoopClient, error: LoopLostError) -> None:
        self._put_out(client.namespace, error)

    def _put_out(self, namespace: str, error: LoopLostError) -> None:
        loop = self._loops[namespace]
        loop.refused = isinstance(error, WrongCaseError)
        if loop.why_out != str(error):
            self._node.get_logger().warning(f"loop {namespace} is {'refused' if loop.refused else 'lost'}: {error}")
        loop.why_out, loop.out_since = str(error), time.monotonic()

    def _why_none(self) -> str:
        if not self._loops:
            return "no plant and controller are heard on /diagnostics: start them"
        return "; ".join(f"{namespace}: {loop.why_out}" for namespace, loop in self._loops.items())

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self._heard[node_of(status)] = time.monotonic()
