"""Two workers of a Dask cluster beside two threads: what sending chunks and results costs."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from benchmarks.harness import Result, Verdict, main, seconds, summary
from tdof_npid_ros.case import Case, load_case
from tdof_npid_ros.loop import integrals
from tdof_npid_ros.paper.evaluation import RowSearch, optimum
from tdof_npid_ros.scenario import parse_plan
from tdof_npid_ros.workers import Workers, workers

TITLE = "Dask workers beside threads"
METHOD = (
    "The same chunks by `Workers.map`, which `reproduce`, `pareto` and robust sweeps go through, on two threads of "
    "this process and on the two workers (processes of one thread each) of a Dask `LocalCluster` on this machine, in "
    "turn, each warmed up; results are compared bit for bit. *Sweep*: the closed loop of Process 1 with 640 lanes, the "
    "gains different in each, some half a second a chunk. *Seeds*: HGA runs of 2,000 evaluations on p3-c1, of which a "
    "good part is Python. A ratio is the median of those of neighbours in time."
)
PEERS = ("dask", "distributed")
NOTES: tuple[str, ...] = ()

CASE = "p1-c0.5"
LANES = 640
CORES = 2
Chunked = tuple[Callable[[Any, Any], Any], Any, list[Any]]


def sweep(case: Case, horizon: float, kp: float) -> np.ndarray:
    """IAE of lanes about a gain, (LANES,)."""
    signals = parse_plan(["0 setpoint 1", f"{horizon} end"], case.sample_period_ns).sampled(case.sample_period_ns)
    gains = case.gains.with_values(kp=tuple(kp * np.linspace(0.9, 1.0, LANES)))
    return integrals(case.plant_at, gains, signals, (-np.inf, np.inf)).iae


def sweep_chunk(shared: tuple[Case, float], kp: float) -> np.ndarray:
    """A chunk of the sweep."""
    return sweep(*shared, kp)


def seed_chunk(generations: int, seed: int) -> dict[str, float]:
    """A chunk of the seeds."""
    return optimum(RowSearch("p3-c1", "tdof_npid2", seed), generations, threads=1)


def run(size: str) -> Result:
    """Threads and workers in turn."""
    full = size == "full"
    rounds, chunks, horizon, generations = (5, 12, 2000.0, 50) if full else (1, 4, 50.0, 2)
    works: dict[str, Chunked] = {
        "sweep": (sweep_chunk, (load_case(CASE), horizon), np.linspace(5.0, 9.0, chunks).tolist()),
        "seeds": (seed_chunk, generations, list(range(chunks))),
    }
    result = Result()
    with workers(threads=CORES) as here, _cluster() as there:
        for name, work in works.items():
            assert _bits(_map(here, work)) == _bits(_map(there, work)), name  # and warm
            times: dict[str, list[float]] = {"threads": [], "workers": []}
            for _ in range(rounds):
                times["threads"].append(seconds(lambda work=work: _map(here, work)))  # type: ignore[misc]
                times["workers"].append(seconds(lambda work=work: _map(there, work)))  # type: ignore[misc]
            for kind, found in times.items():
                rates = [chunks / time for time in found]
                result.rates.append(summary(f"{name}, {CORES} {kind}", "chunks/s", rates, ours=True))
            ratios = [threads / dask for threads, dask in zip(times["threads"], times["workers"], strict=True)]
            goal = 0.85 if name == "sweep" else None
            result.verdicts.append(
                Verdict(f"{name}: two Dask workers, times two threads", float(np.median(ratios)), goal)
            )
    return result


def _map(where: Workers, work: Chunked) -> list[Any]:
    function, shared, chunks = work
    return where.map(function, shared, chunks)


def _bits(results: list[Any]) -> list[Any]:
    return [one.tobytes() if isinstance(one, np.ndarray) else one for one in results]


@contextmanager
def _cluster() -> Iterator[Workers]:
    import distributed

    os.environ.pop("_ROS_WHEELS_BOOTSTRAP_COMPLETE", None)
    with (
        distributed.LocalCluster(n_workers=CORES, threads_per_worker=1, dashboard_address=None) as cluster,
        workers(cluster.scheduler_address) as there,
    ):
        yield there


if __name__ == "__main__":
    main("cluster")
