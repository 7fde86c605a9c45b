"""`tdof-npid simulate` and the parameter files that it shares with the nodes."""

import json
import math
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tdof_npid_ros.case import load_case
from tdof_npid_ros.cli import main
from tdof_npid_ros.control.gains import CONTROLLER_TYPES
from tdof_npid_ros.paper.tables import CASES
from tdof_npid_ros.parameter_file import ParameterFileError, config_folder, read_parameters, write_parameters


def simulated(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, object]:
    assert main(["simulate", *arguments, "--json"]) == 0
    return json.loads(capsys.readouterr().out)  # type: ignore[no-any-return]


def test_json_has_the_keys_of_the_contract(capsys: pytest.CaptureFixture[str]) -> None:
    report = simulated(capsys, "p1-c4", "--controller", "pid", "--gains", "published")
    assert set(report) == {"case", "controller", "gains", "setpoint", "disturbance", "objective", "margins"}
    assert set(report["gains"]) == {"kp", "ki", "kd", "alpha", "beta", "sigma"}  # type: ignore[arg-type]
    assert {"overshoot_percent", "settling_time_s", "iae"} <= set(report["setpoint"])  # type: ignore[arg-type]
    assert {"peak", "recovery_time_s", "iae"} <= set(report["disturbance"])  # type: ignore[arg-type]
    assert report["objective"] == report["setpoint"]["iae"] + report["disturbance"]["iae"]  # type: ignore[index]


