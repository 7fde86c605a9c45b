"""Experiments on somebody's node that gives `output` and takes `control_effort`: each way in which one is stopped."""

from __future__ import annotations

import math
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tdof_npid_ros.analysis.verify import verify
from tdof_npid_ros.cli.experiment import records_to
from tdof_npid_ros.parameters import EXPERIMENT

PERIOD = 0.01
BEFORE = {name: its.default for name, its in EXPERIMENT.items()}
GAINS = {"kp": 2.0, "ki": 4.0, "kd": 0.0, "manual": False}  # the integral takes the plant's pole: at rest in 1 s


class Robot:
    """A first-order plant in the test's own process, which misbehaves when it is told to."""

    def __init__(self, graph: Any) -> None:
        from sensor_msgs.msg import JointState

        self.graph = graph
        self.y = self.u = 0.0
        self.says: float | None = None  # in place of its output
        self.silent = False
        self._message = JointState()
        self._publisher = graph.node.create_publisher(JointState, "/robot/output", 10)
        graph.node.create_subscription(JointState, "/robot/control_effort", self._on_effort, 10)
        self._efforts: list[float] = []
        graph.node.create_timer(PERIOD, self._tick)

    def _on_effort(self, message: Any) -> None:
        self.u = message.effort[0]
        self._efforts.append(self.u)

    def _tick(self) -> None:
        self.y += PERIOD * (self.u - self.y) / 0.5
        if self.silent:
            return
        self._message.header.stamp = self.graph.node.get_clock().now().to_msg()
        self._message.position = [self.y if self.says is None else self.says]
        self._message.effort = [self.u]
        self._publisher.publish(self._message)

    def behave(self) -> None:
        self.says, self.silent = None, False
        self._efforts.clear()

    def rests(self) -> bool:
        return len(self._efforts) > 20 and abs(self.y - 1.0) < 0.02 and abs(self.u - 1.0) < 0.02


def begin(graph: Any, name: str, **moves: Any) -> None:
    values = {"experiment": name, "safe_range.output": [0.0, 2.0], "safe_range.effort": [-5.0, 5.0], **moves}
    result = graph.set_parameters("/robot/controller", atomically=True, **values)[0]
    assert result.successful, result.reason


def is_as_before(graph: Any) -> bool:
    names = [*EXPERIMENT, *GAINS]
    found = graph.get_parameters("/robot/controller", *names)
    return found == [*{**BEFORE, "experiment_lease": 5.0}.values(), *GAINS.values()]


