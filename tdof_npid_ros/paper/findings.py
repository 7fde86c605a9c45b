"""What of the paper does not reproduce, what was tried, and what fits: each with its evidence, computed here."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from math import comb, factorial
from typing import NamedTuple

import numpy as np

from tdof_npid_ros.case import Case
from tdof_npid_ros.control.gains import Gains
from tdof_npid_ros.paper.evaluation import (
    CASE_TITLES,
    CONTROLLER_TITLES,
    Measured,
    Rows,
    deviation_percent,
    measure,
    paper_case,
    published_gains,
)
from tdof_npid_ros.paper.items import CHANGE_AT, SETTLED_AT, time_to_share_of_peak, variation_metrics
from tdof_npid_ros.paper.report import Cell, Finding, Table
from tdof_npid_ros.paper.tables import ROWS, VARIATIONS, Published

LINEAR = 1e6  # σ so large that k(e) = 1
PROCESS3_SIGMA = 2.0  # what comes closest to the published NPID rows of Process 3
WEAKER_DERIVATIVE = 0.75  # of the printed K_d: what comes closest for Process 1, c = 0.5
PADE_ORDER = 3
LIMITS = (6.0, 8.0, 10.0, 12.0, 15.0, 30.0, 60.0, 1000.0)
SPROTT_DISTURBANCES = (3.0, 5.0)
COMPARED_METRICS = {
    "settling_time_s": "Δ t_s (%)",
    "iae_setpoint": "Δ IAE_SP (%)",
    "peak": "Δ M_peak (%)",
    "iae_disturbance": "Δ IAE_DIS (%)",
}


class Variant(NamedTuple):
    """Another way to read the paper: a plant and gains."""

    label: str
    case: Case
    gains: Gains


def findings(rows: Rows) -> tuple[Finding, ...]:
    """All of them that concern the rows at hand."""
    cases = {case for case, _ in rows}
    made = []
    if "p1-c0.5" in cases:
        made.append(process1(rows))
    if cases & {"p3-c1", "p3-c2"}:
        made.append(process3())
    if "sprott" in cases:
        made += [sprott_disturbance(), effort_limit(), variation_at_rest()]
    made.append(recovery_time(cases))
    if linear := cases - {"sprott"}:
        made.append(settling_time(linear))
    return tuple(made)


def process1(rows: Rows) -> Finding:
    """Process 1, c = 0.5, against other readings of its gains and delay."""
    published = _published("p1-c0.5")
    variants = [variant for one in published for variant in _process1_variants(one)]
    ratios = [rows["p1-c0.5", p.controller].tuned.gains.per_lane("kd")[0] / p.kd for p in published]
    return Finding(
        "Process 1 with c = 0.5: a larger overshoot here",
        (
            "With the printed gains, all three controllers overshoot 6 to 7 percentage points more than printed, "
            "and M_peak is 3 to 4 % smaller. Another derivative filter, another dead time, or a rational "
            "approximation of the delay does not explain both.",
            f"What fits is a derivative action {100 * (1 - WEAKER_DERIVATIVE):.0f} % weaker than printed: with it the "
            "two NPID rows come out to within 2 % and 0.2 points, PID but for its overshoot. Our own "
            "optimum agrees: tuned from nothing, K_d becomes "
            + ", ".join(f"{ratio:.2f}" for ratio in ratios)
            + " times the printed one (Table 1), the other gains hardly change. Either the printed K_d are not those "
            "of the printed metrics, or the paper's simulation lost a part of the derivative action; it is lost only "
            "where T_d/N is very short (0.02 to 0.03 s here, 0.07 s and more in the other linear rows).",
        ),
        _variant_table("process1", "Process 1, c = 0.5: readings tried", published, variants),
    )


def process3() -> Finding:
    """The NPID rows of Process 3, for several σ."""
    published = [row for row in (*_published("p3-c1"), *_published("p3-c2")) if row.controller != "pid"]
    variants = [
        Variant(label, paper_case(one.case), published_gains(one).with_values(sigma=sigma))
        for one in published
        for label, sigma in (("σ = 1, as stated", 1.0), ("σ = 2", PROCESS3_SIGMA), ("σ = 3", 3.0), ("k(e) = 1", LINEAR))
    ]
    return Finding(
        "Process 3: the NPID rows are not those of σ = 1",
        (
            "With σ = 1, the biggest change of the setpoint, IAE_SP of the four NPID rows is 25 to 30 % above the "
            "printed values, and no tuning reaches the printed objectives. With σ = 2, one of the values in the paper's "
            "Figure 1, IAE_SP agrees within 1.1 % and M_p within 2.1 points; a linear law (k = 1) overshoots far too much. "
            "The error of this process exceeds the setpoint step (it moves the wrong way first), so that σ = 1 switches "
            "the integral action nearly off just then.",
            "Everything else here uses σ = 1 as the paper states; Tables 5 and 6 also show what tuning σ gives.",
        ),
        _variant_table("process3", "Process 3: σ", published, variants),
    )


def sprott_disturbance() -> Finding:
    """Table 8's disturbance: 3 or 5?"""
    lines: list[tuple[Cell, ...]] = []
    for row in _published("sprott"):
        for size in SPROTT_DISTURBANCES:
            case = paper_case("sprott")
            ours = measure(_with_disturbance(case, size), published_gains(row))
            b = float(case.plant_values["a"])
            lines.append(
                (
                    CONTROLLER_TITLES[row.controller], size, (size + 2.0) / (b * row.ki), row.peak, ours.values["peak"],
                    row.iae_disturbance, ours.values["iae_disturbance"],
                    deviation_percent(ours.values["iae_disturbance"], row.iae_disturbance),
                )
            )  # fmt: skip
    columns = (
        "controller", "disturbance", "(d + 2)/(0.6 K_i)", "M_peak, published", "M_peak, ours", "IAE_DIS, published",
        "IAE_DIS, ours", "Δ IAE_DIS (%)",
    )  # fmt: skip
    return Finding(
        "Sprott circuit: the printed disturbance response is not that of a disturbance of 3",
        (
            "At rest the integral action must carry u = (d + 2 sgn(x₁))/0.6, and without a change of sign of the error it "
            "has taken in IAE_DIS = u/K_i: with d = 3 from x = 0, 5/(0.6 K_i). The three printed IAE_DIS are 7/(0.6 K_i), "
            "to the printed digits. So they belong to d = 5, or to d = 3 with the sign term going from -2 to +2 "
            "(3 + 4 = 7) in a loop that was not at rest with u = 0 before. With d = 5, IAE_DIS agrees to the printed "
            "digits and M_peak within one unit of the last.",
            "Tables 7 and 8 keep the d = 3 of the paper's text.",
        ),
        Table("sprott_disturbance", "Sprott circuit: size of the disturbance", columns, tuple(lines)),
    )


