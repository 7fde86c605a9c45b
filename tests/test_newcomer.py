"""A newcomer's first hour, from documented commands alone: a heater, a motor and a tank reach their setpoints."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from dds_domain import reserved_domain

from tdof_npid_ros.cli import main

TANK = '''
import math


class Tank:
    """A tank with an outflow by the root of its level."""

    parameters = {"area": 2.0, "valve": 0.4}
    initial_state = (1.0,)

    @staticmethod
    def derivative(x, u, d, p):
        return ((u + d - p[1] * math.sqrt(max(x[0], 0.0))) / p[0],)

    @staticmethod
    def output(x, p):
        return x[0]
'''
PLANTS = {
    "heater": "--gain 0.8 --time-constant 180 --dead-time 25 --effort 0 100 --at 20 --step 40 --unit K",
    "motor": "--gain 2 --time-constant 0.3 --integrating --effort -12 12 --step 3.14 --unit rad",
    "tank": "--model newcomers_tank:Tank --at 1 --step 0.5 --effort 0 1 --unit m",
}


@pytest.mark.timeout(400)
@pytest.mark.parametrize("name", PLANTS)
def test_from_a_few_facts_to_a_verified_loop(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "newcomers_tank.py").write_text(TANK)
    file = f"{name}.yaml"

    def told(*arguments: str, status: int = 0) -> dict[str, Any]:
        capsys.readouterr()
        assert main([*arguments, "--json"]) == status
        return dict(json.loads(capsys.readouterr().out))

    told("new", file, *PLANTS[name].split())
    assert [one for one in told("check", file)["advice"] if one["severity"] != "hint"] == []
    first = told("simulate", file, "--plot", "response.png")
    assert first["setpoint"]["settling_time_s"] is not None and Path("response.png").stat().st_size > 10_000

    pid = told("tune", file, "--controller", "pid", "--budget", "8000")
    tuned = told("tune", file, "--controller", "tdof_npid2", "--budget", "8000", "--out", "tuned.yaml")
    assert tuned["objective"] <= pid["objective"] * 1.001 and tuned["objective"] <= first["objective"] * 1.001
    assert tuned["setpoint"]["settling_time_s"] is not None and tuned["margins"]["m_s"] <= 2.01
    assert told("simulate", file, "--gains", "tuned.yaml")["objective"] == tuned["objective"]

    number, domain = reserved_domain()
    with domain:
        command = [sys.executable, "-m", "tdof_npid_ros", "run", file, "--gains", "tuned.yaml"]
        command += ["--bag", "bags/first", "--json"]
        environment = {**os.environ, "ROS_DOMAIN_ID": str(number)}
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    case = ["--case", file] if name == "tank" else []
    report = told("analyze", "bags/first", "--html", "report.html", *case)
    measured = [response for one in report["episodes"] for response in one["lanes"][0]["responses"]]
    assert [one["iae"] for one in measured] == [tuned["setpoint"]["iae"], tuned["disturbance"]["iae"]]
    assert Path("report.html").stat().st_size > 100_000
    assert [one["sound"] for one in told("verify", "bags/first", *case)["bags"]] == [True]
