"""`reproduce` writes what it promises, says what deviates, and leaves other people's files alone."""

from __future__ import annotations

import csv
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tdof_npid_ros.cli import main
from tdof_npid_ros.control.gains import CONTROLLER_TYPES
from tdof_npid_ros.control.law import KD_H, PHI, coefficients
from tdof_npid_ros.paper import findings
from tdof_npid_ros.paper.conclusions import TOLERANCES
from tdof_npid_ros.paper.evaluation import deviation_percent, measure, optimum, paper_case, published_gains, searches_of
from tdof_npid_ros.paper.inferred import OPTIMAL, as_stated, inferred, optimality
from tdof_npid_ros.paper.items import ITEMS, SETTLED_AT, variation_metrics
from tdof_npid_ros.paper.nominal_robust import nominal_beside_robust
from tdof_npid_ros.paper.output import MARKER, OutputError, claim_folder
from tdof_npid_ros.paper.pages import Section, html_page
from tdof_npid_ros.paper.report import Figure, Table, shown_cell
from tdof_npid_ros.paper.reproduce import Effort, Reproduction, reproduce
from tdof_npid_ros.paper.robust import robust
from tdof_npid_ros.paper.tables import CASES, ROWS, VARIATIONS, Published, PublishedVariation
from tdof_npid_ros.paper.tuned import tuned
from tdof_npid_ros.tuning.judge import Constraints
from tdof_npid_ros.tuning.objective import Objective
from tdof_npid_ros.tuning.problem import TuningProblem, candidate_of
from tdof_npid_ros.workers import workers

QUICK = Effort(seeds=1, generations=3, pareto_generations=3)
REPRODUCED_CASES = ("p1-c4", "p2-c2", "p2-c5")
PNG_SIGNATURE = b"\x89PNG"


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Reproduction]:
    folder = tmp_path_factory.mktemp("whole") / "out"
    reproduction = Reproduction(effort=QUICK)
    with workers() as here:
        reproduce(folder, reproduction, here)
    return folder, reproduction


def row_of(case: str, controller: str) -> Published:
    return next(row for row in ROWS if (row.case, row.controller) == (case, controller))


@pytest.mark.parametrize(
    "row", [row for row in ROWS if row.case in REPRODUCED_CASES], ids=lambda row: f"{row[0]}-{row[1]}"
)
def test_published_rows_come_out_at_the_published_gains(row: Published) -> None:
    ours = measure(paper_case(row.case), published_gains(row))
    assert abs(ours.number("overshoot_percent") - row.overshoot_percent) <= TOLERANCES["overshoot_percent"]
    for metric in ("iae_setpoint", "iae_disturbance", "peak"):
        assert ours.number(metric) == pytest.approx(getattr(row, metric), rel=TOLERANCES[metric] / 100)


def test_every_table_and_figure_is_written(whole: tuple[Path, Reproduction]) -> None:
    folder, _ = whole
    for name in ITEMS:
        assert (folder / f"{name}.csv").stat().st_size > 0
        if name.startswith("figure"):
            assert (folder / f"{name}.png").read_bytes()[:4] == PNG_SIGNATURE
        else:
            assert (folder / f"{name}.md").read_text().startswith("### Table")


def test_the_items_are_those_of_the_paper() -> None:
    assert sorted(ITEMS) == sorted(
        [*(f"table{i}" for i in range(1, 10)), "figure1", *(f"figure{i}" for i in range(6, 17))]
    )


def test_the_page_is_self_contained(whole: tuple[Path, Reproduction]) -> None:
    folder, _ = whole
    page = (folder / "index.html").read_text()
    assert page.count("data:image/png;base64,") == sum(name.startswith("figure") for name in ITEMS)
    assert "://" not in page
    assert all(heading in page for heading in ("In short", "What does not reproduce, and why"))


