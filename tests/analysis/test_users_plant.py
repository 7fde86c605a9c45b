"""A plant's class that a bag names is imported only if the user names its file."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from loop_bags import LoopBag

from tdof_npid_ros.case import load_case

PLANT = """
from pathlib import Path
Path(__file__).with_name("imported").touch()

class Lag:
    parameters = {"rate": 1.0}
    initial_state = (0.0,)

    @staticmethod
    def derivative(x, u, d, p):
        return (p[0] * (u + d - x[0]),)

    @staticmethod
    def output(x, p):
        return x[0]
"""
CASE = """
/**/plant: {ros__parameters: {model: 'recorded_lag:Lag', sample_period: 0.01, mode: lockstep}}
/**/controller: {ros__parameters: {type: tdof_npid1, kp: 2.0, ki: 1.0, sigma: 1.0}}
/**/scenario: {ros__parameters: {episodes: [setpoint], plan: {setpoint: ['0 setpoint 1', '1 end']}}}
"""


def program(folder: Path, *arguments: str, status: int = 0) -> str:
    command = [sys.executable, "-m", "tdof_npid_ros", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, cwd=folder)
    assert done.returncode == status, done.stderr
    return done.stdout


def test_a_class_that_a_bag_names_is_imported_only_from_a_file_that_the_user_names(tmp_path: Path) -> None:
    plants = tmp_path / "plants"
    plants.mkdir()
    (plants / "recorded_lag.py").write_text(PLANT)
    (plants / "lag.yaml").write_text(CASE)
    case = load_case(plants / "lag.yaml")
    with LoopBag(tmp_path / "bag") as writer:
        writer.configuration(case, case.gains)
        writer.episode(case, case.gains, "setpoint", 1)
    (plants / "imported").unlink()
    for command, status in (("analyze", 0), ("verify", 3)):
        # The class lies where Python would find it.
        told = program(plants, command, str(tmp_path / "bag"), status=status)
        assert not (plants / "imported").exists() and "--case FILE" in told
    for command in ("analyze", "verify"):
        told = program(tmp_path, command, str(tmp_path / "bag"), "--case", str(plants / "lag.yaml"))
        assert (plants / "imported").exists() and "--case FILE" not in told
