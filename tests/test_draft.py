"""`tdof-npid new`: from a few facts to a parameter file that every command takes, with nothing to say against it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tdof_npid_ros.advice import advice
from tdof_npid_ros.case import load_case
from tdof_npid_ros.cli import main
from tdof_npid_ros.draft import Process, process_of
from tdof_npid_ros.plants.catalog import make_plant, named_model
from tdof_npid_ros.plants.ode import Ode

KINDS = {
    "heater": "--gain 0.8 --time-constant 180 --dead-time 25 --effort 0 100 --step 40 --unit K --at 20",
    "cooler": "--gain -0.5 --time-constant 60 --dead-time 4 --effort 0 100 --step -10 --at 25",
    "motor": "--gain 2 --time-constant 0.3 --integrating --effort -12 12 --step 3.14 --unit rad",
    "level": "--gain 0.05 --integrating --dead-time 2 --effort -1 1 --step 0.5 --at 1 --unit m",
    "two lags": "--gain 1 --time-constant 10 3 --step 1",
    "delay": "--gain 1 --time-constant 0.1 --dead-time 2 --step 1",
    "unstable": "--gain 1 --time-constant -10 --dead-time 1 --step 1",
    "fast": "--gain 1e6 --time-constant 1e-4 --step 1e3",
    "slow": "--gain 1e-3 --time-constant 86400 --dead-time 3600 --effort 0 1e5 --step 30 --at 20 --at-effort 1e4",
}


@pytest.mark.parametrize("facts", KINDS.values(), ids=KINDS)
def test_a_new_file_is_taken_by_every_command_and_reaches_its_setpoint(
    facts: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = str(tmp_path / "plant.yaml")
    assert main(["new", path, *facts.split(), "--json"]) == 0
    written = json.loads(capsys.readouterr().out)
    assert written["rule"] and written["sample_period"] > 0
    case = load_case(path)
    assert [one.line() for one in advice(case) if one.severity != "hint"] == []
    assert main(["simulate", path, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["setpoint"]["settling_time_s"] is not None
    assert all(low < high for low, high in case.bounds.values())


def test_a_gain_of_nothing_has_no_sign(tmp_path: Path) -> None:
    path = tmp_path / "cooler.yaml"
    assert main(["new", str(path), "--gain", "-0.3", "--time-constant", "60", "--dead-time", "5", "--step", "-10"]) == 0
    assert "kd: 0.0\n" in path.read_text()


def test_a_file_that_is_there_is_not_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "plant.yaml"
    path.write_text("mine")
    assert main(["new", str(path), *KINDS["heater"].split()]) == 2
    assert path.read_text() == "mine" and "not overwritten" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("facts", "why"),
    [
        ("--gain 0.8", "--time-constant, --step missing"),
        ("--gain 0 --time-constant 1 --step 1", "gain is 0"),
        ("--gain 1 --time-constant 0 --step 1", "must be finite and not 0"),
        ("--gain 0.8 --time-constant 180 --effort 0 100 --step 400", "beyond the limits 0 to 100"),
        ("--gain 1 --time-constant 1 --effort 5 1 --step 1", "lower limit must be below"),
        ("--gain 1 --time-constant 1 --step 1 --model a:B", "do not go with it"),
        ("--gain 1 --time-constant -1 --dead-time 5 --step 1", "next to no margin"),
    ],
)
def test_facts_that_make_no_loop_are_refused_and_nothing_is_written(
    facts: str, why: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "plant.yaml"
    assert main(["new", str(path), *facts.split()]) == 2
    assert why in capsys.readouterr().err and not path.exists()


TANK = '''
import math
class Tank:
    """A tank with an outflow by the root of its level."""
    parameters = {"area": 2.0, "valve": 0.4}
    initial_state = (1.0,)
    @staticmethod
    def derivative(x, u, d, p): return ((u + d - p[1] * math.sqrt(max(x[0], 0.0))) / p[0],)
    @staticmethod
    def output(x, p): return x[0]
'''


def test_a_class_of_ones_own_is_linearised_where_it_works(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "drafted_tank.py").write_text(TANK)
    monkeypatch.syspath_prepend(tmp_path)
    tank = make_plant(named_model("drafted_tank:Tank", tmp_path), {})
    assert isinstance(tank, Ode)
    process = process_of(tank.at_rest(1.0))
    assert process.time_constants == pytest.approx((10.0,)) and process.gain == pytest.approx(5.0)
    path = str(tmp_path / "tank.yaml")
    facts = "--model drafted_tank:Tank --at 1 --step 0.5 --effort 0 1 --unit m"
    assert main(["new", path, *facts.split()]) == 0
    assert [one.line() for one in advice(load_case(path))] == []
    capsys.readouterr()
    assert main(["simulate", path, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["setpoint"]["overshoot_percent"] < 20.0


def test_the_transfer_function_of_a_process_has_its_gain_and_lags() -> None:
    process = Process(2.0, (3.0, 1.0), 0.5, zero=-0.4, oscillation=(0.2, 0.3))
    model = process.transfer_function()
    assert model["numerator"] == [-0.8, 2.0] and model["denominator"][-1] == 1.0
    assert len(model["denominator"]) == 5
