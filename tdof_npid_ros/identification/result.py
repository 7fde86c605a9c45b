"""What identification gives: a parameter file that every command takes, a report and a picture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tdof_npid_ros.draft import Draft, Process, significant
from tdof_npid_ros.identification.identify import Identified
from tdof_npid_ros.identification.records import Record
from tdof_npid_ros.plants.plant import PlantError
from tdof_npid_ros.responses import CLEAR_OF_NOISE

DIGITS = 7  # of the plant's parameters in the file
SMALLEST_STEP = 2.0**-6  # of the largest: a step that needs more effort than there is is halved, down to this


def process_of(found: Identified) -> Process:
    """The identified plant as the rules and the draft of a file know it."""
    v = found.values
    lags = tuple(v[name] for name in ("time_constant_1", "time_constant_2") if name in v)
    oscillation = None
    if found.structure.name == "unstable_first_order":
        lags = (-v["time_constant"],)
    elif "natural_period" in v:
        oscillation = (v["natural_period"] / (2.0 * math.pi), v["damping"])
    elif "time_constant" in v:
        lags = (v["time_constant"],) * (found.structure.order - found.structure.integrating)
    return Process(
        v["gain"], lags, v["dead_time"], v.get("zero_time_constant", 0.0), found.structure.integrating, oscillation
    )


def draft_of(found: Identified, records: Sequence[Record], title: str, step: float | None = None) -> Draft:
    """A parameter file with the plant, and all else from the record's own scales.

    Args:
        step: the largest change of the setpoint; None: the record's.

    Raises:
        PlantError, TuningError: no file can be made of it.
    """
    process = process_of(found)
    values = {name: significant(value, DIGITS) for name, value in found.values.items()}
    catalogued = found.structure.catalogued(values)
    plant: dict[str, Any] = {"model": catalogued[0], **catalogued[1]} if catalogued else process.transfer_function()
    plant = {k: [significant(c, DIGITS) for c in v] if isinstance(v, list) else v for k, v in plant.items()}
    plant["dead_time"] = values["dead_time"]
    at, effort = (
        significant(_settled(found.level, found), 5),
        significant(_settled(found.effort_level, found, effort=True), 5),
    )
    if at or effort:
        plant |= {"output_offset": at, "effort_offset": effort}
    period = round(min(stretch.period for stretch in found.problem.stretches), 9)
    low, high = max(r.limits[0] for r in records), min(r.limits[1] for r in records)
    notes = [
        f"{found.reason}.",
        f"{found.fit_percent:.1f} % fit on data not used; noise {found.noise:.3g} (standard deviation).",
        *(f"{name}: {i.value:.5g}, 95 % between {i.low:.5g} and {i.high:.5g}" for name, i in found.parameters.items()),
    ]
    largest = _largest_step(records, found.noise) if step is None else step
    step = largest
    while True:
        for signed in (step, -step):  # where the actuator is one-sided, only one way may be open
            try:
                return Draft(
                    process,
                    plant,
                    signed,
                    at,
                    effort,
                    (low, high),
                    sample_period=period,
                    title=title,
                    notes=tuple(notes),
                )
            except PlantError:
                if abs(step) < SMALLEST_STEP * abs(largest):
                    raise
        step = significant(0.5 * step, 3)


def _settled(value: float, found: Identified, effort: bool = False) -> float:
    """A level as it is, or 0 where the record does not tell it from 0."""
    scale = max(float(np.ptp(s.effort if effort else s.output)) for s in found.problem.stretches)
    least = 1e-6 * scale if effort else max(1e-6 * scale, 2.0 * found.noise / math.sqrt(found.solution.count))
    return 0.0 if abs(value) < least else value


def _largest_step(records: Sequence[Record], noise: float) -> float:
    """The largest change of the setpoint; of the output, where no setpoint is known or moves.

    A record that begins at rest begins with a change from there, as far as it is clear of the output's noise.
    """
    steps = [
        np.diff(r.setpoint[np.isfinite(r.setpoint)], prepend=r.stretch.output[0] if r.stretch.at_rest else np.nan)
        for r in records
    ]
    sizes = np.abs(np.concatenate(steps))
    least = max(CLEAR_OF_NOISE * noise, 1e-6 * max(float(np.ptp(r.stretch.output)) for r in records))
    sizes = sizes[np.isfinite(sizes)]
    sizes[sizes <= least] = 0.0
    largest = float(sizes.max(initial=0.0))
    if largest > 0.0 and np.sum(sizes > 0.5 * largest) <= 0.05 * len(sizes):
        return significant(largest, 3)
    return significant(0.5 * max(float(np.ptp(r.stretch.output)) for r in records), 2)


def as_json(found: Identified, draft: Draft | None) -> dict[str, Any]:
    """One JSON object of all that was found."""
    report: dict[str, Any] = {
        "structure": found.structure.name,
        "reason": found.reason,
        "parameters": {name: {"value": i.value, "low": i.low, "high": i.high} for name, i in found.parameters.items()},
        "fit_percent": found.fit_percent,
        "noise": found.noise,
        "noise_model": found.noise_model.tolist(),
        "residual_correlation": found.residual_correlation,
        "residual_bound": found.residual_bound,
        "operating_point": {"output": found.level, "effort": found.effort_level},
        "loads": [{"stretch": load.stretch + 1, "time_s": load.time, "size": load.size} for load in found.loads],
        "candidates": [{"structure": c.structure, "aicc": c.criterion, "loads": c.loads} for c in found.candidates],
        "samples": sum(len(s.time) for s in found.problem.stretches),
        "compared_on_averages_of": found.averaged,
    }
    if draft is not None:
        gains = draft.process.first_gains(draft.period)
        report |= {
            "sample_period": draft.period,
            "first_gains": {n: getattr(gains, n) for n in ("rule", "kp", "ki", "kd")},
        }
    return report


def table(found: Identified) -> str:
    """What was found, for people."""
    integrating = found.structure.integrating
    lines = [found.reason, f"  {'parameter':20} {'value':>12} {'95 % from':>12} {'to':>12}"]
    for name, i in found.parameters.items():
        unit = {"gain": "output/(effort s)" if integrating else "output/effort", "damping": ""}.get(name, "s")
        lines.append(f"  {name:20} {i.value:12.6g} {i.low:12.6g} {i.high:12.6g}  {unit}")
    lines.append(f"  rests at output {found.level:.5g} with effort {found.effort_level:.5g}")
    for load in found.loads:
        where = f"at {load.time:.4g} s of stretch {load.stretch + 1}"
        lines.append(f"  load step of {load.size:.4g} (as an effort) {where}")
    lines.append(f"  fit {found.fit_percent:.1f} % on data not used for it; noise {found.noise:.3g}")
    white = "white" if found.residual_correlation <= found.residual_bound else "not white"
    model = f" after a noise model of {len(found.noise_model)} lags" if len(found.noise_model) else ""
    lines.append(
        f"  what is left is {white}{model}: largest correlation {found.residual_correlation:.3f}, "
        f"bound {found.residual_bound:.3f}"
    )
    others = ", ".join(f"{c.structure} +{c.criterion:.0f}" for c in found.candidates[1:5])
    lines.append(f"  AICc: {found.candidates[0].structure} best{', ' + others if others else ''}")
    return "\n".join(lines)


def draw(found: Identified, records: Sequence[Record], path: Path) -> None:
    """The picture: measured and predicted, residuals, effort; one column for each stretch, four at the most.

    Raises:
        PlottingError: the file cannot be written.
    """
    from tdof_npid_ros.plotting import GUIDE, new_figure, save, style

    shown = sorted(range(len(records)), key=lambda i: -float(np.ptp(records[i].stretch.effort)))[:4]
    shown.sort()
    figure, axes = new_figure(3, len(shown), height=2.2)
    for column, i in enumerate(shown):
        stretch, residual = found.problem.stretches[i], found.residuals[i]
        every = max(1, len(stretch.time) // 4000)
        t, part = stretch.time[::every], slice(None, None, every)
        top, middle, bottom = (axes[row][column] for row in range(3))
        top.plot(t, stretch.output[part], label="measured", color="#b0b0b0", linewidth=3.0)
        top.plot(t, (stretch.output - residual)[part], label="predicted", **style(0))
        setpoint = records[i].setpoint
        if np.isfinite(setpoint).any():
            top.plot(
                t, setpoint[part], label="setpoint", color=GUIDE, linestyle=":", drawstyle="steps-post", linewidth=1.0
            )
        middle.plot(t, residual[part], color=style(1)["color"], linewidth=0.8)
        bottom.plot(t, stretch.effort[part], color=style(2)["color"], drawstyle="steps-post", linewidth=1.2)
        for load in found.loads:
            if load.stretch == i:
                top.axvline(
                    load.time + found.values["dead_time"], color=GUIDE, linewidth=0.9, linestyle="--", label="load step"
                )
        top.set_title(records[i].name, fontsize=10, loc="left")
        bottom.set_xlabel("time (s)")
    axes[0][0].legend(frameon=False, fontsize=8)
    for row, label in enumerate(("output y", "residual", "effort u")):
        axes[row][0].set_ylabel(label)
    figure.suptitle(f"{found.structure.text}: fit {found.fit_percent:.1f} %", fontsize=11)
    save(figure, path)
