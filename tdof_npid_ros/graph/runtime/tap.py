"""Raw subscriptions that are emptied by a thread of their own, with publish and receive times.

An executor wakes for every message, which costs several times the message. Here a thread sleeps a few milliseconds,
then takes whatever has come in the meantime.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Sequence
from operator import itemgetter
from typing import Any, NamedTuple

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile

from tdof_npid_ros.graph.runtime.sequences import Sequences
from tdof_npid_ros.interfaces import message_class
from tdof_npid_ros.wire import EpisodeLabel, SignalReader

SHORTEST_PAUSE = 0.005  # s between two looks while messages come
LONGEST_PAUSE = 0.1  # s between two looks while nothing comes; DDS keeps 5000 messages for each subscription
MOST_AT_ONCE = 5000  # messages of one topic in one look, so that all topics get their turn


class Taken(NamedTuple):
    """A message as it came: serialized, times in ns since the epoch, the publisher's count (0: not known)."""

    received_ns: int
    published_ns: int
    sequence: int
    tap: Tap
    data: bytes


class _NotForExecutors(MutuallyExclusiveCallbackGroup):  # type: ignore[misc]  # rclpy has no type hints
    """A callback group that no executor serves: even its events would wake one for every message."""

    def can_execute(self, entity: Any) -> bool:
        return False


class Tap:
    """One topic's subscription.

    Attributes:
        received: messages taken.
    """

    def __init__(self, node: Node, topic: str, type_name: str, qos: QoSProfile) -> None:
        self.topic = topic
        self.qos = qos
        self.received = 0
        self._sequences = Sequences()
        self._reported_lost = 0
        self._publishers = 1  # at most so far
        self.type_name = type_name
        self._node = node
        self._type = message_class(type_name)
        self._subscription = node.create_subscription(
            self._type,
            topic,
            _never_called,
            qos,
            raw=True,
            callback_group=_NotForExecutors(),
            event_callbacks=SubscriptionEventCallbacks(message_lost=_never_called, use_default_callbacks=False),
        )

    @property
    def missed(self) -> int:
        """Messages that publishers had sent before the subscription reached them."""
        return self._sequences.missed

    @property
    def lost(self) -> int:
        """Messages lost so far: that DDS reports, or that gaps in the publishers' counts show to be."""
        for event in self._subscription.event_handlers:
            event._ready_to_take_data = True  # what an executor's wait set would have said
            self._reported_lost = event.take_data().total_count
        self._publishers = max(self._publishers, self._node.count_publishers(self.topic))
        return max(self._reported_lost, self._sequences.lost(self._publishers))

    def take(self) -> list[Taken]:
        """What has come since the last look, in order."""
        found: list[Taken] = []
        handle, kind = self._subscription.handle, self._type
        with handle:
            while len(found) < MOST_AT_ONCE:
                message = handle.take_message(kind, True)
                if message is None:
                    break
                data, info = message
                found.append(
                    Taken(
                        info["received_timestamp"] or time.time_ns(),
                        info["source_timestamp"],
                        info["publication_sequence_number"] or 0,
                        self,
                        data,
                    )
                )
        self.received += len(found)
        if found:
            self._sequences.take([message.sequence for message in found])
        return found

    def close(self) -> None:
        """Unsubscribe."""
        self._node.destroy_subscription(self._subscription)


class LogProgress:
    """How far the log of some JointState topics is: the stamp that all of them have reached.

    Attributes:
        episode: the newest outputs' label.
        stamp_ns: of the topic that is furthest behind.
    """

    def __init__(self, topics: Sequence[str]) -> None:
        self._latest: dict[str, tuple[str, int]] = {topic: ("", -1) for topic in topics}
        self._readers = {topic: SignalReader() for topic in topics}
        self.episode, self.stamp_ns = "", -1

    def take(self, messages: Iterable[Taken]) -> bool:
        """Look at some messages; returns whether there is progress."""
        newest = {message.tap.topic: message.data for message in messages if message.tap.topic in self._latest}
        if not newest:
            return False
        for topic, data in newest.items():
            try:
                sample = self._readers[topic].read(data)
            except ValueError:
                continue  # nothing that a plant or controller has published
            label = EpisodeLabel.named_in(sample.frame_id)
            self._latest[topic] = str(label or ""), sample.stamp_ns
        before = self.episode, self.stamp_ns
        episodes = {episode for episode, _ in self._latest.values()}
        if len(episodes) == 1:
            self.episode, self.stamp_ns = episodes.pop(), min(stamp for _, stamp in self._latest.values())
        return before != (self.episode, self.stamp_ns)


class TapThread:
    """Takes what has come, again and again, and hands it over in the order in which it was received."""

    def __init__(self, take: Callable[[], list[Taken]], hand_over: Callable[[list[Taken]], None]) -> None:
        self._take = take
        self._hand_over = hand_over
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="taps", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Take what is still there, and end."""
        self._stop.set()
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def _run(self) -> None:
        pause = SHORTEST_PAUSE
        while not self._stop.wait(pause):
            pause = SHORTEST_PAUSE if self._look() else min(2 * pause, LONGEST_PAUSE)
        self._look()

    def _look(self) -> bool:
        found = self._take()
        if found:
            found.sort(key=itemgetter(0))
            self._hand_over(found)
        return bool(found)


def _never_called(_: Any) -> None:
    raise AssertionError("no executor serves a tap")
