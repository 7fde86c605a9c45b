"""A node of a loop that is tuned: what it does not answer or refuses, told as tuning knows it."""

from __future__ import annotations

from typing import TypeVar

from tdof_npid_ros.graph.runtime.parameter_client import Question, RemoteNode, told_as
from tdof_npid_ros.tuning import TuningError
from tdof_npid_ros.tuning.live import LoopLostError

T = TypeVar("T")


class TunedNode(RemoteNode):
    """As `RemoteNode`, which see."""

    def wait(self, question: Question[T]) -> T:
        """The answer to a question.

        Raises:
            TuningError: the node refuses it, with its reason.
            LoopLostError: no answer within the timeout.
        """
        with told_as(LoopLostError, TuningError):
            return super().wait(question)
