"""The scenario: plays the episodes of a parameter file, setpoint and disturbance."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from typing import Any

from diagnostic_msgs.msg import KeyValue
from rosgraph_msgs.msg import Clock as ClockMessage
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from tdof_npid_ros.graph.runtime.messages import EPISODE, lane_names, plan_message, set_stamp, signal_message, stamp_ns
from tdof_npid_ros.graph.runtime.node import OK, STEADY, WARN, LoopNode
from tdof_npid_ros.graph.runtime.parameter_client import Question, RefusedError, RemoteNode
from tdof_npid_ros.graph.runtime.qos import LATCHED_QOS, SIGNAL_QOS
from tdof_npid_ros.graph.runtime.realtime import SteadyRosTime
from tdof_npid_ros.graph.runtime.run import run_node
from tdof_npid_ros.parameters import PLAN, SCENARIO, sample_period_in_ns
from tdof_npid_ros.scenario import Plan, parse_plan, read_episodes
from tdof_npid_ros.wire import EpisodeLabel

PLANT = "plant."  # what begins the name of a plant's parameter in a plan
PLANT_TIMEOUT_NS = 3_000_000_000  # an episode waits so long for a plant that tells of its episodes and can be reset
SETPOINT_AHEAD_NS = 100_000_000  # by which a start's setpoint goes ahead of the plant's reset, on another way
LOOK_PERIOD = 0.1  # s between two looks, in lockstep, whether the plant is there


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
        self.placed_at = math.inf  # the plant's `start`, as far as it was set here
        self.label: EpisodeLabel | None = None  # of the plant's episode, as it tells; None: it has told nothing yet
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
        self.label = None
        self.plant_before: dict[str, Any] = {}  # in realtime: what the plan has changed of the plant, as it was
        self.setting: Question[dict[str, str]] | None = None  # of the plant's parameters, the latest
        self.values_set: dict[str, Any] = {}  # what it asks for
        self.before: EpisodeLabel | None = None  # the plant's label before it was asked for an episode
        self.plant = RemoteNode(self, self.resolve_topic_name("plant"))
        self.subscribe(KeyValue, EPISODE, self._on_episode, LATCHED_QOS)
        self.zero_ns = 0  # the stamp of the plan's beginning
        self.clock_ns = 0  # the latest on /clock
        self.ros_time = SteadyRosTime(self.get_clock().now().nanoseconds, STEADY.now().nanoseconds)
        if self.mode == "lockstep" or self.speed != 1.0:
            self.create_subscription(ClockMessage, "/clock", self._on_clock, 10)
        if self.mode == "lockstep":
            self.create_timer(LOOK_PERIOD, self._publish_plan_if_time, clock=STEADY)
        else:
            self.create_timer(self.period_ns / 1e9 / self.speed, self._on_tick, clock=STEADY)
            self.plant.serves("reset")  # the client is there before it is needed
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
        self.begun = False  # in lockstep: the plan is published; in realtime: it is played
        self.started_ns = 0
        self.told: Question[dict[str, Any]] | None = None  # what the plan will change of the plant
        self.placing: Question[dict[str, str]] | None = None  # where the plant begins
        self.setpoint_told_ns = 0  # when the setpoint of a start at rest was told first
        self.resetting: Question[str] | None = None
        self.wait_until_ns = STEADY.now().nanoseconds + PLANT_TIMEOUT_NS
        if self.mode == "lockstep":
            self._publish_plan_if_time()

    def _publish_plan_if_time(self) -> None:
        """In lockstep: once the plant tells of its episodes, so that ours can be told from those before."""
        if self.current is None or self.begun:
            return
        if self.label is not None or STEADY.now().nanoseconds > self.wait_until_ns:
            self.before = self.label
            self._publish_plan(self.current)

    def _publish_plan(self, plan: Plan) -> None:
        self.begun = True
        self.plan_publisher.publish(plan_message(plan, 0))
        self._advance_to(0)

    def _on_matched(self, status: Any) -> None:
        """A latecomer, a controller started again for one, is told what holds now."""
        if self.mode == "realtime" and self.current is not None and status.current_count_change > 0 <= self.point:
            self._publish_signals(self.current, self.point)

    def _on_episode(self, message: KeyValue) -> None:
        label = EpisodeLabel.parse(message.key)
        if label is None:
            self.refuse("rejected", "episode refused: its key is no label")
            return
        self.label = label
        if self.mode != "lockstep" or self.current is None:
            return
        if not self.begun:
            self._publish_plan_if_time()
        elif message.value == "finished" and label.plan == self.current.digest and label != self.before:
            self._advance_to(self.current.end_ns)
            self._next()

    def _on_clock(self, message: ClockMessage) -> None:
        self.clock_ns = stamp_ns(message.clock)
        if self.mode == "lockstep":
            self._advance_to(self.clock_ns)

    @property
    def ros_ns(self) -> int:
        """ROS time now: the plant's where that goes at another speed."""
        if self.in_simulated_time:
            return int(self.get_clock().now().nanoseconds)
        return self.clock_ns or self.ros_time.at(STEADY.now().nanoseconds)

    def _on_tick(self) -> None:
        if self.current is None:
            return
        if self.setting is not None:
            self.setting.look()
        now = STEADY.now().nanoseconds
        if not self.begun:
            self._begin_if_ready(self.current, now)
            return
        passed = self.ros_ns - self.zero_ns if self.in_simulated_time else int((now - self.started_ns) * self.speed)
        self._advance_to(passed)
        if passed >= self.current.end_ns:
            self._next()

    def _advance_to(self, time_ns: int) -> None:
        """Publish what the plan does up to `time_ns`, each point once, stamped with its own time: the loop's in
        lockstep, ROS's in realtime."""
        plan = self.current
        if plan is None:
            return
        while self.point + 1 < len(plan.times_ns) and plan.times_ns[self.point + 1] <= time_ns:
            self.point += 1
            self._publish_signals(plan, self.point)
            if self.mode == "realtime":
                before = plan.values[self.point - 1] if self.point else [None] * len(plan.names)
                row = zip(plan.names, before, plan.values[self.point], strict=True)
                changes = {name: now for name, was, now in row if name.startswith(PLANT) and now != was}
                self._set_plant({name.removeprefix(PLANT): value for name, value in changes.items()})

    def _publish_signals(self, plan: Plan, point: int) -> None:
        row = dict(zip(plan.names, plan.values[point], strict=True))
        for name in self.publishers_of:
            self._publish(name, plan.times_ns[point], row.get(name, 0.0))

    def _publish(self, name: str, time_ns: int, value: float) -> None:
        message = signal_message("")
        message.name = lane_names(1) if name == "disturbance" else []  # a setpoint's are names of joints
        set_stamp(message.header.stamp, self.zero_ns + time_ns)
        setattr(message, "position" if name == "setpoint" else "effort", [value])
        self.publishers_of[name].publish(message)

    # The plant, in realtime

    def _begin_if_ready(self, plan: Plan, now: int) -> None:
        """Play once the plant has its own parameters again, has told them, and has begun from its initial state."""
        late = now > self.wait_until_ns
        if not late and not (
            self._is_restored() and self._is_known(plan) and self._is_placed(plan) and self._is_reset()
        ):
            return
        if self.resetting is None:
            self.get_logger().warning("no plant/reset here: playing without it, from wherever the output is")
        else:
            self._tell_of_refusal(self.resetting)
            self.resetting.drop()
        self.started_ns, self.zero_ns = now, self.ros_ns
        self._publish_plan(plan)

    def _is_restored(self) -> bool:
        return self.setting is None or self.setting.look()

    def _is_known(self, plan: Plan) -> bool:
        """Whether the plant has told what the plan will change, so that it can be so again for the next episode."""
        names = [name.removeprefix(PLANT) for name in plan.names if name.startswith(PLANT)]
        if not names:
            return True
        self.told = self.told or self.plant.ask_parameters(names)
        if not self.told.look():
            return False
        self.plant_before = {name: value for name, value in self.told.answer.items() if value is not None}
        return True

    def _is_placed(self, plan: Plan) -> bool:
        """Whether the plant has been told where to begin, at rest, if it must be; the setpoint is there then."""
        start = math.inf if plan.start is None else plan.start
        if self.placing is None and start != self.placed_at:
            self.placing, self.placed_at = self.plant.ask_to_set_each({"start": start}), start
        if self.placing is not None and not self.placing.look():
            return False
        if plan.start is None or self.resetting is not None:
            return True
        if self.placing is not None and "start" in self.placing.answer:
            self.refuse("rejected", "the plant cannot begin at rest", f": {self.placing.answer['start']}")
            self.placed_at = math.nan  # so it is asked again
        self.zero_ns = self.ros_ns
        self._publish("setpoint", 0, plan.start)
        self.setpoint_told_ns = self.setpoint_told_ns or STEADY.now().nanoseconds
        return bool(STEADY.now().nanoseconds - self.setpoint_told_ns > SETPOINT_AHEAD_NS)

    def _is_reset(self) -> bool:
        """Whether the plant has been asked to begin an episode, and tells or answers that it has."""
        if self.resetting is None:
            if not self.plant.serves("reset"):
                return False
            self.before = self.label
            self.resetting = self.plant.ask_trigger("reset", repeats=True)
        return self.resetting.look() or self.label != self.before

    def _tell_of_refusal(self, resetting: Question[str]) -> None:
        if resetting.answered.is_set():
            try:
                _ = resetting.answer
            except RefusedError as error:
                self.refuse("rejected", "the plant does not begin anew", f": {error}")

    def _restore_plant(self) -> None:
        before, self.plant_before = self.plant_before, {}
        self._set_plant(before)

    def _set_plant(self, values: dict[str, Any]) -> None:
        """Set parameters of the plant; those refused are not restored either."""
        if not values:
            return
        if self.setting is not None and not self.setting.look():  # it must not come after this one
            self.setting.drop()
            values = {**self.values_set, **values}
        self.values_set = values
        setting = self.setting = self.plant.ask_to_set_each(values)

        def look() -> None:
            for name, reason in setting.answer.items():
                self.plant_before.pop(name, None)
                self.refuse("rejected", f"{PLANT}{name} was refused by the plant", f": {reason}")

        setting.then(look)

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

    def summary(self) -> str:
        """What it plays."""
        return f"{'playing' if self.play_at_start else 'scenario/play plays'} {', '.join(self.plans)}, in {self.mode}"

    def state(self) -> tuple[int, str, dict[str, object]]:
        """For the diagnostics."""
        facts: dict[str, object] = {"state": "playing" if self.current else "idle", "played": self.played}
        if self.current:
            facts["plan"] = self.current.digest
            if self.mode == "lockstep" and self.label is None:
                return WARN, "no plant is heard: start the plant in this namespace, with mode lockstep", facts
        return OK, str(facts["state"]), facts


def main(args: list[str] | None = None) -> None:
    """Run the node."""
    run_node(ScenarioNode, sys.argv if args is None else args)
