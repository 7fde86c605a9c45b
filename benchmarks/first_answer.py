"""From the start of a node's process to its first answer: `python -m benchmarks.first_answer NODE...` prints seconds.

NODE is the command that starts it. It is sent an `output` every few milliseconds until a `control_effort` comes back.
"""

from __future__ import annotations

import subprocess
import sys
import time

PERIOD = 0.005  # s
TIMEOUT = 60.0  # s


def seconds_until_answer(command: list[str]) -> float:
    """Start the node, and end it when it has answered."""
    import rclpy
    from sensor_msgs.msg import JointState

    rclpy.init()
    probe = rclpy.create_node("probe")
    answers: list[JointState] = []
    probe.create_subscription(JointState, "control_effort", answers.append, 10)
    publisher = probe.create_publisher(JointState, "output", 10)
    message = JointState(position=[0.5], effort=[0.0])
    start = time.monotonic()
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as node:
        try:
            while not answers:
                if node.poll() is not None or time.monotonic() - start > TIMEOUT:
                    sys.exit(f"no answer from {command}")
                message.header.stamp = probe.get_clock().now().to_msg()
                publisher.publish(message)
                rclpy.spin_once(probe, timeout_sec=PERIOD)
            return time.monotonic() - start
        finally:
            node.terminate()


if __name__ == "__main__":
    print(seconds_until_answer(sys.argv[1:]))
