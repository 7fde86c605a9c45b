"""What margins and the certificate of a loop cost, beside a tuning run and beside python-control."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.harness import Result, Table, Verdict, main, seconds, summary
from tdof_npid_ros.case import Case, load_case
from tdof_npid_ros.control.gains import Gains
from tdof_npid_ros.control.law import KD_H, PHI, coefficients
from tdof_npid_ros.paper.evaluation import GENERATIONS, published_gains
from tdof_npid_ros.paper.tables import ROWS, Published
from tdof_npid_ros.stability.certificate import certify
from tdof_npid_ros.stability.margins import margins
from tdof_npid_ros.tuning.objective import Objective
from tdof_npid_ros.tuning.problem import POPULATION, TuningProblem
from tdof_npid_ros.tuning.study import Study

TITLE = "Margins and certificate"
METHOD = (
    "`margins` and `certify` at the published gains of each linear row of the paper, the better of two, beside a whole "
    "tuning run of the row (8,000 evaluations on all cores, once). A ratio is that of a row; the largest counts. "
    "python-control gets the same sampled loop as its frequency response (`frd`) at 2,000 frequencies, which "
    "`stability_margins` interpolates: as a transfer function a dead time of hundreds of samples takes it minutes. "
    "Ours are exact, and tell the delay margin and the slowest mode, too."
)
PEERS = ("control",)
NOTES: tuple[str, ...] = ()

AGREE = 0.01  # relative
FREQUENCIES = 2000


def run(size: str) -> Result:
    """Row by row."""
    full = size == "full"
    rows = [row for row in ROWS if row.case != "sprott"][: None if full else 1]
    generations = GENERATIONS if full else 5
    table, ours, peer = [], [], []
    margin_ratios, certificate_ratios, agree = {}, {}, 0
    for row in rows:
        case, gains, label = load_case(row.case), published_gains(row), f"{row.case} {row.controller}"
        tuning = _tuning_time(case, row, generations)
        found, of_margins = _timed(lambda case=case, gains=gains: margins(case, gains))
        _, of_certificate = _timed(lambda case=case, gains=gains: certify(case, gains))
        theirs, of_peer = _timed(lambda case=case, gains=gains: python_control_margins(case, gains))
        off = max(
            abs(theirs[name] / value - 1.0)
            for name, value in (("gm", found.gain_margin), ("pm", found.phase_margin_deg), ("ms", found.m_s))
            if value is not None
        )
        agree += off <= AGREE
        ours.append(of_margins)
        peer.append(of_peer)
        margin_ratios[label], certificate_ratios[label] = of_margins / tuning, of_certificate / tuning
        table.append(
            [label, f"{tuning:.2f}", f"{1e3 * of_margins:.1f}", f"{1e3 * of_certificate:.1f}", f"{1e3 * of_peer:.1f}",
             f"{100.0 * off:.2g}"]
        )  # fmt: skip
    result = Result()
    result.rates += [
        summary("margins, all rows", "s", ours, ours=True),
        summary("python-control, stability_margins, all rows", "s", peer),
    ]
    for name, ratios, goal in (("margins", margin_ratios, 0.3), ("certificate", certificate_ratios, 2.0)):
        worst = max(ratios, key=lambda label: ratios[label])
        claim = f"{name} of a row, times one tuning run of it, worst row ({worst})"
        result.verdicts.append(Verdict(claim, ratios[worst], goal, at_most=True))
    result.verdicts += [
        Verdict("time of python-control's margins, times ours, all rows", sum(peer) / sum(ours), None),
        Verdict(f"rows on which python-control's margins are ours within 1 %, of {len(rows)}", agree, None),
    ]
    header = [
        "row",
        "tuning run, s",
        "margins, ms",
        "certificate, ms",
        "python-control, ms",
        "its largest difference, %",
    ]
    result.tables.append(Table("Each linear row at its published gains", header, table))
    return result


def _timed(function: Any) -> tuple[Any, float]:
    """What it returns, and the better of two times."""
    found: list[Any] = []
    times = [seconds(lambda: found.append(function())) for _ in range(2)]
    return found[-1], min(times)


def _tuning_time(case: Case, row: Published, generations: int) -> float:
    problem = TuningProblem(
        case, row.controller, (), case.weight, seed=1, population=POPULATION, generations=generations
    )
    objective = Objective(problem)
    objective(Study(problem).ask())  # compiles
    return seconds(lambda: Study(problem).run(objective))


def python_control_margins(case: Case, gains: Gains) -> dict[str, float]:
    """Gain margin, phase margin in degrees and M_s of the sampled loop, NaN where it finds none."""
    import control

    found = control.stability_margins(_frequency_response(case, gains))
    gm, pm, distance = found[:3]
    return {"gm": float(gm), "pm": float(pm), "ms": 1.0 / float(distance)}


def _frequency_response(case: Case, gains: Gains) -> Any:
    """L(z), with k(e) = 1, as python-control's frequency response."""
    import control

    h, (c,) = case.sample_period, coefficients(gains, case.sample_period).T
    kp, ki = (float(gains.per_lane(name)[0]) for name in ("kp", "ki"))
    omega = np.logspace(-4.0, 0.0, FREQUENCIES) * np.pi / h
    z = np.exp(1j * omega * h)
    sampled: Any = case.plant.sampled(case.sample_period_ns)
    n = len(sampled.gamma_new)
    phi, output = np.reshape(sampled.phi, (n, n)), np.eye(1, n)  # the first state is the output
    loop = (kp + ki * h / (z - 1.0) + float(c[KD_H]) * (z - 1.0) / (z - float(c[PHI]))) * sum(
        control.ss(phi, np.reshape(gamma, (n, 1)), output, 0.0, h)(z) * z**-late
        for gamma, late in ((sampled.gamma_new, sampled.delay), (sampled.gamma_old, sampled.delay + 1))
    )
    return control.frd(loop, omega, smooth=True)


if __name__ == "__main__":
    main("margins")
