"""What `run` waits for before it gives the loop."""

from __future__ import annotations

import pytest

from tdof_npid_ros.graph.running import _subscribers

NODES = ("plant", "controller", "scenario")


@pytest.mark.parametrize(
    ("mode", "recorded", "plans"), [("lockstep", False, 2), ("lockstep", True, 3), ("realtime", True, 2)]
)
def test_a_plant_in_realtime_takes_no_plan(mode: str, recorded: bool, plans: int) -> None:
    expected = {"output": 1 + recorded, "control_effort": 1 + recorded, "scenario_plan": plans}
    assert _subscribers(NODES, {}, recorded, mode) == expected
