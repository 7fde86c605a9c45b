"""The loop's nodes as processes: distributed = local, order of starting, refusals, endings."""

from __future__ import annotations

import dataclasses
import math
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest

from tdof_npid_ros.case import load_case
from tdof_npid_ros.control.options import ControllerOptions
from tdof_npid_ros.parameter_file import config_folder
from tdof_npid_ros.parameters import NODES, OF_ROS, PLAN
from tdof_npid_ros.plants.catalog import model_table
from tdof_npid_ros.scenario import parse_plan

AT_ONCE = 2.5  # s; some 0.3 s on a quiet machine
PERIOD_NS = 5_000_000
SHORT = {
    "p1-c0.5": ("0 setpoint 1", "0.5 disturbance 0.5", "1.5 end"),
    "sprott": ("0 setpoint 1", "0 plant.a 0.6", "0.2 plant.a 0.72", "0.5 end"),
}


def run_short(
    graph: Any, case: str, lanes: int = 1, plant: Mapping[str, Any] = MappingProxyType({}), **controller: Any
) -> tuple[np.ndarray, np.ndarray]:
    """Run the short plan of a case; returns its outputs and efforts, (steps + 1, lanes)."""
    from sensor_msgs.msg import JointState
    from std_srvs.srv import Trigger

    outputs, efforts = graph.collect("output", JointState), graph.collect("control_effort", JointState)
    graph.start("plant", case=case, lanes=lanes, **plant)
    graph.start("controller", case=case, **controller)
    graph.start("scenario", case=case, episodes=["short"], plan__short=list(SHORT[case]))
    graph.wait_until(lambda: graph.fact("/plant", "state") == "finished", 60, "the end of the episode")
    steps = load_short(case).signals["short"].steps
    for episode in range(2, 7):  # until this onlooker has found both publishers and sees a whole episode
        outputs.clear()
        efforts.clear()
        assert graph.call("plant/reset", Trigger).success
        graph.wait_until(lambda n=episode: graph.fact("/plant", "episode") == str(n), 60)
        graph.wait_until(lambda: graph.fact("/plant", "state") == "finished", 60)
        end = time.monotonic() + 2.0
        graph.wait_until(lambda until=end: len(efforts) == len(outputs) == steps + 1 or time.monotonic() > until)
        if len(efforts) == len(outputs) == steps + 1:
            break
    y = {s: m.position for s, m in zip(stamps(outputs), outputs, strict=True)}
    u = {s: m.effort for s, m in zip(stamps(efforts), efforts, strict=True)}
    assert len(y) == len(u) == steps + 1
    return np.array([y[s] for s in sorted(y)]), np.array([u[s] for s in sorted(u)])


def load_short(case: str) -> Any:
    return dataclasses.replace(load_case(case), episodes={"short": SHORT[case]})


def stamps(messages: list[Any]) -> list[int]:
    return [m.header.stamp.sec * 1_000_000_000 + m.header.stamp.nanosec for m in messages]


@pytest.mark.parametrize("case", ["p1-c0.5", "sprott"])
def test_distributed_equals_local(graph: Any, case: str) -> None:
    y, u = run_short(graph, case)
    local = load_short(case).simulate("short")
    assert np.array_equal(y, local.output)
    assert np.array_equal(u, local.control_effort)


def test_distributed_equals_local_with_lanes(graph: Any) -> None:
    from sensor_msgs.msg import JointState

    values = {"kp": (9.4, 5.0, 2.0), "alpha": (0.3, 0.2, 0.0), "effort_max": (4.0, 3.0, math.inf)}
    gains = load_case("p1-c0.5").gains.with_values(**values)
    states = graph.collect("controller_state", JointState)
    y, u = run_short(graph, "p1-c0.5", lanes=3, **values)
    local = load_short("p1-c0.5").simulate("short", gains)
    assert np.array_equal(y, local.output)
    assert np.array_equal(u, local.control_effort)
    assert u.max(axis=0)[:2].tolist() == [4.0, 3.0]
    graph.wait_until(lambda: states and stamps(states)[-1] == (len(y) - 1) * load_case("p1-c0.5").sample_period_ns)
    terms = dict(zip(states[-1].name, states[-1].position, strict=True))
    assert [terms[f"error/{lane}"] for lane in range(3)] == (1.0 - y[-1]).tolist()
    assert terms["unlimited_effort/2"] == u[-1, 2]


