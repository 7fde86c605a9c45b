"""What an operator may do to the running nodes: life cycle, live changes, manual mode, joints, a restored dump."""

from __future__ import annotations

import math
import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from tdof_npid_ros.analysis.verify import verify
from tdof_npid_ros.control.gains import CONTROLLER_TYPES

PLANT = {"mode": "realtime", "model": "first_order", "time_constant": 0.5, "dead_time": 0.0, "sample_period": 0.01}
CONTROLLER = {
    "sample_period": 0.01,
    "type": "tdof_npid2",
    "kp": 2.0,
    "ki": 4.0,
    "kd": 0.02,
    "alpha": 0.2,
    "setpoint": 1.0,
}


class Live:
    """A realtime loop in a namespace of its own, watched."""

    def __init__(self, graph: Any, namespace: str, plant: dict[str, Any], controller: dict[str, Any]) -> None:
        from sensor_msgs.msg import JointState

        self.graph, self.namespace = graph, namespace
        self.controller_name, self.plant_name = f"{namespace}/controller", f"{namespace}/plant"
        self.outputs = graph.collect(f"{namespace}/output", JointState)
        self.efforts = graph.collect(f"{namespace}/control_effort", JointState)
        self.plant = graph.start("plant", namespace=namespace, **{**PLANT, **plant})
        self.controller = graph.start("controller", namespace=namespace, **{**CONTROLLER, **controller})

    def settle(self, y: float = 1.0, tolerance: float = 0.05) -> None:
        """Wait until the loop runs and its output has stayed at `y` for 30 samples from now on."""
        self.graph.catch_up()
        outputs, efforts = len(self.outputs) + 30, len(self.efforts) + 30
        self.graph.wait_until(
            lambda: (
                len(self.outputs) > outputs
                and len(self.efforts) > efforts
                and np.allclose(self.latest_y(30), y, atol=tolerance)
            ),
            30,
            f"the loop to settle at {y}",
        )

    def latest_y(self, count: int) -> list[float]:
        return [message.position[0] for message in self.outputs[-count:]]

    def wait_for_efforts(self, count: int, since: int | None = None) -> list[float]:
        """The efforts until `count` more have come: these alone, or all from number `since` on."""
        self.graph.catch_up()
        first = len(self.efforts)
        self.graph.wait_until(lambda: len(self.efforts) >= first + count, 30, f"{count} efforts")
        return [message.effort[0] for message in self.efforts[first if since is None else since :]]


@pytest.fixture(scope="module")
def live(shared_graph: Any) -> Live:
    loop = Live(shared_graph, "/live", {}, {})
    loop.settle()
    return loop


def largest_step(efforts: list[float]) -> float:
    return float(np.max(np.abs(np.diff(efforts))))


@pytest.mark.parametrize(
    "change", [{"kp": 6.0}, {"ki": 8.0}, {"kd": 0.2}, {"alpha": 0.9}, {"sigma": 0.3}, {"kp": 2.0, "kd": 0.0}], ids=str
)
def test_gains_change_without_a_jump(live: Live, change: dict[str, Any]) -> None:
    since = len(live.efforts) - 1
    (result,) = live.graph.set_parameters(live.controller_name, atomically=True, **change)
    assert result.successful
    assert largest_step(live.wait_for_efforts(10, since)) < 0.05


@pytest.mark.parametrize("kind", CONTROLLER_TYPES)
def test_the_type_changes_without_a_jump(live: Live, kind: str) -> None:
    since = len(live.efforts) - 1
    assert live.graph.set_parameters(live.controller_name, type=kind)[0].successful
    assert largest_step(live.wait_for_efforts(10, since)) < 0.05


