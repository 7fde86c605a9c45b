"""`tdof-npid tune`: what it prints and writes, and what it refuses before it has cost anything."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import yaml

from tdof_npid_ros.case import load_case
from tdof_npid_ros.cli import main
from tdof_npid_ros.control.gains import Gains
from tdof_npid_ros.parameter_file import config_folder, write_parameters
from tdof_npid_ros.tuning.study import tune_case

QUICK = ["p3-c1", "--population", "10", "--generations", "5", "--seed", "2"]
TUNE = [sys.executable, "-m", "tdof_npid_ros", "tune"]


def tuned(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, Any]:
    assert main(["tune", *QUICK, "--json", *arguments]) == 0
    captured = capsys.readouterr()
    assert captured.err == ""
    report: dict[str, Any] = json.loads(captured.out)
    return report


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """The one line on stderr."""
    assert main(["tune", *arguments]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("tdof-npid tune: ")
    assert captured.err.count("\n") == 1
    return captured.err


def test_it_prints_what_simulate_prints_for_the_optimum(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    report = tuned(capsys, "--controller", "tdof_npid1", "--out", str(tmp_path / "gains.yaml"))
    assert (
        main(["simulate", "p3-c1", "--controller", "tdof_npid1", "--gains", str(tmp_path / "gains.yaml"), "--json"])
        == 0
    )
    simulated = json.loads(capsys.readouterr().out)
    assert report.pop("evaluations") == 50
    assert report.pop("elapsed_s") > 0
    assert {name: report[name] for name in simulated} == simulated
    assert report["margins"]["stable"]


def test_the_objective_printed_is_the_one_that_the_search_minimised(capsys: pytest.CaptureFixture[str]) -> None:
    result = tune_case(load_case("p3-c1"), "tdof_npid1", seed=2, population=10, generations=5)
    assert tuned(capsys, "--controller", "tdof_npid1", "--cold")["objective"] == result.objective


def test_the_case_s_gains_are_where_it_starts_unless_it_starts_cold(capsys: pytest.CaptureFixture[str]) -> None:
    case = load_case("p3-c1")
    before = case.setpoint_response().iae + case.disturbance_response().iae
    warm = tuned(capsys, "--controller", "tdof_npid2")
    assert warm["start"] == "case"
    assert warm["before"]["objective"] == before
    assert warm["before"]["gains"]["kp"] == case.gains.kp
    assert warm["objective"] <= before
    assert json_of(capsys, "p3-c1", "--controller", "pid", "--budget", "400", "--cold")["start"] == "cold"


def test_gains_that_end_at_a_bound_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    case = tmp_path / "narrow.yaml"
    case.write_text((config_folder() / "p3-c1.yaml").read_text().replace("kp: [0.01, ", "kp: [0.01, 0.9]  # ["))
    assert main(["tune", str(case), "--controller", "pid", "--budget", "800", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["at_bounds"] == {"kp": "upper"}
    assert main(["tune", str(case), "--controller", "pid", "--budget", "800"]) == 0
    assert "at the upper bound" in capsys.readouterr().out


def test_the_margins_asked_for_are_kept_and_cost_objective(capsys: pytest.CaptureFixture[str]) -> None:
    length = ["--budget", "1200", "--controller", "pid"]
    free, held = (json_of(capsys, "p3-c1", *length, *more) for more in ([], ["--ms", "1.6", "--phase-margin", "50"]))
    assert free["margins"]["m_s"] > 2.0
    assert held["constraints"] == {"ms": 1.6, "phase_margin": 50.0}
    assert 1.4 < held["margins"]["m_s"] <= 1.601
    assert held["margins"]["phase_margin_deg"] >= 49.9
    assert held["objective"] > free["objective"]


def test_a_lively_loop_is_told_with_what_it_costs_to_be_none(capsys: pytest.CaptureFixture[str]) -> None:
    lively = json_of(capsys, "p1-c0.5", "--controller", "pid", "--budget", "2400")
    price = lively["price"]
    assert lively["margins"]["m_s"] > 2.5
    assert price["ms"] == 2.0
    assert price["percent"] == pytest.approx(100 * (price["objective"] / lively["objective"] - 1))
    held = json_of(capsys, "p1-c0.5", "--controller", "pid", "--budget", "2400", "--ms", "2")
    assert price["objective"] == pytest.approx(held["objective"], rel=0.05)
    assert held["price"] is None
    assert main(["tune", "p1-c0.5", "--controller", "pid", "--budget", "2400"]) == 0
    assert f"objective at most {price['objective']:.6g} (+{price['percent']:.1f} %)" in capsys.readouterr().out


def test_what_a_short_search_would_say_about_the_price_is_not_said(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["tune", "p1-c0.5", "--controller", "pid", "--budget", "400"]) == 0
    assert "--ms 2 keeps away from it\n" in capsys.readouterr().out


def test_margins_that_nothing_within_the_bounds_has_are_said_and_no_gains_given(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out.yaml"
    told = refused(capsys, *QUICK, "--controller", "pid", "--ms", "1.001", "--out", str(out), "--json")
    assert "no pid was found with ms at most 1.001 (nearest: " in told
    assert not out.exists()


def test_it_ends_by_itself_when_it_has_converged(capsys: pytest.CaptureFixture[str]) -> None:
    report = json_of(capsys, "p3-c1", "--controller", "pid", "--until-converged")
    assert report["converged"]
    assert report["evaluations_saved"] == 20_000 - report["evaluations"] > 2000
    assert report["objective"] <= 1.001 * 5.262344


def json_of(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, Any]:
    assert main(["tune", *arguments, "--json"]) == 0
    report: dict[str, Any] = json.loads(capsys.readouterr().out)
    return report


def test_the_weight_counts_in_the_objective(capsys: pytest.CaptureFixture[str]) -> None:
    report = tuned(capsys, "--controller", "pid", "--weight", "0.25")
    assert report["objective"] == report["setpoint"]["iae"] + 0.25 * report["disturbance"]["iae"]


@pytest.mark.parametrize(
    "arguments",
    [("--population", "1000000000"), ("--generations", "9" * 30), ("--budget", "9" * 30), ("--seed", "9" * 5000)],
)
def test_numbers_beyond_all_bounds_are_refused_before_they_take_memory(
    capsys: pytest.CaptureFixture[str], arguments: tuple[str, str]
) -> None:
    try:
        line = refused(capsys, "p3-c1", "--controller", "pid", *arguments)
    except SystemExit as end:  # by the parser
        assert end.code == 2
        line = capsys.readouterr().err
    assert len(line) < 1000 and line.count("\n") == 1


def test_sigma_moves_only_when_it_is_free(capsys: pytest.CaptureFixture[str]) -> None:
    assert tuned(capsys, "--controller", "npid")["gains"]["sigma"] == 1.0
    assert tuned(capsys, "--controller", "npid", "--free", "sigma")["gains"]["sigma"] != 1.0


@pytest.mark.parametrize("algorithm", ["hga", "de", "cmaes"])
def test_every_algorithm_spends_the_budget_and_repeats_itself(
    algorithm: str, capsys: pytest.CaptureFixture[str]
) -> None:
    first, again = (tuned(capsys, "--controller", "pid", "--algorithm", algorithm) for _ in range(2))
    assert first["evaluations"] == 50
    assert first["gains"] == again["gains"]


def test_the_parameter_file_is_one_for_the_controller_node(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "gains.yaml"
    gains = tuned(capsys, "--controller", "tdof_npid2", "--out", str(out))["gains"]
    parameters = yaml.safe_load(out.read_text())["/**/controller"]["ros__parameters"]
    assert parameters["type"] == "tdof_npid2"
    assert {name: parameters[name] for name in gains} == gains
    others = {"type": str, "anti_windup": str, "full_unwinding": bool}
    assert all(isinstance(value, others.get(name, float)) for name, value in parameters.items())


def test_ros_reads_the_parameter_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    parameter = pytest.importorskip("rclpy.parameter")
    out = tmp_path / "gains.yaml"
    gains = tuned(capsys, "--controller", "tdof_npid2", "--out", str(out))["gains"]
    for use_wildcard in (True, False):  # as `ros2 param load` reads it, with and without --no-use-wildcard
        read = parameter.parameter_dict_from_yaml_file(str(out), use_wildcard)
        assert {name: read[name].value.double_value for name in gains} == gains


def test_the_convergence_is_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tuned(capsys, "--controller", "pid", "--plot", str(tmp_path / "convergence"))
    assert (tmp_path / "convergence").read_bytes().startswith(b"\x89PNG")


def test_tuned_gains_stand_beside_those_of_before_and_pid_tuned_alike(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    csv, out = tmp_path / "r.csv", tmp_path / "gains.yaml"
    assert main(["tune", *QUICK, "--controller", "tdof_npid2", "--csv", str(csv), "--out", str(out)]) == 0
    assert capsys.readouterr().out.endswith(f"  written: {out}\n  written: {csv}\n")
    rows = csv.read_text().splitlines()[1:]
    curves = dict.fromkeys(row.split(",")[1] for row in rows)
    assert list(curves) == ["TDOF-NPID2 before", "TDOF-NPID2 tuned", "PID tuned"]
    pid = tuned(capsys, "--controller", "pid")
    case = load_case(QUICK[0])
    run = case.simulate("setpoint", Gains(type="pid", **{name: pid["gains"][name] for name in ("kp", "ki", "kd")}))
    outputs = [float(row.split(",")[5]) for row in rows if row.startswith("setpoint,PID tuned")]
    assert outputs == run.output[:, 0].tolist()


def test_people_see_the_optimum_and_a_log_no_progress(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["tune", *QUICK, "--controller", "pid"]) == 0
    captured = capsys.readouterr()
    assert "50 evaluations" in captured.out
    assert "evaluations/s" not in captured.err  # that is for a terminal


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["p9", "--controller", "pid"], "no case 'p9'"),
        (["p3-c1", "--controller", "fuzzy"], "no controller type 'fuzzy'"),
        (["p3-c1", "--controller", "pid", "--algorithm", "luck"], "algorithm 'luck' is unknown"),
        (["p3-c1", "--controller", "pid", "--free", "sigma"], "sigma cannot be freed for pid"),
        (["p3-c1", "--controller", "pid", "--weight", "-1"], "weight is -1.0"),
        (["p3-c1", "--controller", "pid", "--weight", "1e300"], "weight is 1e+300"),
        (["p3-c1", "--controller", "pid", "--seed", "-1"], "seed -1"),
        (["p3-c1", "--controller", "pid", "--population", "0"], "population 0"),
        (["p3-c1", "--controller", "pid", "--generations", "0"], "generations 0"),
        (["p3-c1", "--controller", "pid", "--budget", "39"], "budget of 39"),
        (["p3-c1", "--controller", "pid", "--resume"], "--resume needs --checkpoint"),
        (["p3-c1", "--controller", "pid", "--out", "/nowhere/x"], "/nowhere/x cannot be written"),
        (["p3-c1", "--controller", "pid", "--plot", "/"], "/ cannot be written"),
        (["p3-c1", "--controller", "pid", "--checkpoint", "/proc/x"], "/proc/x cannot be written"),
        (["p3-c1", "--controller", "pid", "--out", "a", "--plot", "a"], "must be different files"),
        (["p3-c1", "--controller", "pid", "--out", str(config_folder() / "p3-c1.yaml")], "must be different files"),
    ],
)
def test_bad_input_is_refused_in_one_line(arguments: list[str], told: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert told in refused(capsys, *arguments)


def test_gains_replace_nothing_but_gains(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "gains.yaml"
    for _ in range(2):
        assert main(["tune", *QUICK, "--controller", "pid", "--out", str(out)]) == 0
    capsys.readouterr()
    write_parameters(out, {"controller": {"kp": 1.0}, "plant": {"gain": 2.0}})
    before = out.read_bytes()
    assert "holds more than such a result" in refused(capsys, *QUICK, "--controller", "pid", "--out", str(out))
    assert out.read_bytes() == before
    for text in ("/**/controller: {ros__parameters: {kp: 1.0, joint_names: [a]}}", "# mine\n/**/controller: {}"):
        out.write_text(text)
        assert "holds more than such a result" in refused(capsys, *QUICK, "--controller", "pid", "--out", str(out))


def test_bounds_that_no_controller_takes_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    case = tmp_path / "wide.yaml"
    case.write_text((config_folder() / "p3-c1.yaml").read_text().replace("kp: [", "kp: [1.0, 1.0e+60]  # ["))
    assert "its bounds hold gains that no controller takes: kp" in refused(capsys, str(case), "--controller", "pid")


def test_without_cma_the_remedy_is_named(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setitem(sys.modules, "cma", None)
    assert "pip install" in refused(capsys, *QUICK, "--controller", "pid", "--algorithm", "cmaes")


def test_episodes_without_metrics_are_refused_before_the_search(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    case = tmp_path / "case.yaml"
    text = (config_folder() / "p3-c1.yaml").read_text()
    case.write_text(text.replace('setpoint: ["0 setpoint 1"', 'setpoint: ["5 setpoint 1"'))
    assert "changes after 0 s" in refused(capsys, str(case), "--controller", "pid", "--out", str(tmp_path / "out.yaml"))
    assert not (tmp_path / "out.yaml").exists()


def test_reversed_bounds_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = (config_folder() / "p3-c1.yaml").read_text()
    case = tmp_path / "mine.yaml"
    case.write_text(text.replace("ki: [0.0, 3.0]", "ki: [3.0, 0.0]"))
    assert "bounds.ki is [3.0, 0.0]" in refused(capsys, str(case), "--controller", "pid")


def test_nothing_is_written_when_anything_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "gains.yaml").write_text("mine")
    (tmp_path / "checkpoint").write_text("mine too")
    outputs = ["--out", str(tmp_path / "gains.yaml"), "--plot", str(tmp_path / "plot.png")]
    checkpoint = ["--checkpoint", str(tmp_path / "checkpoint")]
    refused(capsys, *QUICK, "--controller", "pid", *outputs, *checkpoint)
    refused(capsys, *QUICK, "--controller", "pid", *outputs, *checkpoint, "--resume")
    refused(capsys, *QUICK, "--controller", "fuzzy", *outputs)
    assert {path.name for path in tmp_path.iterdir()} == {"checkpoint", "gains.yaml"}
    assert (tmp_path / "gains.yaml").read_text() == "mine"
    assert (tmp_path / "checkpoint").read_text() == "mine too"


def test_resume_without_a_checkpoint_yet_begins(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    checkpoint = ["--checkpoint", str(tmp_path / "c")]
    began = tuned(capsys, "--controller", "pid", *checkpoint, "--resume")
    finished = tuned(capsys, "--controller", "pid", *checkpoint, "--resume")
    assert began["gains"] == finished["gains"]


def test_ctrl_c_ends_with_the_generation_and_the_run_can_be_resumed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    checkpoint, out = tmp_path / "c", tmp_path / "gains.yaml"
    arguments = ["p3-c1", "--controller", "pid", "--generations", "100", "--json", "--checkpoint", str(checkpoint)]
    child = subprocess.Popen([*TUNE, *arguments, "--out", str(out)], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    started = time.monotonic()
    while not (checkpoint.exists() and '"generation": 3' in checkpoint.read_text()):
        assert child.poll() is None
        assert time.monotonic() - started < 60
        time.sleep(0.005)
    child.send_signal(signal.SIGINT)
    output, errors = child.communicate(timeout=30)
    assert child.returncode == 130
    assert output == b""
    assert not out.exists()
    assert errors.decode().count("\n") == 1
    assert "go on with --resume" in errors.decode()

    assert main(["tune", *arguments, "--resume"]) == 0
    resumed = json.loads(capsys.readouterr().out)
    assert main(["tune", *arguments[:-2]]) == 0
    uninterrupted = json.loads(capsys.readouterr().out)
    assert resumed.pop("elapsed_s") > 0 < uninterrupted.pop("elapsed_s")
    assert resumed == uninterrupted
