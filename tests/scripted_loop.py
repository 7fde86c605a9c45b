"""A loop that nobody computes: outputs with their efforts as a script holds them, for what looks on."""

from __future__ import annotations

import time
from types import TracebackType

import rclpy
from sensor_msgs.msg import JointState


class ScriptedLoop:
    """A node that publishes `output` and `control_effort`; a context.

    Args:
        namespace: of both.
        period: s from one output to the next.
        domain: None: that of the environment.

    Attributes:
        published: when each value of the effort was published first, in s since 1970.
    """

    def __init__(self, namespace: str, period: float, domain: int | None = None) -> None:
        self.published: dict[float, float] = {}
        self._period = period
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=domain)
        self._node = rclpy.create_node("loop", namespace=namespace, context=self._context)
        topics = ("output", "control_effort")
        self._output, self._effort = (self._node.create_publisher(JointState, topic, 10) for topic in topics)

    def __enter__(self) -> ScriptedLoop:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._node.destroy_node()
        rclpy.shutdown(context=self._context)

    def hold(self, value: float, seconds: float) -> None:
        """Publish outputs with their answers for some time, the effort's value among them."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            message = JointState()
            message.header.stamp = self._node.get_clock().now().to_msg()
            message.position, message.effort = [value], [value]
            self._output.publish(message)
            self.published.setdefault(value, time.time())
            self._effort.publish(message)
            time.sleep(self._period)
