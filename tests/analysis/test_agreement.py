"""`simulate` and `analyze` of the recorded run agree on every metric and on the margins, in every case."""

from pathlib import Path

import pytest
from loop_bags import LoopBag

from tdof_npid_ros.analysis.report import analyze
from tdof_npid_ros.case import Case, load_case
from tdof_npid_ros.parameter_file import config_folder
from tdof_npid_ros.stability.margins import margins

SHIPPED = sorted(path.stem for path in config_folder().glob("*.yaml"))
TANKS = """
from numba import njit
class Tank:
    parameters = {"area": 2.0, "outlet": 0.5}
    initial_state = (1.0,)
    @staticmethod
    def derivative(x, v, d, p):
        area, outlet = p
        return ((0.5 + v + d - outlet * x[0]) / area,)
    @staticmethod
    def output(x, p):
        return x[0]
"""
PLANTS = {  # model and its values, controller, setpoint and disturbance plan
    "lag": ("model: first_order, gain: 2.0, time_constant: 3.0, dead_time: 0.3", "type: pid, kp: 1.5, ki: 0.5",
            '"0 setpoint 2"', '"0 disturbance 0.5"'),
    "down": ("model: first_order, gain: 1.0, time_constant: 1.0, dead_time: 0.0", "type: npid, kp: 2.0, ki: 2.0",
             '"0 setpoint -3"', '"0 disturbance -1"'),
    "integrator": ("model: transfer_function, numerator: [0.5], denominator: [1.0, 0.0], dead_time: 0.8",
                   "type: tdof_npid2, kp: 0.8, ki: 0.1, kd: 0.2, alpha: 0.2, beta: 0.1", '"0 setpoint 1"',
                   '"0 disturbance 0.2"'),
    "oscillator": ("model: transfer_function, numerator: [4.0], denominator: [1.0, 0.8, 4.0], dead_time: 0.1",
                   "type: pid, kp: 0.4, ki: 0.6, kd: 0.2", '"0 setpoint 5"', '"0 disturbance 1"'),
    "unstable": ("model: transfer_function, numerator: [1.0], denominator: [1.0, -1.0], dead_time: 0.1",
                 "type: pid, kp: 4.0, ki: 1.0", '"0 setpoint 1"', '"0 disturbance 1"'),
    "zero": ("model: third_order, gain: 1.0, time_constant: 1.0, zero_time_constant: 1.0, dead_time: 0.2",
             "type: tdof_npid1, kp: 0.5, ki: 0.2, kd: 0.3, alpha: 0.3", '"0 setpoint 1"', '"0 disturbance 1"'),
    "limited": ("model: second_order, gain: 1.0, time_constant: 1.0, dead_time: 0.2, effort_max: 1.5, effort_min: 0.0",
                "type: pid, kp: 3.0, ki: 1.0, effort_min: 0.0, effort_max: 1.5", '"0 setpoint 1.2"',
                '"0 disturbance 0.4"'),
    "angle": ("model: transfer_function, numerator: [1.0], denominator: [1.0, 0.0], dead_time: 0.0",
              "type: pid, kp: 2.0, ki: 0.1, angle: true", '"0 setpoint 3.5"', '"0 disturbance 1"'),
    "chaos": ("model: sprott, initial_state: [0.4, 0.0, 0.0]", "type: pid, kp: 60.0, ki: 30.0, kd: 12.0",
              '"0 setpoint 1"', '"0 setpoint 0.4", "0 disturbance 3"'),
    "operating point": ("model: first_order, gain: 2.0, time_constant: 3.0, dead_time: 0.3, output_offset: 60.0, "
                        "effort_offset: 40.0", "type: pid, kp: 1.5, ki: 0.5", '"0 start 60", "0 setpoint 70"',
                        '"0 start 60", "0 disturbance 5"'),
    "tank": ("model: 'tanks_of_a_test:Tank'", "type: pid, kp: 3.0, ki: 1.0", '"0 setpoint 1.5"',
             '"0 setpoint 1.0", "0 disturbance 0.3"'),
}  # fmt: skip
FILE = (
    "/**: {{ros__parameters: {{sample_period: 0.01}}}}\n/**/plant: {{ros__parameters: {{{0}}}}}\n"
    "/**/controller: {{ros__parameters: {{{1}}}}}\n"
    "/**/scenario: {{ros__parameters: {{episodes: [setpoint, disturbance], plan: "
    '{{setpoint: [{2}, "20 end"], disturbance: [{3}, "20 end"]}}}}}}\n'
)


def recorded(folder: Path, case: Case) -> None:
    with LoopBag(folder) as bag:
        bag.configuration(case, case.gains)
        for number, episode in enumerate(("setpoint", "disturbance"), start=1):
            bag.episode(case, case.gains, episode, number)


def agree(case: Case, folder: Path) -> None:
    recorded(folder, case)
    setpoint, disturbance = analyze([folder]).episodes
    assert [r.kind for r in (*setpoint.responses[0], *disturbance.responses[0])] == ["setpoint", "disturbance"]
    assert setpoint.metrics() == case.setpoint_response()
    assert disturbance.metrics() == case.disturbance_response()
    told = setpoint.margins[0]
    assert told is not None
    if case.options.is_plain:
        assert told == margins(case, case.gains)
    else:
        assert told.stable is None and "options" in str(told.reason)


@pytest.mark.parametrize("name", SHIPPED)
def test_the_cases_that_come_with_it(name, tmp_path) -> None:
    agree(load_case(name), tmp_path / "bag")


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder: Path = tmp_path_factory.mktemp("plants")
    (folder / "tanks_of_a_test.py").write_text(TANKS)
    return folder


@pytest.mark.parametrize("name", PLANTS)
def test_plants_of_one_s_own(name, folder, tmp_path) -> None:
    file = folder / "case.yaml"
    file.write_text(FILE.format(*PLANTS[name]))
    agree(load_case(file), tmp_path / "bag")


def test_a_tank_is_measured_from_the_level_at_which_it_begins(folder) -> None:
    file = folder / "case.yaml"
    file.write_text(FILE.format(*PLANTS["tank"]))
    case = load_case(file)
    y = case.simulate("setpoint").output[:, 0]
    metrics = case.setpoint_response()
    assert y[0] == 1.0
    assert metrics.overshoot_percent == pytest.approx(100 * (y.max() - 1.5) / 0.5)
    assert case.largest_move == 0.5
    outside = abs(y - 1.5) > 0.05 * 0.5
    assert metrics.settling_time_s == pytest.approx((outside.nonzero()[0][-1] + 1) * 0.01)


def test_an_angle_takes_the_shorter_way(tmp_path) -> None:
    file = tmp_path / "case.yaml"
    file.write_text(FILE.format(*PLANTS["angle"]).replace("ki: 0.1, ", ""))
    metrics = load_case(file).setpoint_response()
    way = 2 * 3.141592653589793 - 3.5
    assert metrics.overshoot_percent == 0.0 and metrics.settling_time_s == pytest.approx(1.5, abs=0.02)
    assert metrics.iae == pytest.approx(way / 2, rel=0.02)
