"""A bare rclpy node with one steady timer: `python -m benchmarks.bare_timer PERIOD SECONDS` prints p50 and p99 in
us."""

from __future__ import annotations

import sys
import time

WARM_UP = 1.0  # s; meanwhile it gets to know the other nodes


def run(period: float, seconds: float) -> None:
    """Spin the timer and print the percentiles of its period's error."""
    import numpy as np
    import rclpy
    from rclpy.clock import Clock, ClockType

    from tdof_npid_ros.graph.runtime.run import fastest_executor

    rclpy.init()
    node = rclpy.create_node("bare_timer")
    ticks: list[int] = []
    steady = Clock(clock_type=ClockType.STEADY_TIME)
    node.create_timer(period, lambda: ticks.append(time.monotonic_ns()), clock=steady)
    executor = fastest_executor()
    executor.add_node(node)
    for duration in (WARM_UP, seconds):
        ticks.clear()
        end = time.monotonic() + duration
        while time.monotonic() < end:
            executor.spin_once(timeout_sec=0.5)
    errors = np.abs(np.diff(ticks) - period * 1e9) / 1e3
    print(*np.percentile(errors, (50, 99)))
    rclpy.shutdown()


if __name__ == "__main__":
    run(float(sys.argv[1]), float(sys.argv[2]))