def test_manual_mode_by_topic_and_bumpless_return(live: Live) -> None:
    from sensor_msgs.msg import JointState

    live.settle()
    by_hand = live.graph.publisher("/live/manual_effort", JointState)
    assert live.graph.set_parameters(live.controller_name, atomically=True, manual=True, manual_effort=1.1)[
        0
    ].successful
    live.graph.wait_until(lambda: live.efforts[-1].effort[0] == 1.1, what="the parameter's effort")
    live.graph.publish_until(
        by_hand, JointState(effort=[0.9]), lambda: live.efforts[-1].effort[0] == 0.9, what="the topic's effort"
    )
    live.settle(0.9, 0.1)
    since = len(live.efforts) - 1
    assert live.graph.set_parameters(live.controller_name, manual=False)[0].successful
    assert largest_step(live.wait_for_efforts(20, since)) < 0.1
    live.settle()


def test_an_unstamped_message_beside_a_steady_loop_changes_nothing_and_is_told(live: Live) -> None:
    """ros2 topic pub --once /live/output sensor_msgs/msg/JointState "{position: [2.0]}" """
    from sensor_msgs.msg import JointState

    live.settle()
    since, output = len(live.efforts) - 1, live.graph.publisher("/live/output", JointState)
    stray, told = JointState(position=[2.0]), "output refused: it bears no label"
    live.graph.publish_until(output, stray, lambda: told in live.controller.log, what="a refusal")
    efforts = live.wait_for_efforts(100, since)
    live.graph.node.destroy_publisher(output)
    assert largest_step(efforts) < 0.05
    assert np.allclose(efforts, 1.0, atol=0.1)


def test_inactive_publishes_nothing_and_comes_back_without_a_jump(live: Live) -> None:
    live.settle()
    assert live.graph.set_parameters(live.plant_name, fallback="hold")[0].successful
    assert live.graph.change_state(live.controller_name, "deactivate")
    live.graph.wait_until(lambda: live.graph.node.count_publishers("/live/control_effort") == 0, what="silence")
    live.graph.wait_until(lambda: live.graph.fresh_fact(live.plant_name, "state") == "fallback", what="the fallback")
    assert "inactive" in live.graph.fresh_fact(live.controller_name, "message")
    count, applied = len(live.efforts), live.outputs[-1].effort[0]
    for _ in range(2):  # and once more: activation and deactivation leave nothing behind
        assert live.graph.change_state(live.controller_name, "activate")
        live.wait_for_efforts(5)
        assert live.graph.change_state(live.controller_name, "deactivate")
    assert live.graph.change_state(live.controller_name, "activate")
    efforts = live.wait_for_efforts(5)
    assert largest_step([applied, live.efforts[count].effort[0], *efforts]) < 0.1
    live.settle()


@pytest.mark.parametrize(("save_i_term", "goes_on"), [(True, 0.75), (False, 0.5)])
def test_the_integral_action_is_saved_while_inactive(graph: Any, save_i_term: bool, goes_on: float) -> None:
    """Saved, it is what the answer is computed with; else the effort goes on from what the plant reports."""
    from sensor_msgs.msg import JointState

    efforts = graph.collect("control_effort", JointState)
    graph.start("controller", type="pid", kp=1.0, ki=1.0, save_i_term=save_i_term)
    output = graph.publisher("output", JointState)

    def answer(k: int, y: float, applied: float) -> float:
        message = JointState(position=[y], effort=[applied])
        message.header.stamp.sec = 10 + k
        return float(
            graph.publish_until(
                output,
                message,
                lambda: [m for m in efforts if m.header.stamp == message.header.stamp],
                what="an answer",
            )[0].effort[0]
        )

    assert answer(0, 0.0, 0.75) == 0.75  # within a running loop: the integral action is 0.75
    assert graph.change_state("/controller", "deactivate")
    assert graph.change_state("/controller", "activate")
    assert answer(1, 0.0, 0.5) == goes_on
    assert graph.change_state("/controller", "deactivate")  # and gains for more lanes meanwhile do no harm
    assert graph.set_parameters("/controller", kp=[1.0, 2.0])[0].successful
    assert graph.change_state("/controller", "activate")
    message = JointState(position=[0.0, 0.0], effort=[0.5, 0.25])
    message.header.stamp.sec = 20
    graph.publish_until(output, message, lambda: efforts[-1].header.stamp.sec == 20, what="an answer")
    assert list(efforts[-1].effort) == [0.5, 0.25]


