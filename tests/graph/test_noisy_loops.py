"""The equalities hold bit for bit with noise on: distributed = local, tuned live = tuned offline."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from test_nodes import load_short, run_short
from test_tuner import LiveTuner, offline, problem, visited

from tdof_npid_ros.tuning.study import Study

NOISE = {"noise": 0.02, "quantum": 0.001, "noise_seed": 11}


def with_noise(case: Any) -> Any:
    return replace(case, plant_values={**case.plant_values, **NOISE})


def test_distributed_equals_local_with_noise(graph: Any) -> None:
    case = with_noise(load_short("p1-c0.5"))
    y, u = run_short(graph, "p1-c0.5", lanes=2, plant=NOISE, kp=(9.4, 5.0))
    local = case.simulate("short", case.gains.with_values(kp=(9.4, 5.0)))
    assert np.array_equal(y, local.output)
    assert np.array_equal(u, local.control_effort)
    assert np.std(y[:50]) > 0.01  # within the dead time


def test_tuned_live_equals_tuned_offline_with_noise(graph: Any) -> None:
    graph.start("plant", case="p1-c0.5", namespace="/noisy", reply_timeout=0.2, **NOISE)
    graph.start("controller", case="p1-c0.5", namespace="/noisy")
    graph.wait_for_nodes("/noisy/plant", "/noisy/controller")
    quiet = problem(seed=5)
    which = replace(quiet, case=with_noise(quiet.case))
    live = LiveTuner(graph.domain)
    try:
        found = visited(Study(which), live.pool(which, ["/noisy"]).evaluate)
    finally:
        live.close()
    assert found == offline(which)
    assert found != offline(quiet)
