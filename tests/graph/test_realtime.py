"""The realtime plant keeps time: absolute schedule, missed ticks, speed, figures in the diagnostics, an idle tick's
cost."""

from __future__ import annotations

import os
import time
from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from test_operation import Live

from tdof_npid_ros.graph.runtime.realtime import LatestTimes, SteadyRosTime

SOAK_SECONDS = float(os.environ.get("TDOF_SOAK_SECONDS", "20"))
WARM_UP_SECONDS = min(60.0, SOAK_SECONDS / 2)


@pytest.mark.alone
def test_figures_and_speed(graph: Any) -> None:
    """At speed 5, 100 Hz of simulated time are 500 ticks a second; none is made up, none is lost."""
    from rosgraph_msgs.msg import Clock

    clock = graph.collect("/clock", Clock)
    live = Live(graph, "/fast", {"speed": 5.0}, {})
    live.settle()

    def ticks() -> tuple[int, int]:
        """Ticks that were due, and when; fewer if the process was held up just before."""
        graph.wait_for_nodes(live.plant_name)
        counts = [int(graph.fact(live.plant_name, name, 0)) for name in ("steps", "missed_ticks")]
        return sum(counts), graph.fact(live.plant_name, "stamp_ns")

    def rate() -> float:
        """Ticks a second since the beginning: the longer, the less it matters that the process was held up."""
        last, ended = ticks()
        return (last - first) / (ended - began) * 1e9

    first, began = ticks()
    graph.wait_until(lambda: rate() == pytest.approx(500.0, rel=0.02), 30, "500 ticks a second")
    graph.wait_until(lambda: graph.fact("/fast/plant", "output_to_effort_p99_us"), what="the figures")
    for figure in ("period_error_p50_us", "period_error_p99_us", "output_to_effort_p50_us"):
        assert 0.0 <= float(graph.fact("/fast/plant", figure)) < 1e6
    stamps = [ns(m.header.stamp) for m in live.outputs]
    assert set(b - a for a, b in zip(stamps, stamps[1:], strict=False)) == {10_000_000}
    told = [ns(m.clock) for m in clock]
    assert len(told) > 100 and set(told[10:-10]) <= set(stamps) and told == sorted(set(told))


def test_stamps_are_ros_time_on_one_grid_and_go_on_over_a_reset(graph: Any) -> None:
    """Also those of a scenario's signals; and the plant publishes no /clock, as time is the wall clock's."""
    from sensor_msgs.msg import JointState
    from std_srvs.srv import Trigger

    live = Live(graph, "/ros", {}, {"setpoint": 0.0})
    setpoints = graph.collect("/ros/setpoint", JointState)
    graph.wait_until(lambda: len(live.efforts) > 50, what="a loop")
    assert abs(ns(live.outputs[-1].header.stamp) - time.time_ns()) < 5e9
    assert graph.call("/ros/plant/reset", Trigger, again=True).success
    played = {"episodes": ["a"], "plan__a": ["0 setpoint 1", "0.5 setpoint 0.5", "1 end"]}
    graph.start("scenario", namespace="/ros", mode="realtime", sample_period=0.01, **played)
    graph.wait_until(lambda: any(m.position[0] == 0.5 for m in setpoints), what="the plan")
    assert set(np.diff([ns(m.header.stamp) for m in setpoints if m.position])[-1:]) == {500_000_000}
    assert abs(ns(setpoints[-1].header.stamp) - ns(live.outputs[-1].header.stamp)) < 5e9
    stamps = {label: [] for label in dict.fromkeys(m.header.frame_id for m in live.outputs)}
    for message in live.outputs:
        stamps[message.header.frame_id].append(ns(message.header.stamp))
    assert len(stamps) >= 3  # the beginning, our reset and the scenario's
    assert all(set(np.diff(one)) <= {10_000_000} for one in stamps.values())
    joined = [stamp for one in stamps.values() for stamp in one]
    assert joined == sorted(set(joined))
    assert not graph.node.get_publishers_info_by_topic("/clock")