def test_distributed_equals_local_where_each_lane_has_a_plant_of_its_own(graph: Any) -> None:
    own = {"gain": [1.0, 1.3, 0.7], "dead_time": [0.5, 0.0, 0.1234]}
    kp = (9.4, 5.0, 2.0)
    y, u = run_short(graph, "p1-c0.5", lanes=3, plant=own, kp=kp)
    case = load_short("p1-c0.5")
    case = dataclasses.replace(case, plant_values={**case.plant_values, **own})
    local = case.simulate("short", case.gains.with_values(kp=kp))
    assert np.array_equal(y, local.output)
    assert np.array_equal(u, local.control_effort)
    assert len(set(y[-1])) == 3
    for refused, why in (
        ({"gain": [1.0, 2.0]}, "gain has 2 values, but dead_time has 3"),
        ({"lanes": 2}, "for 3 lanes, but lanes is 2"),
    ):
        assert why in graph.set_parameters("/plant", **refused)[0].reason


def test_distributed_equals_local_with_an_operator_s_settings(graph: Any) -> None:
    options = {"setpoint_rate": 2.0, "effort_rate": 50.0, "dead_band": 0.01, "filter_time": 0.02, "setpoint_max": 0.9}
    y, u = run_short(graph, "p1-c0.5", **options)
    local = dataclasses.replace(load_short("p1-c0.5"), options=ControllerOptions(**options)).simulate("short")
    assert np.array_equal(y, local.output)
    assert np.array_equal(u, local.control_effort)


def test_nodes_start_in_any_order_in_a_namespace_and_end_at_once(graph: Any) -> None:
    scenario = graph.start("scenario", namespace="/a", mode="lockstep", episodes=["e"],
                           plan__e=["0 setpoint 1", "1 end"], fresh=True)  # fmt: skip
    graph.wait_for_nodes("/a/scenario")
    controller = graph.start("controller", namespace="/a", fresh=True)
    plant = graph.start("plant", namespace="/a", mode="lockstep", fresh=True)
    graph.wait_until(lambda: graph.fact("/a/plant", "state") == "finished", 60, "the end of the episode")
    for process in (plant, controller, scenario):
        assert process.stop() < AT_ONCE


def test_ctrl_c_again_and_again_while_it_is_loaded(graph: Any) -> None:
    process = graph.start("plant", fresh=True)
    maps = Path(f"/proc/{process.process.pid}/maps")
    graph.wait_until(lambda: "librcl" in maps.read_text(), what="the first library")
    process.stopped = True
    while process.process.poll() is None:
        process.send(signal.SIGINT)
        graph.spin_once(0.01)
    assert (process.process.returncode, process.log) == (0, "")


def test_ctrl_c_again_and_again_while_a_tuner_ends(graph: Any) -> None:
    process = graph.start("tuner", "-p", "case:=p1-c0.5")
    graph.wait_for_log(process, "tuning")
    process.stopped = True
    while process.process.poll() is None:
        process.send(signal.SIGINT)
        graph.spin_once(0.01)
    assert process.process.returncode == 0, process.log


OUTLIVED = """
import rclpy
from tdof_npid_ros.graph.plant.node import PlantNode
rclpy.init()
stays = rclpy.create_node("stays")
node = PlantNode()
node.trigger_configure()
node.trigger_activate()
input()
node.destroy_node()
print("destroyed", flush=True)
input()
"""


