"""`analyze`: every episode of a bag, measured, compared, drawn, as the in-process simulation says it must be."""

import csv
import json
import os
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from browser import chromium_page
from loop_bags import JOINT_STATE, START_NS, STEP_NS, TRAJECTORY, TYPES, LoopBag, joint_state, plan_message
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter

from tdof_npid_ros.analysis import AnalysisError
from tdof_npid_ros.analysis.episodes import bag_names
from tdof_npid_ros.analysis.report import analyze
from tdof_npid_ros.bag.reader import BagReader
from tdof_npid_ros.case import Case, load_case
from tdof_npid_ros.cli import main
from tdof_npid_ros.control.controller import parameters_digest

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
PNG = b"\x89PNG"


@pytest.fixture(scope="module")
def case() -> Case:
    return load_case("p1-c0.5")


@pytest.fixture(scope="module")
def bag(tmp_path_factory, case) -> Path:
    folder = tmp_path_factory.mktemp("bags") / "bag"
    with LoopBag(folder) as writer:
        writer.configuration(case, case.gains)
        writer.episode(case, case.gains, "setpoint", 1)
        writer.episode(case, case.gains, "disturbance", 2)
    return folder


def test_metrics_are_those_of_the_simulation(bag, case) -> None:
    setpoint, disturbance = analyze([bag]).episodes
    assert setpoint.metrics() == case.setpoint_response()
    assert disturbance.metrics() == case.disturbance_response()
    assert (setpoint.episode.name, disturbance.episode.name) == ("setpoint", "disturbance")
    assert setpoint.episode.gains == (case.gains,)


def test_a_lockstep_run_is_the_simulation_bit_for_bit(bag) -> None:
    assert all(report.deviation.output == report.deviation.control_effort == 0.0 for report in analyze([bag]).episodes)


def test_effort_use(bag, case) -> None:
    use = analyze([bag]).episodes[0].effort[0]
    u = case.simulate("setpoint").control_effort[:, 0]
    assert use.total_variation == np.abs(np.diff(u)).sum()
    assert (use.peak, use.saturated_share) == (np.abs(u).max(), 0.0)


def test_share_of_time_at_a_limit(tmp_path, case) -> None:
    gains = case.gains.with_values(effort_max=2.0)
    with LoopBag(tmp_path / "bag") as writer:
        writer.configuration(case, gains)
        writer.episode(case, gains, "setpoint", 1)
    u = case.simulate("setpoint", gains).control_effort[:, 0]
    assert analyze([tmp_path / "bag"]).episodes[0].effort[0].saturated_share == np.mean(u == 2.0) > 0.05


def test_each_change_in_a_plan_is_a_response_of_its_own(tmp_path, case) -> None:
    plan = ("0 setpoint 1", "5 disturbance 0.5", "10 setpoint 3", "20 end")
    long = replace(case, episodes={"mixed": plan})
    with LoopBag(tmp_path / "bag") as writer:
        writer.configuration(long, case.gains)
        writer.episode(long, case.gains, "mixed", 1)
    ((first, second, third),) = analyze([tmp_path / "bag"]).episodes[0].responses
    assert [(r.kind, r.start_s, r.end_s) for r in (first, second, third)] == [
        ("setpoint", 0.0, 5.0), ("disturbance", 5.0, 10.0), ("setpoint", 10.0, 20.0)
    ]  # fmt: skip
    # The plant is linear, but the law is not: twice the step is another response.
    assert second.metrics.peak < case.disturbance_response().peak
    assert third.metrics.overshoot_percent != first.metrics.overshoot_percent


def test_a_change_of_the_plant(tmp_path) -> None:
    sprott = replace(
        load_case("sprott"), episodes={"increase": ("0 setpoint 1", "0 plant.a 0.6", "1 plant.a 0.72", "2 end")}
    )
    with LoopBag(tmp_path / "bag") as writer:
        writer.configuration(sprott, sprott.gains)
        writer.episode(sprott, sprott.gains, "increase", 1)
    (report,) = analyze([tmp_path / "bag"]).episodes
    assert [response.kind for response in report.responses[0]] == ["setpoint", "plant"]
    assert report.deviation.output == 0.0


