"""The paper's tables and figures, each built from the evaluated rows and fronts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from tdof_npid_ros.case import Case
from tdof_npid_ros.control.gains import Gains
from tdof_npid_ros.paper import figures
from tdof_npid_ros.paper.evaluation import (
    CONTROLLER_TITLES,
    METRICS,
    Measured,
    Row,
    Rows,
    deviation_percent,
    paper_case,
)
from tdof_npid_ros.paper.figures import Curve, Panel
from tdof_npid_ros.paper.report import Cell, Figure, Table
from tdof_npid_ros.paper.tables import CASE_TITLES, COMPARED, VARIATIONS
from tdof_npid_ros.tuning.pareto import Front

CHANGE_AT = 5.0  # s: when `a` changes (Table 9, Figures 15 and 16)
SETTLED_AT = 120.0  # s: when it changes for a loop that has come to rest; beyond, as long as after CHANGE_AT
CHAOS_START, CHAOS_END = [-1.0, -2.0, 1.0], 150.0  # x(0) of Figure 13; s
VARIATION_EPISODES = {0.72: "increase", 0.48: "decrease"}
DATA_ROWS = 1000  # of a figure's CSV, about
GAIN_TITLES = {"kp": "K_p", "ki": "K_i", "kd": "K_d", "alpha": "α", "beta": "β", "sigma": "σ"}
SHOWN_UNTIL = {  # s: the end of the axes of Figures 7 to 14, setpoint and disturbance
    "p1-c0.5": (8.0, 8.0),
    "p1-c4": (50.0, 50.0),
    "p2-c2": (20.0, 25.0),
    "p2-c5": (20.0, 30.0),
    "p3-c1": (20.0, 20.0),
    "p3-c2": (25.0, 25.0),
    "sprott": (3.0, 15.0),
}


class Evaluated(NamedTuple):
    """All that the items are built from."""

    rows: Rows
    fronts: tuple[Front, ...]


class Item(NamedTuple):
    """A table or figure of the paper: the cases whose rows it needs, and how it is built."""

    cases: tuple[str, ...]
    build: Callable[[Evaluated], Table | Figure]
    needs_fronts: bool = False


def gains_table(name: str, cases: Sequence[str]) -> Item:
    """Tables 1, 3, 5, 7: tuned parameters."""

    def build(evaluated: Evaluated) -> Table:
        rows: list[tuple[Cell, ...]] = []
        for row in _rows(evaluated, cases):
            published, ours = row.published.gains, row.tuned.gains
            key = (CASE_TITLES[row.published.case], CONTROLLER_TITLES[row.published.controller])
            rows += [
                (*key, "published", *_gain_cells(published)),
                (*key, "ours, tuned by the HGA", *_gain_cells(ours)),
                (*key, "deviation (%)", *_gain_deviations(ours, published)),
            ]
            if row.sigma_free:
                rows.append((*key, "ours, σ tuned too", *_gain_cells(row.sigma_free.gains)))
        columns = ("process", "controller", "gains", *GAIN_TITLES.values())
        note = "Different gains may give nearly the same response: judge by the performance tables."
        return Table(name, f"Table {name[5:]}: tuned parameters, {_joined(cases)}", columns, tuple(rows), 2, note)

    return Item(tuple(cases), build)


def performance_table(name: str, cases: Sequence[str]) -> Item:
    """Tables 2, 4, 6, 8: performance."""

    def build(evaluated: Evaluated) -> Table:
        rows = _rows(evaluated, cases)
        free = any(row.sigma_free for row in rows)
        columns: tuple[str, ...] = (
            "process", "controller", "quantity", "published", "ours at the published gains", "Δ published gains (%)",
            "ours, tuned", "Δ tuned (%)",
        )  # fmt: skip
        columns += ("ours, σ tuned too", "Δ σ tuned too (%)") if free else ()
        lines = tuple(_performance_line(row, metric, free) for row in rows for metric in METRICS)
        note = "t_s: 5 % band. t_rcy: 2 % of the setpoint step; 0 means that the deviation never left that band."
        return Table(name, f"Table {name[5:]}: performance, {_joined(cases)}", columns, lines, 2, note)

    return Item(tuple(cases), build)


def variation_table(name: str) -> Item:
    """Table 9: `a` changes while the loop runs."""

    def build(evaluated: Evaluated) -> Table:
        rows: list[tuple[Cell, ...]] = []
        for published in VARIATIONS:
            row = evaluated.rows["sprott", published.controller]
            at_published, tuned = row.at_published.gains, row.tuned.gains
            ours = (
                variation_metrics(at_published, published.a, CHANGE_AT),
                variation_metrics(at_published, published.a, SETTLED_AT),
                variation_metrics(tuned, published.a, CHANGE_AT),
            )
            key = (f"a = 0.6 → {published.a:g}", CONTROLLER_TITLES[published.controller])
            for quantity, printed, index in (
                ("M_peak (×10⁻³)", published.peak, 0),
                ("IAE (×10⁻³ s)", published.iae, 1),
            ):
                values = [one[index] for one in ours]
                cells = [x for v in values for x in (v * 1e3, deviation_percent(v, printed))]
                rows.append((*key, quantity, printed * 1e3, *cells))
        columns = (
            "variation", "controller", "quantity", "published", "ours at the published gains", "Δ published gains (%)",
            "the same, at rest before the change", "Δ at rest (%)", "ours, tuned", "Δ tuned (%)",
        )  # fmt: skip
        limit = paper_case("sprott").gains.effort_max
        note = (
            f"From 5 s on, as the paper says, the setpoint response is not over yet in our loop (the effort limit of "
            f"±{limit:g} "
            "makes the integral wind up), and its rest outweighs the effect of a. 'At rest': a changes at 120 s "
            "instead. "
            "The recovery times are with the evidence on Table 9."
        )
        return Table(name, "Table 9: the parameter a changes at 5 s, Sprott circuit", columns, tuple(rows), 2, note)

    return Item(("sprott",), build)


def response_figure(name: str, case: str) -> Item:
    """Figures 7 to 12 and 14: setpoint and disturbance responses."""

    def build(evaluated: Evaluated) -> Figure:
        loop, rows = paper_case(case), _rows(evaluated, (case,))
        step, load = (loop.signals[episode] for episode in ("setpoint", "disturbance"))
        gains = {
            "published gains": [row.at_published.gains for row in rows],
            "our tuned gains": [row.tuned.gains for row in rows],
        }
        curves = {
            (which, episode): [
                Curve(one.type, signals.time, loop.simulate(episode, one).output[:, 0]) for one in gains[which]
            ]
            for which in gains
            for episode, signals in (("setpoint", step), ("disturbance", load))
        }
        shown = SHOWN_UNTIL[case]
        panels = [
            [
                Panel(f"(a) setpoint tracking, {which}", "y", curves[which, "setpoint"], shown[0], 1.0),
                Panel(f"(b) disturbance rejection, {which}", "y", curves[which, "disturbance"], shown[1], 0.0),
            ]
            for which in gains
        ]
        every = max(1, step.steps // DATA_ROWS)
        data = {"time_s": step.time[::every]}
        for (which, episode), responses in curves.items():
            for curve in responses:
                data[f"{curve.controller} {episode} {which}"] = curve.value[::every]
        size = load.disturbance[0]
        return Figure(
            name,
            f"Figure {name[6:]}: responses, {CASE_TITLES[case]}",
            f"A unit step of the setpoint and a disturbance of {size:g}. Above at the gains that the paper prints, "
            "below at those that our HGA found.",
            lambda path: figures.draw_panels(panels, path),
            data,
        )

    return Item((case,), build)


def variation_figure(name: str, a: float) -> Item:
    """Figures 15 and 16: `a` changes at 5 s."""

    def build(evaluated: Evaluated) -> Figure:
        case, rows = paper_case("sprott"), _rows(evaluated, ("sprott",))
        episode = VARIATION_EPISODES[a]
        time = case.signals[episode].time
        whole, tuned = (
            [Curve(one.type, time, case.simulate(episode, one).output[:, 0]) for one in gains]
            for gains in ([row.at_published.gains for row in rows], [row.tuned.gains for row in rows])
        )
        rest = [_from_rest(row, a) for row in rows]
        panels = [
            [
                Panel("(a) published gains", "y", whole, 10.0, 1.0),
                Panel("(b) our tuned gains", "y", tuned, 10.0, 1.0),
                Panel("(c) effect of a alone, published gains", "(y - 1)·10³", rest, 15.0, 0.0, 1e3),
            ]
        ]
        every = max(1, len(time) // DATA_ROWS)
        data = {"time_s": time[::every]}
        data |= {f"{curve.controller} published gains": curve.value[::every] for curve in whole}
        data |= {f"{curve.controller} our tuned gains": curve.value[::every] for curve in tuned}
        return Figure(
            name,
            f"Figure {name[6:]}: a changes from 0.6 to {a:g} at 5 s, Sprott circuit",
            "The change cannot be seen beside the setpoint step, as the paper says. (c) shows it alone: the loop was "
            "at "
            "rest when a changed, and time counts from there.",
            lambda path: figures.draw_panels(panels, path),
            data,
        )

    return Item(("sprott",), build)


def error_scaling_figure(name: str) -> Item:
    """Figure 1: ζ(e)."""

    def build(_: Evaluated) -> Figure:
        error = np.linspace(-8.0, 8.0, 801)
        scaled = {sigma: np.exp(-(error**2) / (2.0 * sigma**2)) * error for sigma in (1.0, 2.0, 3.0)}
        return Figure(
            name,
            "Figure 1: the scaled error ζ = exp(-e²/2σ²)·e",
            "What the integral action sees of the error: all of a small one, little of a large one.",
            lambda path: figures.draw_error_scaling(error, scaled, path),
            {"e": error, **{f"zeta sigma {sigma:g}": value for sigma, value in scaled.items()}},
        )

    return Item((), build)


def fronts_figure(name: str) -> Item:
    """Figure 6: Pareto fronts."""

    def build(evaluated: Evaluated) -> Figure:
        points = [(front.ratio, front.controller, *iae) for front in evaluated.fronts for iae in front.iae.tolist()]
        ratio, controller, setpoint, disturbance = (np.array(column) for column in zip(*points, strict=True))
        return Figure(
            name,
            "Figure 6: optimal Pareto fronts, K = 1, T = 1 s",
            "Tracking against rejection for three dead times, by NSGA-II: the nearer to the lower left corner the "
            "better.",
            lambda path: figures.draw_fronts(evaluated.fronts, path),
            {"ratio": ratio, "controller": controller, "iae_setpoint": setpoint, "iae_disturbance": disturbance},
        )

    return Item((), build, needs_fronts=True)


def chaos_figure(name: str) -> Item:
    """Figure 13: the Sprott circuit left alone."""

    def build(_: Evaluated) -> Figure:
        case = paper_case("sprott")
        case = replace(
            case,
            plant_values={**case.plant_values, "initial_state": CHAOS_START},
            episodes={"alone": (f"{CHAOS_END:g} end",)},
        )
        alone = case.simulate("alone", Gains("pid", kp=0.0))  # a controller without gains: u = 0
        time, x1 = alone.time, alone.output[:, 0]
        x2 = np.gradient(x1, case.sample_period)  # (16): with u = 0, x2 is the output's derivative
        every = max(1, len(time) // (10 * DATA_ROWS))
        return Figure(
            name,
            "Figure 13: chaotic behaviour of the Sprott circuit, u = d = 0",
            "From x(0) = [-1, -2, 1]; 150 s.",
            lambda path: figures.draw_chaos(time, x1, x2, path),
            {"time_s": time[::every], "x1": x1[::every], "x2": x2[::every]},
        )

    return Item((), build)


def variation_metrics(gains: Gains, a: float, change_at: float, case: Case | None = None) -> tuple[float, float, float]:
    """M_peak, IAE (s) and the time (s, from the change) to within 5 % of M_peak, from the change on.

    Args:
        case: the circuit's, unless another variant of it is meant.
    """
    case = case or paper_case("sprott")
    deviation = np.abs(variation_response(gains, a, change_at, case))
    period = case.sample_period
    return (
        float(deviation.max()),
        float(np.trapezoid(deviation, dx=period)),
        time_to_fraction_of_peak(deviation, period),
    )


def variation_response(gains: Gains, a: float, change_at: float, case: Case) -> np.ndarray:
    """y - 1 from the change of `a` on, (steps,), for as long as in the case's own episode."""
    own = case.signals[VARIATION_EPISODES[a]]
    length = float(own.time[-1]) - CHANGE_AT
    nominal = f"0 plant.a {case.plant_values['a']:g}"
    lines = ("0 setpoint 1", nominal, f"{change_at:g} plant.a {a:g}", f"{change_at + length:g} end")
    y = replace(case, episodes={"varied": lines}).simulate("varied", gains).output[:, 0]
    return np.asarray(y[round(change_at / case.sample_period) :] - 1.0)


