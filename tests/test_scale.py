"""Sigma is the largest change of the setpoint: resolved where the file is read, demanded where it is needed."""

from __future__ import annotations

from pathlib import Path

import pytest

from tdof_npid_ros.case import load_case
from tdof_npid_ros.control.gains import GainsError

FILE = """
/**: {{ros__parameters: {{sample_period: 2.0, mode: lockstep}}}}
/**/plant:
  ros__parameters: {{model: first_order, gain: 0.8, time_constant: 180.0, dead_time: 25.0, output_offset: 20.0}}
/**/controller: {{ros__parameters: {{type: {type}, kp: 4.3, ki: 0.024{sigma}}}}}
/**/scenario:
  ros__parameters:
    episodes: [setpoint, disturbance]
    plan: {{setpoint: [{setpoint}, "1600 end"], disturbance: ["0 start 20", "0 disturbance 1", "1600 end"]}}
"""


def written(tmp_path: Path, setpoint: str, type_: str = "tdof_npid2", sigma: str = "") -> Path:
    path = tmp_path / "heater.yaml"
    path.write_text(FILE.format(type=type_, sigma=sigma, setpoint=setpoint))
    return path


@pytest.mark.parametrize(
    ("setpoint", "step"),
    [
        ('"0 setpoint 60"', 40.0),  # from the output at its operating point
        ('"0 start 50", "0 setpoint 60"', 10.0),
        ('"0 start 20", "0 setpoint 30", "400 setpoint 5", "800 setpoint 20"', 25.0),
        ('"0 start 20", "0 setpoint ramp 60 over 400"', 0.2),
    ],
)
def test_sigma_that_is_not_given_is_the_largest_step(tmp_path: Path, setpoint: str, step: float) -> None:
    case = load_case(written(tmp_path, setpoint))
    assert case.gains.sigma == pytest.approx(step) and case.largest_step == pytest.approx(step)
    assert case.bounds["sigma"] == pytest.approx((0.2 * step, 20.0 * step))


def test_sigma_that_is_given_stays(tmp_path: Path) -> None:
    assert load_case(written(tmp_path, '"0 setpoint 60"', sigma=", sigma: 7.0")).gains.sigma == 7.0


def test_without_a_step_sigma_must_be_given_unless_the_type_has_none(tmp_path: Path) -> None:
    with pytest.raises(GainsError, match="sigma is not given"):
        load_case(written(tmp_path, '"0 start 20"'))
    assert load_case(written(tmp_path, '"0 start 20"', type_="pid")).gains.type == "pid"


def test_a_heater_with_a_step_of_40_reaches_it(tmp_path: Path) -> None:
    case = load_case(written(tmp_path, '"0 start 20", "0 setpoint 60"'))
    assert abs(case.simulate("setpoint").output[-1, 0] - 60.0) < 0.5