def test_every_transition_of_the_life_cycle(graph: Any, tmp_path: Path) -> None:
    """configure, activate, deactivate, cleanup and around again; shutdown ends the work also of an active node."""
    names = ("/plant", "/controller", "/scenario", "/recorder")
    processes = {f"/{node}": graph.start(node, autostart=False) for node in ("plant", "controller", "scenario")}
    processes["/recorder"] = graph.start("recorder", autostart=False, bag=str(tmp_path / "bag"))
    graph.wait_for_nodes(*names)
    asleep = {"/diagnostics", "/parameter_events", "/rosout"}

    def change(transition: str) -> None:
        for name in names:
            assert graph.change_state(name, transition), processes[name].log

    def wait_until_asleep() -> None:
        for name in names:
            graph.wait_until(lambda n=name: working_endpoints(graph, n[1:]) == asleep, what=f"{name} to be silent")

    for rounds in range(2):
        for transition in ("configure", "activate", "deactivate", "cleanup"):
            change(transition)
            graph.wait_for_nodes(*names)
            for name in names:
                assert ("inactive" in graph.fact(name, "message")) == (transition != "activate"), name
        wait_until_asleep()
        assert graph.set_parameters("/recorder", bag=str(tmp_path / f"bag{rounds}"))[0].successful
    change("configure")
    change("activate")
    for name in names:
        assert graph.change_state(name, "inactive_shutdown") is False  # it is active
    change("active_shutdown")
    graph.wait_for_nodes(*names)
    for name in names:
        assert "shut down" in graph.fact(name, "message"), name
    wait_until_asleep()


def working_endpoints(graph: Any, node: str) -> set[str]:
    """Topics and services of a node in the root namespace, but for those of its parameters and its life cycle."""
    if (node, "/") not in graph.node.get_node_names_and_namespaces():
        return set()
    found = [
        *graph.node.get_publisher_names_and_types_by_node(node, "/"),
        *graph.node.get_subscriber_names_and_types_by_node(node, "/"),
        *graph.node.get_service_names_and_types_by_node(node, "/"),
        *graph.node.get_client_names_and_types_by_node(node, "/"),
    ]
    return {name for name, _ in found if not name.startswith(f"/{node}/") or name in ("/plant/reset", "/scenario/play")}


def test_deactivating_amid_messages_ends_no_node(graph: Any) -> None:
    """An executor may still hold calls that were due before a transition."""
    live = Live(graph, "/busy", {"sample_period": 0.001}, {"sample_period": 0.001})
    live.settle()
    for node in (live.controller_name, live.plant_name) * 10:
        assert graph.change_state(node, "deactivate")
        assert graph.change_state(node, "activate")
        live.wait_for_efforts(50)
    live.settle()


def test_a_held_controller_waits_for_its_supervisor(graph: Any) -> None:
    from sensor_msgs.msg import JointState

    efforts = graph.collect("control_effort", JointState)
    graph.start("controller", autostart=False, **CONTROLLER)
    graph.wait_for_nodes("/controller")
    assert graph.node.count_subscribers("/output") == 0
    assert graph.change_state("/controller", "configure")
    assert graph.change_state("/controller", "activate")
    output = graph.publisher("output", JointState)
    graph.publish_until(output, JointState(position=[0.0]), lambda: efforts, what="an effort")


def test_a_node_s_diagnostics_are_called_as_the_custom_is(graph: Any) -> None:
    from diagnostic_msgs.msg import DiagnosticArray

    arrays = graph.collect("/diagnostics", DiagnosticArray)
    graph.start("plant", namespace="/left")
    graph.wait_until(lambda: arrays, 60, "diagnostics")
    (status,) = arrays[-1].status
    assert (status.name, status.hardware_id) == ("/left/plant: state", "/left/plant")