def test_a_ramp_has_its_error_only(tmp_path, case) -> None:
    ramp = replace(case, episodes={"ramp": ("0 setpoint ramp 1 over 2", "4 end")})
    with LoopBag(tmp_path / "bag") as writer:
        writer.configuration(ramp, case.gains)
        writer.episode(ramp, case.gains, "ramp", 1)
    ((response,),) = analyze([tmp_path / "bag"]).episodes[0].responses
    assert response.kind == "tracking" and response.metrics is None and response.iae > 0


def test_a_table_fits_the_terminal_and_loses_nothing(tmp_path, case) -> None:
    with LoopBag(tmp_path / "bag") as writer:
        writer.configuration(case, case.gains)
        writer.episode(case, case.gains, "setpoint", 1)
        writer.episode(case, case.gains, "disturbance", 2)
    report = analyze([tmp_path / "bag"])
    wide, narrow = report.table().splitlines(), report.table(80).splitlines()
    assert max(map(len, wide)) > 80 >= max(map(len, narrow))
    assert {word for line in wide[:4] for word in line.split()} - {
        word for line in narrow for word in line.split()
    } <= {word for word in wide[1].split()}
    assert len([line for line in narrow if line.startswith("setpoint #1")]) == len(narrow) // 4


def test_outputs_that_are_missing_are_said_to_be(tmp_path, case) -> None:
    with LoopBag(tmp_path / "bag") as writer:
        writer.configuration(case, case.gains)
        writer.episode(case, case.gains, "setpoint", 1, lost=range(10, 13))
    report = analyze([tmp_path / "bag"])
    assert report.episodes[0].episode.missing == 3
    assert report.episodes[0].metrics() is None
    assert "3 outputs are missing from the bag" in report.table()


def test_lanes(tmp_path, case) -> None:
    gains = case.gains.with_values(kp=(9.426, 5.0, 2.0))
    with LoopBag(tmp_path / "bag") as writer:
        writer.configuration(case, gains)
        writer.episode(case, gains, "setpoint", 1)
    (report,) = analyze([tmp_path / "bag"]).episodes
    assert report.metrics(0) == case.setpoint_response()
    assert report.metrics(1) == case.setpoint_response(case.gains.with_values(kp=5.0))
    assert report.deviation.output == 0.0


def test_two_bags_are_compared(bag, tmp_path, case, capsys) -> None:
    pid = case.gains.with_values(type="pid")
    with LoopBag(tmp_path / "other") as writer:
        writer.configuration(case, pid)
        writer.episode(case, pid, "setpoint", 1)
    rows = analyze([bag, tmp_path / "other"]).rows()
    change = rows[2]["iae_change_percent"]
    assert change == pytest.approx(100 * (case.setpoint_response(pid).iae / case.setpoint_response().iae - 1))
    assert main(["analyze", str(bag), str(tmp_path / "other")]) == 0
    assert "ΔIAE" in capsys.readouterr().out
    assert main(["analyze", str(bag), str(tmp_path / "other"), "--json"]) == 0
    responses = [e["lanes"][0]["responses"][0] for e in json.loads(capsys.readouterr().out)["episodes"]]
    assert [response["iae_change_percent"] for response in responses] == [None, None, change]


@pytest.mark.parametrize(
    ("paths", "names"),
    [
        (["runs/a"], [""]),
        (["runs/a", "runs/b"], ["a", "b"]),
        (["monday/run/bag", "tuesday/run/bag"], ["monday/run/bag", "tuesday/run/bag"]),
        (["runs/a", "runs/a/"], ["", ""]),
    ],
)
def test_bags_are_told_apart_by_the_ends_of_their_paths(paths, names) -> None:
    assert bag_names(paths) == dict(zip(paths, names, strict=True))


def test_a_loop_in_a_namespace(tmp_path, case) -> None:
    with LoopBag(tmp_path / "bag", "/left/") as writer:
        writer.configuration(case, case.gains)
        writer.episode(case, case.gains, "setpoint", 1)
    (report,) = analyze([tmp_path / "bag"]).episodes
    assert report.episode.namespace == "/left/" and report.deviation.output == 0.0


