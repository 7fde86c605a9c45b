"""Somebody's plant: a plain rclpy node that gives `output` and takes `control_effort`, a lag with dead time.

SIGUSR1: from now on its actuator does a third of what it is told; once more: all of it again.
"""

import contextlib
import math
import random
import signal

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from sensor_msgs.msg import JointState

PERIOD = 0.01  # s
GAIN, TIME_CONSTANT, DEAD_SAMPLES, NOISE = 2.0, 0.2, 2, 0.002
WEAK = 0.3


class PlainRobot(Node):
    """It reports no effort, and knows nothing of who drives it."""

    def __init__(self) -> None:
        super().__init__("robot")
        self.y, self.efforts, self.strength = 0.0, [0.0] * DEAD_SAMPLES, 1.0
        self.noise, self.newest = random.Random(1), 0.0
        self.publisher = self.create_publisher(JointState, "output", 10)
        self.create_subscription(JointState, "control_effort", self.on_effort, 10)
        self.create_timer(PERIOD, self.on_tick)

    def on_effort(self, message: JointState) -> None:
        self.newest = message.effort[0]

    def on_tick(self) -> None:
        self.efforts.append(self.newest)
        target = GAIN * self.strength * self.efforts.pop(0)
        self.y += (target - self.y) * (1.0 - math.exp(-PERIOD / TIME_CONSTANT))
        message = JointState(name=["axis"], position=[self.y + self.noise.gauss(0.0, NOISE)])
        message.header.stamp = self.get_clock().now().to_msg()
        message.header.frame_id = "base"
        self.publisher.publish(message)

    def weaken(self, *_: object) -> None:
        self.strength = WEAK if self.strength == 1.0 else 1.0


def main() -> None:
    rclpy.init()
    robot = PlainRobot()
    signal.signal(signal.SIGUSR1, robot.weaken)
    # RCLError: told to end amid a spin
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException, rclpy_implementation.RCLError):
        rclpy.spin(robot)


if __name__ == "__main__":
    main()
