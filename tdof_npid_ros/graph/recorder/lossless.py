"""`lossless`: the loop in lockstep is never faster than its log.

The recorder tells on `recorded` the stamp that the log of output and answers has reached. The plant keeps at most
`WINDOW` steps ahead of it, fewer than the messages that publishers keep for a slow reader; so none is overwritten.
An episode begins and ends with its first and its last answer in the log.
"""

from __future__ import annotations

from collections.abc import Callable

from tdof_npid_ros.graph.runtime.node import LoopNode
from tdof_npid_ros.graph.runtime.qos import SIGNAL_QOS
from tdof_npid_ros.wire import Sample

TOPIC = "recorded"
WINDOW = 600  # steps; publishers keep 1000 messages
NO_LOG = "stopped"  # what `recorded` bears when the recorder has given up: the loop goes on without


class Log:
    """What the plant knows of the log.

    Args:
        grown: called when the log has grown.
    """

    def __init__(self, node: LoopNode, period_ns: int, grown: Callable[[], None]) -> None:
        self._window_ns = WINDOW * period_ns
        self._grown = grown
        self._episode, self._stamp_ns = "", 0
        node.subscribe_signal(TOPIC, self._on_recorded, SIGNAL_QOS)

    def holds(self, episode: str, time_ns: int) -> bool:
        """Whether the output of that time and its answer are in the log."""
        return self._episode == NO_LOG or (self._episode == episode and self._stamp_ns >= time_ns)

    def is_near(self, time_ns: int) -> bool:
        """Whether the output of `time_ns` of an episode that has begun may be published."""
        return self._episode == NO_LOG or time_ns - self._stamp_ns < self._window_ns

    def _on_recorded(self, sample: Sample) -> None:
        self._episode, self._stamp_ns = sample.frame_id, sample.stamp_ns
        self._grown()