@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_bags_that_rosbags_wrote(bag, tmp_path, plugin, case) -> None:
    with BagReader(bag) as reader, RosbagsWriter(tmp_path / "copy", version=9, storage_plugin=plugin) as writer:
        connections = {
            topic: writer.add_connection(topic, info.type, typestore=TYPES) for topic, info in reader.topics.items()
        }
        for topic, log_time, _, data in reader.messages():
            writer.write(connections[topic], log_time, bytes(data))
    setpoint, _ = analyze([tmp_path / "copy"]).episodes
    assert setpoint.metrics() == case.setpoint_response() and setpoint.deviation.output == 0.0
    assert main(["verify", str(tmp_path / "copy")]) == 0


def test_a_robot_without_plan_or_controller(tmp_path) -> None:
    with LoopBag(tmp_path / "bag") as writer:
        for k in range(100):
            data = joint_state(1_000_000_000 + 10_000_000 * k, "base_link", [0.1 * k, 1.0], [0.0, 0.0])
            writer.write("joint_states", JOINT_STATE, data)
    (report,) = analyze([tmp_path / "bag"]).episodes
    assert (report.episode.name, report.episode.lanes, len(report.episode.time)) == ("recording", 2, 100)
    assert "recording #1" in analyze([tmp_path / "bag"]).table()


def test_a_first_stamp_of_0_is_no_part_of_what_follows(tmp_path) -> None:
    with LoopBag(tmp_path / "bag") as writer:
        for stamp in (0, *range(START_NS, START_NS + 10**9, 10**7)):
            writer.write("joint_states", JOINT_STATE, joint_state(stamp, "base_link", [1.0]))
    (report,) = analyze([tmp_path / "bag"]).episodes
    assert len(report.episode.time) == 100
    assert "recording #2: response to tracking: the setpoint is not in the bag" in analyze([tmp_path / "bag"]).table()


def test_a_slow_loop_has_its_time(tmp_path) -> None:
    with LoopBag(tmp_path / "bag") as writer:
        for k in range(20):
            writer.write("joint_states", JOINT_STATE, joint_state(START_NS + k * 7200 * 10**9, "base_link", [1.0]))
    (report,) = analyze([tmp_path / "bag"]).episodes
    assert len(report.episode.time) == 20


def test_stamps_that_fit_no_grid_are_refused(tmp_path) -> None:
    with LoopBag(tmp_path / "bag") as writer:
        for stamp in (1, 2, 3, 10**9):
            writer.write("joint_states", JOINT_STATE, joint_state(stamp, "base_link", [1.0]))
    with pytest.raises(AnalysisError, match="more than 10,000,000 sample periods"):
        analyze([tmp_path / "bag"])


