"""The hand on the loop, at nodes that are only played: it outlives what goes wrong, and knows what has changed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from types import SimpleNamespace
from typing import Any

import pytest
from live_program import eventually

pytest.importorskip("rclpy")

from tdof_npid_ros.control.gains import GAIN_NAMES, Gains
from tdof_npid_ros.control.options import OPTION_NAMES, ControllerOptions
from tdof_npid_ros.graph.runtime.parameter_client import RefusedError
from tdof_npid_ros.live import steering as module
from tdof_npid_ros.live.steering import Steering
from tdof_npid_ros.live.tune_controls import TuneControls
from tdof_npid_ros.live.tuning import Proposal
from tdof_npid_ros.live.view import View

GAINS = Gains("tdof_npid2", kp=2.0, ki=1.0, kd=0.1, alpha=0.3, beta=0.5, sigma=1.0)


class PlayedNode:
    """A node's parameters, as a client sees them."""

    def __init__(self, values: dict[str, Any]) -> None:
        self.values = values
        self.before_setting: Callable[[], None] = lambda: None

    def parameters(self, names: Sequence[str]) -> dict[str, Any]:
        return {name: self.values.get(name) for name in names}

    def ask_parameters(self, names: Sequence[str]) -> Any:
        return SimpleNamespace(look=lambda: True, answer=self.parameters(names))

    def set_parameters(self, values: dict[str, Any]) -> None:
        self.before_setting()
        self.values |= values

    def serves(self, service: str) -> bool:
        return bool(self.values)


class Played:
    """A loop that is only played, and the hand on it."""

    def __init__(self) -> None:
        options = ControllerOptions()
        values = {name: getattr(GAINS, name) for name in GAIN_NAMES}
        values |= {name: getattr(options, name) for name in OPTION_NAMES}
        self.controller = PlayedNode({**values, "sample_period": 0.01, "setpoint": 0.0})
        plant = {"model": "first_order", "gain": 1.0, "time_constant": 1.0, "dead_time": 0.1, "lanes": 1}
        offsets = {"output_offset": 0.0, "effort_offset": 0.0, "effort_min": -10.0, "effort_max": 10.0}
        self.plant = PlayedNode({**plant, **offsets})
        nodes = {"controller": self.controller, "plant": self.plant}
        self.steering = Steering(SimpleNamespace(remote=nodes.__getitem__))  # type: ignore[arg-type]
        eventually(lambda: self.steering.history is not None, "the controller's parameters")


@pytest.fixture
def played(monkeypatch: pytest.MonkeyPatch) -> Iterator[Played]:
    monkeypatch.setattr(module, "LOOK_PERIOD", 0.05)
    one = Played()
    yield one
    one.steering.close()


def fail() -> None:
    raise TypeError("not what\nwas expected")


def test_a_change_that_fails_in_an_unexpected_way_is_told_and_the_next_one_is_made(played: Played) -> None:
    played.controller.before_setting = fail
    played.steering.change({"kp": 3.0})
    eventually(lambda: "TypeError: not what was expected" in played.steering.problems.values(), "the problem", 60.0)
    played.controller.before_setting = lambda: None
    played.steering.change({"kp": 4.0})
    eventually(lambda: played.controller.values["kp"] == 4.0, "the next change", 60.0)
    eventually(lambda: not played.steering.problems, lambda: played.steering.problems, 60.0)


def test_undo_brings_the_type_back_with_its_gains(played: Played) -> None:
    played.steering.change({"type": "pid", "kp": 0.5})
    eventually(lambda: played.steering.values["type"] == "pid", "the change", 60.0)
    played.steering.undo()
    now = lambda: (played.controller.values["type"], played.controller.values["kp"])  # noqa: E731
    eventually(lambda: now() == ("tdof_npid2", 2.0), now, 60.0)
    played.steering.redo()
    eventually(lambda: now() == ("pid", 0.5), now, 60.0)


def test_an_undo_that_is_refused_leaves_what_can_be_undone_and_redone(played: Played) -> None:
    def refuse() -> None:
        raise RefusedError("/controller refused kp: not now")

    for kp in (3.0, 4.0):
        played.steering.change({"kp": kp})
    played.steering.undo()
    kp = lambda: played.controller.values["kp"]  # noqa: E731
    eventually(lambda: kp() == 3.0, kp, 60.0)
    played.controller.before_setting = refuse
    played.steering.undo()
    eventually(lambda: "undo" in played.steering.problems, "the reason", 60.0)
    played.controller.before_setting = lambda: None
    played.steering.redo()
    eventually(lambda: kp() == 4.0, kp, 60.0)
    for _ in range(3):
        played.steering.undo()
    eventually(lambda: kp() == 2.0, kp, 60.0)


def test_gains_that_were_found_are_applied_with_the_type_they_were_found_for(played: Played) -> None:
    tuning = SimpleNamespace(state=Proposal(GAINS.with_values(kp=5.0), [], [], []), stop=lambda: None)
    observer = SimpleNamespace(lane_names=("0",))
    loop = SimpleNamespace(steering=played.steering, tuning=tuning, observer=observer)
    played.steering.change({"type": "pid"})  # while the search went on
    eventually(lambda: played.steering.values["type"] == "pid", "the other type", 60.0)
    TuneControls(View(loop))._on_apply()  # type: ignore[arg-type]
    now = lambda: (played.controller.values["type"], played.controller.values["kp"])  # noqa: E731
    eventually(lambda: now() == ("tdof_npid2", 5.0), now, 60.0)


def test_margins_follow_the_plants_parameters_and_a_plant_that_is_another_one(played: Played) -> None:
    steering = played.steering
    eventually(lambda: steering.margins, lambda: steering.why_no_margins, 60.0)
    before = steering.margins[0].m_s
    played.plant.values["gain"] = 3.0
    eventually(lambda: steering.margins and steering.margins[0].m_s > before, "margins of the gain now", 60.0)
    played.plant.values |= {"model": "third_order", "zero_time_constant": 0.2}
    eventually(lambda: steering.plant.get("zero_time_constant") == 0.2, lambda: steering.plant, 60.0)
