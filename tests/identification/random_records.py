"""Random records with a known truth: plants of every structure, in open and closed loop."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from tdof_npid_ros.control.controller import Controller
from tdof_npid_ros.control.gains import Gains
from tdof_npid_ros.identification.structures import STRUCTURES, Structure
from tdof_npid_ros.plants.simulator import PlantSimulator
from tdof_npid_ros.tuning.rules import RuleGains, imc_oscillating, simc, unstable_first_order

KINDS = ("first_order", "second_order", "underdamped", "zero", "integrator", "unstable")
SAMPLES = 2000


@dataclass(frozen=True)
class RandomRecord:
    """What was recorded, and what is true."""

    kind: str
    structure: Structure
    parameters: dict[str, float]
    period: float
    closed: bool
    loaded: bool
    effort: np.ndarray
    output: np.ndarray
    noise: float


def random_record(seed: int, noise: float, kind: str | None = None, samples: int = SAMPLES) -> RandomRecord:
    """A record of `samples`; `noise` is the standard deviation of the output's noise over the step that it makes."""
    rng = np.random.default_rng(seed)
    kind = kind or KINDS[seed % len(KINDS)]
    period = 10.0 ** rng.uniform(-3.0, 0.5)
    t = period * rng.uniform(15.0, 60.0)
    dead_time = t * 10.0 ** rng.uniform(math.log10(0.05), math.log10(5.0))
    gain = 10.0 ** rng.uniform(-1.5, 1.5) * rng.choice([-1.0, 1.0])
    closed = kind == "unstable" or bool(rng.random() < 0.5)
    numerator = np.array([gain])
    if kind == "first_order":
        structure, shape = STRUCTURES["first_order"], [math.log(t)]
        rule = simc(gain, [t], dead_time, sample_period=period)
    elif kind == "integrator":
        structure, shape = STRUCTURES["integrator"], []
        numerator = np.array([gain / t])
        rule = simc(gain / t, [], dead_time, integrating=True, sample_period=period)
    elif kind == "unstable":
        dead_time = t * rng.uniform(0.05, 0.5)
        structure, shape = STRUCTURES["unstable_first_order"], [math.log(t)]
        rule = unstable_first_order(gain, t, dead_time, sample_period=period)
    else:
        dead_time *= 0.4 if kind == "zero" else 1.0
        damping = rng.uniform(0.15, 0.7) if kind == "underdamped" else rng.uniform(1.0, 1.5)
        structure, shape = STRUCTURES["second_order"], [math.log(t), math.log(damping)]
        zero = 0.0
        if kind == "zero":
            structure = STRUCTURES["second_order_zero"]
            zero = t * (rng.uniform(3.2, 5.0) if rng.random() < 0.5 else -rng.uniform(0.7, 2.0))  # cancels no lag
            numerator = np.array([gain, gain * zero / t])
        if damping < 1.0:
            rule = imc_oscillating(gain, t, damping, dead_time, sample_period=period)
        else:
            root = math.sqrt(damping**2 - 1.0)
            lags = [t * (damping + root), t * (damping - root)]
            rule = simc(gain, lags, dead_time + abs(zero), sample_period=period)
    plant = structure.transfer_function(np.array(shape), dead_time, numerator)
    parameters = structure.physical(np.array(shape), dead_time, numerator)
    loaded = bool(rng.random() < 0.5)
    load_at = int(rng.uniform(0.3, 0.9) * samples) if loaded else samples
    step = 1.0 / abs(gain)  # of the effort, for an output of 1
    load = step * rng.uniform(0.2, 0.6) * rng.choice([-1.0, 1.0])
    limits = (-math.inf, math.inf)
    if rng.random() < 0.3:
        limits = (-1.4 * step, 1.4 * step) if kind != "unstable" else (-12.0 * step, 12.0 * step)
    quantum = step / 20.0 if rng.random() < 0.3 else 0.0
    standard_deviation = noise * 1.0
    noises = standard_deviation * rng.standard_normal(samples)
    reference = _steps(rng, samples, round((3.0 * t + dead_time) / period))
    if kind == "integrator" and not closed:
        reference = _bumps(rng, samples)
    simulator = PlantSimulator(plant, round(period * 1e9), 1, limits)
    controller = _controller(rule, rng, round(period * 1e9)) if closed else None
    effort, output = np.zeros(samples), np.zeros(samples)
    for k in range(samples):
        output[k] = simulator.output[0] + noises[k]
        if controller is not None:
            controller.answer(k * round(period * 1e9), np.array([reference[k]]), np.array([output[k]]))
            wanted = float(controller.effort[0])
        else:
            wanted = reference[k] * step
        if quantum:
            wanted = quantum * round(wanted / quantum)
        disturbance = load if k >= load_at else 0.0
        simulator.advance(np.array([wanted]), np.array([disturbance]))
        effort[k] = simulator.applied_effort[0]
    return RandomRecord(kind, structure, parameters, period, closed, loaded, effort, output, standard_deviation)


def _controller(rule: RuleGains, rng: np.random.Generator, period_ns: int) -> Controller:
    factor = rng.uniform(0.6, 1.0) if "De Paor" not in rule.rule else 1.0
    return Controller(Gains("pid", factor * rule.kp, factor * rule.ki, factor * rule.kd), period_ns)


def _steps(rng: np.random.Generator, samples: int, hold: int) -> np.ndarray:
    values = np.zeros(samples)
    at = int(rng.uniform(0.02, 0.1) * samples)
    level = 0.0
    while at < samples:
        level = rng.uniform(0.6, 1.2) * (-1.0 if level > 0 else 1.0)
        values[at:] = level
        at += max(int(hold * rng.uniform(0.7, 2.0)), samples // 12)
    return values


def _bumps(rng: np.random.Generator, samples: int) -> np.ndarray:
    values = np.zeros(samples)
    at = int(rng.uniform(0.02, 0.1) * samples)
    sign = 1.0
    while at < samples:
        width = int(rng.uniform(0.03, 0.1) * samples)
        values[at : at + width] = sign * rng.uniform(0.6, 1.2)
        values[at + width : at + 2 * width] = -values[at]
        at += 2 * width + int(rng.uniform(0.02, 0.1) * samples)
        sign = -sign
    return values
