"""A bare ping-pong of JointState messages between two processes.

One message is on its way at a time, as in the loop, and it is as long as the loop's. `python -m benchmarks.ping_pong
ping|pong EXECUTOR LANES MESSAGES`; ping prints round trips per second. With `unread` for the executor, the events
executor
hands on the messages' bytes, of which only the stamp is looked at: the limit of any loop over rclpy.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
import time
from array import array

from benchmarks.harness import last_line

EXECUTORS = ("events", "default")
UNREAD = "unread"
DISCOVERY_TIMEOUT = 30.0  # s
WARM_UP = 500  # round trips
STAMP = slice(4, 12)  # of a serialized message
SECONDS = slice(4, 8)
FRAME_ID = {"ping": "b109e267f7fe/1", "pong": "cf011c08c487 b109e267f7fe/1"}  # as long as the loop's


def round_trips_per_second(executor: str, lanes: int, messages: int) -> float:
    """Start both processes and return ping's figure."""
    command = [sys.executable, "-m", "benchmarks.ping_pong"]
    pong = subprocess.Popen([*command, "pong", executor, str(lanes), "0"])
    try:
        ping = subprocess.run(
            [*command, "ping", executor, str(lanes), str(messages)], capture_output=True, text=True, check=True
        )
        return float(last_line(ping.stdout))
    finally:
        pong.terminate()  # not killed: it leaves its shared memory in order
        pong.wait()


def play(role: str, executor_name: str, lanes: int, messages: int) -> None:
    """One of the two processes."""
    import rclpy
    from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
    from rclpy.qos import QoSProfile
    from rclpy.serialization import serialize_message
    from sensor_msgs.msg import JointState

    from tdof_npid_ros.graph.runtime.messages import lane_names

    rclpy.init()
    node = rclpy.create_node(role)
    if executor_name in ("events", UNREAD):
        from rclpy.experimental import EventsExecutor

        executor = EventsExecutor()
    else:
        executor = SingleThreadedExecutor()
    executor.add_node(node)
    values = array("d", [0.5] * lanes)
    message = JointState(name=lane_names(lanes), position=values, effort=values)
    message.header.frame_id = FRAME_ID[role]
    stamp = message.header.stamp
    other = "pong" if role == "ping" else "ping"
    publisher = node.create_publisher(JointState, role, QoSProfile(depth=1000))

    def pong(received: JointState) -> None:
        message.header.stamp = received.header.stamp
        publisher.publish(message)

    def ping(received: JointState) -> None:
        if received.header.stamp.sec == stamp.sec:  # else a repetition from the time of discovery
            stamp.sec += 1
            publisher.publish(message)

    data = bytearray(serialize_message(message))

    def pong_unread(received: bytes) -> None:
        data[STAMP] = received[STAMP]
        publisher.publish(bytes(data))

    def ping_unread(received: bytes) -> None:
        if int.from_bytes(received[SECONDS], sys.byteorder) == stamp.sec:
            stamp.sec += 1
            data[SECONDS] = stamp.sec.to_bytes(4, sys.byteorder)
            publisher.publish(bytes(data))

    unread = executor_name == UNREAD
    callback = {"ping": (ping, ping_unread), "pong": (pong, pong_unread)}[role][unread]
    node.create_subscription(JointState, other, callback, QoSProfile(depth=1000), raw=unread)
    if role == "pong":
        while rclpy.ok():
            with contextlib.suppress(ExternalShutdownException):
                executor.spin_once(timeout_sec=0.5)
        return
    deadline = time.monotonic() + DISCOVERY_TIMEOUT
    while stamp.sec == 0:  # until the two have met
        if time.monotonic() > deadline:
            sys.exit("the two processes did not find each other")
        publisher.publish(message)
        executor.spin_once(timeout_sec=0.2)
    while stamp.sec < WARM_UP:
        executor.spin_once(timeout_sec=0.5)
    first, start = stamp.sec, time.monotonic()
    while stamp.sec < first + messages:
        executor.spin_once(timeout_sec=0.5)
    print((stamp.sec - first) / (time.monotonic() - start))


if __name__ == "__main__":
    play(sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))