def time_to_fraction_of_peak(deviation: np.ndarray, period: float, fraction: float = 0.05) -> float:
    """The time (s) from which on |deviation| (steps,) stays within a fraction of its own largest value."""
    return float((np.flatnonzero(deviation > fraction * deviation.max())[-1] + 1) * period)


def _from_rest(row: Row, a: float) -> Curve:
    case = paper_case("sprott")
    deviation = variation_response(row.at_published.gains, a, SETTLED_AT, case)
    return Curve(row.published.controller, np.arange(len(deviation)) * case.sample_period, deviation)


def _rows(evaluated: Evaluated, cases: Sequence[str]) -> list[Row]:
    return [evaluated.rows[case, controller] for case in cases for controller in COMPARED]


def _joined(cases: Sequence[str]) -> str:
    return " and ".join(CASE_TITLES[case] for case in cases)


def _gain_cells(gains: Gains) -> list[Cell]:
    return [getattr(gains, name) if _has(gains, name) else None for name in GAIN_TITLES]


def _gain_deviations(ours: Gains, published: Gains) -> list[Cell]:
    deviations = [
        deviation_percent(getattr(ours, name), getattr(published, name)) if _has(ours, name) else None
        for name in GAIN_TITLES
    ]
    return [None if one is None else f"{one:+.1f}" for one in deviations]


