"""Gains for a plant that a record tells: tuned under a margin, and checked on all plants that the record allows."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tdof_npid_ros.case import Case, load_case
from tdof_npid_ros.control.gains import ControllerType, Gains
from tdof_npid_ros.control.options import ControllerOptions
from tdof_npid_ros.draft import Draft
from tdof_npid_ros.identification import IdentificationError
from tdof_npid_ros.identification.excitation import relay_point
from tdof_npid_ros.identification.identify import Identified, identify
from tdof_npid_ros.identification.intervals import drawn
from tdof_npid_ros.identification.records import Record
from tdof_npid_ros.identification.result import draft_of
from tdof_npid_ros.identification.structures import STRUCTURES
from tdof_npid_ros.plants.linear import TransferFunction
from tdof_npid_ros.stability import StabilityError
from tdof_npid_ros.stability.margins import Margins, margins
from tdof_npid_ros.tuning.judge import Constraints
from tdof_npid_ros.tuning.objective import Objective
from tdof_npid_ros.tuning.problem import TuningProblem, candidate_of
from tdof_npid_ros.tuning.study import Study

FEW = 3  # parameters
EXPLAINS = 80.0  # per cent, on data not used
DRAWN = 40  # plants
ALLOWED = 1.1  # times M_s - 1 asked for: what the worst of the plants drawn may have
RELAY_AGREES = 1.3  # factor between the gain that a relay tells and the model's
TIGHTENED = 4  # searches at the most, each with a tighter margin asked of the model, until that holds
SET = ("type", "kp", "ki", "kd", "alpha", "beta", "sigma")


@dataclass(frozen=True)
class Design:
    """Gains, and what is promised of them.

    Attributes:
        found: the plant.
        draft: its parameter file.
        case: the plant with its episodes; its gains are the present ones, its options the controller's.
        gains: the new ones.
        objective, objective_before: of the new and of the present gains.
        margins, margins_before: of the model's loop.
        worst_m_s: of the plants drawn; infinite if one of their loops is unstable.
        ms: that the model's loop was held to.
    """

    found: Identified
    draft: Draft
    case: Case
    gains: Gains
    objective: float
    objective_before: float
    margins: Margins
    margins_before: Margins
    worst_m_s: float
    ms: float

    @property
    def settings(self) -> dict[str, Any]:
        """The controller's parameters to set."""
        return settings_of(self.gains)

    @property
    def horizon(self) -> float:
        """s in which the loop has settled after a step."""
        return self.case.signals["setpoint"].steps * self.case.sample_period


def settings_of(gains: Gains) -> dict[str, Any]:
    """The controller's parameters that commissioning sets, by name."""
    values = gains.as_dict()
    return {name: values[name] for name in SET}


def identified(records: Sequence[Record]) -> Identified:
    """The plant that made some records. Where they do not tell the parameters of the structure that fits best, the
    best of few parameters will do, if it explains them; whether it is good enough the confirming step shows.

    Raises:
        IdentificationError: they cannot tell.
    """
    stretches = [record.stretch for record in records]
    try:
        return identify(stretches)
    except IdentificationError as error:
        few = [structure for structure in STRUCTURES.values() if structure.parameters <= FEW]
        try:
            found = identify(stretches, few)
        except IdentificationError:
            raise error from None
        if found.fit_percent < EXPLAINS:
            raise
        return found


def designed(
    found: Identified,
    records: Sequence[Record],
    present: Gains,
    options: ControllerOptions,
    controller: ControllerType,
    sample_period: float,
    ms: float,
    step: float | None = None,
    seed: int = 0,
) -> Design:
    """Gains for a plant that was identified.

    Args:
        present, options: the controller's; all that is not tuned stays as there. Options are left out of the tuning,
            but not of the margins and responses.
        controller: the type to tune.
        sample_period: the controller's, s.
        ms: largest M_s.
        step: largest change of the setpoint; None: the record's.

    Raises:
        IdentificationError: the record does not tell the plant well enough for gains that keep the margin.
        PlantError, TuningError: there are no such gains.
    """
    draft = replace(draft_of(found, records, "Commissioned", step), sample_period=sample_period, ms=ms)
    case = case_of(draft, present)
    operated = replace(case, options=replace(options, manual=False, manual_effort=0.0))
    plants = drawn(found.problem, found.solution, DRAWN, seed)
    limit, worst = 1.0 + ALLOWED * (ms - 1.0), np.inf
    asked = ms
    for _ in range(TIGHTENED):
        problem = TuningProblem(
            case,
            controller,
            () if controller == "pid" else ("sigma",),
            seed=seed,
            constraints=Constraints(ms=asked),
            warm=True,
            until_converged=True,
        )
        study = Study(problem)
        study.run(Objective(problem))
        study.require_feasible()
        gains = study.result.gains
        worst = max(m_s_of(operated, plant, gains) for plant in plants)
        if worst <= limit:
            before, as_before = case.gains, replace(problem, controller=case.gains.type, extra=())
            values = Objective(as_before)(candidate_of(as_before, before)).objective
            return Design(
                found, draft, operated, gains, study.result.objective, float(values[0]),
                margins(operated, gains), margins(operated, before), worst, asked,
            )  # fmt: skip
        asked = 1.0 + (asked - 1.0) * max(min((limit - 1.0) / (worst - 1.0), 0.95), 0.5)
    raise IdentificationError(
        f"the plant is not known well enough: of {DRAWN} plants that the record allows, the worst has M_s {worst:.3g} "
        f"with the gains found, more than {limit:.3g}; make a larger experiment (--size), or a second one"
    )


def check_relay(found: Identified, record: Record) -> None:
    """Make sure that the model goes through the point that a relay's oscillation tells, if it tells one.

    Raises:
        IdentificationError: it does not.
    """
    stretch, point, shape = record.stretch, found.solution.point, found.solution.numerator
    told = relay_point(stretch.time, stretch.effort, stretch.output)
    if told is None:
        return
    plant = found.structure.transfer_function(point.shape, point.dead_time, shape)
    s = 2j * np.pi / told.period
    gain = abs(complex(np.polyval(plant.numerator, s) / np.polyval(plant.denominator, s)))
    if not 1.0 / RELAY_AGREES <= told.gain / gain <= RELAY_AGREES:
        raise IdentificationError(
            f"the relay's oscillation of {told.period:.4g} s tells a gain of {told.gain:.4g}, the model {gain:.4g}: "
            "the plant is not linear there; make a smaller experiment"
        )


def case_of(draft: Draft, present: Gains) -> Case:
    """The drafted file as a case, with the controller as it is now."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "commissioned.yaml"
        path.write_text(draft.text(), encoding="utf-8")
        case = load_case(path)
    low, high = case.gains.effort_min, case.gains.effort_max
    kept = present.with_values(effort_min=low, effort_max=high)
    if kept.type == "pid":
        kept = kept.with_values(sigma=case.gains.sigma)
    return replace(case, gains=kept)


def m_s_of(case: Case, plant: TransferFunction, gains: Gains) -> float:
    """M_s of the loop with another plant; infinite if it is unstable."""
    values = {
        name: value
        for name, value in case.plant_values.items()
        if name in ("effort_min", "effort_max", "output_offset", "effort_offset", "sample_period")
    }
    values |= {
        "numerator": [float(c) for c in plant.numerator],
        "denominator": [float(c) for c in plant.denominator],
        "dead_time": plant.dead_time,
    }
    try:
        found = margins(replace(case, model="transfer_function", plant_values=values), gains)
    except StabilityError:
        return float("inf")
    return float("inf") if found.m_s is None else found.m_s