def test_what_the_control_costs_is_told_as_analyze_tells_it(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    file, text = tmp_path / "limited.yaml", (config_folder() / "p1-c4.yaml").read_text()
    file.write_text(
        text.replace("/**/plant:\n  ros__parameters:\n", "/**/plant:\n  ros__parameters:\n    effort_max: 2.0\n")
    )
    case = load_case(file)
    report = simulated(capsys, str(file))
    gains = case.gains
    for episode in ("setpoint", "disturbance"):
        u = case.simulate(episode, gains).control_effort[:, 0]
        found = report[episode]
        assert found["effort_peak"] == abs(u).max()  # type: ignore[index]
        assert found["effort_variation"] == abs(u[1:] - u[:-1]).sum()  # type: ignore[index]
        assert found["saturated_percent"] == 100.0 * (u >= 2.0).mean()  # type: ignore[index]
    assert report["setpoint"]["saturated_percent"] > 1.0  # type: ignore[index]
    assert main(["simulate", "p1-c4", "--csv", str(tmp_path / "r.csv")]) == 0
    words = capsys.readouterr().out.split()  # a long path has a line of its own
    assert words[-2:] == ["written:", str(tmp_path / "r.csv")]


def test_single_gains_override(capsys: pytest.CaptureFixture[str]) -> None:
    report = simulated(capsys, "p1-c4", "--controller", "tdof_npid1", "--kp", "1.25", "--alpha", "0.5")
    assert (report["gains"]["kp"], report["gains"]["alpha"]) == (1.25, 0.5)  # type: ignore[index]


def test_the_example_of_a_plant_of_one_s_own_runs(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = Path(__file__).parents[2] / "docs" / "your-own-plant.md"
    after = page.read_text().partition("# my_plants/pendulum.py")[2]
    code, parameters = re.fullmatch(r"\n(.*?)```.*?```yaml\n(.*?)```.*", after, re.DOTALL).groups()  # type: ignore[union-attr]
    (tmp_path / "my_plants").mkdir()
    (tmp_path / "my_plants" / "pendulum.py").write_text(code)
    file = tmp_path / "pendulum.yaml"
    file.write_text(parameters)
    monkeypatch.syspath_prepend(str(tmp_path))
    report = simulated(capsys, str(file))
    assert 0.0 < report["setpoint"]["settling_time_s"] < 5.0  # type: ignore[index]
    arguments = ["tune", str(file), "--controller", "tdof_npid2", "--generations", "3", "--json"]
    assert main(arguments) == 0
    assert json.loads(capsys.readouterr().out)["objective"] < report["objective"]  # type: ignore[operator]


def test_gains_come_from_a_parameter_file(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    file = tmp_path / "gains.yaml"
    write_parameters(file, {"controller": {"kp": 1.5, "ki": 0.25, "kd": 2.0}})
    report = simulated(capsys, "p1-c4", "--controller", "pid", "--gains", str(file))
    assert report["gains"]["kp"] == 1.5  # type: ignore[index]
    write_parameters(file, {"controller": {"type": "pid", "kp": 1.5}})
    assert simulated(capsys, "p1-c4", "--gains", str(file))["controller"] == "pid"
    assert simulated(capsys, "p1-c4", "--gains", str(file), "--controller", "npid")["controller"] == "npid"
    write_parameters(file, {"plant": {"gain": 2.0}})
    assert main(["simulate", "p1-c4", "--gains", str(file)]) == 2
    assert "no parameters of a controller in it" in capsys.readouterr().err


def test_misspelt_parameters_are_warned_of(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    text = (config_folder() / "p1-c4.yaml").read_text()
    file.write_text(text.replace("time_constant:", "tau: 3.0\n    time_constnt:").replace("weight:", "wieght:"))
    with pytest.warns(UserWarning) as warned:
        load_case(file)
    nothing = "is not one of this node's, and does nothing"
    assert [str(each.message) for each in warned] == [
        f"{file}: plant: parameter tau {nothing}",
        f"{file}: plant: parameter time_constnt {nothing}: time_constant is meant?",
        f"{file}: tuner: parameter wieght {nothing}: weight is meant?",
    ]
    program = Path(sys.executable).parent / "tdof-npid"
    printed = subprocess.run([program, "simulate", file], capture_output=True, text=True, check=True).stderr
    assert printed.splitlines() == [f"tdof-npid: {each.message}" for each in warned]


@pytest.mark.filterwarnings("error")
def test_what_belongs_to_the_loop_may_be_given_to_all_its_nodes(tmp_path: Path) -> None:
    file = tmp_path / "servo.yaml"
    text = (config_folder() / "p1-c4.yaml").read_text()
    file.write_text(
        text.replace("/**:\n  ros__parameters:\n", "/**:\n  ros__parameters:\n    angle: true\n    output_unit: rad\n")
    )
    case = load_case(file)
    assert case.options.angle and case.units.output == "rad"


def test_a_folder_does_not_hide_a_case(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "p1-c4").mkdir()
    assert simulated(capsys, "p1-c4")["case"] == "p1-c4"


def test_a_dead_time_beyond_memory_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "slow.yaml"
    file.write_text((config_folder() / "p1-c4.yaml").read_text().replace("dead_time: 4.0", "dead_time: 1.0e+6"))
    assert main(["simulate", str(file)]) == 2
    assert "dead_time is 1e+06 s" in capsys.readouterr().err


def status_of(arguments: list[str]) -> int:
    try:
        return main(arguments)
    except SystemExit as end:  # argparse ends the program itself
        return int(str(end.code))


@pytest.mark.parametrize(
    "arguments",
    [
        ["nowhere"],
        ["missing.yaml"],
        ["p1-c4", "--controller", "fuzzy"],
        ["p1-c4", "--gains", "missing.yaml"],
        ["p1-c4", "--kp", "nan"],
        ["p1-c4", "--sigma", "0"],
        ["p1-c4", "--sigma", "wide"],
        ["p1-c4", "--no-such-option"],
        ["."],
    ],
)
def test_bad_input_gets_one_line_and_status_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert status_of(["simulate", *arguments]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert len(printed.err.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("{", "not YAML"),
        ("- 1", "node names"),
        ("plant: 3", "ros__parameters"),
        ("/**/plant: {ros__parameters: {sample_period: -1}}", "sample_period"),
        ("/**/plant: {ros__parameters: {sample_period: 1.0e-10}}", "nanoseconds"),
        ("/**/plant: {ros__parameters: {model: no_such}}", "no_such"),
        ("/**/controller: {ros__parameters: {kp: high}}", "kp"),
        ("/**/scenario: {ros__parameters: {episodes: [a]}}", "plan.a"),
        ("/**/scenario: {ros__parameters: {episodes: [a], plan: {a: [0 speed 1, 1 end]}}}", "line 1 '0 speed 1'"),
        ("/**/tuner: {ros__parameters: {bounds: {kp: [2, 1]}}}", "bounds.kp"),
        ("/**/tuner: {ros__parameters: {weight: heavy}}", "weight is 'heavy'"),
        ("/**/plant: {ros__parameters: {effort_min: low}}", "effort_min is 'low'"),
        ("/**/plant: {ros__parameters: {effort_min: 5.0, effort_max: 1.0}}", "effort_min <= effort_max"),
        ("/**/plant: {ros__parameters: {effort_max: .nan}}", "effort_max is nan"),
        ("/**/scenario: {ros__parameters: {episodes: 3}}", "episodes is 3"),
        ("/**/scenario: {ros__parameters: {episodes: setpoint}}", "episodes is 'setpoint'"),
    ],
)
def test_a_bad_parameter_file_is_refused_with_its_name(text: str, word: str, tmp_path: Path) -> None:
    file = tmp_path / "case.yaml"
    file.write_text(text)
    with pytest.raises(ValueError, match=word) as caught:
        load_case(file)
    assert "case.yaml" in str(caught.value)


def test_parameters_are_found_for_a_node_in_any_namespace(tmp_path: Path) -> None:
    file = tmp_path / "a.yaml"
    file.write_text(
        "/**: {ros__parameters: {sample_period: 0.1, kp: 1.0}}\n"
        "loop: {controller: {ros__parameters: {kp: 2.0, nested: {deep: 3}}}}\n"
        "/other/plant: {ros__parameters: {kp: 9.0}}\n"
    )
    assert read_parameters(file, "controller") == {"sample_period": 0.1, "kp": 2.0, "nested.deep": 3}


def test_a_plant_of_the_users_own_runs_from_a_parameter_file(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    file = tmp_path / "tank.yaml"
    file.write_text(
        "/**: {ros__parameters: {sample_period: 0.02}}\n"
        "/**/plant: {ros__parameters: {model: transfer_function, numerator: [2.0], denominator: [3.0, 1.0]}}\n"
        "/**/controller: {ros__parameters: {type: pid, kp: 2.0, ki: 1.0}}\n"
        "/**/scenario: {ros__parameters: {episodes: [setpoint, disturbance], plan: {"
        'setpoint: ["0 setpoint 1", "30 end"], disturbance: ["0 disturbance 1", "30 end"]}}}\n'
    )
    report = simulated(capsys, str(file))
    assert report["setpoint"]["settling_time_s"] is not None  # type: ignore[index]


LOOP = (
    "/**/plant: {{ros__parameters: {{model: first_order, dead_time: 0.0}}}}\n"
    "/**/controller: {{ros__parameters: {{type: pid, kp: {kp}, ki: 1.0}}}}\n"
    "/**/scenario: {{ros__parameters: {{episodes: [{episodes}], plan: "
    '{{setpoint: [{setpoint}, "30 end"], disturbance: [{disturbance}, "30 end"]}}}}}}\n'
)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"kp": "[1.0, 2.0]"}, "2 lanes"),
        ({"episodes": ""}, "no episode 'setpoint'"),
        ({"episodes": "setpoint"}, "no episode 'disturbance'"),
        ({"setpoint": '"0 setpoint 0"'}, "the setpoint is 0 and the disturbance 0"),
        ({"setpoint": '"0 setpoint 1", "0 disturbance 2"'}, "the setpoint is 1 and the disturbance 2"),
        ({"setpoint": '"5 setpoint 1"'}, "the setpoint changes after 0 s"),
        ({"setpoint": '"0 setpoint 1", "30 setpoint 2"'}, "the setpoint changes after 0 s"),
        ({"setpoint": '"0 setpoint 1", "9 disturbance 1"'}, "the disturbance changes after 0 s"),
        ({"disturbance": '"9 disturbance 1"'}, "the disturbance changes after 0 s"),
        ({"setpoint": '"0 setpoint 1", "0 plant.gain 1", "9 plant.gain 2"'}, "the plant changes after 0 s"),
        ({"disturbance": '"0 setpoint 1", "0 disturbance 1"'}, "the setpoint is 1, but the output begins at 0"),
    ],
)
def test_metrics_are_told_of_a_single_step_at_the_start_only(
    changes: dict[str, str], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    values = {"kp": "2.0", "episodes": "setpoint, disturbance"}
    values |= {"setpoint": '"0 setpoint 1"', "disturbance": '"0 disturbance 1"'}
    file = tmp_path / "loop.yaml"
    file.write_text(LOOP.format(**(values | changes)))
    assert main(["simulate", str(file)]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert words in printed.err
    assert printed.err.count("\n") == 1


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("controller", CONTROLLER_TYPES)
@pytest.mark.parametrize("source", ["published", "tuned"])
def test_every_case_and_type_prints_the_contract_s_object(
    case: str, controller: str, source: str, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["simulate", case, "--controller", controller, "--gains", source, "--json"]
    if controller == "npid" and source == "published":
        assert main(arguments) == 2  # the paper has none
        return
    assert main(arguments) == 0
    report = json.loads(capsys.readouterr().out)
    assert list(report) == ["case", "controller", "gains", "setpoint", "disturbance", "objective", "margins"]
    assert (report["case"], report["controller"]) == (case, controller)
    assert list(report["gains"]) == ["kp", "ki", "kd", "alpha", "beta", "sigma"]
    assert list(report["setpoint"])[:3] == ["overshoot_percent", "settling_time_s", "iae"]
    assert list(report["disturbance"])[:3] == ["peak", "recovery_time_s", "iae"]
    for response, time in (("setpoint", "settling_time_s"), ("disturbance", "recovery_time_s")):
        if report[response][time] is None:
            assert report[response]["reason"]


def test_a_reader_that_has_had_enough_gets_no_traceback() -> None:
    program = subprocess.Popen(
        [sys.executable, "-m", "tdof_npid_ros", "simulate", "p1-c4"], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert program.stdout is not None and program.stderr is not None
    program.stdout.close()
    assert program.stderr.read() == b""
    assert program.wait() != 0


def test_without_ros_the_remedy_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "rclpy", None)
    for module in ("replay_node", "conductor"):
        monkeypatch.delitem(sys.modules, f"tdof_npid_ros.graph.{module}", raising=False)
    monkeypatch.delitem(sys.modules, "tdof_npid_ros.cli.replay", raising=False)
    assert main(["replay", str(tmp_path)]) == 2
    assert "needs ROS 2" in capsys.readouterr().err


def test_different_sample_periods_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "loop.yaml"
    file.write_text("/**/plant: {ros__parameters: {}}\n/**/controller: {ros__parameters: {sample_period: 0.05}}\n")
    assert load_case(file).sample_period_ns  # the plant's is not given
    file.write_text(
        file.read_text().replace("plant: {ros__parameters: {}", "plant: {ros__parameters: {sample_period: 0.01}")
    )
    with pytest.raises(ParameterFileError, match=r"sample_period is 0\.01 in plant and 0\.05 in controller"):
        load_case(file)


def test_no_metric_is_hidden_by_the_plants_unit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of a plant in nanometres, told in metres, and of one that settles within microseconds."""
    slow, fast = str(tmp_path / "slow.yaml"), str(tmp_path / "fast.yaml")
    assert main(["new", slow, "--gain", "1e-9", "--time-constant", "60", "--dead-time", "10", "--step", "2e-8"]) == 0
    assert main(["new", fast, "--gain", "1e6", "--time-constant", "1e-4", "--step", "1e6"]) == 0
    capsys.readouterr()
    for file in (slow, fast):
        report = simulated(capsys, file)
        assert main(["simulate", file]) == 0
        printed = [line.split() for line in capsys.readouterr().out.splitlines()]
        for episode, name in (("setpoint", "iae"), ("setpoint", "settling_time_s"), ("disturbance", "peak")):
            (value,) = [float(line[2]) for line in printed if line[:2] == [episode, name]]
            assert value == pytest.approx(report[episode][name], rel=1e-3)


def test_a_turn_goes_the_short_way_and_its_iae_is_that_of_the_sampled_loop(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """An integrator under u = 2 e at 100 Hz: e falls by 2 % each sample, along a line; continuously, IAE is e0/2."""
    path = tmp_path / "yaw.yaml"
    path.write_text(
        "/**:\n  ros__parameters: {sample_period: 0.01}\n"
        "/**/plant:\n  ros__parameters: {model: transfer_function, numerator: [1.0], denominator: [1.0, 0.0]}\n"
        "/**/controller:\n  ros__parameters: {type: pid, kp: 2.0, ki: 0.0, kd: 0.0, angle: true}\n"
        "/**/scenario:\n  ros__parameters:\n    episodes: [setpoint, disturbance]\n"
        "    plan: {setpoint: ['0 setpoint 3.5', '10 end'], disturbance: ['0 disturbance 1', '10 end']}\n"
    )
    found = simulated(capsys, str(path), "--controller", "pid")
    first = 2 * math.pi - 3.5
    error = [first * 0.98**k for k in range(1001)]
    exact = 0.01 * (sum(error) - (error[0] + error[-1]) / 2)
    assert found["setpoint"]["iae"] == pytest.approx(exact, rel=1e-9)  # type: ignore[index]
    assert exact == pytest.approx(0.99 * first / 2, rel=1e-6)


def test_units_are_beside_the_numbers_and_on_the_axes(tmp_path: Path) -> None:
    file, page = str(tmp_path / "heater.yaml"), tmp_path / "page.html"
    facts = "--gain 0.8 --time-constant 180 --dead-time 25 --step 40 --unit K --effort-unit %"
    assert main(["new", file, *facts.split()]) == 0
    assert main(["simulate", file, "--html", str(page), "--plot", str(tmp_path / "axes.svg")]) == 0
    told = page.read_text("utf-8")
    for title in ("setpoint: IAE (K s)", "disturbance: peak (K)", "largest |u| (%)", '"output (K)"', '"effort (%)"'):
        assert title in told, title
    picture = (tmp_path / "axes.svg").read_text("utf-8")
    assert "output y (K)" in picture and "effort u (%)" in picture