def effort_limit() -> Finding:
    """Table 8's setpoint response, for several limits."""
    published = _published("sprott")
    lines: list[tuple[Cell, ...]] = [("published", None, *_setpoint_cells([_printed(row) for row in published]))]
    for anti_windup in ("none", "conditional"):
        for limit in LIMITS:
            changes = {"effort_min": -limit, "effort_max": limit, "anti_windup": anti_windup}
            ours = [measure(paper_case("sprott"), published_gains(row).with_values(**changes)) for row in published]
            lines.append((f"anti-windup {anti_windup}", limit, *_setpoint_cells(ours)))
    columns = (
        "loop",
        "limit ±",
        *(f"{m}, {CONTROLLER_TITLES[r.controller]}" for r in published for m in ("M_p (%)", "t_s (s)", "IAE_SP (s)")),
    )
    return Finding(
        "Sprott circuit: the effort limit is not given",
        (
            "The paper limits u to the operational amplifier's supply but does not say to what, nor how windup is "
            "treated. No single limit gives the three printed setpoint responses: IAE_SP of the two TDOF rows asks for "
            "about 40, M_p of PID for about 7 without anti-windup. The project uses ±30 without anti-windup, which is "
            "nearest for the TDOF rows; the PID row's M_p then is far below the printed one. The limit does not "
            "touch the disturbance columns.",
            "With ±30, tuning drives K_p and K_i of the NPID controllers towards the bounds of our search: nothing "
            "in the circuit's model punishes large gains.",
        ),
        Table(
            "effort_limit", "Sprott circuit: setpoint response by effort limit, published gains", columns, tuple(lines)
        ),
    )


