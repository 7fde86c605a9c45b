"""The SROS2 policies name what the nodes have, and nothing else; no code is loaded by a remote change."""

from __future__ import annotations

import dataclasses
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import pytest
from conftest import REPOSITORY

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "analysis"))
from loop_bags import LoopBag

from tdof_npid_ros.case import load_case
from tdof_npid_ros.graph.__main__ import MODULES as NODES
from tdof_npid_ros.graph.recorder.node import EXPECTED as EXPECTED_BY_RECORDER

OWN_PARAMETERS = {"/parameter_events"}  # every node may listen to its own clock parameter; not all versions of rclpy do
# Ways to run a node that, together, use all that its policy allows. BAG is a bag that the test makes.
WAYS: dict[str, list[dict[str, Any]]] = {
    "plant": [{"mode": "lockstep", "lossless": True}, {"mode": "realtime"}],
    "controller": [{}],
    "scenario": [
        {"mode": mode, "episodes": ["e"], "plan__e": ["0 setpoint 1", "0 plant.gain 1", "60 end"]}
        for mode in ("lockstep", "realtime")
    ],
    "tuner": [{"answer_timeout": 1.0}, {"answer_timeout": 1.0, "episode": "alternate"}],
    "replay": [{"bag": "BAG", "rate": 1e-4, "clock": True}, {"bag": "BAG", "compare": True}],
}
CASE = dataclasses.replace(load_case("p1-c0.5"), episodes={"setpoint": ("0 setpoint 1", "1 end")})
EXPECTED = {name.lstrip("/") for name in EXPECTED_BY_RECORDER}
RECORDED = {
    "control_effort",
    "setpoint",
    "disturbance",
    "manual_effort",
    "controller_state",
    "tuning_progress",
    "recorded",
}


def allowed(node: str, kind: str, action: str) -> set[str]:
    root = ElementTree.parse(REPOSITORY / "config" / "sros2" / f"{node}.policy.xml")
    names = [name.text or "" for group in root.iter(f"{kind}s") if group.get(action) == "ALLOW" for name in group]
    assert len(names) == len(set(names))
    return {name.replace("~", f"/{node}") if name[0] in "~/" else f"/{name}" for name in names}


def endpoints(graph: Any, node: str, namespace: str) -> dict[str, set[str]]:
    """The names that a node in a namespace has, as if it were in the root namespace; none before it is discovered."""
    if (node, namespace) not in graph.node.get_node_names_and_namespaces():
        return {action: set() for action in ("publish", "subscribe", "reply", "request")}
    found = {
        "publish": graph.node.get_publisher_names_and_types_by_node(node, namespace),
        "subscribe": graph.node.get_subscriber_names_and_types_by_node(node, namespace),
        "reply": graph.node.get_service_names_and_types_by_node(node, namespace),
        "request": graph.node.get_client_names_and_types_by_node(node, namespace),
    }
    return {action: {name.removeprefix(namespace.rstrip("/")) for name, _ in pairs} for action, pairs in found.items()}


@pytest.mark.parametrize("node", [node for node in NODES if node != "recorder"])
def test_a_policy_allows_what_its_node_has_and_nothing_else(graph: Any, node: str, tmp_path: Path) -> None:
    with LoopBag(tmp_path / "bag") as writer:
        writer.configuration(CASE, CASE.gains)
        writer.episode(CASE, CASE.gains, "setpoint", 1)
    ways = {f"/way{i}": way for i, way in enumerate(WAYS[node])}
    for namespace, way in ways.items():
        options = {name: str(tmp_path / "bag") if value == "BAG" else value for name, value in way.items()}
        arguments = ["-p", "case:=p1-c0.5"] if node == "tuner" else []  # `case` is an argument of `start`, too
        process = graph.start(node, *arguments, namespace=namespace, **options)
        if "compare" in way or node == "tuner":
            process.expected_status = None  # it fails, for there is no controller, or not any more
        if node == "tuner":
            mode = "realtime" if "episode" in way else "lockstep"
            graph.start("plant", case="p1-c0.5", namespace=namespace, mode=mode)
            graph.start("controller", case="p1-c0.5", namespace=namespace)
    kinds = {"publish": "topic", "subscribe": "topic", "reply": "service", "request": "service"}
    expected = {action: allowed(node, kind, action) for action, kind in kinds.items()}
    if node == "replay":  # a bag may hold anything of a loop
        assert expected["publish"] >= {f"/{name.lstrip('/')}" for name in {*EXPECTED, *RECORDED}}
        expected["publish"] -= {
            f"/{name}" for name in ("setpoint", "disturbance", "episode", *RECORDED - {"control_effort"})
        }
    seen: dict[str, set[str]] = {action: set() for action in kinds}

    graph.wait_for_nodes(*(f"{namespace}/{node}" for namespace in ways))
    for namespace in ways:  # it may go by a simulator's time, too
        assert graph.set_parameters(f"{namespace}/{node}", use_sim_time=True)[0].successful

    def all_seen() -> bool:
        for namespace in ways:
            for action, found in endpoints(graph, node, namespace).items():
                assert found <= expected[action] | OWN_PARAMETERS, (namespace, action)
                seen[action] |= found
        return all(seen[action] | OWN_PARAMETERS == expected[action] | OWN_PARAMETERS for action in kinds)

    graph.wait_until(all_seen, 60, f"{expected} to be seen, not only {seen}")


def test_the_recorder_may_listen_to_the_loop_and_ask_for_parameters(graph: Any, tmp_path: Path) -> None:
    graph.start("recorder", bag=str(tmp_path / "bag"), lossless=True)
    graph.start("controller")
    graph.wait_for_nodes("/recorder", "/controller")
    graph.wait_until(lambda: "/controller/get_parameters" in endpoints(graph, "recorder", "/")["request"], 30)
    found = endpoints(graph, "recorder", "/")
    assert found["publish"] == allowed("recorder", "topic", "publish")
    assert found["reply"] == allowed("recorder", "service", "reply")
    onlooker = {name for name in found["request"] if name.startswith("/test/")}
    assert found["request"] - onlooker <= allowed("recorder", "service", "request")
    assert found["subscribe"] <= allowed("recorder", "topic", "subscribe")
    others = {"/clock", "/diagnostics", "/parameter_events", "/rosout"} | {
        f"/{node}/transition_event" for node in NODES
    }
    assert (
        allowed("recorder", "topic", "subscribe")
        == {f"/{name.lstrip('/')}" for name in {*EXPECTED, *RECORDED}} | others
    )
    assert allowed("recorder", "service", "request") == {
        f"/{node}/{service}" for node in NODES for service in ("get_parameters", "list_parameters")
    }


def test_a_model_is_never_loaded_by_a_remote_change(graph: Any) -> None:
    graph.start("plant")
    graph.wait_for_nodes("/plant")
    (result,) = graph.set_parameters("/plant", model="os:system")
    assert not result.successful
    assert graph.get_parameters("/plant", "model") == ["first_order"]