def test_it_drives_the_joint_states_of_a_robot(graph: Any) -> None:
    from sensor_msgs.msg import JointState

    efforts = graph.collect("control_effort", JointState)
    controller = graph.start("controller", "-r", "output:=joint_states", kp=[2.0, 3.0],
                             joint_names=["elbow", "wrist"], setpoint=[1.0, 2.0], effort_max=[5.0, 1.25])  # fmt: skip
    joint_states = graph.publisher("joint_states", JointState)
    message = JointState(name=["base", "wrist", "elbow"], position=[9.0, 1.5, 0.25], velocity=[0.0] * 3)
    message.header.frame_id = "robot1/base_link"
    graph.publish_until(joint_states, message, lambda: efforts, what="an effort")
    assert list(efforts[0].name) == ["elbow", "wrist"]
    assert list(efforts[0].effort) == [2.0 * 0.75, 1.25]
    unstamped = JointState(name=message.name, position=[9.0, 1.5, 0.5])
    graph.publish_until(joint_states, unstamped, lambda: "its stamp has not; stamp each" in controller.log, what="that")
    by_hand = JointState(name=["wrist", "elbow"], effort=[1.0, -1.0])
    manual_effort = graph.publisher("manual_effort", JointState)
    graph.publish_until(
        manual_effort, by_hand, lambda: graph.get_parameters("/controller", "manual_effort") == [[-1.0, 1.0]]
    )
    incomplete = JointState(name=["base", "elbow"], position=[0.0, 0.0])
    graph.publish_until(joint_states, incomplete, lambda: "has no joint wrist" in controller.log, what="a refusal")


def test_one_value_of_a_gain_serves_all_joints_and_a_setpoint_may_be_for_some(graph: Any, tmp_path: Path) -> None:
    """And all of it is verified, also after the gain of one joint was changed."""
    from sensor_msgs.msg import JointState

    efforts = graph.collect("control_effort", JointState)
    controller = graph.start("controller", kp=2.0, ki=0.5, type="pid", setpoint=1.0,
                             joint_names=["elbow", "wrist", "hand"])  # fmt: skip
    recorder = graph.start("recorder", bag=str(tmp_path / "bag"))
    graph.wait_for_nodes("/controller", "/recorder")
    output = graph.publisher("output", JointState)
    message = JointState(name=["base", "hand", "wrist", "elbow"], position=[9.0, 0.75, 0.5, 0.25])
    message.header.frame_id = "base_link"

    def answer() -> Any:
        message.header.stamp.sec += 1
        stamp = message.header.stamp
        graph.publish_until(output, message, lambda: efforts and efforts[-1].header.stamp == stamp, what="an answer")
        return efforts[-1]

    assert list(answer().effort) == [1.5, 1.0, 0.5]
    setpoint = graph.publisher("setpoint", JointState)
    wrist = JointState(name=["wrist"], position=[3.0])
    graph.publish_until(setpoint, wrist, lambda: list(answer().position) == [1.0, 3.0, 1.0], what="the wrist's")
    some = JointState(position=[4.0, math.nan, math.nan])
    graph.publish_until(setpoint, some, lambda: list(answer().position) == [4.0, 3.0, 1.0], what="the elbow's")
    in_effort = JointState(effort=[1.0])
    graph.publish_until(setpoint, in_effort, lambda: "it came in effort" in controller.log, what="a refusal")
    assert graph.set_parameters("/controller", ki=[0.0, 0.5, 1.0])[0].successful
    answer()
    assert graph.set_parameters("/controller", kp=5.0)[0].successful
    answer()
    assert "ready: pid for elbow, wrist, hand, kp [2 2 2], ki 0.5, kd 0" in controller.log
    recorder.stop()
    account = verify(tmp_path / "bag")
    assert account.different == 0 and account.equal >= 5, account


