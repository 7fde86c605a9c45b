"""Does time grow linearly with lanes, horizon and bag size?"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.harness import Result, Verdict, main, summary
from tdof_npid_ros.bag.reader import BagReader
from tdof_npid_ros.bag.writer import BagWriter
from tdof_npid_ros.case import load_case
from tdof_npid_ros.loop import integrals
from tdof_npid_ros.scenario import parse_plan

QUESTION = "Growth of time with lanes, horizon and bag size"
UNLIMITED = (-np.inf, np.inf)


def run(size: str) -> Result:
    """Time each at growing sizes and fit the exponent of a power law."""
    full = size == "full"
    result = Result(QUESTION)
    case = load_case("p1-c0.5")
    lanes = (64, 256, 1024, 4096) if full else (64, 128)
    horizons = (50, 200, 800, 3200) if full else (10, 20)
    messages = (20_000, 80_000, 320_000, 1_280_000) if full else (2_000, 4_000)
    for name, unit, sizes, timed in (
        ("lanes, 25 s horizon", "lanes", lanes, lambda n: _loop(case, n, 25.0)),
        ("horizon, 64 lanes", "s", horizons, lambda n: _loop(case, 64, float(n))),
        ("bag read into columns", "messages", messages, _bag),
    ):
        times = [timed(n) for n in sizes]
        exponent = float(np.polyfit(np.log(sizes), np.log(times), 1)[0])
        for n, seconds in zip(sizes, times, strict=True):
            result.rates.append(summary(f"{name}: {n} {unit}", "s", [seconds]))
        result.verdicts.append(Verdict(f"exponent of time over {name}", exponent, 1.1, at_most=True))
    return result


def _best_of_three(function: object) -> float:
    times = []
    for _ in range(3):
        start = time.perf_counter()
        function()  # type: ignore[operator]
        times.append(time.perf_counter() - start)
    return min(times)


def _loop(case: object, lanes: int, seconds: float) -> float:
    period_ns = case.sample_period_ns  # type: ignore[attr-defined]
    signals = parse_plan(["0 setpoint 1", f"{seconds} end"], period_ns).sampled(period_ns)
    base = case.gains  # type: ignore[attr-defined]
    gains = base.with_values(kp=tuple(np.linspace(5.0, 9.0, lanes)))
    return _best_of_three(lambda: integrals(case.plant_at, gains, signals, UNLIMITED))  # type: ignore[attr-defined]


def _bag(messages: int) -> float:
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    types = store.types
    stamp = types["builtin_interfaces/msg/Time"](sec=0, nanosec=0)
    header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="0123456789ab/1")
    value = np.array([0.5])
    message = types["sensor_msgs/msg/JointState"](
        header=header, name=[], position=value, velocity=np.zeros(0), effort=value
    )
    data = bytes(store.serialize_cdr(message, "sensor_msgs/msg/JointState"))
    with tempfile.TemporaryDirectory() as folder:
        with BagWriter(Path(folder) / "bag") as writer:
            topic = writer.add_topic("/output", "sensor_msgs/msg/JointState")
            for k in range(messages):
                writer.write(topic, data, k * 1000, k * 1000, k)
        return _best_of_three(lambda: BagReader(Path(folder) / "bag").columns("/output"))


if __name__ == "__main__":
    main(run)
