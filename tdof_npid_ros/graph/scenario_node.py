"""The scenario: plays the episodes of a parameter file, setpoint and disturbance."""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, SetParameters
from rosgraph_msgs.msg import Clock as ClockMessage
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from tdof_npid_ros.graph.runtime.messages import lane_names, plan_message, set_stamp, signal_message, stamp_ns
from tdof_npid_ros.graph.runtime.node import LATCHED_QOS, OK, SIGNAL_QOS, STEADY, LoopNode, run_node
from tdof_npid_ros.parameters import PLAN, SCENARIO, sample_period_in_ns
from tdof_npid_ros.scenario import Plan, parse_plan, read_episodes

PLANT = "plant."  # what begins the name of a plant's parameter in a plan
ASK_AGAIN_NS = 300_000_000  # an answer is lost if the plant has not found this node yet
PLANT_TIMEOUT_NS = 3_000_000_000  # in realtime, an episode waits so long for a plant that can be reset


class ScenarioNode(LoopNode):
    """Latches each episode's plan on `scenario_plan` and publishes `setpoint` and `disturbance`.

    In lockstep the plant starts an episode when its plan arrives and the next follows when the plant has finished it;
    `setpoint` and `disturbance` are for onlookers then. In realtime they drive the loop.
    """

    def __init__(self) -> None:
        super().__init__("scenario")
        given = self.declare_all(SCENARIO)
        self.period_ns = sample_period_in_ns(given["sample_period"])
        self.mode, self.speed, self.play_at_start = given["mode"], given["speed"], given["play"]
        for name in given["episodes"]:
            self.declare(replace(PLAN, name=f"{PLAN.name}{name}"))
        self._read_plans({})
        self.accept_changes()
        self.played = 0
        self.reported_episode = 0  # by the plant
        self.finished = (0, "")  # the plant's latest episode, and its plan, that was played to its end
        self.plant_before: list[Parameter] = []  # in realtime: what the plan has changed of the plant, as it was
        self.restored: Any = None  # the future of the plant's answer to that
        self.told: Any = None  # and of the one to what it is before,
        self.asked_ns = 0  # and when that was asked for
        self.queue: list[Plan] = []
        self.current: Plan | None = None

    def activate(self) -> None:
        """Create topics, services and timers."""
        self.plan_publisher = self.publisher_of(JointTrajectory, "scenario_plan", LATCHED_QOS)
        self.publishers_of = {
            name: self.publisher_of(JointState, name, SIGNAL_QOS, self._on_matched)
            for name in ("setpoint", "disturbance")
        }
        self.create_service(Trigger, "scenario/play", self._on_play)
        self.plant_name = self.resolve_topic_name("plant")
        self.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        if self.mode == "lockstep":
            self.create_subscription(ClockMessage, "/clock", self._on_clock, 10)
        else:
            self.reset_client = self.create_client(Trigger, "plant/reset")
            self.get_client = self.create_client(GetParameters, "plant/get_parameters")
            self.set_client = self.create_client(SetParameters, "plant/set_parameters")
            self.create_timer(self.period_ns / 1e9 / self.speed, self._on_tick, clock=STEADY)
        if self.play_at_start:
            self._play()

    def deactivate(self) -> None:
        """Forget the episode that is being played."""
        self._restore_plant()
        self.queue, self.current = [], None

    # Playing

    def _on_play(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self.current is not None or self.queue:
            response.success, response.message = False, "still playing"
        else:
            self._play()
            response.success, response.message = True, f"playing {', '.join(self.plans)}"
        return response

    def _play(self) -> None:
        self.queue = list(self.plans.values())
        self._next()

    def _next(self) -> None:
        """Begin the next episode, if there is one."""
        self._restore_plant()
        if not self.queue:
            self.current = None
            self.played += 1
            self.get_logger().info("all episodes played")
            self.publish_diagnostics()
            return
        self.current = self.queue.pop(0)
        self.point = -1
        self.started_ns: int | None = None
        self.wait_until_ns = STEADY.now().nanoseconds + PLANT_TIMEOUT_NS
        if self.mode == "lockstep":
            self._publish_plan(self.current)

    def _publish_plan(self, plan: Plan) -> None:
        self.plan_publisher.publish(plan_message(plan, 0))
        self._advance_to(0)

    def _begin(self, plan: Plan) -> None:
        """In realtime: the plant to its initial state, and the plan's first values."""
        if self.reset_client.service_is_ready():
            self.reset_client.call_async(Trigger.Request())
        else:
            self.get_logger().warning("no plant/reset here: playing without it, from wherever the output is")
        self.started_ns = STEADY.now().nanoseconds
        self._publish_plan(plan)

    def _on_matched(self, status: Any) -> None:
        """A latecomer, a controller started again for one, is told what holds now."""
        if self.mode == "realtime" and self.current is not None and status.current_count_change > 0 <= self.point:
            self._publish_signals(self.current, self.point)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name != self.plant_name:
                continue
            facts = {pair.key: pair.value for pair in status.values}
            try:
                episode = int(facts.get("episode", 0))
            except ValueError:
                self.refuse("rejected", "diagnostics of the plant refused: its episode is no number")
                continue
            if episode < self.reported_episode:  # the plant has been started again, and counts anew
                self.finished = (0, "")
            self.reported_episode = episode
            if self.mode != "lockstep" or self.current is None or facts.get("state") != "finished":
                continue
            report = (episode, self.current.digest)
            if facts.get("plan") == self.current.digest and report != self.finished:
                self.finished = report
                self._advance_to(self.current.end_ns)
                self._next()

    def _on_clock(self, message: ClockMessage) -> None:
        self._advance_to(stamp_ns(message.clock))

    def _on_tick(self) -> None:
        if self.current is None:
            return
        now = STEADY.now().nanoseconds
        if self.started_ns is None:
            is_there = self.reset_client.service_is_ready() or now > self.wait_until_ns
            if is_there and self._knows_plant(self.current, now):
                self._begin(self.current)
            return
        now = int((now - self.started_ns) * self.speed)
        self._advance_to(now)
        if now >= self.current.end_ns:
            self._next()

    def _advance_to(self, time_ns: int) -> None:
        """Publish what the plan does up to `time_ns`, each point once, stamped with its own time."""
        plan = self.current
        if plan is None:
            return
        while self.point + 1 < len(plan.times_ns) and plan.times_ns[self.point + 1] <= time_ns:
            self.point += 1
            self._publish_signals(plan, self.point)
            if self.mode == "realtime":
                before = plan.values[self.point - 1] if self.point else [None] * len(plan.names)
                row = zip(plan.names, before, plan.values[self.point], strict=True)
                self._set_plant([_double(name, now) for name, was, now in row if name.startswith(PLANT) and now != was])

    def _publish_signals(self, plan: Plan, point: int) -> None:
        row = dict(zip(plan.names, plan.values[point], strict=True))
        for name, publisher in self.publishers_of.items():
            message = signal_message("")
            message.name = lane_names(1) if name == "disturbance" else []  # a setpoint's are names of joints
            set_stamp(message.header.stamp, plan.times_ns[point])
            field = "position" if name == "setpoint" else "effort"
            setattr(message, field, [row.get(name, 0.0)])
            publisher.publish(message)

    def _knows_plant(self, plan: Plan, now: int) -> bool:
        """Whether the plant is as configured, and has told what that is, so that it can be so for the next episode."""
        if self.restored is not None and not self.restored.done() and now < self.wait_until_ns:
            return False
        names = [name.removeprefix(PLANT) for name in plan.names if name.startswith(PLANT)]
        if not names:
            return True
        if self.told is None or not self.told.done():
            if self.get_client.service_is_ready() and now - self.asked_ns > ASK_AGAIN_NS:
                if self.told is None:
                    self.wait_until_ns = now + PLANT_TIMEOUT_NS
                self.told, self.asked_ns = self.get_client.call_async(GetParameters.Request(names=names)), now
            return bool(now > self.wait_until_ns)
        values = self.told.result().values
        found = [Parameter(name=name, value=value) for name, value in zip(names, values, strict=False)]
        self.plant_before = [
            parameter for parameter in found if parameter.value.type != ParameterType.PARAMETER_NOT_SET
        ]
        return True

    def _restore_plant(self) -> None:
        before, self.plant_before = self.plant_before, []
        self.restored, self.told, self.asked_ns = self._set_plant(before), None, 0

    def _set_plant(self, parameters: list[Parameter]) -> Any:
        """Set them; returns the future of the plant's answer, None if there are none."""
        if not parameters:
            return None

        def look(answer: Any) -> None:
            for parameter, result in zip(parameters, answer.result().results, strict=False):
                if not result.successful:
                    self.plant_before = [before for before in self.plant_before if before.name != parameter.name]
                    self.refuse("rejected", f"{PLANT}{parameter.name} was refused by the plant", f": {result.reason}")

        future = self.set_client.call_async(SetParameters.Request(parameters=parameters))
        future.add_done_callback(look)
        return future

    # Parameters and state

    def _read_plans(self, changes: dict[str, Any]) -> None:
        names = changes.get("episodes", self.values_of(["episodes"])["episodes"])
        declared = [f"{PLAN.name}{name}" for name in names]
        for name in declared:
            if not self.has_parameter(name):
                raise ValueError(f"{name} was not there at the start: start the scenario with its episode in episodes")
        parameters = {"episodes": names, **self.values_of(declared), **changes}
        self.plans = {}
        for name, lines in read_episodes(parameters).items():
            self.plans[name] = parse_plan(lines, self.period_ns)

    def checked(self, changes: dict[str, Any]) -> None:
        """Refuse changes that do not make a valid whole."""
        before = self.plans
        try:
            self._read_plans(changes)
        finally:
            self.plans = before

    def changed(self, changes: dict[str, Any]) -> None:
        """Take over accepted changes."""
        self._read_plans(changes)

    def state(self) -> tuple[int, str, dict[str, object]]:
        """For the diagnostics."""
        facts: dict[str, object] = {"state": "playing" if self.current else "idle", "played": self.played}
        if self.current:
            facts["plan"] = self.current.digest
        return OK, str(facts["state"]), facts


def _double(name: str, value: float) -> Parameter:
    """A change of the plan, `plant.gain` say, as the plant's parameter."""
    kind = ParameterType.PARAMETER_DOUBLE
    return Parameter(name=name.removeprefix(PLANT), value=ParameterValue(type=kind, double_value=value))


def main(args: list[str] | None = None) -> None:
    """Run the node."""
    run_node(ScenarioNode, sys.argv if args is None else args)
