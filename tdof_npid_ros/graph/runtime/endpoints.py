"""Who else is on a topic: quality-of-service profiles that do not fit, and publishers too many."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import (
    QoSCompatibility,
    QoSProfile,
    ReliabilityPolicy,
    qos_check_compatible,
)

LOOKS = 5  # looks, one a second, after something has changed: names of nodes arrive later than their topics
FOREVER_NS = 2**62


class Endpoints:
    """Watches the topics of one node.

    Args:
        refuse: called with a count's name, a cause, and perhaps `times`, for what is to be counted and logged once.
    """

    def __init__(self, node: Node, refuse: Callable[..., None]) -> None:
        self._node = node
        self._refuse = refuse
        self._published: set[str] = set()
        self._subscribed: set[str] = set()
        self._sole: set[str] = set()
        self._looks = 0
        self.conflicts: list[str] = []

    def forget(self) -> None:
        """Watch no topic any more."""
        self._published.clear()
        self._subscribed.clear()
        self._sole.clear()
        self.conflicts = []

    def publisher_events(self, topic: str, matched: Callable[[Any], None] | None = None) -> PublisherEventCallbacks:
        """The callbacks for a publisher that this node is about to create."""
        self._published.add(self._node.resolve_topic_name(topic))

        def on_matched(event: Any) -> None:
            self._looks = LOOKS
            if matched is not None:
                matched(event)

        return PublisherEventCallbacks(
            matched=on_matched,
            incompatible_qos=self._on_change,
            deadline=lambda event: self._refuse("deadline_missed", f"{topic}: the deadline offered was missed"),
            liveliness=lambda event: self._refuse("liveliness_lost", f"{topic}: this publisher lost its liveliness"),
        )

    def subscription_events(self, topic: str, sole: bool) -> SubscriptionEventCallbacks:
        """The callbacks for a subscription that this node is about to create; `sole`: one publisher is expected."""
        name = self._node.resolve_topic_name(topic)
        self._subscribed.add(name)
        if sole:
            self._sole.add(name)

        def on_liveliness(event: Any) -> None:
            if event.not_alive_count_change > 0:
                self._refuse("publisher_not_alive", f"{topic}: its publisher is not alive any more")

        def on_lost(event: Any) -> None:
            self._refuse("lost", f"{topic}: messages were lost on the way", times=event.total_count_change)

        return SubscriptionEventCallbacks(
            message_lost=on_lost,
            matched=self._on_change,
            incompatible_qos=self._on_change,
            liveliness=on_liveliness,
            deadline=lambda event: self._refuse("deadline_missed", f"{topic}: the deadline requested was missed"),
        )

    def _on_change(self, event: Any) -> None:
        self._looks = LOOKS

    def look(self) -> None:
        """Once a second: what does not fit, if something has changed lately."""
        if self._looks == 0:
            return
        self._looks -= 1
        before, self.conflicts = self.conflicts, []
        for topic in self._published | self._subscribed:
            offers = self._node.get_publishers_info_by_topic(topic)
            requests = self._node.get_subscriptions_info_by_topic(topic)
            self._compare(topic, offers, requests)
            if topic in self._sole and len(offers) > 1:
                names = ", ".join(sorted(map(full_name, offers)))
                self.conflicts.append(f"{topic} has {len(offers)} publishers ({names}): stop all but one")
        for conflict in self.conflicts:
            if conflict not in before:
                self._refuse("conflicts", conflict)

    def _compare(self, topic: str, offers: list[Any], requests: list[Any]) -> None:
        own_name = self._node.get_fully_qualified_name()
        for offer in offers:
            for request in requests:
                if own_name not in (full_name(offer), full_name(request)):
                    continue
                compatible, _ = qos_check_compatible(offer.qos_profile, request.qos_profile)
                if compatible == QoSCompatibility.ERROR:
                    unreliable = offer.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
                    self.conflicts.append(
                        f"{topic}: {full_name(offer)} offers {described(offer.qos_profile)}, but {full_name(request)} "
                        f"requests {described(request.qos_profile)}: no message passes; give both the same"
                        f"{', reliability:=best_effort here' if unreliable else ''}"
                    )


def full_name(endpoint: Any) -> str:
    """The name of an endpoint's node with its namespace."""
    return f"{endpoint.node_namespace.rstrip('/')}/{endpoint.node_name}"


def described(qos: QoSProfile) -> str:
    """What matters of a profile, in one line."""
    words = [qos.reliability.name.lower(), qos.durability.name.lower()]
    for name, duration in (("deadline", qos.deadline), ("liveliness lease", qos.liveliness_lease_duration)):
        if 0 < duration.nanoseconds < FOREVER_NS:
            words.append(f"{name} {duration.nanoseconds / 1e9:g} s")
    return ", ".join(words)