def variation_at_rest() -> Finding:
    """Table 9 is that of a loop at rest."""
    lines = []
    for row in VARIATIONS:
        gains = published_gains(_row("sprott", row.controller))
        peak, iae, recovery = variation_metrics(gains, row.a, SETTLED_AT)
        lines.append(
            (
                f"a → {row.a:g}", CONTROLLER_TITLES[row.controller], 1e3 * row.iae, 1e3 * iae, deviation_percent(iae, row.iae),
                1e3 * row.peak, 1e3 * peak, deviation_percent(peak, row.peak), row.recovery_time_s, CHANGE_AT + recovery,
                deviation_percent(CHANGE_AT + recovery, row.recovery_time_s),
            )
        )  # fmt: skip
    columns = (
        "variation", "controller", "IAE published (×10⁻³ s)", "IAE ours (×10⁻³ s)", "Δ IAE (%)", "M_peak published (×10⁻³)",
        "M_peak ours (×10⁻³)", "Δ M_peak (%)", "t_rcy published (s)", "5 s + time to 5 % of M_peak, ours (s)", "Δ t_rcy (%)",
    )  # fmt: skip
    return Finding(
        "Table 9: the published numbers are those of a loop at rest",
        (
            "When a changes in a loop that has come to rest, all six IAE agree to four digits (they are "
            "0.8·|1/0.6 - 1/a|/K_i), M_peak within 2 %, and t_rcy within 0.6 % if it is the time from the *start* of the "
            "run to within 5 % of M_peak. With the change at 5 s as the text says, the same numbers come out only if nothing "
            "is left of the setpoint response by then, which depends on the effort limit that is not given.",
        ),
        Table("variation_at_rest", "Table 9 from rest, published gains", columns, tuple(lines)),
    )


def recovery_time(cases: Collection[str]) -> Finding:
    """What t_rcy means."""
    lines: list[tuple[Cell, ...]] = []
    near = 0
    for row in (row for row in ROWS if row.case in cases):
        case, gains = paper_case(row.case), _fitting_gains(row)
        deviation = np.abs(case.simulate("disturbance", gains).output[:, 0])
        within_peak = time_to_share_of_peak(deviation, case.sample_period)
        change = deviation_percent(within_peak, row.recovery_time_s)
        near += change is not None and abs(change) <= 10.0
        contract = case.disturbance_response(gains).recovery_time_s
        lines.append(
            (
                CASE_TITLES[row.case], CONTROLLER_TITLES[row.controller], row.recovery_time_s, contract,
                deviation_percent(contract, row.recovery_time_s), within_peak, change,
            )
        )  # fmt: skip
    columns = (
        "process", "controller", "published (s)", "2 % of the setpoint step, ours (s)", "Δ 2 % of the step (%)",
        "5 % of M_peak, ours (s)", "Δ 5 % of M_peak (%)",
    )  # fmt: skip
    return Finding(
        "Recovery time t_rcy: the paper's numbers are those of 5 % of M_peak",
        (
            "The paper says 'within 2 % of the setpoint'. For a step of 1 that is ±0.02, and it matches few rows; "
            "the Sprott circuit's deviation of 0.008 never even leaves that band (0 here, 8 to 11 s printed). The "
            f"time to within 5 % of the peak deviation is within 10 % of the printed value in {near} of {len(lines)} rows "
            "and within 1 % in all three of the Sprott circuit. Most of the others "
            "are decided by whether one more oscillation just reaches the band. (Process 3's NPID rows with σ = 2.)",
            "The program's metric stays the stated one, 2 % of the setpoint step.",
        ),
        Table("recovery_time", "Recovery time by definition, published gains", columns, tuple(lines)),
    )