def test_a_message_with_more_joints_than_lanes_is_refused_with_what_to_do(graph: Any) -> None:
    from sensor_msgs.msg import JointState

    controller = graph.start("controller", "-r", "output:=joint_states")
    joint_states = graph.publisher("joint_states", JointState)
    graph.publish_until(
        joint_states,
        JointState(name=["elbow", "wrist"], position=[1.0, 2.0]),
        lambda: "name the joints to control in joint_names, of elbow, wrist" in graph.fact("/controller", "message"),
        what="an error that names joint_names",
    )
    assert "joint_names" in controller.log and graph.fact("/controller", "level") == 2


def test_a_node_tells_that_it_is_ready_what_it_waits_for_and_of_parameters_for_another_name(graph: Any) -> None:
    file = graph.folder / "arm.yaml"
    file.write_text("/**/controller: {ros__parameters: {kp: 7.0, sigma: 1.0}}\n")
    given = ("-r", "__node:=arm", "--params-file", str(file), "-p", "controller:kp:=3.0", "-p", "type:=pid")
    controller = graph.start("controller", *given, type="pid")
    graph.wait_for_log(controller, "ready: pid, kp 1, ki 0, kd 0, sigma 1, 100 Hz, waiting for /output")
    assert f"{file} gives this node, /arm, nothing: it is for /**/controller; write /**/arm instead" in controller.log
    assert "controller:kp:=3.0 gives this node, /arm, nothing" in controller.log
    graph.wait_for_log(controller, "no output yet: start the plant, or remap output to your robot's joint_states (so ")


@pytest.mark.parametrize("mode", ["realtime", "lockstep"])
def test_plant_and_controller_may_name_the_joints_in_different_orders(graph: Any, mode: str) -> None:
    from sensor_msgs.msg import JointState

    outputs = graph.collect("output", JointState)
    graph.start("plant", mode=mode, lanes=2, joint_names=["elbow", "wrist"], time_constant=0.5, dead_time=0.0)
    graph.start("controller", joint_names=["wrist", "elbow"], type="pid", kp=[1.0, 3.0], ki=0.0, kd=0.0, setpoint=1.0)
    if mode == "lockstep":
        graph.start("scenario", mode=mode, episodes=["e"], plan__e=["0 setpoint 1", "60 end"])
    rest = [3.0 / 4.0, 1.0 / 2.0]  # kp/(1 + kp)
    graph.wait_until(lambda: outputs and np.allclose(outputs[-1].position, rest, atol=0.01), 60, f"{rest}")


def test_the_first_output_is_held_until_a_setpoint_comes(graph: Any) -> None:
    """And again after the controller was inactive."""
    from sensor_msgs.msg import JointState

    efforts = graph.collect("control_effort", JointState)
    graph.start("controller", hold_output=True, kp=2.0, ki=0.0, setpoint=9.0)
    output, message = graph.publisher("output", JointState), JointState()

    def answer(y: float) -> tuple[float, float]:
        """Setpoint and effort of the answer to an output, the next in time."""
        message.header.stamp.sec += 1
        message.position = [y]
        graph.publish_until(
            output, message, lambda: efforts and efforts[-1].header.stamp == message.header.stamp, what="an answer"
        )
        return efforts[-1].position[0], efforts[-1].effort[0]

    assert answer(0.75) == (0.75, 0.0)
    assert answer(0.5) == (0.75, 0.5)
    assert graph.set_parameters("/controller", setpoint=1.0)[0].successful
    assert answer(0.5) == (1.0, 1.0)
    assert graph.change_state("/controller", "deactivate") and graph.change_state("/controller", "activate")
    assert answer(0.25)[0] == answer(0.5)[0] == 0.25
    publisher = graph.publisher("setpoint", JointState)
    graph.publish_until(publisher, JointState(position=[1.5]), lambda: answer(0.5)[0] == 1.5, what="the setpoint")