def test_whatever_stops_an_experiment_all_is_as_before_and_verified(graph: Any, tmp_path: Path) -> None:
    recorder = graph.start("recorder", namespace="/robot", bag=str(tmp_path / "bag"))
    controller = graph.start(
        "controller", namespace="/robot", type="tdof_npid2", kp=2.0, ki=4.0, sample_period=PERIOD, setpoint=1.0,
        output_timeout=1.0, experiment_lease=5.0,
    )  # fmt: skip
    graph.wait_for_log(recorder, "ready", 60.0)
    graph.wait_for_nodes("/robot/controller")
    robot = Robot(graph)

    def stopped(name: str, stop: Callable[[], Any], told: str, **moves: Any) -> None:
        """Begin an experiment, stop it, and wait until all is as before and the loop at rest."""
        graph.wait_until(robot.rests, 60.0, "rest")
        begin(graph, name, kp=4.0, **moves)
        with graph.expect_log(controller, f"experiment {name} has ended", 30.0):
            stop()
        assert is_as_before(graph)
        line = next(line for line in controller.log.splitlines() if f"experiment {name} has ended" in line)
        assert told in line
        robot.behave()
        refused = graph.set_parameters("/robot/controller", atomically=True, experiment=name)[0]
        assert not refused.successful and "has ended" in refused.reason  # a tool that is late does not begin it anew

    moves = {"experiment_setpoint": 1.5}
    by_hand = {"experiment_effort": 1.5}
    stopped("range", lambda: setattr(robot, "says", 2.5), "output 2.5 is beyond safe_range.output", **by_hand)
    stopped(
        "effort",
        lambda: graph.set_parameters(
            "/robot/controller", atomically=True, experiment="effort", experiment_setpoint=1.9
        ),
        "is beyond safe_range.effort",
        experiment_setpoint=1.0,
        **{"safe_range.effort": [-5.0, 2.0]},
    )
    stopped("nan", lambda: setattr(robot, "says", math.nan), "not finite", **moves)
    stopped("silence", lambda: setattr(robot, "silent", True), "no output comes", **by_hand)
    stopped(
        "operator",
        lambda: graph.set_parameters("/robot/controller", atomically=True, experiment=""),
        "it was asked to end",
        **by_hand,
    )
    stopped("lease", lambda: None, "experiment_lease", **moves, experiment_lease=0.5)

    # The tool is killed, in the middle of moving the effort by hand.
    graph.wait_until(robot.rests, 60.0, "rest")
    tool = subprocess.Popen(
        [sys.executable, "-m", "tdof_npid_ros", "experiment", "/robot", "--by", "effort", "--size", "0.2",
         "--safe-output", "0", "2", "--patience", "5", "--bag", str(tmp_path / "tool")],
        env=graph.environment, cwd=tmp_path,
    )  # fmt: skip
    try:
        graph.wait_until(
            lambda: math.isfinite(graph.get_parameters("/robot/controller", "experiment_effort")[0]), 60.0, "the tool"
        )
        assert graph.get_parameters("/robot/controller", "manual") == [True]
    finally:
        tool.send_signal(signal.SIGKILL)
        tool.wait()
    killed = time.monotonic()
    graph.wait_until(lambda: is_as_before(graph), 30.0, "the lease's end")
    assert time.monotonic() - killed < 10.0
    graph.wait_until(robot.rests, 60.0, "rest")
    controller.stop()
    recorder.stop()
    account = verify(tmp_path / "bag")
    assert account.different == 0 and not account.unchecked
    assert account.equal > 500


def test_an_operators_setpoint_ends_an_experiment_and_holds(graph: Any) -> None:
    from sensor_msgs.msg import JointState

    controller = graph.start("controller", namespace="/robot", kp=2.0, ki=4.0, sample_period=PERIOD, setpoint=1.0)
    graph.wait_for_nodes("/robot/controller")
    robot = Robot(graph)
    graph.wait_until(robot.rests, 60.0, "rest")
    begin(graph, "step", experiment_setpoint=1.5, experiment_lease=30.0)
    publisher = graph.publisher("/robot/setpoint", JointState)
    with graph.expect_log(controller, "an operator has given a setpoint"):
        graph.publish_until(publisher, JointState(position=[0.5]), lambda: "has ended" in controller.log)
    graph.wait_until(lambda: robot.y == pytest.approx(0.5, abs=0.02), 60.0, "the operator's setpoint")


@pytest.mark.parametrize("ended", ["by the deactivation", "by silence"])
def test_an_inactive_time_keeps_the_integral_action_of_before_the_experiment(graph: Any, ended: str) -> None:
    from sensor_msgs.msg import JointState

    controller = graph.start(
        "controller", namespace="/robot", kp=2.0, ki=4.0, sample_period=PERIOD, setpoint=1.0, output_timeout=1.0
    )
    graph.wait_for_nodes("/robot/controller")
    robot = Robot(graph)
    graph.wait_until(robot.rests, 60.0, "rest")
    begin(graph, "step", experiment_setpoint=1.5, experiment_lease=30.0)
    graph.wait_until(lambda: min(robot.y, robot.u) > 1.45, 60.0, "the step")
    if ended == "by silence":
        robot.silent = True
        graph.wait_for_log(controller, "experiment step has ended")
    assert graph.change_state("/robot/controller", "deactivate")
    robot.behave()
    robot.says = 1.0  # at the setpoint of before, the effort is the integral action, and stays
    graph.catch_up()
    efforts = graph.collect("/robot/control_effort", JointState)
    assert graph.change_state("/robot/controller", "activate")
    graph.wait_until(lambda: efforts, 60.0, "an effort")
    assert efforts[-1].effort[0] == pytest.approx(1.0, abs=0.1)


