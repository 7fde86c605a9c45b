"""Chunks on threads and on a Dask cluster: the same bits whatever the workers, their number and their death."""

from __future__ import annotations

import json
import math
import os
import pickle
import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import distributed
import numpy as np
import pytest

from tdof_npid_ros import workers as module
from tdof_npid_ros.case import Case, load_case
from tdof_npid_ros.checkpoint import CheckpointError
from tdof_npid_ros.cli import main
from tdof_npid_ros.plants.ode import loaded_class, take_class
from tdof_npid_ros.plants.plant import PlantError
from tdof_npid_ros.robustness.spread import spreads_of
from tdof_npid_ros.tuning.objective import Objective
from tdof_npid_ros.tuning.perturbed import Perturbed
from tdof_npid_ros.tuning.problem import TuningProblem
from tdof_npid_ros.tuning.study import Study
from tdof_npid_ros.workers import ChunkCheckpoint, WorkersError, workers

pytestmark = pytest.mark.timeout(300)  # processes load the program anew

CASE = load_case("p1-c0.5")
CHUNKS = [np.linspace(2.0, 20.0, 7) + 0.1 * chunk for chunk in range(16)]
WORK = {"sweep": "kp"}

TANK = """
from numba import njit


class Tank:
    parameters = {"area": 2.0}
    initial_state = (0.0,)

    @staticmethod
    def derivative(x, u, d, p):
        return (into(u + d, p[0]),)

    @staticmethod
    def output(x, p):
        return x[0]


@njit
def into(flow, area):
    return flow / area
"""
TANK_FILE = """
/**: {ros__parameters: {sample_period: 0.05}}
plant: {ros__parameters: {model: "tank_of_user:Tank", area: 3.0}}
controller: {ros__parameters: {type: pid, kp: 1.0, ki: 0.5, kd: 0.1}}
scenario: {ros__parameters: {episodes: [setpoint], plan.setpoint: ["0 setpoint 1", "5 end"]}}
"""


def outputs(case: Case, kp: np.ndarray) -> np.ndarray:
    """A chunk of a sweep."""
    return case.simulate("setpoint", case.gains.with_values(kp=tuple(kp))).output


def slow_outputs(case: Case, kp: np.ndarray) -> np.ndarray:
    time.sleep(0.1)
    return outputs(case, kp)


def outputs_slower_in(slow: int, kp: np.ndarray) -> np.ndarray:
    time.sleep(1.0 if os.getpid() == slow else 0.02)
    return outputs(CASE, kp)


def process(_: Any, __: Any) -> int:
    time.sleep(0.1)
    return os.getpid()


def refuse(_: Any, chunk: int) -> int:
    if chunk == 2:
        raise PlantError("this plant cannot be")
    return chunk


def bits(results: list[np.ndarray]) -> bytes:
    return b"".join(result.tobytes() for result in results)


@pytest.fixture(scope="module")
def one_thread() -> bytes:
    with workers(threads=1) as here:
        return bits(here.map(outputs, CASE, CHUNKS))


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as local:
        yield local


def test_threads_give_the_bits_of_one_thread(one_thread: bytes) -> None:
    with workers(threads=5) as here:
        assert bits(here.map(outputs, CASE, CHUNKS)) == one_thread


def test_a_cluster_gives_the_bits_of_one_thread(cluster: Any, one_thread: bytes) -> None:
    with workers(cluster.scheduler_address) as there:
        assert len(set(there.map(process, None, list(range(8))))) == there.cores == 2
        assert bits(there.map(outputs, CASE, CHUNKS)) == one_thread


def test_a_slow_worker_changes_no_bit(cluster: Any, one_thread: bytes) -> None:
    with workers(cluster.scheduler_address) as there:
        slow = there.map(process, None, [0])[0]
        assert bits(there.map(outputs_slower_in, slow, CHUNKS)) == one_thread


