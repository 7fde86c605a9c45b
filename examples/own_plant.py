"""A loop with a plant of your own: an ordinary rclpy node, here a cart with dry friction, in place of our plant.

python examples/own_plant.py bags/cart

Whatever simulates or drives something may stand in its place: it publishes `output` with a stamp of its own, and takes
`control_effort`.
"""

import sys
from pathlib import Path

from rclpy.node import Node
from rclpy.time import Time
from sensor_msgs.msg import JointState

from tdof_npid_ros import analyze, run

PARAMETERS = Path(__file__).with_name("cart.yaml")
PERIOD = 0.01  # s
PERIOD_NS = 10_000_000
DEPTH = 1000  # messages kept for a recorder that is behind on a busy machine


class Cart(Node):
    """A mass of 2 kg on a rail; its friction holds up to 1.5 N."""

    mass, friction = 2.0, 1.5

    def __init__(self, **how: object) -> None:
        super().__init__("cart", **how)
        self.position = self.velocity = self.force = self.time = 0.0
        self.stamp_ns = self.get_clock().now().nanoseconds
        self.publisher = self.create_publisher(JointState, "output", DEPTH)
        self.create_subscription(JointState, "control_effort", self.on_effort, 10)
        self.create_timer(PERIOD, self.step)

    def on_effort(self, message: JointState) -> None:
        """Take the newest force."""
        self.force = message.effort[0]

    def step(self) -> None:
        """Move on, and tell where the cart is; not before the controller and the recorder listen."""
        if self.publisher.get_subscription_count() < 2:
            return
        slowed = self.friction * PERIOD / self.mass
        velocity = self.velocity + self.force * PERIOD / self.mass
        self.velocity = 0.0 if abs(velocity) <= slowed else velocity - slowed * (1 if velocity > 0 else -1)
        self.position += self.velocity * PERIOD
        self.time += PERIOD
        self.stamp_ns += PERIOD_NS
        message = JointState(name=["cart"], position=[self.position], effort=[self.force])
        message.header.stamp = Time(nanoseconds=self.stamp_ns).to_msg()
        self.publisher.publish(message)


def main(bag: str) -> None:
    """Step the cart half a metre, and print what was recorded."""
    with run(PARAMETERS, bag=bag, nodes=("controller",)) as loop:
        cart = Cart(context=loop.node.context)
        loop.add_node(cart)
        loop.wait_until(lambda: cart.time > 0.5)
        loop.publish("setpoint", 0.5)
        loop.wait_until(lambda: cart.time > 4.0)
    print(analyze([bag]).table())


if __name__ == "__main__":
    main(*sys.argv[1:])