class Ticked:
    """A plant in realtime of which each tick comes when it is told to, in ns, and the stamps of its outputs."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        from tdof_npid_ros.graph.plant import realtime

        self._monkeypatch, self._module = monkeypatch, realtime
        self.stamps: list[int] = []
        settings = {"effort_timeout": 0.0, "fallback": "hold", "fallback_effort": 0.0, "return_time": 0.0}
        self.node = SimpleNamespace(counts=Counter(), values_of=lambda names: settings)
        simulator = SimpleNamespace(lanes=1, applied_effort=np.zeros(1), advance=lambda effort, disturbance: None)
        port = SimpleNamespace(
            node=self.node, period_ns=10, simulator=simulator, publish_output=self.stamps.append,
            publish_clock=lambda time_ns: None,
        )  # fmt: skip
        self.plant = realtime.RealtimePlant(port)  # type: ignore[arg-type]
        self.plant.wall_period_ns, self.plant.due_from_ns = 10, 3
        self.plant.clock_told_ns = self.plant.latest_stamp_ns = 0
        self.plant.ros_time, self.plant.period_error = SteadyRosTime(10**18, 3), LatestTimes()
        self.plant._start()

    def tick(self, *times: int) -> None:
        for now in times:
            steady = SimpleNamespace(now=lambda now=now: SimpleNamespace(nanoseconds=now))
            self._monkeypatch.setattr(self._module, "STEADY", steady)
            self.plant._on_tick()


def test_a_late_tick_shifts_no_stamp(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first one is stamped with the time at which it was due; those after it come a period later each."""
    ticked = Ticked(monkeypatch)
    ticked.tick(46, 54, 63, 97, 103)  # due at 43, 53, 63, 73 (missed), 83 (missed), 93, 103
    assert ticked.stamps == [10**18 + 40 + 10 * k for k in range(5)]
    assert ticked.node.counts["missed_ticks"] == 2