def test_deviations_are_relative_to_the_published_value(whole: tuple[Path, Reproduction]) -> None:
    folder, _ = whole
    with (folder / "table4.csv").open(newline="") as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == 6 * 7
    for line in lines:
        if line["ours, tuned"]:
            expected = 100 * (float(line["ours, tuned"]) / float(line["published"]) - 1)
            assert float(line["Δ tuned (%)"]) == pytest.approx(expected)


def test_a_deviation_needs_both_numbers() -> None:
    assert deviation_percent(1.1, 1.0) == pytest.approx(10.0)
    assert deviation_percent(None, 1.0) is None
    assert deviation_percent(1.0, 0.0) is None


def test_the_summary_says_for_every_row_whether_it_reproduces(whole: tuple[Path, Reproduction]) -> None:
    folder, _ = whole
    summary = json.loads((folder / "summary.json").read_text())
    assert len(summary["rows"]) == len(ROWS)
    assert all(row["reproduced"] for row in summary["rows"] if row["case"] in REPRODUCED_CASES)
    assert not any(row["reproduced"] for row in summary["rows"] if row["case"] in ("p1-c0.5", "sprott"))
    assert len(summary["conclusions"]) == 14


def test_only_writes_what_is_asked_for(tmp_path: Path) -> None:
    reproduction = Reproduction(["figure1", "figure13"], QUICK)
    with workers() as here:
        reproduce(tmp_path / "out", reproduction, here)
    assert {path.stem for path in (tmp_path / "out").iterdir()} == {"figure1", "figure13", "index", "summary", MARKER}
    assert isinstance(reproduction.built["figure13"], Figure)


def test_a_killed_run_goes_on_where_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def killed(*_: object) -> None:
        raise InterruptedError

    monkeypatch.setattr(Reproduction, "_find", lambda self: None)  # takes long, and is no search
    with workers() as here:
        with monkeypatch.context() as patched, pytest.raises(InterruptedError):
            patched.setattr(Reproduction, "_build", killed)
            reproduce(tmp_path / "out", Reproduction(["table6"], QUICK), here)
        with monkeypatch.context() as patched:
            patched.setattr("tdof_npid_ros.paper.reproduce.optimum", killed)
            resumed = reproduce(tmp_path / "out", Reproduction(["table6"], QUICK), here)
            with pytest.raises(InterruptedError):  # all is written, so nothing is kept any more
                reproduce(tmp_path / "out", Reproduction(["table6"], QUICK), here)
        assert reproduce(tmp_path / "out", Reproduction(["table6"], QUICK), here) == resumed


