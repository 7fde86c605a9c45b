"""The controller: answers each output with a control effort."""

from __future__ import annotations

import math
import sys
from typing import Any

import numpy as np
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from tdof_npid_ros.case import sample_period_in_ns
from tdof_npid_ros.control.controller import Controller
from tdof_npid_ros.control.gains import ANTI_WINDUP, CONTROLLER_TYPES, GAIN_NAMES, Gains, gains_from_mapping
from tdof_npid_ros.control.law import TERMS
from tdof_npid_ros.control.stamps import Stamps
from tdof_npid_ros.graph.messages import as_field, plan_from_message, signal_message, stamp_ns, values
from tdof_npid_ros.graph.node import LATCHED_QOS, OK, SIGNAL_QOS, WARN, LoopNode, number, run_node
from tdof_npid_ros.scenario import Plan

DESCRIPTIONS = {
    "type": f"control law: {', '.join(CONTROLLER_TYPES)}",
    "kp": "proportional gain K_p, effort per output unit; an array gives one value per lane",
    "ki": "integral gain K_i, effort per output unit and second",
    "kd": "derivative gain K_d, effort per output unit times seconds",
    "alpha": "setpoint weight on the proportional action (6); tdof_npid1 and tdof_npid2",
    "beta": "setpoint weight on the derivative action (6); tdof_npid2",
    "sigma": "width of the nonlinear gain (4), in the output's unit, above 0; all but pid",
    "n": "derivative filter N (1b), above 0; usually 5 to 30",
    "effort_min": "lower limit of the effort",
    "effort_max": "upper limit of the effort",
    "anti_windup": f"what the integral action does at a limit: {', '.join(ANTI_WINDUP)}",
    "tracking_time": "s; of back_calculation; 0: sqrt(kd/ki), or kp/ki without derivative action",
    "integral_min": "lower limit of the integral action, in the effort's unit",
    "integral_max": "upper limit of the integral action, in the effort's unit",
}