def test_a_destroyed_node_leaves_the_domain_before_its_process_ends(graph: Any) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", OUTLIVED],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=graph.environment,
        text=True,
    ) as process:
        assert process.stdin is not None and process.stdout is not None
        graph.wait_until(lambda: "plant" in graph.node.get_node_names(), 60, "the plant")
        process.stdin.write("\n")
        process.stdin.flush()
        assert process.stdout.readline() == "destroyed\n"
        with graph.newcomer() as newcomer:
            left = {"stays"}
            graph.wait_until(
                lambda: {"stays", "plant"} & set(newcomer.get_node_names()) == left, 30, "the plant's leaving"
            )
        assert process.poll() is None
        process.communicate("\n", timeout=30)
    assert process.returncode == 0


STUCK = """
import ctypes, sys
from tdof_npid_ros.graph.runtime.node import LoopNode
from tdof_npid_ros.graph.runtime.run import run_node

class Stuck(LoopNode):
    def destroy_node(self):
        ctypes.PyDLL(None).sleep(60)  # and nobody else can run any Python

run_node(lambda: Stuck("stuck"), sys.argv)
"""


def test_a_node_that_the_middleware_does_not_let_go_of_ends_all_the_same(graph: Any) -> None:
    with subprocess.Popen([sys.executable, "-c", STUCK], env=graph.environment) as process:
        graph.wait_for_nodes("/stuck")
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0


def test_controller_killed_and_restarted(graph: Any) -> None:
    plant = graph.start("plant", mode="lockstep", reply_timeout=0.05, retries=2)
    controller = graph.start("controller")
    graph.start("scenario", mode="lockstep", episodes=["e"], plan__e=["0 setpoint 1", "3000 end"])
    graph.wait_until(lambda: int(graph.fact("/plant", "steps", 0)) > 100, 60, "steps")
    with graph.expect_log(plant, ": stopped. Start a controller"):
        controller.send(signal.SIGKILL)
    assert graph.fresh_fact("/plant", "state") == "stopped"
    assert "start one" in graph.fact("/plant", "message")
    before = int(graph.fact("/plant", "steps"))
    graph.start("controller")
    graph.wait_until(lambda: int(graph.fact("/plant", "steps")) > before + 100, 60, "more steps")


def test_a_plant_that_is_started_again_finishes_the_scenario(graph: Any) -> None:
    plant = graph.start("plant", mode="lockstep")
    graph.start("controller")
    graph.start(
        "scenario", mode="lockstep", episodes=["e", "f"], plan__e=["0 setpoint 1", "1 end"],
        plan__f=["0 setpoint 2", "100 end"],
    )  # fmt: skip
    graph.wait_until(lambda: graph.fact("/plant", "episode") == "2", 60, "the second episode")
    plant.send(signal.SIGKILL)
    graph.start("plant", mode="lockstep")
    graph.wait_until(lambda: graph.fact("/scenario", "played") == "1", 60, "the end of the scenario")
    assert graph.fact("/plant", "episode") == "1"


def test_an_answer_that_nobody_could_hear_yet_is_given_again(graph: Any) -> None:
    """The plant may be found after the controller has answered it; then it waits for that answer."""
    from sensor_msgs.msg import JointState
    from trajectory_msgs.msg import JointTrajectory

    from tdof_npid_ros.graph.runtime.messages import plan_message
    from tdof_npid_ros.graph.runtime.qos import LATCHED_QOS

    graph.start("controller")
    plan = load_case("p1-c0.5").plans["setpoint"]
    plans = graph.publisher("scenario_plan", JointTrajectory, LATCHED_QOS)
    output = JointState(position=[0.25])
    output.header.frame_id = f"{plan.digest}/1"
    graph.publisher("output", JointState).publish(output)
    graph.publish_until(
        plans,
        plan_message(plan, 0),
        lambda: graph.fact("/controller", "steps") == "1",
        what="an answer that nobody hears",
    )
    efforts = graph.collect("control_effort", JointState)
    graph.wait_until(lambda: efforts, what="the same answer")
    assert efforts[0].header.frame_id.endswith(output.header.frame_id)
    assert list(efforts[0].position) == [1.0]