def _has(gains: Gains, name: str) -> bool:
    without = {"pid": ("alpha", "beta", "sigma"), "npid": ("alpha", "beta"), "tdof_npid1": ("beta",), "tdof_npid2": ()}
    return name not in without[gains.type]


def _performance_line(row: Row, metric: str, free: bool) -> tuple[Cell, ...]:
    published = getattr(row.published, metric)
    key = (CASE_TITLES[row.published.case], CONTROLLER_TITLES[row.published.controller], METRICS[metric])
    line = (*key, published, *_beside(row.at_published, metric, published), *_beside(row.tuned, metric, published))
    if not free:
        return line
    return line + (_beside(row.sigma_free, metric, published) if row.sigma_free else (None, None))


def _beside(measured: Measured, metric: str, published: float) -> tuple[Cell, Cell]:
    value = measured.values[metric]
    return value, deviation_percent(value, published)


ITEMS: dict[str, Item] = {
    "figure1": error_scaling_figure("figure1"),
    "figure6": fronts_figure("figure6"),
    "table1": gains_table("table1", ("p1-c0.5", "p1-c4")),
    "table2": performance_table("table2", ("p1-c0.5", "p1-c4")),
    "figure7": response_figure("figure7", "p1-c0.5"),
    "figure8": response_figure("figure8", "p1-c4"),
    "table3": gains_table("table3", ("p2-c2", "p2-c5")),
    "table4": performance_table("table4", ("p2-c2", "p2-c5")),
    "figure9": response_figure("figure9", "p2-c2"),
    "figure10": response_figure("figure10", "p2-c5"),
    "table5": gains_table("table5", ("p3-c1", "p3-c2")),
    "table6": performance_table("table6", ("p3-c1", "p3-c2")),
    "figure11": response_figure("figure11", "p3-c1"),
    "figure12": response_figure("figure12", "p3-c2"),
    "figure13": chaos_figure("figure13"),
    "table7": gains_table("table7", ("sprott",)),
    "table8": performance_table("table8", ("sprott",)),
    "figure14": response_figure("figure14", "sprott"),
    "table9": variation_table("table9"),
    "figure15": variation_figure("figure15", 0.72),
    "figure16": variation_figure("figure16", 0.48),
}
