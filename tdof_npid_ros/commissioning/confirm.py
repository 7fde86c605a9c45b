"""A confirming step: what the model predicts of it, and how far that is from what was measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tdof_npid_ros.case import Case
from tdof_npid_ros.commissioning.design import Design
from tdof_npid_ros.control.gains import Gains
from tdof_npid_ros.loop import Trajectory
from tdof_npid_ros.plants.linear import TransferFunction

AT_REST = 0.02  # of the step: a response that stays so near to the setpoint has settled
ROOM = 1.3  # a confirming step lasts so many times longer
LEAST_SAMPLES = 100
LARGEST_MISS = 0.1  # of the step: rms of measured less predicted, beyond the noise
OFF = 0.1  # of the step: the output must end as near to the setpoint


@dataclass(frozen=True)
class Confirmed:
    """A step as it was measured, beside the prediction.

    Attributes:
        time: s, from the step on, (samples,).
        setpoint, output, effort: measured, (samples,).
        predicted: of the same times.
        miss: rms of measured less predicted, as a fraction of the step; the noise is taken off.
        off: distance of the output from the setpoint at the end, as a fraction of the step.
        overshoot, overshoot_predicted: as fractions of the step.
        reason: why it is not as predicted; empty if it is.
    """

    time: np.ndarray
    setpoint: np.ndarray
    output: np.ndarray
    effort: np.ndarray
    predicted: Trajectory
    miss: float
    off: float
    overshoot: float
    overshoot_predicted: float
    reason: str


def predicted_step(
    design: Design, gains: Gains, rest: tuple[float, float], setpoint: float, target: float, length: float
) -> Trajectory:
    """A step of the setpoint about where the loop rests now, by the model.

    Args:
        rest: output and effort there.
        setpoint, target: before and after the step.
        length: s.
    """
    case = design.case
    plant = {**case.plant_values, "output_offset": rest[0], "effort_offset": rest[1]}
    lines = (f"0 start {rest[0]!r}", f"0 setpoint {target!r}", f"{length!r} end")
    anchored: Case = replace(case, plant_values=plant, episodes={"step": lines})
    assert isinstance(anchored.plant, TransferFunction)
    return anchored.simulate("step", gains)


def settling_time(design: Design, size: float) -> float:
    """How long a step of the setpoint, about where the model rests, is watched, s."""
    plant = design.case.plant
    assert isinstance(plant, TransferFunction)
    rest = plant.output_offset, plant.effort_offset
    run = predicted_step(design, design.gains, rest, rest[0], rest[0] + size, design.horizon)
    away = np.flatnonzero(np.abs(run.output[:, 0] - run.setpoint) > AT_REST * abs(size))
    last = int(away[-1]) if away.size else 0
    return max(ROOM * float(run.time[last]), LEAST_SAMPLES * design.case.sample_period)


def confirmed(
    design: Design,
    time: Sequence[float],
    setpoint: Sequence[float],
    output: Sequence[float],
    effort: Sequence[float],
    rest: tuple[float, float],
    noise: float,
) -> Confirmed:
    """Compare a measured step, from its first sample on, with its prediction."""
    t, y, r, u = (np.array(values, dtype=float) for values in (time, output, setpoint, effort))
    t = t - t[0]
    h = design.case.sample_period
    size = float(r[-1] - rest[0])
    steps = max(int(np.ceil(t[-1] / h)) + 1, 2)
    trajectory = predicted_step(design, design.gains, rest, rest[0], float(r[-1]), round(steps * h, 9))
    model = np.interp(t, trajectory.time, trajectory.output[:, 0])
    rms = float(np.sqrt(max(np.mean((y - model) ** 2) - noise**2, 0.0)))
    tail = y[-max(len(y) // 10, 1) :]
    off = abs(float(tail.mean()) - float(r[-1])) / abs(size)
    over, over_model = (
        max(float(np.max(values * np.sign(size))) - r[-1] * np.sign(size), 0.0) / abs(size)
        for values in (y - 3.0 * noise * np.sign(size), model)
    )
    miss, reason = rms / abs(size), ""
    if miss > LARGEST_MISS:
        reason = f"measured and predicted differ by {miss:.0%} of the step (rms), more than {LARGEST_MISS:.0%}"
    elif off > OFF + 3.0 * noise / abs(size):
        reason = f"the output has not come nearer to the setpoint than {off:.0%} of the step"
    return Confirmed(t, r, y, u, trajectory, miss, off, float(over), float(over_model), reason)