def test_what_an_experiment_restores_gives_no_sigma(graph: Any) -> None:
    graph.start("controller", namespace="/robot", type="pid", kp=2.0, ki=4.0, sample_period=PERIOD, setpoint=1.0)
    graph.wait_for_nodes("/robot/controller")
    robot = Robot(graph)
    graph.wait_until(robot.rests, 60.0, "rest")

    def set_(**values: Any) -> str:
        result = graph.set_parameters("/robot/controller", atomically=True, **values)[0]
        return "" if result.successful else str(result.reason)

    needs_sigma = "type npid needs sigma"
    begin(graph, "plain", experiment_setpoint=1.1, experiment_lease=60.0)
    assert needs_sigma in set_(type="npid")
    assert set_(experiment="") == ""
    assert needs_sigma in set_(type="npid")
    begin(graph, "its own", type="tdof_npid2", sigma=0.5, experiment_lease=60.0)
    assert set_(experiment="its own", experiment_setpoint=1.1) == ""
    assert needs_sigma in set_(type="npid")
    assert set_(experiment="") == ""
    assert needs_sigma in set_(type="npid")
    begin(graph, "kept", experiment_lease=60.0)
    assert set_(experiment="", type="npid", sigma=1.0) == ""
    begin(graph, "next", type="pid", experiment_lease=60.0)
    assert set_(experiment="") == ""
    assert set_(type="tdof_npid1") == ""


def test_a_recorder_that_has_lost_messages_records_all_the_same() -> None:
    from tdof_npid_ros.graph.observer import NodeState

    bag = Path("bag")
    assert not records_to(bag, None)
    assert not records_to(bag, NodeState(1, "inactive", {}, 0.0))
    assert not records_to(bag, NodeState(0, "recording 3 topics to bag2", {"bag": "bag2"}, 0.0))
    assert records_to(bag, NodeState(1, "5 messages lost, most on /clock: set lossless", {"bag": "bag"}, 0.0))


class HeldController:
    """What an experiment sees of a loop: no answers, and a controller that takes what it is given, or refuses."""

    def __init__(self) -> None:
        self.given: list[dict[str, Any]] = []
        self.refusal = ""
        self.count = 0
        self.observer = self

    def remote(self, _: str) -> HeldController:
        return self

    def rows_since(self, first: int) -> tuple[list[Any], int]:
        return [], first

    def set_parameters(self, values: dict[str, Any]) -> None:
        from tdof_npid_ros.graph.runtime.parameter_client import RefusedError

        self.given.append(values)
        if self.refusal:
            raise RefusedError(f"/controller: {self.refusal}")


def test_the_lease_is_renewed_while_something_is_computed(monkeypatch: pytest.MonkeyPatch) -> None:
    from tdof_npid_ros.graph import experimenter

    monkeypatch.setattr(experimenter, "LEASE", 0.2)
    loop: Any = HeldController()
    renewals: list[int] = []
    enough = threading.Event()

    def computed() -> str:
        while len(loop.given) < 5 and not enough.wait(0.01):
            pass
        renewals.append(len(loop.given))
        return "a verdict"

    watchdog = threading.Timer(60.0, enough.set)
    watchdog.start()
    with experimenter.Hold(loop, "confirm", (0.0, 2.0), (-5.0, 5.0), 10.0) as hold:
        assert hold.during(computed) == "a verdict"
    watchdog.cancel()
    assert renewals[0] >= 5
    for values in loop.given[1:5]:  # the ranges, too: a controller that was started again knows none
        assert values["experiment"] == hold.name and values["safe_range.output"] == [0.0, 2.0]


def test_what_is_computed_is_not_used_once_the_experiment_has_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    from tdof_npid_ros.graph import experimenter

    monkeypatch.setattr(experimenter, "LEASE", 0.2)
    loop: Any = HeldController()

    def computed() -> str:
        loop.refusal = "experiment confirm has ended: the output is beyond safe_range.output"
        time.sleep(0.5)
        return "a verdict"

    with (
        pytest.raises(experimenter.ExperimentError, match="has ended"),
        experimenter.Hold(loop, "confirm", (0.0, 2.0), (-5.0, 5.0), 10.0) as hold,
    ):
        hold.during(computed)