def test_a_bag_that_was_cut_off_is_said_to_be(bag, capsys) -> None:
    file = bag / "bag_0.mcap"
    os.truncate(file, file.stat().st_size - 100)
    assert main(["analyze", str(bag)]) == 0
    assert f"missing: {file}: the index and summary: the recording was never finished" in capsys.readouterr().out
    assert main(["analyze", str(bag), "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["missing"]) == 1
    assert main(["verify", str(bag)]) == 0
    assert "  missing: " in capsys.readouterr().out


@pytest.mark.parametrize("options", [["--csv", "{bag}/bag_0.mcap"], ["--csv", "{bag}.txt", "--html", "{bag}.txt"]])
def test_nothing_is_written_over(bag, options, capsys) -> None:
    before = (bag / "bag_0.mcap").read_bytes()
    assert main(["analyze", str(bag), *(option.format(bag=bag) for option in options)]) == 2
    assert "must be different files" in capsys.readouterr().err
    assert (bag / "bag_0.mcap").read_bytes() == before


def test_a_picture_is_written_where_it_was_asked_for(bag, tmp_path) -> None:
    analyze([bag]).picture(tmp_path / "picture")
    assert (tmp_path / "picture").read_bytes().startswith(PNG)


def test_a_realtime_loop_takes_setpoint_and_disturbance_from_their_topics(tmp_path, case) -> None:
    with LoopBag(tmp_path / "bag") as writer:
        writer.configuration(case, case.gains)
        run = replace(case, episodes={"s": ("0 setpoint 1", "5 disturbance 1", "10 end")}).simulate("s")
        for k in range(len(run.time)):
            stamp = k * case.sample_period_ns
            if k in (0, 1000):
                writer.write("disturbance", JOINT_STATE, joint_state(0, "", (), [run.disturbance[k]]))
            writer.write("output", JOINT_STATE, joint_state(stamp, "", run.output[k]))
            answer = joint_state(stamp, "abc", [run.setpoint[k]], run.control_effort[k])
            writer.write("control_effort", JOINT_STATE, answer)
    ((setpoint, disturbance),) = analyze([tmp_path / "bag"]).episodes[0].responses
    assert (setpoint.kind, disturbance.kind, disturbance.start_s) == ("setpoint", "disturbance", 5.0)
    assert disturbance.metrics.peak > 0.05
    assert STEP_NS


def test_a_bag_without_outputs_is_refused(tmp_path, capsys) -> None:
    with LoopBag(tmp_path / "bag") as writer:
        writer.write("setpoint", JOINT_STATE, joint_state(0, "", [1.0]))
    with pytest.raises(AnalysisError, match="no output"):
        analyze([tmp_path / "bag"])
    assert main(["analyze", str(tmp_path / "bag")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_files_and_json(bag, tmp_path, capsys, case) -> None:
    files = {name: tmp_path / f"a.{name}" for name in ("png", "html", "csv")}
    options = [word for name, path in files.items() for word in (f"--{name}", str(path))]
    assert main(["analyze", str(bag), "--json", *options]) == 0
    episodes = json.loads(capsys.readouterr().out)["episodes"]
    assert episodes[0]["lanes"][0]["responses"][0]["iae"] == case.setpoint_response().iae
    assert files["png"].read_bytes().startswith(PNG) and files["png"].stat().st_size > 10_000
    rows = list(csv.DictReader(files["csv"].open()))
    assert float(rows[0]["iae"]) == case.setpoint_response().iae
    page = files["html"].read_text()
    assert f'<td class="number">{case.gains.kp:.6g}</td>' in page
    assert not re.search(r"<(script|link|img)[^>]*(src|href)=|@import", page), "the page must need nothing else"


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine")
def test_the_page_works_in_a_browser(bag, tmp_path) -> None:
    """Loaded from disk: all plots draw, nothing is fetched or complained of, Ctrl and wheel zoom, a click hides."""
    page_file = tmp_path / "a.html"
    analyze([bag]).html(page_file)
    with chromium_page(CHROMIUM, width=1280) as page:
        page.goto(page_file.as_uri())
        page.wait_for_selector(".bk-Canvas, .bk-Figure", state="attached")
        page.wait_for_function("Bokeh.documents.length && Bokeh.documents[0].is_idle")
        ranges = "Bokeh.documents[0].roots().map(f => [f.x_range.start, f.x_range.end])"
        before = page.evaluate(ranges)
        assert len(before) == 4 and before[0] == before[1] and before[0][0] == 0
        plot = page.locator(".bk-Figure").first.bounding_box()
        page.mouse.move(plot["x"] + plot["width"] / 2, plot["y"] + plot["height"] / 2)
        page.keyboard.down("Control")  # the wheel alone moves the page
        page.mouse.wheel(0, -300)
        page.wait_for_function(f"({ranges})[1][1] < {before[0][1]}")
        shown = "Bokeh.documents[0].roots().map(f => f.renderers.map(r => r.visible))"
        assert page.evaluate(shown)[0] == [True, True]
        page.evaluate("Bokeh.documents[0].roots()[0].renderers[1].visible = false")
        assert page.evaluate(shown)[1][-1] is False, "a curve that is hidden above is hidden below"


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine")
def test_the_page_fits_a_phone(bag, tmp_path) -> None:
    page_file = tmp_path / "a.html"
    analyze([bag]).html(page_file)
    with chromium_page(CHROMIUM, width=390) as page:
        page.goto(page_file.as_uri())
        page.wait_for_function("Bokeh.documents.length && Bokeh.documents[0].is_idle")
        assert page.evaluate("document.documentElement.scrollWidth") <= 390


def test_bags_of_other_plants_or_plans_are_not_compared(bag, tmp_path, case) -> None:
    slower = replace(case, plant_values={**case.plant_values, "time_constant": 6.0})
    higher = replace(case, episodes={"setpoint": ("0 setpoint 2", "25 end")})
    for name, other in (("slower", slower), ("higher", higher)):
        with LoopBag(tmp_path / name) as writer:
            writer.configuration(other, case.gains)
            writer.episode(other, case.gains, "setpoint", 1)
    report = analyze([bag, tmp_path / "slower", tmp_path / "higher"])
    assert [row["iae_change_percent"] for row in report.rows()] == [None] * 4


def test_notes_name_their_bag(bag, tmp_path) -> None:
    with LoopBag(tmp_path / "robot") as writer:
        for k in range(100):
            writer.write("joint_states", JOINT_STATE, joint_state(10**9 + 10**7 * k, "base_link", [0.1 * k]))
    assert any(
        note.startswith("robot recording #1: response to tracking")
        for note in analyze([bag, tmp_path / "robot"]).notes()
    )


def test_a_realtime_run_of_a_plan_is_the_same_episode_as_one_in_lockstep(bag, tmp_path, case) -> None:
    """Its outputs bear no plan, but the scenario says which one it plays, just after the plant's reset."""
    run, plan = case.simulate("setpoint"), case.plans["setpoint"]
    with LoopBag(tmp_path / "realtime") as writer:
        writer.configuration(case, case.gains)
        for k in range(1001):
            if k == 3:
                writer.write("scenario_plan", TRAJECTORY, plan_message(plan))
            label, stamp = "-/0011aabb.2", START_NS + k * case.sample_period_ns
            writer.write("output", JOINT_STATE, joint_state(stamp, label, run.output[k], [0.0]))
            digest = parameters_digest(case.gains, case.sample_period_ns)
            answer = joint_state(stamp, f"{digest} {label}", [run.setpoint[k]], run.control_effort[k])
            writer.write("control_effort", JOINT_STATE, answer)
    report = analyze([bag, tmp_path / "realtime"])
    names = [one.episode.name for one in report.episodes]
    assert names == ["setpoint", "disturbance", "setpoint"]
    assert [row["iae_change_percent"] is None for row in report.rows()] == [True, True, False]
    (response,) = report.episodes[2].responses[0]
    assert response.kind == "setpoint" and response.start_s == 0.0
    assert response.metrics.overshoot_percent == case.setpoint_response().overshoot_percent


def test_in_realtime_the_setpoint_of_the_episode_before_is_none_of_this_one(tmp_path, case) -> None:
    """The plant's first output is answered before the plan's first setpoint has come."""
    run, plan = case.simulate("disturbance"), case.plans["disturbance"]
    with LoopBag(tmp_path / "realtime") as writer:
        writer.configuration(case, case.gains)
        for k in range(1001):
            if k == 2:
                writer.write("scenario_plan", TRAJECTORY, plan_message(plan))
                writer.write("disturbance", JOINT_STATE, joint_state(0, "", (), [1.0]))
            label, stamp = "-/0011aabb.2", k * case.sample_period_ns
            writer.write("output", JOINT_STATE, joint_state(stamp, label, run.output[max(k - 2, 0)], [0.0]))
            answer = joint_state(stamp, f"abc {label}", [0.0 if k > 2 else 1.0], run.control_effort[k])
            writer.write("control_effort", JOINT_STATE, answer)
    (report,) = analyze([tmp_path / "realtime"]).episodes
    (response,) = report.responses[0]
    assert (response.kind, report.episode.name) == ("disturbance", "disturbance")
    assert response.metrics.peak == run.output.max()