@pytest.mark.parametrize(
    ("node", "parameters", "reason"),
    [
        ("controller", {"kp": "much"}, "kp"),
        ("controller", {"sigma": -1.0}, "sigma"),
        ("controller", {"sample_period": 0.0}, "sample_period"),
        ("controller", {"cpu": 0.5}, "cpu is 0.5: it must be a whole number"),
        ("plant", {"mode": "fast"}, "mode"),
        ("plant", {"model": "no.such:Plant"}, "no.such"),
        ("plant", {"lanes": 0}, "lanes"),
        ("plant", {"start": 1e6, "effort_min": 0.0, "effort_max": 100.0}, "beyond its limits 0 to 100"),
        ("plant", {"start": 1e6, "effort_max": 100.0, "mode": "lockstep"}, "beyond its limits -inf to 100"),
        ("scenario", {"episodes": ["missing"], "plan__missing": ["0 setpoint 1"]}, "end"),
    ],
)
def test_bad_start_parameters_are_one_line_and_status_2(
    graph: Any, node: str, parameters: dict[str, Any], reason: str
) -> None:
    process = graph.start(node, **parameters)
    process.expected_status = 2
    assert process.process.wait(30) == 2
    lines = process.log.strip().splitlines()
    assert len(lines) == 1 and reason in lines[0], process.log


def test_a_misspelt_parameter_is_warned_of(graph: Any, tmp_path: Path) -> None:
    plant = graph.start("plant", gian=2.0, sample_period=0.01, joint_names=[""], plan__setpoint=["1 end"])
    graph.wait_for_nodes("/plant")
    assert "parameter gian is not one of this node's, and does nothing: gain is meant?" in plant.log
    assert plant.log.count("not one of this node's") == 1
    case = tmp_path / "mine.yaml"
    case.write_text((config_folder() / "p1-c4.yaml").read_text().replace("weight:", "wieght:"))
    tuner = graph.start("tuner", "-p", f"case:={case}", autostart=False)
    warning = "mine.yaml: tuner: parameter wieght is not one of this node's, and does nothing: weight is meant?"
    graph.wait_for_log(tuner, warning)


@pytest.mark.parametrize("node", NODES)
def test_a_node_declares_its_table_and_describes_it(graph: Any, node: str, tmp_path: Path) -> None:
    from rcl_interfaces.msg import ParameterType
    from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters

    given = {"tuner": "case:=p1-c4", "replay": "bag:=bags/sample", "recorder": f"bag:={tmp_path / 'bag'}"}.get(node)
    graph.start(node, *(["-p", given] if given else []), autostart=False)
    graph.wait_for_nodes(f"/{node}")
    listed = graph.call(f"/{node}/list_parameters", ListParameters, ListParameters.Request(), again=True)
    model = model_table("first_order") if node == "plant" else {}
    table = {**NODES[node], **model}
    names = [name for name in listed.result.names if not name.startswith(OF_ROS) and not name.startswith(PLAN.name)]
    assert set(names) == table.keys()
    described = graph.call(
        f"/{node}/describe_parameters", DescribeParameters, DescribeParameters.Request(names=names), again=True
    )
    values = graph.call(f"/{node}/get_parameters", GetParameters, GetParameters.Request(names=names), again=True)
    for name, found, value in zip(names, described.descriptors, values.values, strict=True):
        parameter = table[name]
        assert parameter.description in found.description
        assert found.additional_constraints == parameter.constraints
        assert found.read_only == parameter.fixed
        assert found.type == value.type != ParameterType.PARAMETER_NOT_SET
        ranges = found.floating_point_range or found.integer_range
        assert bool(ranges) == parameter.is_slider
        assert not ranges or (ranges[0].from_value, ranges[0].to_value) == parameter.within[:2]