def test_stamps_grow_over_a_reset_also_after_a_first_tick_that_was_a_period_late(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ticked = Ticked(monkeypatch)
    ticked.tick(54, 54, 63)  # due at 43, 53 and 63: the first two come together
    ticked.plant._start()
    ticked.tick(73, 83)
    assert ticked.stamps == [10**18 + 50 + 10 * k for k in range(5)]
    assert ticked.node.counts["missed_ticks"] == 0


def test_with_use_sim_time_silence_counts_in_simulated_time(graph: Any) -> None:
    """A simulator that pauses is not silent; one whose time goes on without an output is."""
    from rosgraph_msgs.msg import Clock
    from sensor_msgs.msg import JointState

    efforts = graph.collect("control_effort", JointState)
    controller = graph.start("controller", output_timeout=0.1, use_sim_time=True)
    clock, output = graph.publisher("/clock", Clock), graph.publisher("output", JointState)
    now = Clock()
    now.clock.sec = 5
    graph.publish_until(clock, now, lambda: graph.fact("/controller", "stamp_ns", 0) == 5 * 10**9, what="its time")
    message = JointState(position=[0.5], effort=[0.0])
    for k in range(3):
        message.header.stamp.nanosec = 1 + k
        graph.publish_until(output, message, lambda k=k: len(efforts) > k, what="an answer")
    began = time.monotonic()
    graph.wait_until(lambda: time.monotonic() > began + 1.0)  # ten times the timeout, while the simulator pauses
    assert "no output for" not in controller.log
    now.clock.nanosec = 200_000_000
    graph.publish_until(clock, now, lambda: "no output for 0.1 s" in controller.log, what="the silence")


def ns(stamp: Any) -> int:
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def test_a_loop_slower_than_its_timeouts_is_not_silent(graph: Any) -> None:
    """A sample period above effort_timeout and output_timeout, as of a furnace."""
    from sensor_msgs.msg import JointState

    slow = {"sample_period": 0.6}
    outputs = graph.collect("output", JointState)
    graph.start("plant", time_constant=1.0, dead_time=0.0, **slow)
    graph.start("controller", kp=0.5, ki=1.0, setpoint=1.0, **slow)
    graph.wait_until(lambda: outputs and outputs[-1].position[0] > 0.4, what="an output that follows")
    graph.wait_for_nodes("/plant", "/controller")
    for node in ("/plant", "/controller"):
        assert graph.fact(node, "silences", "0") == "0", node


def test_in_realtime_each_episode_begins_with_the_configured_plant(graph: Any) -> None:
    quick = {"sample_period": 0.01, "speed": 10.0}
    graph.start("plant", **quick, gain=1.5)
    graph.wait_for_nodes("/plant")
    scenario = graph.start(
        "scenario",
        episodes=["a", "b"],
        plan__a=["0 plant.gain 3", "0 plant.dead_time 2", "30 end"],
        plan__b=["0 setpoint 1", "50 end"],
        **quick,
    )
    graph.wait_until(lambda: graph.get_parameters("/plant", "gain") == [3.0], what="the change that the plan makes")
    graph.wait_until(lambda: graph.get_parameters("/plant", "gain") == [1.5], what="the gain as it was")
    graph.wait_for_log(scenario, "plant.dead_time was refused by the plant")
    assert graph.fresh_fact("/scenario", "rejected") == "1"


@pytest.mark.alone
def test_soak_at_200_hz(graph: Any) -> None:
    """No answer is missed and memory stays flat; TDOF_SOAK_SECONDS=600 is the long version."""
    live = Live(graph, "/soak", {"sample_period": 0.005}, {"sample_period": 0.005})
    live.settle()

    def resident_kib(process: Any) -> int:
        status = Path(f"/proc/{process.process.pid}/status").read_text()
        return int(status.split("VmRSS:")[1].split()[0])

    began = time.monotonic()
    graph.wait_until(lambda: time.monotonic() - began > WARM_UP_SECONDS, SOAK_SECONDS + 30)
    before = {process.node: resident_kib(process) for process in (live.plant, live.controller)}
    first = len(live.outputs)
    graph.wait_until(lambda: time.monotonic() - began > SOAK_SECONDS, SOAK_SECONDS + 30)
    for process in (live.plant, live.controller):
        assert resident_kib(process) - before[process.node] < 1024, process.node
    answered = {(m.header.stamp.sec, m.header.stamp.nanosec) for m in live.efforts}
    unanswered = [m for m in live.outputs[first:-20] if (m.header.stamp.sec, m.header.stamp.nanosec) not in answered]
    assert len(unanswered) == 0


def test_an_episode_in_realtime_begins_at_rest_where_its_plan_says(graph: Any) -> None:
    """A heater at 60 by an effort of 50: neither moves, before the disturbance comes."""
    from sensor_msgs.msg import JointState

    quick = {"sample_period": 0.05}
    outputs = graph.collect("output", JointState)
    efforts = graph.collect("control_effort", JointState)
    heater = {"gain": 0.8, "time_constant": 2.0, "dead_time": 0.1, "output_offset": 20.0}
    graph.start("plant", **quick, **heater, effort_timeout=0.0)  # a busy machine is no silence here
    graph.start("controller", **quick, kp=1.0, ki=0.5, kd=0.1, alpha=0.3, sigma=40.0, output_timeout=0.0)
    graph.wait_until(lambda: len(efforts) > 10, what="a loop that runs")
    graph.start("scenario", **quick, episodes=["held"], plan__held=["0 start 60", "6 disturbance 20", "16 end"])
    graph.wait_until(lambda: outputs[-1].position[0] > 61.0, what="the disturbance")
    began = next(i for i, m in enumerate(outputs) if m.position[0] == 60.0)
    until = ns(outputs[began].header.stamp) + 3 * 10**9
    still = [m for m in outputs[began:] if m.position[0] < 60.1 and ns(m.header.stamp) < until]
    assert all(abs(m.position[0] - 60.0) < 1e-6 for m in still)
    at_rest = [m.effort[0] for m in efforts if m.header.frame_id.split()[-1] == outputs[began].header.frame_id]
    assert all(abs(effort - 50.0) < 1e-6 for effort in at_rest[: len(still) - 5])


def test_a_plant_that_cannot_rest_where_it_is_to_begin_refuses_it_and_goes_on(graph: Any) -> None:
    from sensor_msgs.msg import JointState
    from std_srvs.srv import Trigger

    outputs = graph.collect("output", JointState)
    plant = graph.start("plant", sample_period=0.01, time_constant=0.5, effort_min=0.0, effort_max=100.0)
    graph.wait_for_nodes("/plant")

    def reason(**values: float) -> str:
        (result,) = graph.set_parameters("/plant", **values)
        return "" if result.successful else str(result.reason)

    assert reason(start=1e6) == "start 1e+06: the plant rests there with an effort of 1e+06, beyond its limits 0 to 100"
    assert reason(start=50.0) == "" and graph.call("/plant/reset", Trigger, again=True).success
    graph.wait_until(lambda: outputs[-1].position[0] > 10.0, what="the episode that begins there")
    label = outputs[-1].header.frame_id
    assert "effort of 50, beyond its limits 0 to 40" in reason(effort_max=40.0)
    assert reason(gain=0.1) == ""  # as a plan may change it, in the midst of an episode that began at 50
    refused = graph.call("/plant/reset", Trigger, again=True)
    assert not refused.success and "effort of 500, beyond its limits 0 to 100" in refused.message
    graph.catch_up()
    seen = len(outputs)
    graph.wait_until(lambda: len(outputs) > seen + 20, what="a plant that goes on")
    assert outputs[-1].header.frame_id == label
    assert reason(gain=1.0) == "" and graph.call("/plant/reset", Trigger, again=True).success
    graph.wait_until(lambda: outputs[-1].header.frame_id != label, what="a new episode")
    assert "Traceback" not in plant.log


def test_plants_for_other_lanes_wait_for_the_reset_with_them(graph: Any) -> None:
    from sensor_msgs.msg import JointState
    from std_srvs.srv import Trigger

    outputs = graph.collect("output", JointState)
    quick = {"sample_period": 0.01, "time_constant": 0.05, "dead_time": 0.0, "effort_timeout": 0.0}
    graph.start("plant", **quick, lanes=3, gain=[1.0, 2.0, 3.0])
    efforts = graph.publisher("control_effort", JointState)

    def rests_at(*values: float) -> None:
        there = lambda: outputs and np.allclose(outputs[-1].position, values, atol=1e-3)  # noqa: E731
        graph.publish_until(efforts, JointState(effort=[1.0] * len(values)), there, what=f"outputs of {values}")

    def changed(**values: Any) -> None:
        (result,) = graph.set_parameters("/plant", atomically=True, **values)
        assert result.successful, result.reason

    rests_at(1.0, 2.0, 3.0)
    for lanes, gain in ((2, [5.0, 4.0]), (4, [5.0, 4.0, 3.0, 2.0])):
        before = list(outputs[-1].position)
        changed(lanes=lanes, gain=gain)
        graph.catch_up()
        seen = len(outputs)
        graph.wait_until(lambda seen=seen: len(outputs) > seen + 50, what="half a second")
        assert np.allclose(outputs[-1].position, before, atol=1e-3)
        assert graph.call("/plant/reset", Trigger, again=True).success
        graph.wait_until(lambda lanes=lanes: len(outputs[-1].position) == lanes, what="the other lanes")
        rests_at(*gain)
    changed(gain=[1.0] * 4)  # of the same lanes: at once
    rests_at(1.0, 1.0, 1.0, 1.0)


def test_a_scenario_tells_of_a_plant_that_does_not_begin_anew(graph: Any) -> None:
    graph.start("plant", sample_period=0.01, start=50.0, effort_max=100.0)
    graph.wait_for_nodes("/plant")
    assert graph.set_parameters("/plant", gain=0.1)[0].successful
    scenario = graph.start("scenario", sample_period=0.01, episodes=["a"], plan__a=["0 setpoint 1", "0.1 end"])
    graph.wait_for_log(scenario, "the plant does not begin anew: /plant/reset: start 50: the plant rests there")
    graph.wait_for_log(scenario, "all episodes played")
