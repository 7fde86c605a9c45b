"""What an experienced colleague says of a parameter file, and what `simulate` and `tune` pass on of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tdof_npid_ros.advice import advice, gravest
from tdof_npid_ros.case import Case, load_case
from tdof_npid_ros.draft import Draft, Process

HEATER = Process(0.8, (180.0,), 25.0)


def heater(tmp_path: Path, **changes: Any) -> Case:
    path = tmp_path / "heater.yaml"
    facts: dict[str, Any] = {"step": 40.0, "effort": (0.0, 100.0)} | changes
    path.write_text(Draft(HEATER, HEATER.transfer_function(), **facts).text(), encoding="utf-8")
    return load_case(path)


def said(case: Case) -> list[tuple[str, str]]:
    """Severity and subject of each finding, but for the hint that M_s is above 2."""
    return [(one.severity, one.about) for one in advice(case) if (one.severity, one.about) != ("hint", "gains")]


def test_an_m_s_above_2_is_a_hint() -> None:
    (found,) = advice(load_case("p1-c0.5"))
    assert found.severity == "hint" and "M_s is 2.3" in found.text and "--ms 1.8" in found.remedy


@pytest.mark.parametrize("name", ["p1-c0.5", "p1-c4", "p2-c2", "p2-c5", "p3-c1", "p3-c2", "sprott"])
def test_there_is_nothing_to_say_against_the_papers_cases(name: str) -> None:
    assert said(load_case(name)) == []


def test_there_is_nothing_to_say_against_a_new_file(tmp_path: Path) -> None:
    assert said(heater(tmp_path)) == []


def test_a_sigma_far_below_the_setpoints_step_is_told(tmp_path: Path) -> None:
    case = heater(tmp_path)
    found = gravest(replace(case, gains=case.gains.with_values(sigma=1.0)))
    assert found is not None and found.about == "sigma" and "set sigma to the largest change" in found.line()


def test_a_limit_that_the_controller_does_not_know_is_told(tmp_path: Path) -> None:
    case = heater(tmp_path)
    free = replace(case, gains=case.gains.with_values(effort_max=float("inf")))
    assert ("warning", "effort_min, effort_max") in said(free)


def test_an_episode_with_the_effort_at_its_limit_throughout_is_told(tmp_path: Path) -> None:
    case = heater(tmp_path)
    cold = replace(case, episodes={**case.episodes, "disturbance": ("0 disturbance 10", "1600 end")})
    (found,) = [one for one in advice(cold) if one.severity != "hint"]
    assert (found.severity, found.about) == ("warning", "episode disturbance")
    assert "0 start VALUE" in found.remedy


def test_a_setpoint_that_the_actuator_cannot_hold_is_told(tmp_path: Path) -> None:
    case = heater(tmp_path)
    too_hot = replace(case, episodes={**case.episodes, "setpoint": ("0 setpoint 120", "1600 end")})
    assert any(one.about == "episode setpoint" and "effort of 150" in one.text for one in advice(too_hot))


def test_a_sample_period_as_long_as_the_time_constant_is_told(tmp_path: Path) -> None:
    assert ("warning", "sample_period") in said(heater(tmp_path, sample_period=100.0))


def test_an_episode_that_ends_too_early_is_told(tmp_path: Path) -> None:
    case = heater(tmp_path)
    short = replace(case, episodes={"setpoint": ("0 setpoint 40", "120 end"), "disturbance": ("0 start 40", "120 end")})
    assert ("warning", "episode setpoint") in said(short)


def test_an_unstable_loop_is_an_error(tmp_path: Path) -> None:
    case = heater(tmp_path, effort=(-float("inf"), float("inf")))
    assert said(replace(case, gains=case.gains.with_values(kp=200.0)))[0] == ("error", "gains")


PLANTS = '''
class Fast:
    """A motor with its winding: 1/(0.1 s) and 1/(0.2 ms)."""
    parameters = {"te": 0.0002, "tm": 0.1}
    initial_state = (0.0, 0.0)
    @staticmethod
    def derivative(x, u, d, p): return ((u + d - x[0]) / p[0], (x[0] - x[1]) / p[1])
    @staticmethod
    def output(x, p): return x[1]
'''
FAST = """
/**: {ros__parameters: {sample_period: 0.01, mode: lockstep}}
/**/plant: {ros__parameters: {model: "advised_%d:Fast", substeps: %d}}
/**/controller: {ros__parameters: {type: pid, kp: 2.0, ki: 10.0}}
/**/scenario:
  ros__parameters:
    episodes: [setpoint, disturbance]
    plan: {setpoint: ["0 setpoint 1", "4 end"], disturbance: ["0 disturbance 1", "4 end"]}
"""


@pytest.mark.parametrize(("substeps", "severity"), [(4, "error"), (20, "hint"), (60, "hint"), (100, None)])
def test_an_integration_that_is_unstable_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, substeps: int, severity: str | None
) -> None:
    (tmp_path / f"advised_{substeps}.py").write_text(PLANTS)
    monkeypatch.syspath_prepend(tmp_path)
    path = tmp_path / "fast.yaml"
    path.write_text(FAST % (substeps, substeps))
    found = [one for one in advice(load_case(path)) if one.about == "substeps"]
    assert [one.severity for one in found] == ([severity] if severity else [])


def test_each_lane_with_a_plant_of_its_own_is_advised_of() -> None:
    case = load_case("p1-c0.5")
    lanes = replace(case, plant_values={**case.plant_values, "gain": [1.0, 5.0]})
    assert [(one.severity, one.about) for one in advice(lanes)] == [
        ("error", "lane 1, gains"),
        ("hint", "lane 0, gains"),
    ]
