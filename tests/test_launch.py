"""The launch files: what they start with which arguments. Without an installed ROS 2, `launch` has stand-ins here."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from tdof_npid_ros.parameters import NODES

FOLDER = Path(__file__).parent.parent / "launch"
ACTIONS = ("DeclareLaunchArgument", "EmitEvent", "OpaqueFunction", "RegisterEventHandler")


class Made(SimpleNamespace):
    """What was made of some class, with its arguments."""


def maker(kind: str) -> Any:
    return lambda *args, **given: Made(kind=kind, args=args, **given)


class Configuration:
    """LaunchConfiguration: its value is in the context."""

    def __init__(self, name: str) -> None:
        self.name = name

    def perform(self, context: dict[str, str]) -> str:
        return context[self.name]


@pytest.fixture(autouse=True)
def launch(monkeypatch: pytest.MonkeyPatch) -> None:
    """Modules `launch` and `launch_ros` whose classes only keep their arguments."""
    names: dict[str, dict[str, Any]] = {
        "launch": {"LaunchDescription": maker("LaunchDescription")},
        "launch.actions": {name: maker(name) for name in ACTIONS},
        "launch.event_handlers": {name: maker(name) for name in ("OnProcessIO", "OnProcessExit")},
        "launch.events": {"matches_action": lambda action: action},
        "launch.events.process": {"ShutdownProcess": maker("ShutdownProcess")},
        "launch.substitutions": {"LaunchConfiguration": Configuration},
        "launch_ros": {},
        "launch_ros.actions": {"Node": maker("Node")},
    }
    for name, content in names.items():
        module = ModuleType(name)
        module.__dict__.update(content)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.delitem(sys.modules, "tdof_npid_ros.graph.launching", raising=False)


def started(name: str, /, **given: str) -> list[Made]:
    """What a launch file starts with these arguments, the others at their defaults."""
    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.launch.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    (entities,) = module.generate_launch_description().args
    declared = [entity for entity in entities if entity.kind == "DeclareLaunchArgument"]
    context = {one.args[0]: one.default_value for one in declared}
    assert given.keys() <= context.keys()
    context |= given
    assert None not in context.values(), "an argument that must be given"
    for one in declared:
        assert getattr(one, "choices", None) is None or context[one.args[0]] in one.choices
    (function,) = (entity.function for entity in entities if entity.kind == "OpaqueFunction")
    return list(function(context))


def nodes(of: list[Made]) -> dict[str, Made]:
    return {one.executable: one for one in of if one.kind == "Node"}


def test_a_loop_is_one_node_of_each_kind_with_the_case_s_file() -> None:
    made = nodes(started("loop"))
    assert list(made) == ["recorder", "plant", "controller", "scenario"]
    for node in made.values():
        (file,) = node.parameters
        assert Path(file).name == "p1-c0.5.yaml" and Path(file).is_file()
        assert node.package == "tdof_npid_ros" and node.ros_arguments == ["--log-level", "info"]


def test_arguments_hold_over_the_file_and_are_parameters_of_the_nodes_that_get_them() -> None:
    made = nodes(
        started(
            "loop", mode="lockstep", type="npid", bag="bags/x", lossless="true", publish_clock="false", recorder="true"
        )
    )
    given = {name: node.parameters[1] for name, node in made.items()}
    assert given == {
        "recorder": {"bag": "bags/x", "lossless": True},
        "plant": {"mode": "lockstep", "lossless": True, "publish_clock": False},
        "controller": {"type": "npid"},
        "scenario": {"mode": "lockstep"},
    }
    for node, parameters in given.items():
        assert made[node].name == node  # or the file's section, which names it, would hold
        for name, value in parameters.items():
            NODES[node][name].checked(value)


def test_nodes_can_be_left_out() -> None:
    assert list(nodes(started("loop", recorder="false", controller="false"))) == ["plant", "scenario"]


def test_it_ends_when_the_episodes_are_played_unless_it_is_to_stay() -> None:
    (handler,) = (one.args[0] for one in started("loop") if one.kind == "RegisterEventHandler")
    assert handler.target_action.executable == "scenario"
    ends = handler.on_stderr(Made(text=b"[INFO] [1.2] [scenario]: all episodes played\n"))
    # these nodes, not the whole launch, which another may have included
    assert [end.event.kind for end in ends] == ["ShutdownProcess"] * 4
    assert [end.event.process_matcher.executable for end in ends] == ["recorder", "plant", "controller", "scenario"]
    assert not handler.on_stderr(Made(text=b"[INFO] ready"))
    for stays in (started("loop", stay="true"), started("loop", scenario="false")):
        assert {one.kind for one in stays} == {"Node"}


def test_what_the_loop_waits_for_is_what_the_scenario_logs() -> None:
    scenario = (FOLDER.parent / "tdof_npid_ros" / "graph" / "scenario_node.py").read_text()
    assert 'info("all episodes played")' in scenario


def test_a_robot_s_controller_is_remapped_and_recorded_if_a_bag_is_given() -> None:
    (controller,) = started("controller", params="arm.yaml", name="arm", output="joint_states", setpoint="goal")
    assert controller.remappings == [("output", "joint_states"), ("setpoint", "goal")]
    assert (controller.name, controller.parameters) == ("arm", ["arm.yaml"])
    recorder, controller = started(
        "controller", params="arm.yaml", bag="bags/arm", namespace="left", name="arm", output="joint_states"
    )
    assert (recorder.parameters, recorder.namespace) == (["arm.yaml", {"bag": "bags/arm"}], "left")
    assert recorder.remappings == [("output", "joint_states")]  # listens to them, and as the controller does
    assert (recorder.name, controller.name) == ("recorder", "arm")
    with pytest.raises(AssertionError, match="must be given"):
        started("controller")


def test_the_tuner_comes_with_its_loop_which_ends_with_it() -> None:
    plant, controller, tuner, handler = started("tuner", case="p3-c1", type="pid", seed="7", mode="lockstep")
    assert plant.parameters[1] == {"mode": "lockstep"} and len(controller.parameters) == 1
    assert tuner.parameters[1] == {"case": "p3-c1", "type": "pid", "seed": 7}
    for name, value in tuner.parameters[1].items():
        NODES["tuner"][name].checked(value)
    assert handler.args[0].target_action is tuner
    assert [end.event.process_matcher for end in handler.args[0].on_exit] == [plant, controller]
    assert list(nodes(started("tuner", plant="false", controller="false"))) == ["tuner"]


def test_a_replay_comes_alone_or_is_compared_with_a_controller() -> None:
    (replay,) = started("replay", bag="2024", rate="2.0", loop="true")
    assert replay.parameters == [{"bag": "2024", "rate": 2.0, "loop": True, "clock": False}]
    controller, replay, handler = started("replay", bag="bags/first", case="p1-c4")
    assert Path(controller.parameters[0]).name == "p1-c4.yaml" and replay.parameters[0]["compare"] is True
    assert handler.args[0].target_action is replay
    with pytest.raises(AssertionError, match="must be given"):
        started("replay")


@pytest.mark.parametrize("name", ["loop", "controller", "tuner", "replay"])
def test_each_goes_into_a_namespace(name: str) -> None:
    given = {"controller": {"params": "arm.yaml", "bag": "x"}, "replay": {"bag": "x", "case": "p1-c4"}}.get(name, {})
    assert {one.namespace for one in nodes(started(name, namespace="left", **given)).values()} == {"left"}