def test_a_parameter_dump_restores_the_controller(graph: Any) -> None:
    from rcl_interfaces.srv import ListParameters

    graph.start(
        "controller", namespace="/a", kp=[2.5, 3.0], ki=0.3, type="npid", effort_max=4.0, manual_effort=[1.0, 2.0]
    )
    graph.wait_for_nodes("/a/controller")
    assert graph.set_parameters("/a/controller", dead_band=0.25)[0].successful
    names = list(graph.call("/a/controller/list_parameters", ListParameters, again=True).result.names)
    values = graph.get_parameters("/a/controller", *names)
    plain = [list(value) if hasattr(value, "__len__") and not isinstance(value, str) else value for value in values]
    file = graph.folder / "dump.yaml"  # as `ros2 param dump /a/controller` writes it
    file.write_text(yaml.dump({"/b/controller": {"ros__parameters": dict(zip(names, plain, strict=True))}}))
    graph.start("controller", "--params-file", str(file), namespace="/b")
    graph.wait_for_nodes("/b/controller")
    assert graph.get_parameters("/b/controller", *names) == values
    graph.wait_for_nodes("/a/controller", "/b/controller")
    assert graph.fact("/b/controller", "parameters") == graph.fact("/a/controller", "parameters")


def test_loading_a_dump_moves_nothing_once_the_topic_commands(graph: Any) -> None:
    from sensor_msgs.msg import JointState

    efforts = graph.collect("control_effort", JointState)
    controller = graph.start("controller", kp=2.0, type="pid", setpoint=0.5)
    output, setpoint = graph.publisher("output", JointState), graph.publisher("setpoint", JointState)
    message = JointState(position=[0.25])

    def position() -> float:
        message.header.stamp.sec += 1
        stamp = message.header.stamp
        graph.publish_until(output, message, lambda: efforts and efforts[-1].header.stamp == stamp, what="an answer")
        return efforts[-1].position[0]

    assert position() == 0.5
    graph.publish_until(setpoint, JointState(position=[2.0]), lambda: position() == 2.0, what="the setpoint")
    (other,) = graph.set_parameters("/controller", setpoint=1.0)
    assert not other.successful and "the topic /setpoint gives the setpoint, now [2.0]" in other.reason
    for same in (0.5, 2.0):  # as a dump has it, and as it is
        with graph.expect_log(controller, "the parameter setpoint does nothing"):
            assert graph.set_parameters("/controller", setpoint=same)[0].successful
    assert position() == 2.0
    assert graph.set_parameters("/controller", kp=2.0)[0].successful
    assert "kp: " not in controller.log  # it is what it was
    assert graph.change_state("/controller", "deactivate") and graph.change_state("/controller", "activate")
    assert graph.set_parameters("/controller", setpoint=1.0)[0].successful
    assert position() == 1.0


def test_of_a_long_array_the_log_shows_the_beginning() -> None:
    from tdof_npid_ros.graph.runtime.node import shortened

    assert shortened([1.0, 2.0]) == "[1.0, 2.0]" and shortened("text" * 9) == "text" * 9
    assert shortened([float(k) for k in range(100)]) == "[0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, … 100 values]"


def test_deadline_and_liveliness_of_a_publisher_that_stops_are_counted(graph: Any) -> None:
    promises = {"deadline": 0.1, "lease": 0.5, "request_deadline": True}
    live = Live(graph, "/promising", promises, promises)
    live.settle()
    facts = [(live.controller_name, "deadline_missed"), (live.controller_name, "publisher_not_alive")]
    graph.wait_for_nodes(live.controller_name)
    before = {fact: int(graph.fact(*fact, 0)) for fact in facts}
    live.plant.send(signal.SIGSTOP)
    graph.wait_until(lambda: all(int(graph.fact(*fact, 0)) > before[fact] for fact in facts), 30, f"more than {before}")
    live.plant.send(signal.SIGCONT)
    live.settle()
    assert "output: its publisher is not alive any more" in live.controller.log
    from sensor_msgs.msg import JointState

    graph.node.create_publisher(JointState, f"{live.namespace}/output", 10)  # it promises nothing
    graph.wait_for_log(live.controller, "requests reliable, volatile, deadline 0.1 s, liveliness lease 0.5 s")


