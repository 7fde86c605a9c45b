"""The models that are fitted are the plants that the loop runs with."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tdof_npid_ros.identification.fit import Problem, Stretch
from tdof_npid_ros.identification.structures import STRUCTURES
from tdof_npid_ros.plants.simulator import PlantSimulator

SHAPES: dict[str, list[float]] = {
    "integrator": [],
    "first_order": [math.log(3.0)],
    "second_order_equal": [math.log(2.0)],
    "integrator_lag": [math.log(2.0)],
    "unstable_first_order": [math.log(30.0)],
    "second_order": [math.log(2.0), math.log(0.4)],
    "third_order_zero": [math.log(1.0)],
    "second_order_zero": [math.log(2.0), math.log(1.4)],
}
PERIOD, DEAD_TIME, LOAD = 0.05, 1.23, 0.7


def recorded(name: str, samples: int = 600, load_from: int | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Effort and output of a plant of each structure, stepped as the plant node steps it."""
    structure = STRUCTURES[name]
    numerator = np.array([2.0, 0.7][: structure.numerators])
    plant = structure.transfer_function(np.array(SHAPES[name]), DEAD_TIME, numerator)
    k = np.arange(samples)
    effort = np.where(k < 40, 0.0, np.where(k < 300, 1.0, -0.5)) + 0.2 * np.sin(0.05 * k)
    simulator = PlantSimulator(plant, round(PERIOD * 1e9), 1, (-math.inf, math.inf))
    output = np.zeros(samples)
    for i in range(samples):
        output[i] = simulator.output[0]
        disturbance = LOAD if load_from is not None and i >= load_from else 0.0
        simulator.advance(effort[i : i + 1], np.full(1, disturbance))
    return effort, output


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("even", [True, False])
@pytest.mark.parametrize("load_from", [None, 200])
def test_the_model_at_the_truth_leaves_no_residual(name: str, even: bool, load_from: int | None) -> None:
    effort, output = recorded(name, load_from=load_from)
    time = PERIOD * np.arange(len(effort))
    problem = Problem(STRUCTURES[name], [Stretch(time, effort, output, False, 0.0, even)], (load_from is not None,))
    point = problem.unloaded()
    load_time = np.inf if load_from is None else load_from * PERIOD + DEAD_TIME
    point = type(point)(np.array(SHAPES[name]), DEAD_TIME, np.array([load_time]), np.array([LOAD]))
    solution = problem.solved(point)
    assert solution.numerator == pytest.approx([2.0, 0.7][: len(solution.numerator)], rel=1e-6)
    assert np.abs(problem.residuals(solution)[0]).max() < 1e-7 * np.ptp(output)


@pytest.mark.parametrize("name", SHAPES)
def test_a_record_without_even_stamps_is_fitted_as_exactly(name: str) -> None:
    """Every third output is missing, and the next stamp of each is late: the effort is held all the same."""
    effort, _ = recorded(name)
    kept = np.flatnonzero(np.arange(len(effort)) % 3 != 1)
    time = PERIOD * kept
    held = np.repeat(effort[kept], np.diff(kept, append=kept[-1] + 1))
    assert len(held) == len(effort)
    structure = STRUCTURES[name]
    plant = structure.transfer_function(np.array(SHAPES[name]), DEAD_TIME, np.array([2.0, 0.7][: structure.numerators]))
    simulator = PlantSimulator(plant, round(PERIOD * 1e9), 1, (-math.inf, math.inf))
    outputs = []
    for u in held:
        outputs.append(float(simulator.output[0]))
        simulator.advance(np.array([u]), np.zeros(1))
    problem = Problem(structure, [Stretch(time, effort[kept], np.array(outputs)[kept], False, 0.0, False)], (False,))
    start = problem.unloaded()
    start = type(start)(np.array(SHAPES[name]) + 0.05, 1.3, start.load_time, start.load)
    solution = problem.refined(start)
    assert solution.point.dead_time == pytest.approx(DEAD_TIME, rel=1e-4)
    assert solution.point.shape == pytest.approx(SHAPES[name], abs=1e-4)
