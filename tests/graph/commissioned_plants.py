"""Twenty plants to commission: what the true ones are, and how their loops run before."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any


class Tank:
    """A tank with a square-root outflow; y is its level, u the inflow in per cent."""

    parameters = {"area": 10.0, "outflow": 5.0}  # noqa: RUF012  as users write it
    initial_state = (1.0,)

    @staticmethod
    def derivative(x: Any, u: Any, d: Any, p: Any) -> Any:
        return ((0.1 * (u + d) - p[1] * math.sqrt(max(x[0], 1e-9))) / p[0],)

    @staticmethod
    def output(x: Any, p: Any) -> Any:
        return x[0]


@dataclass(frozen=True)
class Loop:
    """A plant with the controller that it has before.

    Attributes:
        plant: the plant node's parameters.
        gains: kp and ki before.
        start: the output at rest.
        safe: range of the output.
        sigma: the largest change of the setpoint.
        effort: limits.
        period, speed: s and times.
        by_hand: the loop is in manual mode before.
    """

    plant: dict[str, Any]
    gains: tuple[float, float]
    start: float
    safe: tuple[float, float]
    sigma: float
    effort: tuple[float, float] = (-10.0, 10.0)
    period: float = 0.2
    speed: float = 20.0
    by_hand: bool = False
    more: tuple[str, ...] = field(default=())


def first(gain: float, lag: float, dead_time: float, **more: float) -> dict[str, Any]:
    return {"model": "first_order", "gain": gain, "time_constant": lag, "dead_time": dead_time, **more}


def transfer(numerator: list[float], denominator: list[float], dead_time: float = 0.0, **more: float) -> dict[str, Any]:
    model = {"model": "transfer_function", "numerator": numerator, "denominator": denominator}
    return {**model, "dead_time": dead_time, **more}


PER_CENT = (0.0, 100.0)
LOOPS = {
    "heater": Loop(
        first(0.8, 30.0, 5.0, output_offset=20.0, noise=0.05), (1.5, 0.05), 50.0, (30.0, 75.0), 10.0, PER_CENT
    ),
    "heater by hand": Loop(
        first(1.2, 20.0, 2.0, output_offset=20.0, noise=0.05), (1.0, 0.05), 60.0, (30.0, 90.0), 10.0, PER_CENT,
        speed=50.0, by_hand=True,
    ),
    "oven": Loop(
        {"model": "second_order", "gain": 1.5, "time_constant": 15.0, "dead_time": 4.0, "output_offset": 25.0,
         "noise": 0.1},
        (0.6, 0.02), 70.0, (30.0, 110.0), 15.0, PER_CENT,
    ),
    "lag dominant": Loop(first(2.0, 60.0, 2.0, noise=0.002), (2.0, 0.05), 0.0, (-3.0, 3.0), 1.0, speed=40.0),
    "dead time dominant": Loop(first(1.0, 5.0, 15.0, noise=0.005), (0.1, 0.02), 0.0, (-3.0, 3.0), 1.0),
    "motor": Loop(transfer([1.5], [2.0, 1.0, 0.0], quantum=0.001), (0.2, 0.01), 0.0, (-3.0, 3.0), 1.0,
                  (-12.0, 12.0)),
    "integrator": Loop(transfer([0.05], [1.0, 0.0], 4.0, noise=0.005), (1.0, 0.01), 0.0, (-3.0, 3.0), 1.0),
    "level by hand": Loop(
        transfer([0.002], [1.0, 0.0], 2.0, noise=0.002, effort_offset=40.0), (20.0, 0.2), 1.0, (0.2, 2.5), 0.5,
        PER_CENT, speed=40.0, by_hand=True,
    ),
    "tank": Loop({"model": "commissioned_plants:Tank", "noise": 0.002}, (40.0, 2.0), 1.0, (0.4, 1.8), 0.2, PER_CENT),
    "inverse response": Loop(
        {"model": "third_order", "gain": 1.0, "time_constant": 5.0, "zero_time_constant": 3.0, "noise": 0.003},
        (0.3, 0.02), 0.0, (-3.0, 3.0), 1.0, speed=40.0,
    ),
    "strong inverse response": Loop(
        {"model": "third_order", "gain": 2.0, "time_constant": 8.0, "zero_time_constant": 8.0, "noise": 0.003},
        (0.1, 0.006), 0.0, (-3.0, 3.0), 1.0,
    ),
    "paper 1": Loop(first(1.0, 5.0, 0.5), (2.0, 0.3), 0.0, (-3.0, 3.0), 1.0, (-50.0, 50.0), 0.1, 10.0),
    "paper 2": Loop(
        {"model": "second_order", "gain": 1.0, "time_constant": 2.0, "dead_time": 1.0}, (0.5, 0.1), 0.0,
        (-3.0, 3.0), 1.0,
        (-50.0, 50.0), 0.1, 10.0,
    ),
    "paper 3": Loop(
        {"model": "third_order", "gain": 1.0, "time_constant": 1.0, "zero_time_constant": 1.0}, (0.2, 0.1), 0.0,
        (-3.0, 3.0), 1.0, (-50.0, 50.0), 0.05, 5.0,
    ),
    "swinging": Loop(transfer([1.0], [9.0, 1.8, 1.0], 1.0, noise=0.003), (0.1, 0.03), 0.0, (-3.0, 3.0), 1.0),
    "two lags": Loop(transfer([2.0], [100.0, 25.0, 1.0], 2.0, noise=0.005), (0.8, 0.03), 0.0, (-4.0, 4.0), 1.0),
    "lead": Loop(transfer([4.0, 1.0], [60.0, 16.0, 1.0], 0.4, noise=0.003), (1.0, 0.1), 0.0, (-3.0, 3.0), 1.0),
    "five lags": Loop(
        transfer([1.0], [243.0, 405.0, 270.0, 90.0, 15.0, 1.0], noise=0.003), (0.3, 0.02), 0.0, (-3.0, 3.0), 1.0
    ),
    "unstable": Loop(
        transfer([1.0], [10.0, -1.0], 1.0, noise=0.002), (4.0, 0.1), 0.0, (-3.0, 3.0), 0.5, (-20.0, 20.0)
    ),
    "reverse": Loop(
        first(-2.0, 12.0, 3.0, output_offset=150.0, noise=0.1), (-0.5, -0.03), 50.0, (0.0, 100.0), 10.0, PER_CENT
    ),
}  # fmt: skip
QUICK = ("heater by hand", "motor", "tank", "integrator", "inverse response")