def test_an_earlier_output_is_written_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for _ in range(2):
        assert main(["reproduce", "--out", str(tmp_path / "out"), "--only", "figure1", "--json"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["items"] == ["figure1"]


def test_a_folder_of_somebody_else_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "thesis.txt").write_text("mine")
    assert main(["reproduce", "--out", str(tmp_path), "--only", "figure1"]) == 2
    assert capsys.readouterr().err.strip().endswith("give a new or an empty folder")
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def test_the_output_of_another_subcommand_is_refused(tmp_path: Path) -> None:
    claim_folder(tmp_path, "pareto")
    with pytest.raises(OutputError, match="did not write"):
        claim_folder(tmp_path, "reproduce")


def test_a_file_is_no_folder(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="is a file"):
        claim_folder(tmp_path / "file", "reproduce")


@pytest.mark.parametrize("arguments", [["--only", "table99"], ["--only", ","], ["--seeds", "0"]])
def test_bad_arguments_are_refused_before_anything_is_written(arguments: list[str], tmp_path: Path) -> None:
    assert main(["reproduce", "--out", str(tmp_path / "out"), *arguments]) == 2
    assert not (tmp_path / "out").exists()


def test_the_seeds_decide_the_outcome() -> None:
    searches = searches_of(row_of("p1-c0.5", "pid"), seeds=2)
    first, second = ([optimum(search, 2)["objective"] for search in searches] for _ in range(2))
    assert first == second
    assert first[0] != first[1]


@pytest.mark.parametrize("published", VARIATIONS, ids=lambda variation: f"{variation.controller}-{variation.a}")
def test_table_9_is_that_of_a_loop_at_rest(published: PublishedVariation) -> None:
    gains = published_gains(row_of("sprott", published.controller))
    peak, iae, recovery = variation_metrics(gains, published.a, SETTLED_AT)
    assert iae == pytest.approx(published.iae, rel=1e-4)
    assert peak == pytest.approx(published.peak, rel=0.02)
    assert 5.0 + recovery == pytest.approx(published.recovery_time_s, rel=0.01)


@pytest.mark.parametrize("published", VARIATIONS, ids=lambda variation: f"{variation.controller}-{variation.a}")
def test_table_9_comes_out_closer_in_the_inferred_simulation(published: PublishedVariation) -> None:
    _, case, gains = inferred(row_of("sprott", published.controller))
    peak, iae, recovery = variation_metrics(gains, published.a, SETTLED_AT, case)
    assert iae == pytest.approx(published.iae, rel=1e-4)
    assert peak == pytest.approx(published.peak, rel=0.003)
    assert 5.0 + recovery == pytest.approx(published.recovery_time_s, rel=0.001)


def test_the_sprott_disturbance_behind_the_printed_numbers_is_5() -> None:
    table = findings.sprott_disturbance().table
    assert table is not None
    for row in table.rows:
        _, size, _, _, _, published, ours, _ = row
        assert isinstance(ours, float) and isinstance(published, float)
        assert (round(ours, 3) == published) == (size == 5.0)


@pytest.mark.parametrize("row", [row for row in ROWS if row.case == "p1-c0.5"], ids=lambda row: row.controller)
def test_process_1_comes_out_in_the_inferred_simulation(row: Published) -> None:
    _, case, gains = inferred(row)
    ours, (settling, recovery) = measure(case, gains), findings.transient_times(case, gains)
    assert ours.number("overshoot_percent") == pytest.approx(row.overshoot_percent, abs=0.4)
    for metric in ("iae_setpoint", "peak", "iae_disturbance"):
        assert ours.number(metric) == pytest.approx(getattr(row, metric), rel=0.01)
    assert (settling, recovery) == pytest.approx((row.settling_time_s, row.recovery_time_s), rel=0.01)


@pytest.mark.parametrize("row", [row for row in ROWS if row.case == "sprott"], ids=lambda row: row.controller)
def test_the_sprott_circuit_comes_out_in_the_inferred_simulation(row: Published) -> None:
    _, case, gains = inferred(row)
    ours = measure(case, gains)
    assert ours.number("overshoot_percent") == pytest.approx(row.overshoot_percent, abs=0.6)
    assert ours.number("settling_time_s") == pytest.approx(row.settling_time_s, abs=0.011)
    assert ours.number("iae_setpoint") == pytest.approx(row.iae_setpoint, rel=0.002)


def test_the_inferred_simulation_is_a_filter_advanced_before_it_is_used() -> None:
    row = row_of("p1-c0.5", "tdof_npid2")
    _, case, gains = inferred(row)
    h, filter_time = case.sample_period, row.kd / row.kp / published_gains(row).n
    c = coefficients(gains, h)
    phi = math.exp(-h / filter_time)
    assert c[PHI, 0] == pytest.approx(phi)
    assert c[KD_H, 0] == pytest.approx(row.kd / filter_time * phi)  # u_d = K_d/T_f (e - z⁺), e - z⁺ = φ (e - z)


def test_most_rows_come_out_in_the_inferred_simulation() -> None:
    assert "14 of 21 rows agree" in findings.papers_simulation({row.case for row in ROWS}).paragraphs[0]


@pytest.mark.parametrize("row", [row for row in ROWS if row.case == "p1-c0.5"], ids=lambda row: row.controller)
def test_printed_gains_are_optimal_in_the_inferred_simulation_only(row: Published) -> None:
    assert optimality(row, inferred).excess_percent <= OPTIMAL
    assert optimality(row, as_stated).excess_percent > 5.0


@pytest.mark.parametrize("case", CASES)
def test_tuned_gains_are_of_loops_whose_objective_does_not_change_with_longer_episodes(case: str) -> None:
    short = paper_case(case)
    for kind in CONTROLLER_TYPES:
        row = tuned(case, kind)
        assert row is not None
        problem = TuningProblem(short, kind)
        candidate = candidate_of(problem, row.gains)
        scores = Objective(problem)(candidate)
        assert scores.objective[0] == pytest.approx(row.objective, rel=1e-12)
        assert scores.violation[0] == 0.0
        for times in (3, 10):
            end = times * short.plans["setpoint"].end_ns / 1e9
            episodes = {name: (short.episodes[name][0], f"{end} end") for name in ("setpoint", "disturbance")}
            longer = Objective(TuningProblem(replace(short, episodes=episodes), kind))(candidate)
            assert longer.objective[0] == pytest.approx(row.objective, rel=1e-3)


def test_robust_gains_have_the_margin_of_their_level_at_a_price() -> None:
    for (case, kind, level), row in robust().items():
        problem = TuningProblem(paper_case(case), kind, constraints=Constraints(ms=level))  # type: ignore[arg-type]
        scores = Objective(problem)(candidate_of(problem, row.gains))
        assert scores.violation[0] == 0.0
        assert scores.objective[0] == pytest.approx(row.objective, rel=1e-12)
        free = tuned(case, kind)  # type: ignore[arg-type]
        assert free is not None
        assert row.objective > 0.999 * free.objective


def test_a_table_shows_repeated_keys_once() -> None:
    table = Table("t", "T", ("process", "controller", "Δ (%)"), (("a", "x", 1.25), ("a", "y", None)), 1)
    assert table.shown() == [["a", "x", "+1.2"], ["", "y", "–"]]


def test_the_data_of_a_figure_are_numbers_and_names() -> None:
    columns = {"ratio": np.array([0.1, 1.0]), "controller": np.array(["pid", "npid"])}
    figure = Figure("f", "F", "", lambda path: None, columns)
    assert figure.csv() == "ratio,controller\n0.1,pid\n1,npid\n"


@pytest.mark.parametrize(
    ("cell", "heading", "text"),
    [
        (4.0, "t (s)", "4.000"),
        (0.008, "M", "0.008"),
        (1500.0, "K_i", "1500"),
        (2e-6, "M", "0"),
        (-0.024, "Δ (%)", "-0.02"),
    ],
)
def test_numbers_are_shown_with_as_many_digits_as_help(cell: float, heading: str, text: str) -> None:
    assert shown_cell(cell, heading) == text


def test_symbols_have_subscripts_in_the_page() -> None:
    page = html_page("T", [Section("S", ("**Which.** IAE_SP < K_p",))], Path())
    assert "<p><strong>Which.</strong> IAE<sub>SP</sub> &lt; K<sub>p</sub></p>" in page


@pytest.mark.parametrize("case", CASES)
def test_the_search_bounds_hold_the_printed_gains(case: str) -> None:
    for row in (row for row in ROWS if row.case == case):
        for name, (lower, upper) in paper_case(case).bounds.items():
            assert name == "sigma" or lower <= getattr(row, name) <= upper


def test_robust_gains_are_better_on_unseen_plants_on_every_linear_row() -> None:
    rows = {(row.case, row.controller): None for row in ROWS}
    table = nominal_beside_robust(rows)  # type: ignore[arg-type]
    assert len(table.rows) == sum(row.case != "sprott" for row in ROWS) == 18
    for _, _, unstable, mean, _, robust_unstable, robust_mean, _ in table.rows:
        assert (robust_unstable, robust_mean) < (unstable, mean)  # type: ignore[operator]