ADDED = """
import sys
from tdof_npid_ros import parameters
from tdof_npid_ros.parameter import Parameter, Range

parameters.SCENARIO["patience"] = Parameter("patience", 1.5, "how long it waits", "s", Range(0.0, 9.0))
from tdof_npid_ros.graph.__main__ import run

run("scenario", ["scenario", *sys.argv[1:]])
"""


def test_a_parameter_added_to_the_table_alone_is_declared_and_checked(graph: Any) -> None:
    graph.start("scenario", "-p", "patience:=3", program=ADDED, autostart=False)
    graph.wait_for_nodes("/scenario")
    assert graph.get_parameters("/scenario", "patience") == [3]
    (result,) = graph.set_parameters("/scenario", patience=10.0)
    assert result.reason == "patience is 10.0: it must be a number from 0 to 9, in s"
    (result,) = graph.set_parameters("/scenario", patience=4)
    assert result.successful
    assert graph.get_parameters("/scenario", "patience") == [4.0]
    assert graph.fresh_fact("/scenario", "refused_parameters", 0) == "1"


def test_what_a_plant_cannot_do_is_refused_and_it_goes_on(graph: Any) -> None:
    from trajectory_msgs.msg import JointTrajectory

    from tdof_npid_ros.graph.runtime.messages import plan_message
    from tdof_npid_ros.graph.runtime.qos import LATCHED_QOS

    plant = graph.start("plant", model="third_order", mode="lockstep")
    graph.wait_for_nodes("/plant")
    (result,) = graph.set_parameters("/plant", time_constant=1e110)
    assert not result.successful
    publisher = graph.publisher("scenario_plan", JointTrajectory, LATCHED_QOS)
    changeable = {"dead_time": 0.0, "nonsense": 0.0, "gain": 1.0}
    for count, lines in enumerate((["0 plant.dead_time 500"], ["0 plant.nonsense 1"]), 1):
        publisher.publish(plan_message(parse_plan([*lines, "1 end"], PERIOD_NS, changeable), 0))
        graph.wait_until(lambda n=count: int(graph.fact("/plant", "rejected", 0)) == n, what="a refusal")
    assert "plant.dead_time cannot change while the loop runs: with model third_order these can: gain" in plant.log
    publisher.publish(plan_message(parse_plan(["0 plant.gain 2", "1 end"], PERIOD_NS, changeable), 0))
    graph.wait_until(lambda: graph.fact("/plant", "episode") == "1", what="a plan that it can follow")


def test_a_lockstep_plant_that_is_activated_again_begins_anew(graph: Any) -> None:
    from sensor_msgs.msg import JointState
    from trajectory_msgs.msg import JointTrajectory

    from tdof_npid_ros.graph.runtime.messages import plan_message
    from tdof_npid_ros.graph.runtime.qos import LATCHED_QOS

    outputs = graph.collect("output", JointState)
    graph.start("plant", mode="lockstep", case="p1-c0.5")
    graph.start("controller", case="p1-c0.5")
    graph.wait_for_nodes("/plant", "/controller")
    publisher = graph.publisher("scenario_plan", JointTrajectory, LATCHED_QOS)
    publisher.publish(plan_message(parse_plan(["0 setpoint 1", "1000 end"], 5_000_000), 0))
    graph.wait_until(lambda: len(outputs) > 100, what="a loop that runs")
    graph.node.destroy_publisher(publisher)
    assert graph.change_state("/plant", "deactivate")
    assert graph.change_state("/plant", "activate")
    graph.wait_for_nodes("/plant")
    assert graph.fact("/plant", "state") == "waiting"


