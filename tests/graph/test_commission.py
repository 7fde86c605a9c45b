"""From a running loop to gains, with the tool as a process: near the best there is, with the margin, and never unsafe.

`TDOF_COMMISSION=all` commissions all twenty plants, and interrupts at more moments.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from commissioned_plants import LOOPS, QUICK, Loop

from tdof_npid_ros.case import Case, load_case
from tdof_npid_ros.cli import main
from tdof_npid_ros.control.gains import Gains
from tdof_npid_ros.parameters import EXPERIMENT
from tdof_npid_ros.plants.catalog import named_model
from tdof_npid_ros.stability.margins import margins
from tdof_npid_ros.tuning.judge import Constraints
from tdof_npid_ros.tuning.objective import Objective
from tdof_npid_ros.tuning.problem import TuningProblem, candidate_of
from tdof_npid_ros.tuning.study import Study

pytestmark = pytest.mark.alone  # what a busy machine delays is identified as the plant's
HERE = Path(__file__).parent
MS = 1.8
ALL = os.environ.get("TDOF_COMMISSION") == "all"
CHOSEN = list(LOOPS) if ALL else list(QUICK)


def started(graph: Any, loop: Loop) -> None:
    common = {"sample_period": loop.period, "effort_min": loop.effort[0], "effort_max": loop.effort[1]}
    folder = {"cwd": HERE} if ":" in loop.plant["model"] else {}
    graph.start(
        "plant", namespace="/loop", mode="realtime", speed=loop.speed, start=loop.start, effort_timeout=10.0, **common,
        **loop.plant, **folder,
    )  # fmt: skip
    kp, ki = loop.gains
    graph.start(
        "controller", namespace="/loop", type="tdof_npid2", kp=kp, ki=ki, sigma=loop.sigma, setpoint=loop.start,
        output_timeout=5.0, manual=loop.by_hand, manual_effort=resting(loop) if loop.by_hand else 0.0,
        anti_windup="back_calculation", **{f"safe_range__{k}": list(v) for k, v in ranges(loop).items()}, **common,
    )  # fmt: skip
    graph.wait_for_nodes("/loop/plant", "/loop/controller")


def commission(graph: Any, folder: Path, *arguments: str, **how: Any) -> subprocess.Popen[str]:
    """The tool as a process; what it says is in `tool.log`, where `how` gives it no other streams."""
    with (folder / "tool.log").open("w") as log:
        return subprocess.Popen(
            [sys.executable, "-m", "tdof_npid_ros", "commission", "/loop", "--yes", "--bag", "bag", *arguments],
            env=graph.environment, cwd=folder, text=True, **{"stdout": log, "stderr": log, **how},
        )  # fmt: skip


def ranges(loop: Loop) -> dict[str, tuple[float, float]]:
    return {"output": loop.safe, "effort": loop.effort}


def resting(loop: Loop) -> float:
    plant = loop.plant
    if "gain" not in plant:
        return float(plant.get("effort_offset", 0.0))
    return float((loop.start - plant.get("output_offset", 0.0)) / plant["gain"] + plant.get("effort_offset", 0.0))


def true_case(file: Path, loop: Loop) -> Case:
    """The episodes and bounds that commissioning has drafted, with the true plant, at rest where it rests."""
    case = load_case(file)
    values = {**loop.plant, "effort_min": loop.effort[0], "effort_max": loop.effort[1]}
    for name in ("noise", "quantum"):
        values.pop(name, None)
    return replace(case, model=named_model(loop.plant["model"], HERE), plant_values=values)


def compared(case: Case, gains: Gains) -> tuple[float, float, float]:
    """Objective and M_s of gains on the true plant, and the best objective at the same M_s asked for."""
    problem = TuningProblem(
        case, "tdof_npid2", ("sigma",), constraints=Constraints(ms=MS), warm=True, until_converged=True, seed=1
    )
    study = Study(replace(problem, case=replace(case, gains=gains)))
    study.run(Objective(problem))
    study.require_feasible()
    value = float(Objective(problem)(candidate_of(problem, gains)).objective[0])
    found = margins(case, gains)
    assert found.m_s is not None, found.reason
    return value, found.m_s, study.result.objective


@pytest.mark.timeout(600)
@pytest.mark.parametrize("name", CHOSEN)
def test_gains_are_near_the_best_with_the_margin_and_the_loop_stays_safe(graph: Any, tmp_path: Path, name: str) -> None:
    from sensor_msgs.msg import JointState

    loop = LOOPS[name]
    outputs = graph.collect("/loop/output", JointState)
    started(graph, loop)
    asked = ["--json", "--out", "plant.yaml", "--ms", str(MS), *loop.more]
    tool = commission(graph, tmp_path, *asked, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    graph.wait_until(lambda: tool.poll() is not None, 500.0, "the tool's end")
    told, errors = tool.communicate()
    assert tool.returncode == 0, told[-1000:] + errors
    report = json.loads(told)
    assert report["outcome"] == "kept" and report["experiments"] <= 3
    assert (tmp_path / "bag" / "commission.html").stat().st_size > 10_000
    on_controller = graph.get_parameters("/loop/controller", "kp", "ki", "sigma", "manual", "experiment")
    new = report["gains"]
    assert on_controller == [new["kp"], new["ki"], new["sigma"], loop.by_hand, ""]
    low, high = loop.safe
    assert all(low <= message.position[0] <= high for message in outputs)
    case = true_case(tmp_path / "plant.yaml", loop)
    value, m_s, best = compared(case, case.gains.with_values(**new))
    structure, experiments = report["model"]["structure"], report["experiments"]
    with Path(os.environ.get("TDOF_COMMISSION_TABLE", os.devnull)).open("a") as file:
        file.write(f"| {name} | {structure} | {experiments} | {value / best:.3f} | {m_s:.3f} |\n")
    assert value <= 1.15 * best and m_s <= 2.0


def is_kept(kp: float, experiment: str, loop: Loop) -> bool:
    return kp != loop.gains[0] and not experiment


MOMENTS = {
    "experiment": lambda graph, _: graph.get_parameters("/loop/controller", "experiment") != [""],
    "trial": lambda graph, loop: graph.get_parameters("/loop/controller", "kp") != [loop.gains[0]],
    "kept": lambda graph, loop: is_kept(*graph.get_parameters("/loop/controller", "kp", "experiment"), loop),
}


@pytest.mark.timeout(300)
@pytest.mark.parametrize("moment", MOMENTS if ALL else ["experiment"])
def test_ctrl_c_leaves_the_loop_as_it_was(graph: Any, tmp_path: Path, moment: str) -> None:
    """Also in what a script starts in the background, where a shell has SIGINT ignored."""
    loop = LOOPS["level by hand"]
    started(graph, loop)
    ignored = lambda: signal.signal(signal.SIGINT, signal.SIG_IGN)  # noqa: E731
    tool = commission(graph, tmp_path, stderr=subprocess.PIPE, preexec_fn=ignored)
    graph.wait_until(lambda: tool.poll() is not None or MOMENTS[moment](graph, loop), 60.0, f"the {moment}")
    tool.send_signal(signal.SIGINT)
    graph.wait_until(lambda: tool.poll() is not None, 60.0, "the tool's end")
    _, errors = tool.communicate()
    assert (tool.returncode, errors) == (130, "tdof-npid commission: interrupted\n")
    found = graph.get_parameters("/loop/controller", *EXPERIMENT, "kp", "ki", "manual", "setpoint")
    limits = {f"safe_range.{signal}": list(range_) for signal, range_ in ranges(loop).items()}
    before = {name: its.default for name, its in EXPERIMENT.items()} | limits
    assert found == [*before.values(), *loop.gains, loop.by_hand, loop.start]


PLAIN = {"kp": 0.3, "ki": 2.0, "sigma": 1.0}
ROBOT = Path(__file__).with_name("plain_robot.py").read_text()


def driven_robot(graph: Any) -> Any:
    """Somebody's node, driven by our controller with gains that hold it."""
    robot = graph.start("robot", program=ROBOT, namespace="/loop")
    graph.start("controller", namespace="/loop", type="tdof_npid2", setpoint=1.0, sample_period=0.01, **PLAIN)
    graph.wait_for_nodes("/loop/controller")
    return robot