class ControllerNode(LoopNode):
    """Takes `output`, `setpoint` and `scenario_plan`; publishes `control_effort` and `controller_state`."""

    def __init__(self) -> None:
        super().__init__("controller")
        period = self.declare_value("sample_period", 0.01, "s; time between two outputs", fixed=True)
        default = Gains().as_dict()
        gains = gains_from_mapping(
            {name: self.declare_value(name, default[name], DESCRIPTIONS[name]) for name in GAIN_NAMES}
        )
        setpoint = self.declare_value("setpoint", 0.0, "setpoint until one arrives on the topic")
        self.controller = Controller(gains, sample_period_in_ns(period))
        self.controller.answer(0, np.zeros(gains.lanes), np.zeros(gains.lanes))  # compiles, before the first output
        self.controller.reset()
        self.setpoint = np.array([number("setpoint", setpoint)])
        self.plan: Plan | None = None
        self.stamps = Stamps()
        self.waiting: JointState | None = None
        self.accept_changes()

    def activate(self) -> None:
        self.stamps.forget()
        self.controller.reset()
        self.effort = signal_message("")
        self.effort_for = ("", "")
        self.terms = signal_message("")
        self.effort_publisher = self.create_publisher(JointState, "control_effort", SIGNAL_QOS)
        self.state_publisher = self.create_publisher(JointState, "controller_state", SIGNAL_QOS)
        self.create_subscription(JointTrajectory, "scenario_plan", self._on_plan, LATCHED_QOS)
        self.create_subscription(JointState, "setpoint", self._on_setpoint, SIGNAL_QOS)
        self.create_subscription(JointState, "output", self._on_output, SIGNAL_QOS)

    # What arrives

    def _on_plan(self, message: JointTrajectory) -> None:
        try:
            plan = plan_from_message(message)
        except ValueError as error:
            self.refuse("rejected", f"scenario_plan refused: {error}")
            return
        self.plan = plan
        if self.waiting is not None:
            self._on_output(self.waiting)

    def _on_setpoint(self, message: JointState) -> None:
        r = values(message.position)
        if len(r) not in (1, self.controller.lanes) or not np.isfinite(r).all():
            self.refuse("rejected", f"setpoint {list(r)[:8]} refused: it must be finite, one value or one per lane")
        else:
            self.setpoint = r.copy()

    def _on_output(self, message: JointState) -> None:
        stamp, episode = stamp_ns(message.header.stamp), message.header.frame_id
        if not self._is_sound(message.position):
            return
        if "/" in episode:
            if self.plan is None or not episode.startswith(self.plan.digest):
                self.waiting = message  # its plan is on the way
                return
            self.waiting = None
            setpoint = self._planned_setpoint(self.plan, stamp)
        else:
            setpoint = np.broadcast_to(self.setpoint, (self.controller.lanes,))
        verdict = self.stamps.take(stamp, episode)
        if verdict == "late":
            self.counts["late"] += 1
            return
        if verdict == "restart":
            self.controller.reset()
        if self.controller.answer(stamp, setpoint, values(message.position)):
            self.counts["steps"] += 1
            self.answered_setpoint = setpoint
            saturated = (
                not self.controller.gains.effort_min < self.controller.effort[0] < self.controller.gains.effort_max
            )
            self.counts["saturated"] += saturated
        else:
            self.counts["repeated"] += 1
        self._publish_answer(message, episode)

    def _planned_setpoint(self, plan: Plan, stamp: int) -> np.ndarray:
        r = plan.value_at("setpoint", stamp)
        return np.full(self.controller.lanes, r)

    def _is_sound(self, field: Any) -> bool:
        lanes = self.controller.lanes
        if len(field) != lanes:
            self.refuse("rejected", f"output with {len(field)} values refused: the gains are for {lanes} lanes")
        elif not (math.isfinite(field[0]) if lanes == 1 else np.isfinite(values(field)).all()):
            self.refuse("rejected", "output that is not finite refused")
        else:
            return True
        return False

    # What goes out

    def _publish_answer(self, output: JointState, episode: str) -> None:
        if self.effort_for != (self.controller.digest, episode):
            self.effort_for = (self.controller.digest, episode)
            self.effort.header.frame_id = f"{self.controller.digest} {episode}" if episode else self.controller.digest
        self.effort.header.stamp = output.header.stamp
        self.effort.effort = as_field(self.controller.effort)
        self.effort.position = as_field(self.answered_setpoint)
        self.effort_publisher.publish(self.effort)
        if self.state_publisher.get_subscription_count():
            self._publish_terms()

    def _publish_terms(self) -> None:
        lanes = self.controller.lanes
        if len(self.terms.name) != len(TERMS) * lanes:
            self.terms.name = [term if lanes == 1 else f"{term}/{lane}" for term in TERMS for lane in range(lanes)]
        self.terms.header.stamp = self.effort.header.stamp
        self.terms.position = as_field(self.controller.terms)
        self.state_publisher.publish(self.terms)

    # Parameters and state

    def checked(self, changes: dict[str, Any]) -> None:
        self.controller.gains.with_values(**{name: value for name, value in changes.items() if name in GAIN_NAMES})
        if "setpoint" in changes:
            number("setpoint", changes["setpoint"])

    def changed(self, changes: dict[str, Any]) -> None:
        gains = {name: value for name, value in changes.items() if name in GAIN_NAMES}
        if gains:
            self.controller.change_gains(self.controller.gains.with_values(**gains))
        if "setpoint" in changes:
            self.setpoint = np.array([number("setpoint", changes["setpoint"])])

    def state(self) -> tuple[int, str, dict[str, object]]:
        facts: dict[str, object] = {
            "type": self.controller.gains.type,
            "lanes": self.controller.lanes,
            "parameters": self.controller.digest,
        }
        if self.waiting is not None:
            return WARN, "an output waits for its plan on scenario_plan", facts
        if self.stamps.latest_ns is None:
            return WARN, "no output yet: start the plant, or remap output to your robot's joint_states", facts
        return OK, "running", {**facts, "time_s": self.stamps.latest_ns / 1e9}


def main(args: list[str] | None = None) -> None:
    """Run the node."""
    run_node(ControllerNode, sys.argv if args is None else args)
