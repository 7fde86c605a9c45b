"""`lossless`: the loop is never faster than its log."""

from __future__ import annotations

from typing import Any

import rclpy
from rclpy.duration import Duration
from rclpy.publisher import Publisher

from tdof_npid_ros.graph.node import LoopNode

WINDOW = 250  # messages that may be on the way; publishers keep 1000 for readers that have not got them yet
PATIENCE = Duration(seconds=1)  # until the node says that it waits


class Pace:
    """Holds a node up until every reliable reader of its publishers has what was published.

    A reader that keeps all (the recorder's) acknowledges nothing more while 5000 messages wait to be read. So neither
    the way to it nor its memory can lose a message.

    Args:
        readers: how many each publisher must have before the first message: the loop's own, and the recorder.
    """

    def __init__(self, node: LoopNode, publishers: list[Publisher], readers: int = 2) -> None:
        self._node = node
        self._publishers = publishers
        self._readers = readers
        self._published = 0

    @property
    def may_begin(self) -> bool:
        """Whether the recorder is there."""
        return all(publisher.get_subscription_count() >= self._readers for publisher in self._publishers)

    def hold(self) -> None:
        """Call it after each message."""
        self._published += 1
        if self._published % WINDOW:
            return
        for publisher in self._publishers:
            self._wait(publisher)

    def _wait(self, publisher: Any) -> None:
        while rclpy.ok() and not publisher.wait_for_all_acked(PATIENCE):
            self._node.refuse("held_up", f"lossless: waiting until all readers of {publisher.topic_name} have read")
