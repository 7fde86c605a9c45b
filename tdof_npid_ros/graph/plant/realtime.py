"""The plant in realtime: it steps on a steady timer and takes the newest effort.

Step k bears the stamp start + k·h in ROS time, from the tick that was due at the start, however late that came, and
whatever happens to the wall clock.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from tdof_npid_ros.graph.plant.port import PlantPort
from tdof_npid_ros.graph.runtime.loop_end import patience_ns
from tdof_npid_ros.graph.runtime.node import ERROR, OK, STEADY, WARN
from tdof_npid_ros.graph.runtime.realtime import LatestTimes, SteadyRosTime
from tdof_npid_ros.plants.failsafe import FailSafe
from tdof_npid_ros.plants.plant import EachLane
from tdof_npid_ros.wire import AnswerLabel, Sample

CLOCK_PERIOD_NS = 10_000_000  # at least, of wall time, between two /clock messages


class RealtimePlant:
    """Steps once per period of wall time; a tick that comes too late is counted and never made up."""

    def __init__(self, port: PlantPort) -> None:
        self._port, self._node = port, port.node

    def activate(self) -> None:
        """Create the topics and the timer."""
        node = self._node
        self.period_error, self.output_to_effort = LatestTimes(), LatestTimes()
        speed = node.values_of(["speed"])["speed"]
        self.wall_period_ns = max(1, round(self._port.period_ns / speed))
        self.start_ns = node.get_clock().now().nanoseconds  # the stamp of step 0
        self.ros_time = SteadyRosTime(self.start_ns, STEADY.now().nanoseconds, speed)
        self.clock_told_ns = self.latest_stamp_ns = 0
        self._begin()
        node.subscribe_signal("control_effort", self._on_effort, node.requested_qos(as_promised=True), sole=True)
        node.subscribe_signal("disturbance", self._on_disturbance, node.requested_qos(1))
        self.due_from_ns = STEADY.now().nanoseconds  # ticks are due whole periods after
        node.create_timer(self.wall_period_ns / 1e9, self._on_tick, clock=STEADY)

    def reset(self) -> tuple[bool, str]:
        """Back to the initial state; the next tick is step 0."""
        try:
            self._begin()
        except (ValueError, ArithmeticError) as error:
            return False, str(error)
        return True, "at the initial state"

    def _begin(self) -> None:
        """Begin an episode; a plant that cannot rest at `start` raises ValueError, and changes nothing."""
        port = self._port
        label = port.next_label("")
        port.begin(label, port.new_simulator(label.number))
        self._start()

    def _start(self) -> None:
        lanes = self._port.simulator.lanes
        self.disturbance = np.zeros(lanes)
        self.failsafe = FailSafe(lanes, *self._failsafe_settings())
        resting = self._port.simulator.applied_effort
        if resting.any():  # it begins with the effort that holds it where it is, as if that had just come
            self.failsafe.take(resting.copy(), STEADY.now().nanoseconds)
        self.step = 0
        self.first_tick_ns: int | None = None
        self.output_ns = (0, 0)  # stamp of the latest output, and when it was published

    def _failsafe_settings(self) -> tuple[int, float | None, int]:
        p = self._node.values_of(["effort_timeout", "fallback", "fallback_effort", "return_time"])
        fallback = float(p["fallback_effort"]) if p["fallback"] == "effort" else None
        return patience_ns(p["effort_timeout"], self.wall_period_ns), fallback, round(p["return_time"] * 1e9)

    def _on_tick(self) -> None:
        node, now = self._node, STEADY.now().nanoseconds
        if self.first_tick_ns is None:
            self.first_tick_ns = now - (now - self.due_from_ns) % self.wall_period_ns  # when it was due
            after_all_ns = self.latest_stamp_ns + self._port.period_ns
            self.start_ns = max(self.ros_time.at(self.first_tick_ns), after_all_ns)
            self.latest_tick_ns = now
            self.missed_ticks = 0
        else:
            self._account_for_tick(now)
            was_silent = self.failsafe.silent
            effort = self.failsafe.effort_at(now)
            if self.failsafe.silent and not was_silent:
                self._report_silence()
            self._port.simulator.advance(effort, self.disturbance)
            node.counts["steps"] += 1
            self.step += 1
        stamp_ns = self.start_ns + self.step * self._port.period_ns
        self._port.publish_output(stamp_ns)
        self.latest_stamp_ns = stamp_ns
        self.output_ns = stamp_ns, now
        if now - self.clock_told_ns >= CLOCK_PERIOD_NS:
            self.clock_told_ns = now
            self._port.publish_clock(stamp_ns)

    def _account_for_tick(self, now: int) -> None:
        assert self.first_tick_ns is not None
        self.period_error.add(abs(now - self.latest_tick_ns - self.wall_period_ns))
        self.latest_tick_ns = now
        missed = (now - self.first_tick_ns) // self.wall_period_ns - (self.step + 1)
        if missed > self.missed_ticks:
            self._node.counts["missed_ticks"] += missed - self.missed_ticks
            self.missed_ticks = missed

    def _on_effort(self, sample: Sample) -> None:
        episode = AnswerLabel.parse(sample.frame_id).episode
        if episode is not None and episode != self._port.label:  # still on its way when the plant was reset
            self._node.counts["late"] += 1
            return
        effort = self._port.effort_of(sample)
        if effort is None:
            return
        now = STEADY.now().nanoseconds
        stamp, published = self.output_ns
        if sample.stamp_ns == stamp:
            self.output_to_effort.add(now - published)
        if self.failsafe.take(effort, now):
            self._node.get_logger().info("control_effort comes again: going over to it")

    def _report_silence(self) -> None:
        p = self._node.values_of(["fallback", "fallback_effort"])
        does = f"taking fallback_effort {p['fallback_effort']:g}" if p["fallback"] == "effort" else "holding the last"
        self._node.counts["silences"] += 1
        self._node.get_logger().error(f"no control_effort for {self._failsafe_settings()[0] / 1e9:g} s: {does}")

    def _on_disturbance(self, sample: Sample) -> None:
        lanes = self._port.simulator.lanes
        disturbance = np.repeat(sample.effort, lanes) if len(sample.effort) == 1 else sample.effort
        if self._port.takes("disturbance", disturbance):
            self.disturbance = disturbance

    def on_matched(self, status: Any) -> None:
        """Nothing waits for subscribers."""

    def changed(self) -> None:
        """Take over changed parameters."""
        node, simulator, plant = self._node, self._port.simulator, self._port.plant_at({})
        if not isinstance(plant, EachLane) or len(plant.plants) == simulator.lanes:  # else both wait for the next reset
            simulator.change_plant(plant)
        simulator.effort_limits = self._port.effort_limits()
        if node.active:
            self.failsafe.change(*self._failsafe_settings())

    def state(self) -> tuple[int, str, dict[str, object]]:
        """As `LoopNode.state`."""
        facts: dict[str, object] = {
            "episode": self._port.label.number,
            "state": "fallback" if self.failsafe.silent else "running",
            "time_s": self.step * self._port.period_ns / 1e9,
            **self.period_error.facts("period_error"),
            **self.output_to_effort.facts("output_to_effort"),
        }
        if self.failsafe.silent:
            return ERROR, "no control_effort: the plant has taken its fallback; start or free the controller", facts
        if not self.failsafe.is_driven:
            return WARN, "no control_effort yet: start a controller in this namespace", facts
        return OK, "running", facts
