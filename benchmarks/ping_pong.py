"""A bare ping-pong of JointState messages between two processes: the limit of any lockstep loop over rclpy.

`python -m benchmarks.ping_pong ping|pong EXECUTOR LANES MESSAGES`; ping prints round trips per second.
"""

from __future__ import annotations

import subprocess
import sys
import time
from array import array

EXECUTORS = ("events", "default")
DISCOVERY_TIMEOUT = 30.0  # s


def round_trips_per_second(executor: str, lanes: int, messages: int) -> float:
    """Start both processes and return ping's figure."""
    command = [sys.executable, "-m", "benchmarks.ping_pong"]
    pong = subprocess.Popen([*command, "pong", executor, str(lanes), "0"])
    try:
        ping = subprocess.run(
            [*command, "ping", executor, str(lanes), str(messages)], capture_output=True, text=True, check=True
        )
        return float(ping.stdout)
    finally:
        pong.kill()
        pong.wait()


def play(role: str, executor_name: str, lanes: int, messages: int) -> None:
    """One of the two processes."""
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.qos import QoSProfile
    from sensor_msgs.msg import JointState

    rclpy.init()
    node = rclpy.create_node(role)
    if executor_name == "events":
        from rclpy.experimental import EventsExecutor

        executor = EventsExecutor()
    else:
        executor = SingleThreadedExecutor()
    executor.add_node(node)
    values = array("d", [0.5] * lanes)
    message = JointState(position=values, effort=values)
    count = 0
    other = "pong" if role == "ping" else "ping"
    publisher = node.create_publisher(JointState, role, QoSProfile(depth=1000))

    def answer(received: JointState) -> None:
        nonlocal count
        count += 1
        if role == "pong" or count < messages:
            publisher.publish(message)

    node.create_subscription(JointState, other, answer, QoSProfile(depth=1000))
    deadline = time.monotonic() + DISCOVERY_TIMEOUT
    while role == "ping" and not (publisher.get_subscription_count() and node.count_publishers(other)):
        if time.monotonic() > deadline:
            sys.exit("the two processes did not find each other")
        executor.spin_once(timeout_sec=0.05)
    if role == "ping":
        start = time.monotonic()
        while count == 0:  # the first messages may be lost while the two meet
            publisher.publish(message)
            executor.spin_once(timeout_sec=0.2)
        count, start = 0, time.monotonic()
        publisher.publish(message)
        while count < messages:
            executor.spin_once(timeout_sec=0.5)
        print(messages / (time.monotonic() - start))
    else:
        while rclpy.ok():
            executor.spin_once(timeout_sec=0.5)


if __name__ == "__main__":
    play(sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))