def settling_time(cases: Collection[str]) -> Finding:
    """How near the settling times are to a jump."""
    lines: list[tuple[Cell, ...]] = []
    for row in (row for row in ROWS if row.case in cases):
        case, gains = paper_case(row.case), _fitting_gains(row)
        deviation = np.abs(case.simulate("setpoint", gains).output[:, 0] - 1.0)
        later = deviation[int(row.settling_time_s / case.sample_period) + 1 :]
        ours = case.setpoint_response(gains).settling_time_s
        lines.append(
            (
                CASE_TITLES[row.case], CONTROLLER_TITLES[row.controller], row.settling_time_s, ours,
                deviation_percent(ours, row.settling_time_s), 100.0 * float(later.max()),
            )
        )  # fmt: skip
    columns = (
        "process", "controller", "published (s)", "ours (s)", "Δ t_s (%)", "largest deviation after the published t_s, ours (%)",
    )  # fmt: skip
    return Finding(
        "Settling time t_s: where it jumps",
        (
            "t_s jumps when one more oscillation reaches the 5 % band. In several rows ours is much longer only because an "
            "oscillation peaks at 5.0 to 5.5 % instead of just below 5 %: see the last column.",
        ),
        Table("settling_time", "Settling times, published gains", columns, tuple(lines)),
    )


def _process1_variants(row: Published) -> list[Variant]:
    case, gains = paper_case(row.case), published_gains(row)
    dead_time = float(case.plant_values["dead_time"])
    time_constant = float(case.plant_values["time_constant"])
    numerator, denominator = _pade(dead_time, PADE_ORDER)
    rational = {
        "numerator": numerator,
        "denominator": np.polymul(denominator, [time_constant, 1.0]).tolist(),
        "dead_time": 0.0,
    }
    shorter = replace(case, plant_values={**case.plant_values, "dead_time": 0.47})
    return [
        Variant("as printed", case, gains),
        Variant("N = 5", case, gains.with_values(n=5.0)),
        Variant("N = 100", case, gains.with_values(n=100.0)),
        Variant("dead time 0.47 s", shorter, gains),
        Variant("Padé delay of third order", replace(case, model="transfer_function", plant_values=rational), gains),
        Variant("K_d 25 % lower", case, gains.with_values(kd=WEAKER_DERIVATIVE * row.kd)),
    ]


def _pade(delay: float, order: int) -> tuple[list[float], list[float]]:
    """Numerator and denominator of the Padé approximation of e^(-delay s), highest power first."""
    terms = [comb(order, k) * factorial(2 * order - k) / factorial(2 * order) * delay**k for k in range(order, -1, -1)]
    signs = [(-1.0) ** k for k in range(order, -1, -1)]
    return [sign * term for sign, term in zip(signs, terms, strict=True)], terms


def _variant_table(name: str, title: str, published: Sequence[Published], variants: Sequence[Variant]) -> Table:
    per_row = len(variants) // len(published)
    lines: list[tuple[Cell, ...]] = []
    for i, variant in enumerate(variants):
        row, ours = published[i // per_row], measure(variant.case, variant.gains)
        deviations = [deviation_percent(ours.values[metric], getattr(row, metric)) for metric in COMPARED_METRICS]
        overshoot = ours.number("overshoot_percent") - row.overshoot_percent
        lines.append((CASE_TITLES[row.case], CONTROLLER_TITLES[row.controller], variant.label, overshoot, *deviations))
    columns = ("process", "controller", "reading", "Δ M_p (points)", *COMPARED_METRICS.values())
    return Table(name, title, columns, tuple(lines), 2, "Deviations of ours from the published values.")


def _setpoint_cells(measured: Sequence[Measured]) -> list[Cell]:
    return [
        one.values[metric] for one in measured for metric in ("overshoot_percent", "settling_time_s", "iae_setpoint")
    ]


def _printed(row: Published) -> Measured:
    return Measured(
        row.gains, {name: getattr(row, name) for name in ("overshoot_percent", "settling_time_s", "iae_setpoint")}
    )


def _with_disturbance(case: Case, size: float) -> Case:
    end = case.plans["disturbance"].end_ns / 1e9
    return replace(case, episodes={**case.episodes, "disturbance": (f"0 disturbance {size:g}", f"{end:g} end")})


def _fitting_gains(row: Published) -> Gains:
    """The printed gains; for Process 3's NPID rows with the σ that fits."""
    gains = published_gains(row)
    fits = row.case.startswith("p3") and row.controller != "pid"
    return gains.with_values(sigma=PROCESS3_SIGMA) if fits else gains


def _published(case: str) -> list[Published]:
    return [row for row in ROWS if row.case == case]


def _row(case: str, controller: str) -> Published:
    return next(row for row in ROWS if (row.case, row.controller) == (case, controller))
