"""What plant and controller, the two ends of the loop, share: promises of their timing, checks of what they take."""

from __future__ import annotations

import numpy as np
from rclpy.qos import QoSProfile

from tdof_npid_ros.control.joints import all_within, fault_of
from tdof_npid_ros.graph.runtime.node import LoopNode
from tdof_npid_ros.graph.runtime.qos import RECENT, signal_qos
from tdof_npid_ros.graph.runtime.realtime import prepare_for_realtime

PATIENCE_PERIODS = 3  # without a signal: no silence yet, however slow the loop


def patience_ns(timeout: float, period_ns: int) -> int:
    """How long a loop's node waits for a signal: a timeout in s, but some periods at least; 0 for ever."""
    return max(round(timeout * 1e9), PATIENCE_PERIODS * period_ns) if timeout else 0


class LoopEnd(LoopNode):
    """A node that answers each signal with another one."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        all_within(np.zeros(1), 1.0)  # compiles

    def prepare_for_realtime(self) -> None:
        """Take the priority and the processor asked for; log what the system does not allow."""
        p = self.values_of(["priority", "cpu"])
        for refusal in prepare_for_realtime(p["priority"], p["cpu"]):
            self.get_logger().warning(refusal)

    def promised_qos(self, with_deadline: bool = True) -> QoSProfile:
        """Of the topic that is published."""
        p = self.values_of(["deadline", "lease"])
        return signal_qos(1000, p["deadline"] if with_deadline else 0.0, p["lease"])

    def requested_qos(self, depth: int = RECENT, as_promised: bool = False) -> QoSProfile:
        """Of a signal that is taken.

        Args:
            depth: how many messages wait for this node.
            as_promised: with the deadline and the lease that are asked for, if they are.
        """
        p = self.values_of(["deadline", "lease", "request_deadline", "reliability"])
        deadline, lease = (p["deadline"], p["lease"]) if as_promised and p["request_deadline"] else (0.0, 0.0)
        return signal_qos(depth, deadline, lease, reliable=p["reliability"] == "reliable")

    def is_valid(self, topic: str, values: np.ndarray, lanes: int, largest: float) -> bool:
        """Whether a signal has one value for each of `lanes`, none beyond `largest`; else it is refused."""
        fault = fault_of(topic, values, lanes, largest)
        if fault is not None:
            self.refuse("rejected", *fault)
        return fault is None
