"""An arm in MuJoCo as the driver of a robot would show it: `joint_states`, best effort, at 250 Hz; efforts by name.

python examples/arm/arm.py

It knows nothing of the controller. Its brakes hold it until efforts come, and again when none has come for a while; the
torque that they hold is told as `effort`, as a driver tells what its motors give.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rclpy.time import Time
from sensor_msgs.msg import JointState

MODEL = Path(__file__).with_name("arm.xml")
PERIOD_NS = 4_000_000  # 250 Hz
SILENCE = 0.1  # s without efforts until the brakes close
LISTENERS = 2  # that it waits for, a controller and a recorder
MEETING = 250  # steps more, until these have met each other, too: so the bag begins with the controller's first answer
AT_START = {"shoulder": -0.6, "elbow": 1.2}  # rad; the others at 0


class Arm(Node):
    """Six joints with motors, and a gripper that has a controller of its own."""

    def __init__(self, **how: Any) -> None:
        super().__init__("arm", **how)
        self.model = mujoco.MjModel.from_xml_path(str(MODEL))
        self.data = mujoco.MjData(self.model)
        self.joints = [self.model.joint(i).name for i in range(self.model.njnt)]
        self.motor = {self.joints[self.model.actuator(i).trnid[0]]: i for i in range(self.model.nu)}
        for name, angle in AT_START.items():
            self.data.joint(name).qpos[0] = angle
        mujoco.mj_forward(self.model, self.data)
        self.time = 0.0  # s, of the arm
        self.stamp_ns = self.get_clock().now().nanoseconds
        self.heard_at = 0.0
        self.brakes_hold = True
        self.to_wait = MEETING
        self.publisher = self.create_publisher(JointState, "joint_states", qos_profile_sensor_data)
        self.create_subscription(JointState, "efforts", self.on_efforts, qos_profile_sensor_data)
        self.create_timer(PERIOD_NS / 1e9, self.step)

    def on_efforts(self, message: JointState) -> None:
        """Take efforts for the joints that are named; the motors limit them."""
        for name, effort in zip(message.name, message.effort, strict=True):
            if name in self.motor:
                self.data.ctrl[self.motor[name]] = effort
        self.heard_at = self.time
        self.brakes_hold = False

    def step(self) -> None:
        """Let 4 ms pass, and tell angles, speeds and torques."""
        if self.publisher.get_subscription_count() < LISTENERS:
            return
        if self.to_wait:
            self.to_wait -= 1
            return
        if self.time - self.heard_at > SILENCE:
            self.brakes_hold = True
        if self.brakes_hold:
            self.data.qvel[:] = 0.0
            mujoco.mj_forward(self.model, self.data)
            torque = self.data.qfrc_bias
        else:
            mujoco.mj_step(self.model, self.data, nstep=round(PERIOD_NS / 1e9 / self.model.opt.timestep))
            torque = self.data.qfrc_actuator
        self.time += PERIOD_NS / 1e9
        self.stamp_ns += PERIOD_NS
        message = JointState(name=self.joints)
        message.header.stamp = Time(nanoseconds=self.stamp_ns).to_msg()
        message.position, message.velocity, message.effort = map(
            np.ndarray.tolist, (self.data.qpos, self.data.qvel, torque)
        )
        self.publisher.publish(message)


def main() -> None:
    """Run until Ctrl-C."""
    rclpy.init()
    try:
        rclpy.spin(Arm())
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