def test_different_sample_periods_are_told(graph: Any) -> None:
    graph.start("controller", case="p1-c0.5", sample_period=0.05)
    graph.start("plant", case="p1-c0.5")
    graph.start("scenario", case="p1-c0.5")
    graph.wait_until(lambda: graph.fact("/controller", "level", 0) == 2, 60, "a controller that tells")
    assert graph.fact("/controller", "message") == "plant and controller differ in sample_period: give both the same"


@pytest.fixture(scope="module")
def loop(shared_graph: Any) -> Any:
    from sensor_msgs.msg import JointState

    shared_graph.process = shared_graph.start("controller", case="p1-c0.5", namespace="/c")
    shared_graph.efforts = shared_graph.collect("/c/control_effort", JointState)
    shared_graph.output = shared_graph.publisher("/c/output", JointState)
    shared_graph.time_ns = 0
    shared_graph.wait_for_nodes("/c/controller")
    return shared_graph


class TestController:
    """Refusals of one controller that goes on."""

    def answer(self, loop: Any, *position: float) -> Any:
        """The answer to the next output."""
        loop.time_ns += PERIOD_NS
        return self.answer_again(loop, *position)

    def answer_again(self, loop: Any, *position: float) -> Any:
        """The answer to an output with the stamp of the latest."""
        message, count = output_message(loop.time_ns, *position), len(loop.efforts)
        answered = loop.publish_until(
            loop.output,
            message,
            lambda: [m for m in loop.efforts[count:] if m.header.stamp == message.header.stamp],
            what="an answer",
        )
        return answered[0]

    def wait_for_rejection(self, loop: Any, publisher: Any, message: Any) -> None:
        rejected = int(loop.fresh_fact("/c/controller", "rejected", 0))
        loop.publish_until(
            publisher, message, lambda: int(loop.fact("/c/controller", "rejected", 0)) > rejected, what="a rejection"
        )

    @pytest.mark.parametrize(
        ("values", "reason"),
        [
            ({"kp": math.nan}, "kp is nan"),
            ({"kp": math.inf}, "finite"),
            ({"kp": "high"}, "number"),
            ({"kp": [1.0, math.nan]}, "nan"),
            ({"kp": [1.0, 2.0], "ki": [1.0, 2.0, 3.0]}, "lanes"),
            ({"kp": True}, "number"),
            ({"sigma": 0.0}, "above 0"),
            ({"type": "fuzzy"}, "one of"),
            ({"anti_windup": "magic"}, "one of"),
            ({"kp": 3.0, "n": -1.0}, "n is"),
            ({"effort_min": 1.0, "effort_max": -1.0}, "effort_min"),
            ({"sample_period": 0.1}, "read"),
        ],
    )
    def test_bad_parameters_are_refused_whole(self, loop: Any, values: dict[str, Any], reason: str) -> None:
        names = ["kp", "ki", "sigma", "n", "type", "effort_min", "effort_max", "sample_period"]
        before = loop.get_parameters("/c/controller", *names)
        (result,) = loop.set_parameters("/c/controller", atomically=True, **values)
        assert not result.successful
        assert reason in result.reason
        assert loop.get_parameters("/c/controller", *names) == before

    def test_what_the_command_line_sends_is_taken_as_declared(self, loop: Any) -> None:
        """`ros2 param set` and `load` make 3 of 3.0, and the word inf of .inf."""
        for sent, taken in ((3, 3.0), ("inf", math.inf), ("-.inf", None), (".INF", math.inf)):
            (result,) = loop.set_parameters("/c/controller", effort_max=sent)
            assert result.successful == (taken is not None), result.reason
            if taken is not None:
                (value,) = loop.get_parameters("/c/controller", "effort_max")
                assert type(value) is float and value == taken
        for name, wrong in (("save_i_term", "x"), ("save_i_term", None), ("kp", None), ("type", 3), ("manual", [True])):
            (result,) = loop.set_parameters("/c/controller", **{name: wrong})
            assert not result.successful and f"{name} is {wrong!r}" in result.reason

    def test_lanes_of_a_loop_that_runs_are_not_changed(self, loop: Any) -> None:
        self.answer(loop, 0.1)
        (result,) = loop.set_parameters("/c/controller", kp=[1.0, 2.0])
        assert not result.successful and "the loop that runs has 1" in result.reason

    def test_good_parameters_are_logged_old_and_new(self, loop: Any) -> None:
        assert loop.set_parameters("/c/controller", effort_max=50)[0].successful
        loop.wait_for_log(loop.process, "effort_max: inf -> 50")

    def test_bad_outputs_are_counted_and_change_nothing(self, loop: Any) -> None:
        latest = self.answer(loop, 0.1)
        stamp_ns = loop.time_ns
        for bad in ((math.nan,), (-math.inf,), (), (1.0, 2.0)):
            loop.time_ns += PERIOD_NS
            self.wait_for_rejection(loop, loop.output, output_message(loop.time_ns, *bad))
        assert max(stamps(loop.efforts)) == stamp_ns
        loop.time_ns = stamp_ns
        assert self.answer_again(loop, 0.1).effort == latest.effort  # no state has advanced
        assert loop.process.log.count("output that is not finite refused") == 1
        assert "output refused: it has 0 values for 1 lanes" in loop.process.log

    def test_an_output_of_no_valid_time_is_refused(self, loop: Any) -> None:
        latest = self.answer(loop, 0.1)
        message = output_message(loop.time_ns, 0.1)
        message.header.stamp.sec, message.header.stamp.nanosec = 2**31 - 1, 2**32 - 1
        self.wait_for_rejection(loop, loop.output, message)
        assert self.answer_again(loop, 0.1).effort == latest.effort

    def test_bad_setpoints_are_refused(self, loop: Any) -> None:
        from sensor_msgs.msg import JointState

        setpoint = loop.publisher("/c/setpoint", JointState)
        loop.publish_until(
            setpoint,
            JointState(position=[0.25]),
            lambda: list(self.answer(loop, 0.1).position) == [0.25],
            what="the setpoint to be taken",
        )
        rejected = int(loop.fresh_fact("/c/controller", "rejected", 0))
        for position in ([math.nan], [1.0, 2.0, 3.0], [], [-math.inf]):
            setpoint.publish(JointState(position=position))
        loop.wait_until(lambda: int(loop.fact("/c/controller", "rejected", 0)) == rejected + 4, what="4 rejections")
        assert list(self.answer(loop, 0.1).position) == [0.25]
        assert loop.process.log.count("setpoint") == 1

    def test_bad_plans_are_refused(self, loop: Any) -> None:
        from builtin_interfaces.msg import Duration
        from rclpy.qos import DurabilityPolicy, QoSProfile
        from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

        plan = loop.publisher(
            "/c/scenario_plan", JointTrajectory, QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        )
        point = JointTrajectoryPoint(positions=[math.nan])
        for message in (
            JointTrajectory(),
            JointTrajectory(joint_names=["nonsense"], points=[point, point]),
            JointTrajectory(joint_names=["setpoint"], points=[point, JointTrajectoryPoint(
                positions=[1.0], time_from_start=Duration(sec=1))]),
        ):  # fmt: skip
            self.wait_for_rejection(loop, plan, message)

    def test_idle_uses_no_measurable_processor_time(self, loop: Any) -> None:
        stat = Path(f"/proc/{loop.process.process.pid}/stat")

        def ticks() -> int:
            fields = stat.read_text().rsplit(")", 1)[1].split()
            return int(fields[11]) + int(fields[12])

        before, end = ticks(), time.monotonic() + 2.0
        loop.wait_until(lambda: time.monotonic() > end, what="2 s")
        assert ticks() - before <= 6  # of 200 hundredths of a second; it publishes diagnostics once a second


def output_message(time_ns: int, *position: float) -> Any:
    from sensor_msgs.msg import JointState

    message = JointState(position=position)
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(time_ns, 1_000_000_000)
    return message
