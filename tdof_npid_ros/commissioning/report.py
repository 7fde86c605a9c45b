"""A commissioning as one page and one JSON object: experiment, model, prediction, confirmation, decision."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tdof_npid_ros.commissioning.confirm import Confirmed
from tdof_npid_ros.commissioning.design import DRAWN, SET, Design, settings_of
from tdof_npid_ros.identification.records import Record
from tdof_npid_ros.identification.result import as_json, table
from tdof_npid_ros.interactive import Page, response_plots
from tdof_npid_ros.plotting import Curve, Panel
from tdof_npid_ros.prediction import curve_of
from tdof_npid_ros.stability.margins import Margins

BEFORE, NEW = "present gains", "new gains"


@dataclass
class Commissioning:
    """What has been done so far.

    Attributes:
        namespace, bag: of the loop, and where it was recorded.
        noise: of the output, before the first experiment.
        proposals: the experiments, as sentences; `records` what came of them and of confirming steps.
        design: None before there is one; `confirmed` likewise.
        outcome: kept, reverted or declined.
        reason: why.
    """

    namespace: str
    bag: str
    noise: float = 0.0
    proposals: list[str] = field(default_factory=list)
    records: list[Record] = field(default_factory=list)
    design: Design | None = None
    confirmed: Confirmed | None = None
    outcome: str = ""
    reason: str = ""

    def as_json(self) -> dict[str, Any]:
        """Everything that is a number or a word."""
        report: dict[str, Any] = {
            "namespace": self.namespace,
            "outcome": self.outcome,
            "reason": self.reason,
            "experiments": len(self.proposals),
            "noise": self.noise,
            "bag": self.bag,
        }
        if (design := self.design) is not None:
            report |= {
                "model": as_json(design.found, design.draft),
                "gains": settings_of(design.gains),
                "gains_before": settings_of(design.case.gains),
                "objective": design.objective,
                "objective_before": design.objective_before if math.isfinite(design.objective_before) else None,
                "margins": design.margins.as_dict(),
                "margins_before": design.margins_before.as_dict(),
                "worst_m_s": design.worst_m_s,
            }
        if (step := self.confirmed) is not None:
            report["confirmed"] = {
                "step": float(step.setpoint[-1] - step.output[0]),
                "miss": step.miss,
                "off": step.off,
                "overshoot": step.overshoot,
                "overshoot_predicted": step.overshoot_predicted,
                "as_predicted": not step.reason,
            }
        return report

    def page(self) -> Page:
        """The page."""
        page = Page(f"Commissioning of {self.namespace}: {self.outcome}")
        page.text(self.reason)
        page.text(f"Recorded in {self.bag}.")
        page.heading("Experiments")
        for text in self.proposals:
            page.text(text)
        design = self.design
        if design is None:
            return page
        fitted = zip(self.records, design.found.problem.stretches, design.found.residuals, strict=False)
        for record, stretch, residual in fitted:
            predicted = Curve("model", stretch.time, stretch.output - residual, stretch.effort)
            measured = Curve("measured", stretch.time, stretch.output, stretch.effort, record.setpoint)
            page.plot(*response_plots(Panel(record.name, [measured, predicted], units=design.case.units)))
        page.heading(f"The plant: {design.found.structure.text}")
        page.text(design.found.reason)
        intervals = design.found.parameters.items()
        bounds = [(name, *map(_text, (one.value, one.low, one.high))) for name, one in intervals]
        page.table([("parameter", "value", "95 % from", "to"), *bounds])
        for line in table(design.found).splitlines()[len(bounds) + 2 :]:
            page.text(line.strip())
        page.heading("Gains and margins")
        page.table(_compared(design))
        page.text(
            f"Of {DRAWN} plants drawn from what the record allows, the worst has M_s {design.worst_m_s:.3f} with the "
            "new gains."
        )
        page.heading("Predicted responses")
        for episode in design.case.episodes:
            curves = []
            for label, gains in ((BEFORE, design.case.gains), (NEW, design.gains)):
                run = design.case.simulate(episode, gains)
                if np.abs(run.output).max() < 1e3 * max(1.0, float(np.abs(run.setpoint).max())):
                    curves.append(curve_of(label, run))
            page.plot(*response_plots(Panel(episode, curves, design.case.effort_limits, units=design.case.units)))
        if (step := self.confirmed) is not None:
            page.heading("The confirming step")
            page.text(
                f"Measured and predicted differ by {step.miss:.1%} of the step (rms, without the noise); overshoot "
                f"{step.overshoot:.1%}, predicted {step.overshoot_predicted:.1%}."
            )
            run = step.predicted
            curves = [
                Curve("measured", step.time, step.output, step.effort, step.setpoint),
                Curve("predicted", run.time, run.output[:, 0], run.control_effort[:, 0]),
            ]
            page.plot(*response_plots(Panel("step", curves, design.case.effort_limits, units=design.case.units)))
        return page


def lines_of(design: Design) -> list[str]:
    """The design for people."""
    rows = _compared(design)
    return [f"  {row[0]:16} {row[1]:>14} {row[2]:>14}" for row in rows] + [
        f"  of the plants that the record allows, the worst has M_s {design.worst_m_s:.3f}"
    ]


def _compared(design: Design) -> list[Sequence[str]]:
    before, new = settings_of(design.case.gains), settings_of(design.gains)
    rows: list[Sequence[str]] = [("", BEFORE, NEW)]
    rows += [(name, _text(before[name]), _text(new[name])) for name in SET]
    rows.append(("objective", _text(design.objective_before), _text(design.objective)))
    names = ("m_s", "m_t", "gain_margin", "phase_margin_deg", "delay_margin_s", "time_constant_s")
    rows += [(name, _margin(design.margins_before, name), _margin(design.margins, name)) for name in names]
    return rows


def _margin(margins: Margins, name: str) -> str:
    return "unstable" if margins.stable is False else _text(getattr(margins, name))


def _text(value: Any) -> str:
    return "-" if value is None else value if isinstance(value, str) else f"{value:.5g}"