@pytest.mark.timeout(400)
def test_somebodys_node_is_commissioned(graph: Any, tmp_path: Path) -> None:
    driven_robot(graph)
    tool = commission(graph, tmp_path, "--json")
    graph.wait_until(lambda: tool.poll() is not None, 300.0, "the tool's end")
    told = (tmp_path / "tool.log").read_text()
    assert tool.returncode == 0, told[-1000:]
    report = json.loads(told)
    assert report["outcome"] == "kept" and report["experiments"] <= 3
    found = {name: one["value"] for name, one in report["model"]["parameters"].items()}
    assert report["model"]["structure"] == "first_order"
    assert found["gain"] == pytest.approx(2.0, rel=0.03) and found["time_constant"] == pytest.approx(0.2, rel=0.1)
    assert graph.get_parameters("/loop/controller", *PLAIN) == [report["gains"][name] for name in PLAIN]


@pytest.mark.timeout(400)
@pytest.mark.skipif(not ALL, reason="a long form: TDOF_COMMISSION=all")
def test_a_step_worse_than_predicted_brings_back_the_gains_of_before(graph: Any, tmp_path: Path) -> None:
    robot = driven_robot(graph)
    tool, log = commission(graph, tmp_path), tmp_path / "tool.log"
    now = lambda: graph.get_parameters("/loop/controller", *PLAIN)  # noqa: E731
    graph.wait_until(lambda: now() != list(PLAIN.values()), 200.0, "the trial")
    robot.send(signal.SIGUSR1)
    graph.wait_until(lambda: "the gains are those of before" in log.read_text(), 60.0, "that it is worse")
    assert now() == list(PLAIN.values())
    tool.send_signal(signal.SIGINT)
    graph.wait_until(lambda: tool.poll() is not None, 60.0, "the tool's end")
    assert tool.returncode == 130
    assert "not yet: measured and predicted differ by" in log.read_text()
    assert graph.get_parameters("/loop/controller", "experiment", *PLAIN) == ["", *PLAIN.values()]


