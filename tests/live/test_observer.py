"""What an onlooker keeps of a loop, in whatever order its messages come."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from dds_domain import reserved_domain

pytest.importorskip("rclpy")


@pytest.fixture
def observer(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    from tdof_npid_ros.graph.observer import LoopObserver

    number, domain = reserved_domain()
    with domain:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(number))
        observer = LoopObserver("/seen")
        yield observer
        observer.close()


def hand_over(observer: Any, *messages: tuple[str, int, float]) -> None:
    """Topic, stamp in s, and value of messages, in the order in which they were received."""
    from rclpy.serialization import serialize_message
    from sensor_msgs.msg import JointState

    from tdof_npid_ros.graph.runtime.tap import Taken

    taken = []
    for topic, stamp, value in messages:
        message = JointState(position=[value], effort=[value])
        message.header.stamp.sec = stamp
        tap = next(tap for tap, its in observer._take_from.items() if its == topic)
        taken.append(Taken(0, 0, 0, tap, serialize_message(message)))
    observer._hand_over(taken)


def test_an_answer_that_comes_before_its_output_is_kept(observer: Any) -> None:
    """The plant sends an output to the controller first, and on a busy machine to others after its answer."""
    hand_over(observer, ("output", 1, 0.1), ("control_effort", 1, 1.0), ("control_effort", 2, 2.0))
    assert [row.stamp_ns for row in observer.rows] == [1_000_000_000]
    hand_over(observer, ("output", 2, 0.2), ("output", 3, 0.3), ("control_effort", 3, 3.0))
    assert [(float(row.output[0]), float(row.effort[0])) for row in observer.rows] == [
        (0.1, 1.0), (0.2, 2.0), (0.3, 3.0)
    ]  # fmt: skip


def test_answers_whose_output_never_comes_are_forgotten(observer: Any) -> None:
    from tdof_npid_ros.graph.observer import LOOKING_ON

    depth = LOOKING_ON.depth
    hand_over(observer, *(("control_effort", stamp, 1.0) for stamp in range(1, depth + 10)))
    assert len(observer._early) == depth and not observer.rows
    hand_over(observer, ("output", depth + 20, 0.5), ("control_effort", depth + 20, 1.0), ("output", depth + 9, 0.1))
    assert [row.stamp_ns for row in observer.rows] == [(depth + 20) * 1_000_000_000]
