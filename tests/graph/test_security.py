"""The SROS2 policies name what the nodes have, and nothing else."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from typing import Any

import pytest
from conftest import REPOSITORY

NODES = ("plant", "controller", "scenario")


def allowed(node: str, kind: str, action: str) -> set[str]:
    root = ElementTree.parse(REPOSITORY / "config" / "sros2" / f"{node}.policy.xml")
    names = [name.text or "" for group in root.iter(f"{kind}s") if group.get(action) == "ALLOW" for name in group]
    return {name.replace("~", f"/{node}") if name[0] in "~/" else f"/{name}" for name in names}


@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
def test_policies_are_what_the_nodes_need(graph: Any, mode: str) -> None:
    for node in NODES:
        graph.start(node, mode=mode, episodes=["e"], plan__e=["0 setpoint 1", "60 end"])
    graph.wait_for_nodes(*(f"/{node}" for node in NODES))
    for node in NODES:
        graph.wait_until(
            lambda n=node: f"/{n}/get_state" in names(graph.node.get_service_names_and_types_by_node(n, "/"))
        )
        published = names(graph.node.get_publisher_names_and_types_by_node(node, "/"))
        subscribed = names(graph.node.get_subscriber_names_and_types_by_node(node, "/"))
        assert published <= allowed(node, "topic", "publish")
        assert subscribed <= allowed(node, "topic", "subscribe")
        assert names(graph.node.get_service_names_and_types_by_node(node, "/")) <= allowed(node, "service", "reply")
        assert names(graph.node.get_client_names_and_types_by_node(node, "/")) <= allowed(node, "service", "request")
        if node == "controller":
            assert published == allowed(node, "topic", "publish")
            assert subscribed | {"/parameter_events"} == allowed(node, "topic", "subscribe")


def names(found: list[tuple[str, list[str]]]) -> set[str]:
    return {name for name, _ in found}


def test_a_model_is_never_loaded_by_a_remote_change(graph: Any) -> None:
    graph.start("plant")
    graph.wait_for_nodes("/plant")
    (result,) = graph.set_parameters("/plant", model="os:system")
    assert not result.successful
    assert graph.get_parameters("/plant", "model") == ["first_order"]
