"""How a process keeps time: ROS time that is never set, percentiles of the latest durations, and what the system allows
a realtime loop."""

from __future__ import annotations

import gc
import os
from pathlib import Path

import numpy as np

LATEST = 4096  # durations that the percentiles are of
PERCENTILES = {"p50": 0.5, "p99": 0.99, "max": 1.0}


class SteadyRosTime:
    """ROS time as it was at the beginning, going on with the steady clock: no setting of the wall clock moves it.

    Args:
        ros_ns, steady_ns: both clocks now, ns.
        speed: times as fast as the steady clock.
    """

    def __init__(self, ros_ns: int, steady_ns: int, speed: float = 1.0) -> None:
        self._ros_ns, self._steady_ns, self._speed = ros_ns, steady_ns, speed

    def at(self, steady_ns: int) -> int:
        """ROS time, ns, at a time of the steady clock."""
        passed_ns = steady_ns - self._steady_ns
        return self._ros_ns + (passed_ns if self._speed == 1.0 else round(passed_ns * self._speed))


class LatestTimes:
    """The latest durations, in ns."""

    def __init__(self) -> None:
        self._times = np.zeros(LATEST, dtype=np.int64)
        self._count = 0

    def add(self, duration_ns: int) -> None:
        """Note a duration."""
        self._times[self._count % LATEST] = duration_ns
        self._count += 1

    def facts(self, name: str) -> dict[str, object]:
        """Percentiles in microseconds, for the diagnostics."""
        if not self._count:
            return {}
        times = np.sort(
            self._times[: self._count]
        )  # np.percentile takes ten times as long when it is not in the caches
        last = len(times) - 1
        return {
            f"{name}_{key}_us": f"{times[round(fraction * last)] / 1e3:.1f}" for key, fraction in PERCENTILES.items()
        }


def prepare_for_realtime(priority: int, cpu: int) -> list[str]:
    """Keep the garbage collector out of the loop and take the priority and processor asked for.

    Args:
        priority: of SCHED_FIFO, 1 to 99; 0: as it is.
        cpu: number of the processor to stay on; -1: any.

    Returns:
        What the system did not allow, one line each, with the remedy.
    """
    gc.collect()
    gc.freeze()
    gc.disable()
    refusals = []
    threads = [int(path.name) for path in Path("/proc/self/task").iterdir()]
    if priority:
        try:
            for thread in threads:
                os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(priority))
        except OSError as error:
            refusals.append(
                f"priority {priority} not taken ({error.strerror}): allow it with `rtprio 99` in "
                "/etc/security/limits.conf"
            )
    if cpu >= 0:
        try:
            for thread in threads:
                os.sched_setaffinity(thread, {cpu})
        except OSError as error:
            refusals.append(f"cpu {cpu} not taken ({error.strerror}): it must be one of {os.sched_getaffinity(0)}")
    return refusals


def collect_garbage() -> None:
    """Once in a while, what a loop without garbage collector has left in cycles; young objects only, some 100 us."""
    if not gc.isenabled():
        gc.collect(0)