def test_a_worker_killed_at_random_and_one_added_change_no_bit(cluster: Any, one_thread: bytes) -> None:
    with workers(cluster.scheduler_address) as there:
        victim = random.choice(there.map(process, None, list(range(8))))

        def disturb() -> None:
            time.sleep(random.uniform(0.05, 0.5))
            os.kill(victim, signal.SIGKILL)
            cluster.scale(3)

        disturber = threading.Thread(target=disturb)
        disturber.start()
        assert bits(there.map(slow_outputs, CASE, CHUNKS)) == one_thread
        disturber.join()


def test_a_user_s_plant_class_goes_to_workers_that_have_not_its_file(cluster: Any, tmp_path: Path) -> None:
    (tmp_path / "tank_of_user.py").write_text(TANK)
    (tmp_path / "tank.yaml").write_text(TANK_FILE)
    case, one = load_case(tmp_path / "tank.yaml"), np.array([2.0])
    with workers(cluster.scheduler_address) as there:
        assert bits(there.map(outputs, case, [one])) == bits([outputs(case, one)])


def test_another_version_of_a_user_s_class_does_not_take_the_place_of_the_first() -> None:
    names = {take_class("tank:Tank", pickle.dumps(version)) for version in (dict, list)}
    assert len(names) == 2
    assert {loaded_class(name) for name in names} == {dict, list}


def test_fronts_found_on_a_cluster_are_those_found_here(cluster: Any, capsys: pytest.CaptureFixture[str]) -> None:
    pareto = ["pareto", "--ratio", "0.5", "--controller", "npid", "pid", "--generations", "2", "--json"]
    assert main(pareto) == main([*pareto, "--scheduler", cluster.scheduler_address]) == 0
    here, there = capsys.readouterr().out.splitlines()
    assert here == there
    assert {point["controller"] for point in json.loads(here)["points"]} == {"npid", "pid"}


def test_gains_tuned_for_many_plants_on_a_cluster_are_those_found_here(cluster: Any) -> None:
    short = {"setpoint": ("0 setpoint 1", "3 end"), "disturbance": ("0 disturbance 1", "3 end")}
    case = replace(load_case("p3-c1"), episodes=short)
    plants = Perturbed(spreads_of(case, ["gain 20 %"]), 3)
    problem = TuningProblem(case, "pid", population=6, generations=2, perturbed=plants)
    with workers(cluster.scheduler_address) as there:
        candidates = Study(problem).ask()
        here, spread = Objective(problem)(candidates), Objective(problem, where=there)(candidates)
        assert here.objective.tobytes() == spread.objective.tobytes()
        assert here.violation.tobytes() == spread.violation.tobytes()


def test_what_a_chunk_raises_is_raised_here(cluster: Any) -> None:
    for scheduler in (None, cluster.scheduler_address):
        with workers(scheduler) as where, pytest.raises(PlantError, match="this plant cannot be"):
            where.map(refuse, None, list(range(4)))


def test_a_worker_with_another_version_of_the_program_is_refused(cluster: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "program_digest", lambda: "of another version")
    with (
        workers(cluster.scheduler_address) as there,
        pytest.raises(
            WorkersError, match=r"has another version of tdof_npid_ros in .*: install the same one everywhere"
        ),
    ):
        there.map(outputs, CASE, CHUNKS[:1])


def test_a_scheduler_that_is_not_there_is_told_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "CONNECT_TIMEOUT", 0.5)
    for nowhere in ("tcp://127.0.0.1:9", "127.0.0.1:9", "no address", "no-file.json"):
        with pytest.raises(WorkersError, match=f"no Dask scheduler answers at {nowhere}") as error:
            workers(nowhere)
        assert "\n" not in str(error.value)


