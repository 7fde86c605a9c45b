"""Does time grow linearly with lanes, horizon and bag size?"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.harness import Curve, Result, Verdict, main, seconds
from benchmarks.writer import TOPIC, message, write_ours
from tdof_npid_ros.bag.reader import BagReader
from tdof_npid_ros.case import Case, load_case
from tdof_npid_ros.loop import integrals
from tdof_npid_ros.scenario import parse_plan

TITLE = "Growth of time with lanes, horizon and bag size"
METHOD = (
    "The in-process loop of Process 1 with more and more lanes (25 s of simulated time) and over longer and longer "
    "horizons (64 lanes), and the columns of larger and larger bags; the best of three each. The exponent is the slope "
    "of the line through the points in the logarithmic picture: 1 is linear growth."
)
PEERS: tuple[str, ...] = ()
NOTES: tuple[str, ...] = ()

UNLIMITED = (-np.inf, np.inf)
EXPONENT = 1.1


def run(size: str) -> Result:
    """Time each at growing sizes and fit the exponent of a power law."""
    full = size == "full"
    case = load_case("p1-c0.5")
    lanes = [64 * 2**i for i in range(7 if full else 2)]
    horizons = [50 * 2**i for i in range(7)] if full else [10, 20]
    messages = [20_000 * 2**i for i in range(7)] if full else [2_000, 4_000]
    result = Result()
    measured: tuple[tuple[str, str, list[int], Callable[[int], float]], ...] = (
        ("loop, more lanes", "lanes", lanes, lambda n: _loop(case, n, 25.0)),
        ("loop, longer horizon", "simulated s", horizons, lambda n: _loop(case, 64, float(n))),
        ("bag read into columns", "messages", messages, _bag),
    )
    for name, unit, sizes, timed in measured:
        times = [timed(n) for n in sizes]
        exponent = float(np.polyfit(np.log(sizes), np.log(times), 1)[0])
        result.curves.append(Curve(name, unit, [float(n) for n in sizes], times))
        result.verdicts.append(Verdict(f"{name}: exponent of time", exponent, EXPONENT, at_most=True))
    return result


def _best_of_three(function: Callable[[], object]) -> float:
    return min(seconds(function) for _ in range(3))


def _loop(case: Case, lanes: int, horizon: float) -> float:
    signals = parse_plan(["0 setpoint 1", f"{horizon} end"], case.sample_period_ns).sampled(case.sample_period_ns)
    gains = case.gains.with_values(kp=tuple(np.linspace(5.0, 9.0, lanes)))
    return _best_of_three(lambda: integrals(case.plant_at, gains, signals, UNLIMITED))


def _bag(messages: int) -> float:
    with tempfile.TemporaryDirectory() as folder:
        write_ours(Path(folder) / "bag", map(message, range(messages)))
        return _best_of_three(lambda: BagReader(Path(folder) / "bag").columns(TOPIC))


if __name__ == "__main__":
    main("growth")
