"""The quality of service of the loop's topics."""

from __future__ import annotations

from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, HistoryPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy


def signal_qos(depth: int, deadline: float = 0.0, lease: float = 0.0, reliable: bool = True) -> QoSProfile:
    """The latest `depth`; deadline and liveliness lease in s, 0 for none."""
    reliability = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
    profile = QoSProfile(depth=depth, history=HistoryPolicy.KEEP_LAST, reliability=reliability)
    if deadline > 0:
        profile.deadline = Duration(nanoseconds=round(deadline * 1e9))
    if lease > 0:
        profile.liveliness = LivelinessPolicy.AUTOMATIC
        profile.liveliness_lease_duration = Duration(nanoseconds=round(lease * 1e9))
    return profile


SIGNAL_QOS = signal_qos(1000)
RECENT = 20  # messages that wait for a late reader: enough that none is lost, too few to answer after a long stop
SENSOR_QOS = signal_qos(RECENT, reliable=False)  # hears reliable publishers, too
LATCHED_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