@pytest.mark.parametrize("gains", [{"kp": [2.0, 2.0]}, {"kp": 2.0, "joint_names": ["a", "b"]}], ids=str)
def test_several_lanes_are_refused_with_what_to_do(graph: Any, tmp_path: Path, gains: dict[str, Any]) -> None:
    graph.start("controller", namespace="/loop", **gains)
    graph.wait_for_nodes("/loop/controller")
    tool = commission(graph, tmp_path)
    graph.wait_until(lambda: tool.poll() is not None, 60.0, "the tool's end")
    told = "the loop has 2 lanes: an experiment is of one; give that one a controller"
    assert (tool.returncode, (tmp_path / "tool.log").read_text()) == (2, f"tdof-npid commission: {told}\n")
    assert graph.get_parameters("/loop/controller", "experiment", *gains) == ["", *gains.values()]


@pytest.mark.parametrize(
    ("asked", "told"),
    [
        (["--ms", "0.9"], "ms is 0.9: it must be above 1"),
        (["--ms", "1"], "ms is 1: it must be above 1"),
        (["--ms", "0"], "ms is 0: it must be above 1"),
        (["--ms", "nan"], "ms is nan: it must be above 1"),
        (["--controller", "fuzzy"], "no controller type 'fuzzy'"),
    ],
)
def test_what_no_gains_could_have_is_refused_before_a_loop_is_looked_for(
    asked: list[str], told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["commission", "/nowhere", "--yes", "--bag", str(tmp_path / "bag"), *asked]) == 2
    said = capsys.readouterr().err
    assert told in said and said.count("\n") == 1
