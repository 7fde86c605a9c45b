"""The scripts of `examples/` do what they say."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from dds_domain import reserved_domain

from tdof_npid_ros import analyze, read_bag
from tdof_npid_ros.analysis.verify import verify

EXAMPLES = Path(__file__).parents[2] / "examples"


def printed_by(script: str, *arguments: str) -> str:
    """What a script prints, in a DDS domain of its own."""
    number, domain = reserved_domain()
    with domain:
        environment = {**os.environ, "ROS_DOMAIN_ID": str(number)}
        command = [sys.executable, str(EXAMPLES / script), *arguments]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=280)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return done.stdout


@pytest.mark.timeout(300)
def test_two_controllers_are_compared_from_one_bag(tmp_path: Path) -> None:
    bag = str(tmp_path / "bag")
    table = printed_by("compare_controllers.py", bag)
    rows = analyze([bag]).rows()
    assert [(row["controller"], row["response"]) for row in rows] == [
        (controller, response) for controller in ("pid", "tdof_npid2") for response in ("setpoint", "disturbance")
    ]
    assert rows[2]["overshoot_percent"] < rows[0]["overshoot_percent"] and rows[2]["iae"] < rows[0]["iae"]
    assert f"{rows[2]['overshoot_percent']:.4f}" in table
    assert verify(bag).sound


@pytest.mark.timeout(300)
def test_a_sweep_over_ros_2_is_the_sweep_in_process(tmp_path: Path) -> None:
    printed = printed_by("gain_sweep.py", str(tmp_path / "bag"))
    assert printed.count("overshoot") == 8 and printed.endswith("bit for bit: True\n")


@pytest.mark.timeout(300)
def test_a_plant_of_one_s_own_is_driven_and_recorded(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    printed_by("own_plant.py", str(bag))
    account = verify(bag)
    assert account.sound and account.equal > 100 and not account.unverifiable
    with read_bag(bag) as recorded:
        position = recorded.columns("/output", ["position"])["position"][:, 0]
    assert position[0] == 0.0 and abs(position[-1] - 0.5) < 0.01


@pytest.mark.alone  # on a busy machine best-effort messages are lost
@pytest.mark.timeout(300)
def test_an_arm_s_joints_are_held_then_driven(tmp_path: Path) -> None:
    pytest.importorskip("mujoco", reason="MuJoCo is not installed: pip install '.[examples]'")
    bag = tmp_path / "bag"
    printed = printed_by("arm/drive.py", str(bag))
    assert printed.count("setpoint") >= 4
    account = verify(bag)
    assert account.sound and account.equal >= 1000 and not account.unverifiable
    with read_bag(bag) as recorded:
        states = recorded.columns("/joint_states", ["name", "position"])
        efforts = recorded.columns("/efforts", ["name"])["name"]
    joints = list(states["name"][0])
    assert len(joints) == 7 and {*joints} - {*efforts[0]} == {"gripper"}
    position = states["position"]
    assert abs(position[240] - position[0]).max() < 1e-3  # held where it was
    wanted = dict(zip(joints, position[0], strict=True)) | {"base": 0.5, "shoulder": -0.2, "elbow": 0.9}
    wanted["wrist_pitch"] = 0.4
    assert abs(position[-1] - [wanted[joint] for joint in joints])[:6].max() < 0.02


def test_a_loop_that_stands_still_is_told_with_what_its_nodes_warn_of(monkeypatch: pytest.MonkeyPatch) -> None:
    from tdof_npid_ros.graph import running

    monkeypatch.setattr(running, "STANDS_STILL", 3.0)
    number, domain = reserved_domain()
    monkeypatch.setenv("ROS_DOMAIN_ID", str(number))
    with domain, running.run("p1-c0.5", lanes=2) as loop:  # gains for one lane
        loop.play("setpoint")
        with pytest.raises(running.LoopError, match=r"stood still for 3 s: .*controller: output refused"):
            loop.wait()
        with pytest.raises(running.LoopError, match="no episode setpoit: there are setpoint, disturbance"):
            loop.play("setpoit")


def test_a_parameter_that_no_node_has_is_refused_before_anything_starts() -> None:
    from tdof_npid_ros.graph.running import run

    with pytest.raises(ValueError, match="no node has a parameter kpp: kp is meant"), run("p1-c0.5", kpp=1.0):
        pass