def test_a_lost_scheduler_is_told_and_the_work_is_resumed_to_the_same_bits(tmp_path: Path, one_thread: bytes) -> None:
    file = tmp_path / "scheduler.json"
    dask = [sys.executable, "-m", "dask"]
    scheduler = subprocess.Popen(
        [*dask, "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(file)],
        stderr=subprocess.DEVNULL,
    )
    worker = subprocess.Popen(
        [*dask, "worker", "--scheduler-file", str(file), "--no-nanny", "--nthreads", "1", "--no-dashboard"],
        stderr=subprocess.DEVNULL,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parent)},
    )
    try:
        until = time.monotonic() + 60.0
        while not file.exists():
            assert time.monotonic() < until
            time.sleep(0.05)
        checkpoint = ChunkCheckpoint(tmp_path / "checkpoint.json", WORK)
        with workers(str(file)) as there:
            killer = threading.Thread(target=kill_after, args=(scheduler, tmp_path / "done", 5))
            killer.start()
            with pytest.raises(WorkersError, match=r"the Dask scheduler at .*json was lost"):
                there.map(told_outputs, str(tmp_path / "done"), CHUNKS, checkpoint=checkpoint)
            killer.join()
            with pytest.raises(WorkersError, match="was lost"):
                there.map(slow_outputs, CASE, CHUNKS)
    finally:
        scheduler.kill()
        worker.kill()
        scheduler.wait()
        worker.wait()
    seen: list[int] = []
    with workers(threads=2) as here:
        resumed = ChunkCheckpoint(checkpoint.path, WORK, resume=True)
        assert bits(here.map(count_and_simulate, seen, CHUNKS, checkpoint=resumed)) == one_thread
    assert 0 < len(seen) < len(CHUNKS)


def told_outputs(file: str, kp: np.ndarray) -> np.ndarray:
    result = slow_outputs(CASE, kp)
    with Path(file).open("a") as done:
        done.write("x")
    return result


def kill_after(victim: subprocess.Popen[bytes], file: Path, chunks: int) -> None:
    while not file.exists() or file.stat().st_size < chunks:
        time.sleep(0.02)
    victim.kill()


def count_and_simulate(seen: list[int], kp: np.ndarray) -> np.ndarray:
    seen.append(1)
    return outputs(CASE, kp)


def test_results_of_every_kind_come_back_from_a_checkpoint_as_they_were(tmp_path: Path) -> None:
    kept = {"a": [0.1, math.inf, -0.0, None, True, "x", 3], "b": {"c": np.array([[1.5, math.nan]])}, "d": np.arange(3)}
    with workers(threads=1) as here:
        first = here.map(pick, kept, list(kept), checkpoint=ChunkCheckpoint(tmp_path / "c", WORK))
        again = here.map(pick, {}, list(kept), checkpoint=ChunkCheckpoint(tmp_path / "c", WORK, resume=True))
    assert repr(first) == repr(again) == repr(list(kept.values()))
    assert again[2].dtype == kept["d"].dtype


def pick(values: dict[str, Any], key: str) -> Any:
    return values[key]


def test_a_checkpoint_of_other_work_or_one_not_to_be_resumed_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "c"
    with workers(threads=1) as here:
        here.map(pick, {1: 2}, [1], checkpoint=ChunkCheckpoint(path, WORK))
        before = path.read_bytes()
        with pytest.raises(CheckpointError, match="exists: resume it, or give another file"):
            here.map(pick, {1: 2}, [1], checkpoint=ChunkCheckpoint(path, WORK))
        with pytest.raises(CheckpointError, match="is of other work: sweep is kp there and ki here"):
            here.map(pick, {1: 2}, [1], checkpoint=ChunkCheckpoint(path, {"sweep": "ki"}, resume=True))
        with pytest.raises(CheckpointError, match="is of other work: chunks is 1 there and 2 here"):
            here.map(pick, {1: 2}, [1, 1], checkpoint=ChunkCheckpoint(path, WORK, resume=True))
    assert path.read_bytes() == before


def test_what_was_done_before_an_error_is_kept(tmp_path: Path) -> None:
    checkpoint = ChunkCheckpoint(tmp_path / "c", WORK, resume=True)
    with workers(threads=1) as here:
        with pytest.raises(KeyError):
            here.map(pick, {0: 5, 1: 6}, [0, 1, 2], checkpoint=checkpoint)
        assert here.map(pick, {2: 7}, [0, 1, 2], checkpoint=checkpoint) == [5, 6, 7]