def test_processor_and_priority_are_taken_or_the_log_says_how_to_allow_them(graph: Any) -> None:
    plant = graph.start("plant", mode="realtime", cpu=0, priority=7)
    controller = graph.start("controller", cpu=4096)
    graph.wait_for_nodes("/plant", "/controller")
    assert os.sched_getaffinity(plant.process.pid) == {0}
    policy = os.sched_getscheduler(plant.process.pid), os.sched_getparam(plant.process.pid).sched_priority
    assert policy == (os.SCHED_FIFO, 7) or "priority 7 not taken" in plant.log
    assert "cpu 4096 not taken" in controller.log


def test_a_loop_that_was_driven_off_is_told_and_brought_back_by_full_unwinding(graph: Any) -> None:
    """A robot left with an effort of -596, six sigma from its setpoint; a file tells what plant it is."""
    from sensor_msgs.msg import JointState

    efforts = graph.collect("control_effort", JointState)
    case = ("--params-file", "config/p1-c4.yaml")
    controller = graph.start("controller", *case, sample_period=0.1, type="npid", sigma=0.5, output_timeout=0.0)
    output, message = graph.publisher("output", JointState), JointState(position=[-3.0], effort=[-596.0])
    message.header.stamp.sec = 100
    graph.publish_until(output, message, lambda: efforts, what="an answer")

    def until(condition: Any, what: str) -> None:
        def after_another_output() -> Any:
            ns = message.header.stamp.nanosec + 100_000_000
            message.header.stamp.sec, message.header.stamp.nanosec = message.header.stamp.sec + ns // 10**9, ns % 10**9
            output.publish(message)
            return condition()

        graph.wait_until(after_another_output, 30, what)

    until(lambda: "was driven off" in controller.log, "the warning")
    assert efforts[-1].effort[0] == pytest.approx(-596.0, abs=1e-3)
    until(lambda: graph.fact("/controller", "k_of_error"), "the figures")
    assert float(graph.fact("/controller", "k_of_error")) == pytest.approx(np.exp(-18.0), rel=1e-3)
    assert "k(e) is 1.5e-08" in controller.log and "with the plant of the file that takes about" in controller.log
    assert "set full_unwinding" in controller.log and controller.log.count("was driven off") == 1
    assert graph.set_parameters("/controller", full_unwinding=True)[0].successful
    until(lambda: efforts[-1].effort[0] > -595.0, "the integral action to unwind")
    graph.wait_until(lambda: graph.fact("/controller", "message") == "running", 30, "that all is well")


def test_a_second_publisher_and_a_profile_that_does_not_fit_are_reported(graph: Any) -> None:
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from sensor_msgs.msg import JointState

    controller = graph.start("controller", **CONTROLLER)
    graph.publisher("output", JointState)
    graph.publisher("output", JointState)
    graph.wait_until(lambda: "/output has 2 publishers (/test, /test)" in graph.fact("/controller", "message"))
    graph.node.create_publisher(JointState, "setpoint", QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT))
    graph.wait_for_log(controller, "/setpoint: /test offers best_effort, volatile, but /controller requests reliable")
    assert int(graph.fact("/controller", "conflicts")) >= 1


def test_a_second_publisher_of_the_clock_is_warned_of(graph: Any) -> None:
    lockstep = {**PLANT, "mode": "lockstep"}
    graph.start("plant", namespace="/third", **lockstep, publish_clock=False)
    first = graph.start("plant", namespace="/first", **lockstep)
    graph.wait_for_nodes("/first/plant", "/third/plant")
    assert "publish /clock" not in first.log and graph.node.count_publishers("/clock") == 1
    second = graph.start("plant", namespace="/second", **PLANT, speed=2.0)
    for plant in (first, second):
        graph.wait_for_log(plant, "others publish /clock, too, so time jumps: set publish_clock to false")
