"""The plant: a simulated process that publishes its output and takes control effort."""

from __future__ import annotations

import math
import sys
from typing import Any

import numpy as np
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import PublisherEventCallbacks
from rosgraph_msgs.msg import Clock as ClockMessage
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from tdof_npid_ros.case import sample_period_in_ns
from tdof_npid_ros.graph.messages import as_field, plan_from_message, set_stamp, signal_message, stamp_ns, values
from tdof_npid_ros.graph.node import ERROR, LATCHED_QOS, OK, SIGNAL_QOS, WARN, LoopNode, number, run_node
from tdof_npid_ros.plants.catalog import FIXED_WHILE_RUNNING, make_plant, model_parameters
from tdof_npid_ros.plants.lockstep import Episode
from tdof_npid_ros.plants.plant import Plant
from tdof_npid_ros.plants.simulator import PlantSimulator
from tdof_npid_ros.scenario import Plan

MODES = ("lockstep", "realtime")
CLOCK_PERIOD = 0.02  # s of wall time between two /clock messages in lockstep


class PlantNode(LoopNode):
    """Publishes `output`, takes `control_effort` and `disturbance`; `plant/reset` starts it over."""

    def __init__(self) -> None:
        super().__init__("plant")
        period = self.declare_value("sample_period", 0.01, "s; time of one step", fixed=True)
        self.period_ns = sample_period_in_ns(period)
        self.mode = self.declare_value(
            "mode", "realtime", "lockstep: wait for each answer; realtime: steady timer", fixed=True
        )
        if self.mode not in MODES:
            raise ValueError(f"mode is {self.mode!r}: it must be one of {', '.join(MODES)}")
        self.model = str(
            self.declare_value("model", "first_order", "model of the plant, or package.module:Class", fixed=True)
        )
        self.model_names = list(model_parameters(self.model))
        for name, default in model_parameters(self.model).items():
            fixed = name in FIXED_WHILE_RUNNING
            self.declare_value(name, default, f"parameter {name} of the model {self.model}", fixed=fixed)
        self.declare_value("lanes", 1, "independent copies of the plant in one message; taken over at the next reset")
        self.declare_value("effort_min", -math.inf, "lower limit of the actuator, in the effort's unit")
        self.declare_value("effort_max", math.inf, "upper limit of the actuator, in the effort's unit")
        self.declare_value("speed", 1.0, "realtime: simulated seconds per wall-clock second", fixed=True)
        self.declare_value("reply_timeout", 0.5, "lockstep: s of wall time until an unanswered output is repeated")
        self.declare_value("retries", 20, "lockstep: how often an output is repeated before the plant stops")
        self.declare_value("publish_clock", True, "lockstep: publish the loop's time on /clock", fixed=True)
        self.checked({})
        self.accept_changes()
        self.plan: Plan | None = None
        self.episode: Episode | None = None
        self.episodes = 0
        self.running = self.stopped = False
        self._make_simulator()

    def activate(self) -> None:
        self.output = signal_message("")
        matched = PublisherEventCallbacks(matched=self._on_matched)
        self.output_publisher = self.create_publisher(JointState, "output", SIGNAL_QOS, event_callbacks=matched)
        self.create_service(Trigger, "plant/reset", self._on_reset)
        if self.mode == "lockstep":
            self._activate_lockstep()
        else:
            self._activate_realtime()

    # Lockstep

    def _activate_lockstep(self) -> None:
        self.waiting, self.repeats, self.clock_ns = (0, 0), 0, -1
        self.clock_publisher = self.create_publisher(ClockMessage, "/clock", 10)
        self.create_subscription(JointTrajectory, "scenario_plan", self._on_plan, LATCHED_QOS)
        self.create_subscription(JointState, "control_effort", self._on_answer, SIGNAL_QOS)
        self.create_timer(self.values_of(["reply_timeout"])["reply_timeout"], self._on_reply_timeout, clock=STEADY)
        if self.get_parameter("publish_clock").value:
            self.create_timer(CLOCK_PERIOD, self._publish_clock, clock=STEADY)

    def _on_plan(self, message: JointTrajectory) -> None:
        try:
            plan = plan_from_message(message)
            Episode(plan, self.simulator, self._plant, 0)
        except ValueError as error:
            self.refuse("rejected", f"scenario_plan refused: {error}")
            return
        self.plan = plan
        self._start_episode()

    def _start_episode(self) -> None:
        assert self.plan is not None
        self.episodes += 1
        self._make_simulator()
        self.episode = Episode(self.plan, self.simulator, self._plant, self.episodes)
        self.output.header.frame_id = self.episode.name
        self.running, self.stopped, self.repeats = True, False, 0
        self.get_logger().info(f"episode {self.episodes}: plan {self.plan.digest}, {self.episode.steps} steps")
        self._publish_output(0)
        self.publish_diagnostics()

    def _on_answer(self, message: JointState) -> None:
        episode = self.episode
        stamp = stamp_ns(message.header.stamp)
        if episode is None or not (self.running or self.stopped) or not episode.awaits(stamp, message.header.frame_id):
            self.counts["late"] += 1
            return
        if not self._is_sound(message.effort, "control_effort"):
            return
        if self.stopped:
            self.get_logger().info("the controller answers again: going on")
            self.running, self.stopped = True, False
        self.counts["steps"] += 1
        if episode.answer(values(message.effort)):
            self._publish_output(episode.stamp_ns)
        else:
            self.running = False
            self.get_logger().info(f"episode {self.episodes} finished")
            self._publish_clock()
            self.publish_diagnostics()

    def _on_reply_timeout(self) -> None:
        if not self.running or self.episode is None:
            return
        waiting = (self.episodes, self.episode.stamp_ns)
        if waiting != self.waiting:
            self.waiting, self.repeats = waiting, 0
            return
        limits = self.values_of(["reply_timeout", "retries"])
        if self.repeats >= limits["retries"]:
            self.running, self.stopped = False, True
            self.get_logger().error(
                f"no answer to the output at {self.episode.stamp_ns / 1e9:g} s after {self.repeats} repetitions: stopped. "
                "Start a controller in this namespace, or call plant/reset"
            )
            self.publish_diagnostics()
            return
        if self.repeats == 0:
            self.get_logger().warning(f"no answer to the output at {self.episode.stamp_ns / 1e9:g} s: repeating it")
        self._repeat_output()

    def _repeat_output(self) -> None:
        assert self.episode is not None
        self.repeats += 1
        self.counts["repeated"] += 1
        self._publish_output(self.episode.stamp_ns)

    def _on_matched(self, status: Any) -> None:
        if self.stopped and status.current_count_change > 0:
            self.running, self.stopped, self.repeats = True, False, 0
            self._repeat_output()

    def _publish_clock(self) -> None:
        if self.episode is not None and self.clock_ns != self.episode.stamp_ns:
            self.clock_ns = self.episode.stamp_ns
            message = ClockMessage()
            set_stamp(message.clock, self.clock_ns)
            self.clock_publisher.publish(message)

    # Realtime

    def _activate_realtime(self) -> None:
        self.effort = np.zeros(self.simulator.lanes)
        self.disturbance = np.zeros(self.simulator.lanes)
        self.create_subscription(JointState, "control_effort", self._on_effort, SIGNAL_QOS)
        self.create_subscription(JointState, "disturbance", self._on_disturbance, SIGNAL_QOS)
        self.tick, self.expected_ns = 0, None
        self.wall_period_ns = max(1, round(self.period_ns / self.get_parameter("speed").value))
        self.create_timer(self.wall_period_ns / 1e9, self._on_tick, clock=STEADY)

    def _on_tick(self) -> None:
        now = STEADY.now().nanoseconds
        if self.expected_ns is not None and now > self.expected_ns + self.wall_period_ns:
            self.counts["missed_ticks"] += (now - self.expected_ns) // self.wall_period_ns
        self.expected_ns = now + self.wall_period_ns
        if self.tick:
            self.simulator.advance(self.effort, self.disturbance)
            self.counts["steps"] += 1
        self._publish_output(self.tick * self.period_ns)
        self.tick += 1

    def _on_effort(self, message: JointState) -> None:
        if self._is_sound(message.effort, "control_effort"):
            self.effort = values(message.effort).copy()

    def _on_disturbance(self, message: JointState) -> None:
        if self._is_sound(message.effort, "disturbance"):
            self.disturbance = values(message.effort).copy()

    # Both

    def _publish_output(self, time_ns: int) -> None:
        set_stamp(self.output.header.stamp, time_ns)
        self.output.position = as_field(self.simulator.output)
        self.output.effort = as_field(self.simulator.applied_effort)
        self.output_publisher.publish(self.output)

    def _is_sound(self, field: Any, topic: str) -> bool:
        lanes = self.simulator.lanes
        if len(field) != lanes:
            self.refuse("rejected", f"{topic} with {len(field)} values for {lanes} lanes refused")
        elif not (math.isfinite(field[0]) if lanes == 1 else np.isfinite(values(field)).all()):
            self.refuse("rejected", f"{topic} that is not finite refused")
        else:
            return True
        return False

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self.mode == "realtime":
            self._make_simulator()
            self.effort = np.zeros(self.simulator.lanes)
            self.disturbance = np.zeros(self.simulator.lanes)
            self.tick = 0
            response.success, response.message = True, "at the initial state, time 0"
        elif self.plan is None:
            response.success, response.message = False, "no plan on scenario_plan yet: start the scenario"
        else:
            self._start_episode()
            response.success, response.message = True, f"episode {self.episodes} of plan {self.plan.digest} started"
        return response

    def _plant(self, changes: dict[str, float]) -> Plant:
        return make_plant(self.model, {**self.values_of(self.model_names), **changes})

    def _make_simulator(self) -> None:
        p = self.values_of(["lanes", "effort_min", "effort_max"])
        limits = (float(p["effort_min"]), float(p["effort_max"]))
        self.simulator = PlantSimulator(self._plant({}), self.period_ns, int(p["lanes"]), limits)

    # Parameters and state

    def checked(self, changes: dict[str, Any]) -> None:
        names = [*self.model_names, "lanes", "effort_min", "effort_max", "speed", "reply_timeout", "retries"]
        p = {**self.values_of(names), **changes}
        make_plant(self.model, p)
        for name, low, high in (("reply_timeout", 0.01, 3600), ("retries", 0, 1e9), ("speed", 1e-3, 1e3)):
            number(name, p[name], low, high)
        if not isinstance(p["lanes"], int) or not 1 <= p["lanes"] <= 100_000:
            raise ValueError(f"lanes is {p['lanes']!r}: it must be a whole number from 1 to 100000")
        if not number("effort_min", p["effort_min"]) <= number("effort_max", p["effort_max"]):
            raise ValueError(
                f"effort_min is {p['effort_min']} and effort_max {p['effort_max']}: need effort_min <= effort_max"
            )

    def changed(self, changes: dict[str, Any]) -> None:
        if self.mode == "realtime":
            self.simulator.change_plant(self._plant({}))
            p = self.values_of(["effort_min", "effort_max"])
            self.simulator.effort_limits = (float(p["effort_min"]), float(p["effort_max"]))

    def state(self) -> tuple[int, str, dict[str, object]]:
        facts: dict[str, object] = {"mode": self.mode, "lanes": self.simulator.lanes, "episode": self.episodes}
        if self.mode == "realtime":
            return OK, "running", {**facts, "state": "running", "time_s": self.tick * self.period_ns / 1e9}
        name = "running" if self.running else "stopped" if self.stopped else "finished" if self.episodes else "waiting"
        facts |= {"state": name, "plan": self.plan.digest if self.plan else ""}
        if self.episode is not None:
            facts["time_s"] = self.episode.stamp_ns / 1e9
        if self.stopped:
            return ERROR, "no controller answers: start one, or call plant/reset", facts
        if name == "waiting":
            return WARN, "waiting for a plan on scenario_plan: start the scenario", facts
        return OK, name, facts


STEADY = Clock(clock_type=ClockType.STEADY_TIME)


def main(args: list[str] | None = None) -> None:
    """Run the node."""
    run_node(PlantNode, sys.argv if args is None else args)
