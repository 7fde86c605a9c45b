"""Nodes of a recorded loop killed or stopped in rounds: it recovers, and what was recorded is verified bit for bit.

`TDOF_KILL_ROUNDS=60` is the long form.
"""

from __future__ import annotations

import os
import random
import signal
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_operation import CONTROLLER, PLANT
from test_realtime import ns

from tdof_npid_ros.analysis.verify import verify
from tdof_npid_ros.bag.reader import BagReader
from tdof_npid_ros.case import load_case

ROUNDS = int(os.environ.get("TDOF_KILL_ROUNDS", "2"))
SEED = int(os.environ.get("TDOF_KILL_SEED", "0"))
CASE = "p1-c0.5"
ENDLESS = ("0 setpoint 1", "0.5 disturbance 0.5", "5000 end")
NODES = ("controller", "plant", "recorder", "scenario")
KINDS = [(node, number) for node in NODES for number in (signal.SIGKILL, signal.SIGSTOP)]


def drawn_rounds() -> list[tuple[str, int]]:
    """What happens to which node, in a random order in which each kind comes as often as the others."""
    rng = random.Random(SEED)
    rounds: list[tuple[str, int]] = []
    while len(rounds) < ROUNDS:
        rounds += rng.sample(KINDS, len(KINDS))
    return rounds[:ROUNDS]


class Recorded:
    """The nodes of a recorded loop, by name; a recorder that is started again writes a bag of its own."""

    def __init__(self, graph: Any, bags: Path, parameters: dict[str, dict[str, Any]]) -> None:
        self._graph, self._folder, self._parameters = graph, bags, parameters
        self.bags: list[Path] = []
        self.processes = {node: self.start(node) for node in NODES if node in parameters}

    def start(self, node: str) -> Any:
        values = dict(self._parameters[node])
        if node == "recorder":
            self.bags.append(self._folder / f"bag{len(self.bags)}")
            values["bag"] = str(self.bags[-1])
        return self._graph.start(node, **values)

    def harm(self, node: str, number: int, seconds: float) -> None:
        """Kill a node and start it again, or stop it for a time."""
        process = self.processes[node]
        if node == "recorder":  # of what it has recorded, the last second may be lost
            self._graph.wait_for_log(process, "ready", 60.0)
            self._spend(2.0)
        process.send(number)
        if number == signal.SIGKILL:
            self.processes[node] = self.start(node)
        else:
            self._spend(seconds)
            process.send(signal.SIGCONT)

    def _spend(self, seconds: float) -> None:
        until = time.monotonic() + seconds
        self._graph.wait_until(lambda: time.monotonic() > until, seconds + 5.0)


def columns(bag: Path, topic: str) -> dict[str, np.ndarray]:
    with BagReader(bag) as reader:
        return reader.columns(topic, ["header.stamp", "header.frame_id", "position", "velocity", "effort"])


@pytest.mark.timeout(60 + 30 * ROUNDS)
def test_in_lockstep_every_bit_is_as_in_process(graph: Any, tmp_path: Path) -> None:
    """Only a controller that is started again within an episode has forgotten what it knew."""
    from rosgraph_msgs.msg import Clock
    from std_srvs.srv import Trigger

    clock = graph.collect("/clock", Clock)
    common = {"case": CASE, "lossless": True}
    loop = Recorded(graph, tmp_path, {
        "plant": {**common, "reply_timeout": 0.05, "retries": 2},
        "controller": {"case": CASE},
        "recorder": common,
        "scenario": {"case": CASE, "episodes": ["endless"], "plan__endless": list(ENDLESS)},
    })  # fmt: skip
    rng = random.Random(SEED)

    def goes_on() -> None:
        """The plant tells its time, and that it goes on, every 50 ms."""
        graph.catch_up()
        clock.clear()
        graph.wait_until(lambda: len({ns(message.clock) for message in clock}) > 3, 60.0, "more steps")

    goes_on()
    for node, number in drawn_rounds():
        loop.harm(node, number, rng.uniform(0.05, 0.6))
        goes_on()
        assert graph.call("plant/reset", Trigger, again=True).success
        goes_on()
    for process in loop.processes.values():
        process.stop()
    local = replace(load_case(CASE), episodes={"endless": ENDLESS}).simulate("endless")
    period_ns = load_case(CASE).sample_period_ns
    joins = equal = 0
    for bag in loop.bags:
        account = verify(bag)
        assert not account.differs, account.lines()
        outputs, efforts = columns(bag, "/output"), columns(bag, "/control_effort")
        labels = np.array([str(label).split()[-1] for label in efforts["header.frame_id"]])
        for label in np.unique(outputs["header.frame_id"]):
            joined = [
                int(stamp)
                for stamp, told in zip(
                    efforts["header.stamp"][labels == label], efforts["velocity"][labels == label], strict=True
                )
                if len(told)
            ]
            joins += len(joined)
            until = min(joined, default=2**62)
            for found, field, which, true in (
                (outputs, "position", outputs["header.frame_id"] == label, local.output),
                (efforts, "effort", labels == label, local.control_effort),
            ):
                kept = which & (found["header.stamp"] < until)
                values = np.concatenate([np.zeros(0), *found[field][kept]])
                steps = found["header.stamp"][kept] // period_ns
                assert np.array_equal(values, true[steps, 0]), (bag, label)
                equal += len(steps)
    assert joins <= ROUNDS and equal > 100 * ROUNDS
    print(f"{ROUNDS} rounds, {len(loop.bags)} bags, {equal} messages as in process, {joins} joins")


@pytest.mark.timeout(60 + 40 * ROUNDS)
def test_in_realtime_the_output_comes_back(graph: Any, tmp_path: Path) -> None:
    from sensor_msgs.msg import JointState
    from std_srvs.srv import Trigger

    outputs, efforts = graph.collect("output", JointState), graph.collect("control_effort", JointState)
    loop = Recorded(graph, tmp_path, {
        "plant": {**PLANT, "fallback": "hold", "effort_timeout": 0.2},
        "controller": {**CONTROLLER, "output_timeout": 0.2},
        "recorder": {},
        "scenario": {"play": False},
    })  # fmt: skip
    rng = random.Random(SEED)

    def settle() -> None:
        graph.catch_up()
        outputs.clear()
        efforts.clear()
        graph.wait_until(
            lambda: len(efforts) > 30 and np.allclose([m.position[0] for m in outputs[-30:]], 1.0, atol=0.05),
            30.0, "the output to come back",
        )  # fmt: skip

    settle()
    assert graph.call("plant/reset", Trigger).success  # of this episode the recorder has the beginning
    settle()
    for node, number in drawn_rounds():
        loop.harm(node, number, rng.uniform(0.05, 0.6))
        graph.wait_for_nodes(f"/{node}")
        settle()
    for process in loop.processes.values():
        process.stop()
    equal = 0
    for bag in loop.bags:
        account = verify(bag)
        assert not account.differs, account.lines()
        equal += account.equal
    assert equal > 30 * ROUNDS
    print(f"{ROUNDS} rounds, {len(loop.bags)} bags, {equal} efforts verified")
