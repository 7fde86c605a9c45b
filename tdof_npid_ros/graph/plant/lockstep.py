"""The plant in lockstep: it publishes an output, waits for its answer, and steps."""

from __future__ import annotations

from typing import Any

from trajectory_msgs.msg import JointTrajectory

from tdof_npid_ros.graph.plant.port import PlantPort
from tdof_npid_ros.graph.recorder.lossless import Log
from tdof_npid_ros.graph.runtime.messages import plan_from_message
from tdof_npid_ros.graph.runtime.node import ERROR, OK, STEADY, WAIT_UNTIL_TOLD, WARN
from tdof_npid_ros.graph.runtime.qos import LATCHED_QOS
from tdof_npid_ros.plants.lockstep import Episode
from tdof_npid_ros.scenario import Plan
from tdof_npid_ros.wire import AnswerLabel, Sample

CLOCK_PERIOD = 0.05  # s of wall time between two /clock messages


class LockstepPlant:
    """Runs the latched plan, episode by episode; takes only the answer to the output that waits for it."""

    def __init__(self, port: PlantPort) -> None:
        self._port, self._node = port, port.node
        self.plan: Plan | None = None
        self.episode: Episode | None = None

    def activate(self) -> None:
        """Create the topics and timers, and wait for the plan, which is latched."""
        node = self._node
        self.plan, self.episode = None, None
        self.waiting, self.waits_since_ns = (0, 0), 0  # the output that waits for its answer, and since when
        self.repeats, self.told = 0, False
        self.was_answered = False  # by any controller, since the activation
        self.clock_ns = -1
        node.subscribe(JointTrajectory, "scenario_plan", self._on_plan, LATCHED_QOS)
        node.subscribe_signal("control_effort", self._on_answer, node.requested_qos(), sole=True)
        self.held = False  # an output waits for the log
        p = node.values_of(["lossless", "reply_timeout"])
        self.log = Log(node, self._port.period_ns, self._on_log_grown) if p["lossless"] else None
        node.create_timer(float(p["reply_timeout"]), self._on_reply_timeout, clock=STEADY)
        node.create_timer(CLOCK_PERIOD, self._publish_clock, clock=STEADY)

    def _on_plan(self, message: JointTrajectory) -> None:
        try:
            self._start_episode(plan_from_message(message))
        except (ValueError, ArithmeticError) as error:
            self._node.refuse("rejected", "scenario_plan refused", f": {error}")

    def reset(self) -> tuple[bool, str]:
        """The plan once more."""
        if self.plan is None:
            return False, "no plan on scenario_plan yet: start the scenario"
        try:
            self._start_episode(self.plan)
        except (ValueError, ArithmeticError) as error:
            return False, str(error)
        return True, f"episode {self._port.label.number} of plan {self.plan.digest} started"

    def _start_episode(self, plan: Plan) -> None:
        """Begin it; a plan that the plant cannot follow raises ValueError, and changes nothing."""
        port = self._port
        simulator, label = port.new_simulator(), port.next_label(plan.digest)
        episode = Episode(plan, simulator, port.plant_at, label)
        self.plan, self.episode = plan, episode
        self.repeats, self.held = 0, False
        port.begin(label, simulator)
        self._node.get_logger().info(f"episode {label.number}: plan {plan.digest}, {episode.steps} steps")
        port.publish_output(0)
        self._node.publish_diagnostics()

    def _on_answer(self, answer: Sample) -> None:
        node, episode = self._node, self.episode
        if (
            episode is None
            or self._port.phase == "finished"
            or not episode.awaits(answer.stamp_ns, AnswerLabel.parse(answer.frame_id))
        ):
            node.counts["late"] += 1
            return
        effort = self._port.effort_of(answer)
        if effort is None:
            return
        if not self._is_logged(episode):
            return  # it comes again
        if self._port.phase == "stopped":
            node.get_logger().info("the controller answers again: going on")
            self._port.tell("running")
        self.was_answered = True
        goes_on = episode.answer(effort)
        if goes_on:
            self._publish_when_logged(episode)
        node.counts["steps"] += 1
        if not goes_on:
            self._finish(episode)

    def _finish(self, episode: Episode) -> None:
        self._port.tell("finished")
        self._node.get_logger().info(f"episode {episode.label.number} finished")
        self._publish_clock()
        self._node.publish_diagnostics()

    def _publish_when_logged(self, episode: Episode) -> None:
        self.held = self.log is not None and not self.log.is_near(episode.stamp_ns)
        if not self.held:
            self._port.publish_output(episode.stamp_ns)

    def _on_log_grown(self) -> None:
        if self._port.phase != "running" or self.episode is None:
            return
        if self.held:
            self._publish_when_logged(self.episode)
        elif self._is_end(self.episode) and self._is_logged(self.episode):
            self._repeat_output(self.episode)  # for the answer that was not taken yet

    def _is_logged(self, episode: Episode) -> bool:
        """Whether an answer may be taken: the first and the last one not before they are in the log."""
        return self.log is None or not self._is_end(episode) or self.log.holds(str(episode.label), episode.stamp_ns)

    def _is_end(self, episode: Episode) -> bool:
        return episode.stamp_ns in (0, episode.steps * self._port.period_ns)

    def _on_reply_timeout(self) -> None:
        node, episode = self._node, self.episode
        if self._port.phase != "running" or episode is None:
            return
        waiting = (self._port.label.number, episode.stamp_ns)
        is_new = waiting != self.waiting
        if is_new:
            self.waiting, self.waits_since_ns, self.repeats = waiting, STEADY.now().nanoseconds, 0
        lasts = STEADY.now().nanoseconds - self.waits_since_ns >= WAIT_UNTIL_TOLD * 1e9
        if self.held or not self._is_logged(episode):
            node.counts["held_up"] += 1
            if lasts:
                node.warn_once("lossless: waiting for the recorder; start one with lossless in this namespace")
            if not self.held:
                self._port.publish_output(episode.stamp_ns)
            elif not is_new:
                self._port.repeat_output()  # answered already; a recorder that was started again has heard nothing yet
            return
        if is_new:
            return
        if self.repeats >= node.values_of(["retries"])["retries"]:
            self._port.tell("stopped")
            node.get_logger().error(
                f"no answer to the output at {episode.stamp_ns / 1e9:g} s after {self.repeats} repetitions: stopped. "
                "Start a controller in this namespace, or call plant/reset"
            )
            node.publish_diagnostics()
            return
        if self.repeats == 0:
            self.told = False
        if not self.told and (self.was_answered or lasts):  # a controller that starts takes its time
            self.told = True
            node.get_logger().warning(f"no answer to the output at {episode.stamp_ns / 1e9:g} s: repeating it")
        self._repeat_output(episode)

    def _repeat_output(self, episode: Episode) -> None:
        self.repeats += 1
        self._node.counts["repeated"] += 1
        self._port.publish_output(episode.stamp_ns)

    def on_matched(self, status: Any) -> None:
        """A subscriber of `output` has come: if it is the controller, it can go on."""
        if self.episode is None or status.current_count_change <= 0:
            return
        self.repeats = 0  # what was published before, it may not have heard
        if self._port.phase == "stopped":
            self._port.tell("running")
            self._repeat_output(self.episode)

    def _publish_clock(self) -> None:
        if self.episode is not None and self.clock_ns != self.episode.stamp_ns:
            self.clock_ns = self.episode.stamp_ns
            self._port.publish_clock(self.clock_ns)

    def changed(self) -> None:
        """Changed parameters wait for the next episode."""

    def state(self) -> tuple[int, str, dict[str, object]]:
        """As `LoopNode.state`."""
        facts: dict[str, object] = {
            "episode": self._port.label.number,
            "state": self._port.phase,
            "plan": self.plan.digest if self.plan else "",
        }
        if self.episode is not None:
            facts["time_s"] = self.episode.stamp_ns / 1e9
        if self._port.phase == "stopped":
            return ERROR, "no controller answers: start one, or call plant/reset", facts
        if self._port.phase == "waiting":
            return WARN, "waiting for a plan on scenario_plan: start the scenario", facts
        return OK, self._port.phase, facts
