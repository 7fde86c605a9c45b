"""What the law is given instead of the raw setpoint and output, and the limits that its effort has at this sample."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from tdof_npid_ros.compiled import compiled, entry_point
from tdof_npid_ros.control.law import exp_minus_of
from tdof_npid_ros.control.options import ControllerOptions

# Rows of the state: the shaped setpoint, the filtered output and the effort of the sample before.
(SETPOINT, OUTPUT, EFFORT) = range(3)
STATES = 3


class Shape(NamedTuple):
    """Options as the compiled function reads it: steps are per sample, the filter's gain is 1 without filter."""

    setpoint_min: float
    setpoint_max: float
    setpoint_step: float
    filter_gain: float
    dead_band: float
    turn: float  # 2 pi for angles, else 0
    effort_step: float


def shape_of(options: ControllerOptions, sample_period: float) -> Shape:
    """The shape of options that are sampled every `sample_period` seconds."""
    t = options.filter_time
    return Shape(
        options.setpoint_min,
        options.setpoint_max,
        options.setpoint_rate * sample_period,
        1.0 - exp_minus_of(sample_period / t) if t > 0 else 1.0,
        options.dead_band,
        options.turn,
        options.effort_rate * sample_period,
    )


@compiled
def shorter_way(difference: float, turn: float) -> float:
    """A difference of angles within half a turn; any difference if `turn` is 0."""
    return difference - turn * math.floor(difference / turn + 0.5) if turn > 0.0 else difference


@entry_point
def shape_lanes(
    shape: Shape,
    r: np.ndarray,
    y: np.ndarray,
    u_min: np.ndarray,
    u_max: np.ndarray,
    state: np.ndarray,
    shaped: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
) -> None:
    """Shape one sample of every lane.

    Args:
        r, y: setpoint and output, (lanes,).
        u_min, u_max: limits of the effort at any sample, (lanes,).
        state: (STATES, lanes); setpoint and output advance, the effort is for the caller to write.
        shaped: setpoint and output for the law, (2, lanes); written.
        low, high: limits of the effort at this sample, (lanes,); written.
    """
    r_min, r_max, r_step, filter_gain, band, turn, u_step = shape
    for j in range(r.shape[0]):
        target = min(max(r[j], r_min), r_max)
        way = shorter_way(target - state[SETPOINT, j], turn)
        if turn > 0.0:
            target = state[SETPOINT, j] + way
        if abs(way) > r_step:
            target = state[SETPOINT, j] + math.copysign(r_step, way)
        state[SETPOINT, j] = target

        measured = y[j]
        if filter_gain < 1.0:
            measured = state[OUTPUT, j] + filter_gain * shorter_way(measured - state[OUTPUT, j], turn)
        state[OUTPUT, j] = measured
        if turn > 0.0:
            measured = target - shorter_way(target - measured, turn)
        if band > 0.0:
            error = target - measured
            measured = target if abs(error) <= band else measured + math.copysign(band, error)
        shaped[0, j] = target
        shaped[1, j] = measured

        low[j] = min(max(u_min[j], state[EFFORT, j] - u_step), u_max[j])
        high[j] = max(min(u_max[j], state[EFFORT, j] + u_step), u_min[j])
