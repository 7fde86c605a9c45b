"""The tuner over real nodes: the equalities of tuning, several loops, faults, and a plant that cannot be reset."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tdof_npid_ros.case import Case, load_case
from tdof_npid_ros.control.gains import CONTROLLER_TYPES, ControllerType, gains_from_mapping
from tdof_npid_ros.parameter_file import read_parameters
from tdof_npid_ros.tuning import TuningError
from tdof_npid_ros.tuning.ask_tell import Array, Scores
from tdof_npid_ros.tuning.judge import Constraints
from tdof_npid_ros.tuning.objective import Objective
from tdof_npid_ros.tuning.problem import TuningProblem
from tdof_npid_ros.tuning.study import Study

CASES = {"/p1": "p1-c0.5", "/p1_too": "p1-c0.5", "/p3": "p3-c1"}
SHORT = {  # the signals move up to the end, so nobody asks whether the loop has come to rest
    "setpoint": ("0 setpoint 1", "0.78 setpoint 1.1", "0.8 end"),
    "disturbance": ("0 disturbance 1", "0.68 disturbance 1.1", "0.7 end"),
}
QUICK: dict[str, Any] = {"population": 5, "generations": 4, "polish": 5}
Visited = list[tuple[list[list[float]], list[float], list[float]]]


def short(case: str) -> Case:
    return replace(load_case(case), episodes=SHORT)


def problem(case: str = "p1-c0.5", kind: ControllerType = "tdof_npid2", seed: int = 0, **options: Any) -> TuningProblem:
    return TuningProblem(short(case), kind, seed=seed, **{**QUICK, **options})


def as_the_node_has_it(*arguments: Any, **options: Any) -> TuningProblem:
    """The problem of a tuner node, which begins with the case's gains and ends when it has converged."""
    return problem(*arguments, warm=True, until_converged=True, **options)


def visited(study: Study, evaluate: Callable[[Array], Scores], after: Callable[[Study], bool] | None = None) -> Visited:
    """Every generation's candidates and values, as the study runs."""
    seen: Visited = []

    def noted(candidates: Array) -> Scores:
        values = evaluate(candidates)
        seen.append((candidates.tolist(), values.objective.tolist(), values.violation.tolist()))
        return values

    study.run(noted, after)
    return seen


def offline(which: TuningProblem) -> Visited:
    return visited(Study(which), Objective(which))


class LiveTuner:
    """What the tuner node tunes with, in the test's process, so that a test need not start a node for each run."""

    def __init__(self, domain: int) -> None:
        import rclpy

        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=domain)
        self.node = rclpy.create_node("tuner", context=self._context)
        self._pools: list[Any] = []
        self._ended = threading.Event()
        self._spinner = threading.Thread(target=self._spin, daemon=True)
        self._spinner.start()

    def _spin(self) -> None:
        from rclpy.executors import SingleThreadedExecutor

        executor = SingleThreadedExecutor(context=self._context)
        executor.add_node(self.node)
        while not self._ended.is_set():
            executor.spin_once(timeout_sec=0.05)
        executor.remove_node(self.node)
        executor.shutdown()

    def pool(
        self, which: TuningProblem, loops: list[str], loop_timeout: float = 60.0, answer_timeout: float = 1.5
    ) -> Any:
        from tdof_npid_ros.graph.tuner.loop_pool import LoopPool
        from tdof_npid_ros.graph.tuner.patience import Patience

        pool = LoopPool(self.node, which, loops, Patience(loop_timeout, answer_timeout, lambda: None))
        self._pools.append(pool)
        return pool

    def close(self) -> None:
        self._ended.set()
        self._spinner.join()
        for pool in self._pools:
            pool.close()
        self.node.destroy_node()
        self._context.shutdown()
        self._context.destroy()


def use_all(pool: Any, namespaces: list[str]) -> None:
    """Evaluate until these loops are in use: on a busy machine one may be heard late."""
    end = time.monotonic() + 30.0
    while sorted(pool.in_use) != namespaces and time.monotonic() < end:
        pool.evaluate(np.full((2, 5), 0.5))
    assert sorted(pool.in_use) == namespaces


@pytest.fixture(scope="module")
def loops(shared_graph: Any) -> Any:
    """Plants and controllers in three namespaces, two of them the same case. No scenario: the tuner needs none."""
    for namespace, case in CASES.items():
        for node in ("plant", "controller"):
            shared_graph.start(
                node, case=case, namespace=namespace, **({"reply_timeout": 0.2} if node == "plant" else {})
            )
    shared_graph.wait_for_nodes(*(f"{namespace}/{node}" for namespace in CASES for node in ("plant", "controller")))
    return shared_graph


@pytest.fixture
def tuner(shared_graph: Any) -> Iterator[LiveTuner]:
    live = LiveTuner(shared_graph.domain)
    yield live
    live.close()


@pytest.fixture
def tuner_file(tmp_path: Path) -> Callable[[str], Path]:
    """Writes a case's parameter file with the short episodes."""

    def write(case: str) -> Path:
        lines = (Path(__file__).parents[2] / "config" / f"{case}.yaml").read_text().splitlines()
        file = tmp_path / f"{case}.yaml"
        changed = [
            f"      {name}: {list(SHORT[name])}" if (name := line.strip().split(":")[0]) in SHORT else line
            for line in lines
        ]
        file.write_text("\n".join(changed).replace("'", '"'))
        return file

    return write


# tuned live = tuned offline, resumed = uninterrupted


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("kind", CONTROLLER_TYPES)
@pytest.mark.parametrize("namespace", ["/p1", "/p3"])
def test_tuned_live_equals_tuned_offline(
    loops: Any, tuner: LiveTuner, namespace: str, kind: ControllerType, seed: int
) -> None:
    which = problem(CASES[namespace], kind, seed)
    assert visited(Study(which), tuner.pool(which, [namespace]).evaluate) == offline(which)


def test_tuned_live_equals_tuned_offline_under_constraints_from_the_case_s_gains(loops: Any, tuner: LiveTuner) -> None:
    which = problem(kind="npid", seed=2, constraints=Constraints(ms=1.6, phase_margin=40.0), warm=True)
    live = visited(Study(which), tuner.pool(which, ["/p1"]).evaluate)
    assert live == offline(which)
    violations = np.concatenate([violation for _, _, violation in live])
    assert (violations == 0.0).any()
    assert ((violations > 0.0) & (violations < 100.0)).any()


def test_two_loops_give_what_one_gives(loops: Any, tuner: LiveTuner) -> None:
    which = problem(seed=3)
    pool = tuner.pool(which, ["/p1", "/p1_too"])
    use_all(pool, ["/p1", "/p1_too"])
    assert visited(Study(which), pool.evaluate) == offline(which)
    assert pool.in_use == ["/p1", "/p1_too"]


def test_loops_are_found_and_one_of_another_case_is_refused_before_it_costs_an_episode(
    loops: Any, tuner: LiveTuner
) -> None:
    from sensor_msgs.msg import JointState

    which = problem(seed=4)
    outputs = loops.collect("/p3/output", JointState)
    pool = tuner.pool(which, ["*"])
    use_all(pool, ["/p1", "/p1_too"])
    assert visited(Study(which), pool.evaluate) == offline(which)
    assert sorted(pool.in_use) == ["/p1", "/p1_too"]
    loops.wait_for_nodes("/p3/plant")
    assert not outputs


def test_only_loops_of_another_case_end_the_tuning_with_the_reason(loops: Any, tuner: LiveTuner) -> None:
    pool = tuner.pool(problem(), ["/p3"])
    with pytest.raises(TuningError, match=r"/p3/plant has model third_order, but p1-c0.5 has first_order"):
        pool.evaluate(np.ones((1, 5)))


@pytest.mark.parametrize("node", ["controller", "plant"])
def test_a_loop_killed_half_way_loses_its_share_and_is_used_again_when_it_is_back(
    loops: Any, tuner: LiveTuner, node: str
) -> None:
    which = problem(seed=5, generations=1000)
    pool = tuner.pool(which, ["/p1", "/p1_too"])
    use_all(pool, ["/p1", "/p1_too"])
    process = next(p for p in reversed(loops.processes) if p.node == node and "__ns:=/p1_too" in p.process.args)
    used: list[list[str]] = []

    def after(study: Study) -> bool:
        used.append(pool.in_use)
        if study.generation == 2:
            process.send(signal.SIGKILL)
        if study.generation == 4:
            loops.start(node, case="p1-c0.5", namespace="/p1_too")
        return study.generation < 4 or pool.in_use == ["/p1"]

    live = visited(Study(which), pool.evaluate, after)
    assert live == visited(Study(which), Objective(which), lambda study: study.generation < len(live))
    assert used[1] == ["/p1", "/p1_too"]
    assert used[3] == ["/p1"]
    assert used[-1] == ["/p1", "/p1_too"]


def test_a_run_killed_and_started_again_ends_as_one_left_alone(
    loops: Any, tuner_file: Callable[[str], Path], tmp_path: Path
) -> None:
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from sensor_msgs.msg import JointState

    latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    parameters = {
        "type": "npid", "seed": 6, **QUICK, "generations": 12,
        "checkpoint": str(tmp_path / "checkpoint.json"), "result": str(tmp_path / "tuned.yaml"), "loops": ["/p1"],
    }  # fmt: skip
    case = tuner_file("p1-c0.5")
    progress = loops.collect("tuning_progress", JointState, latched)
    killed = loops.start("tuner", "-p", f"case:={case}", **parameters)
    loops.wait_until(lambda: progress and progress[-1].position[1] >= 4, 60, "the fourth generation")
    killed.send(signal.SIGKILL)
    again = loops.start("tuner", "-p", f"case:={case}", **parameters)
    again.stopped = True  # it ends by itself
    loops.wait_until(lambda: again.process.poll() is not None, 60, "the end of the second run")
    which = as_the_node_has_it(kind="npid", seed=6, generations=12)
    study = Study(which)
    study.run(Objective(which))
    assert read_parameters(tmp_path / "tuned.yaml", "controller") == study.result.gains.as_dict()
    assert "confirmed" in again.log
    loops.wait_until(lambda: progress[-1].position[0] == study.best_value, what="the last progress")
    assert list(progress[-1].name) == ["best", "generation", "evaluations", "budget", "kp", "ki", "kd"]
    gains = study.result.gains
    assert loops.get_parameters("/p1/controller", "type", "kp", "ki") == ["npid", gains.kp, gains.ki]
    assert loops.get_parameters("/p1/plant", "lanes") == [1]


# Faults


def test_a_scenario_that_plays_meanwhile_changes_nothing(loops: Any, tuner: LiveTuner) -> None:
    which = problem(seed=7, generations=8)
    pool = tuner.pool(which, ["/p1"])
    scenario = loops.start("scenario", case="p1-c0.5", namespace="/p1", play=False)
    loops.wait_for_nodes("/p1/scenario")

    def play(study: Study) -> bool:
        if study.generation == 2:
            from std_srvs.srv import Trigger

            loops.call("/p1/scenario/play", Trigger)
        return True

    assert visited(Study(which), pool.evaluate, play) == offline(which)
    scenario.stop()


def test_a_silent_loop_ends_the_tuning_with_the_reason(loops: Any, tuner: LiveTuner) -> None:
    pool = tuner.pool(problem(), ["/nowhere"], loop_timeout=1.0)
    with pytest.raises(TuningError, match="no loop to tune: /nowhere: not heard of yet"):
        pool.evaluate(np.ones((1, 5)))
    pool = tuner.pool(problem(), ["/p1"], loop_timeout=8.0, answer_timeout=1.0)
    suspended = [p for p in loops.processes if "__ns:=/p1" in p.process.args and p.node == "controller"]
    pool.evaluate(np.ones((1, 5)))
    for process in suspended:
        process.send(signal.SIGSTOP)
    try:
        with pytest.raises(TuningError, match=r"no loop to tune: /p1: /p1/controller/.* did not answer within 1 s"):
            pool.evaluate(np.ones((1, 5)))
    finally:
        for process in suspended:
            process.send(signal.SIGCONT)


CAREFUL_CONTROLLER = """
import sys
from tdof_npid_ros.graph.controller_node import ControllerNode
from tdof_npid_ros.graph.runtime.run import run_node

class CarefulController(ControllerNode):
    def checked(self, changes):
        kp = changes.get("kp", 0.0)
        if max(kp if isinstance(kp, list) else [kp]) > 10:
            raise ValueError("kp above 10 is not for this machine")
        super().checked(changes)

run_node(CarefulController, sys.argv)
"""


def test_a_gain_that_the_controller_refuses_ends_the_tuning_with_its_reason(
    loops: Any, tuner_file: Callable[[str], Path], tmp_path: Path
) -> None:
    case = tuner_file("p1-c0.5")
    script = tmp_path / "careful_controller.py"
    script.write_text(CAREFUL_CONTROLLER)
    options = ["--ros-args", "-r", "__ns:=/careful", "--params-file", str(case)]
    with subprocess.Popen([sys.executable, str(script), *options], env=loops.environment) as careful:
        plant = loops.start("plant", case=str(case), namespace="/careful")
        process = loops.start("tuner", "-p", f"case:={case}", namespace="/careful", **QUICK)
        process.expected_status = 2
        loops.wait_until(lambda: process.process.poll() is not None, 60, "the end of the tuner")
        kp = loops.get_parameters("/careful/controller", "kp")
        plant.stop()
        careful.terminate()
    assert "/careful/controller refused type, kp" in process.log
    assert "kp above 10 is not for this machine" in process.log
    assert kp == [load_case("p1-c0.5").gains.kp]


def test_a_result_that_cannot_be_written_is_known_before_the_run(loops: Any, tuner_file: Callable[[str], Path]) -> None:
    case = tuner_file("p1-c0.5")
    process = loops.start("tuner", "-p", f"case:={case}", result="/proc/tuned.yaml", loops=["/p1"], **QUICK)
    process.expected_status = 2
    loops.wait_until(lambda: process.process.poll() is not None, 30, "the end of the tuner")
    assert "/proc/tuned.yaml cannot be written" in process.log
    assert "is used" not in process.log


def test_a_disk_that_fills_up_meanwhile_leaves_the_gains_on_the_controller(
    loops: Any, tuner_file: Callable[[str], Path]
) -> None:
    case = tuner_file("p1-c0.5")
    process = loops.start(
        "tuner", "-p", f"case:={case}", result="/dev/full", type="pid", seed=8, loops=["/p1"], **QUICK
    )
    process.expected_status = 2
    loops.wait_until(lambda: process.process.poll() is not None, 60, "the end of the tuner")
    assert "/dev/full cannot be written: No space left on device" in process.log
    which = as_the_node_has_it(kind="pid", seed=8)
    study = Study(which)
    study.run(Objective(which))
    assert loops.get_parameters("/p1/controller", "type", "kp") == ["pid", study.result.gains.kp]


FLEETING_CONTROLLER = """
import os, sys
from tdof_npid_ros.graph.controller_node import ControllerNode
from tdof_npid_ros.graph.runtime.run import run_node

class FleetingController(ControllerNode):
    sets = 0

    def changed(self, changes):
        lanes = self.controller.lanes
        super().changed(changes)
        self.sets += "kp" in changes
        if {when}:
            os._exit(0)

run_node(FleetingController, sys.argv)
"""


@pytest.mark.parametrize(
    ("when", "generations"),
    [("self.sets > 2 * 3", 3), ("lanes > self.controller.lanes", 1000)],
    ids=["in mid-run", "in the confirming episode"],
)
def test_what_was_found_is_written_though_the_loop_is_lost(
    loops: Any, tuner_file: Callable[[str], Path], tmp_path: Path, when: str, generations: int
) -> None:
    case, result = str(tuner_file("p1-c0.5")), tmp_path / "tuned.yaml"
    program = FLEETING_CONTROLLER.replace("{when}", when)
    plant = loops.start("plant", case=case, namespace="/fleeting", reply_timeout=0.2)
    controller = loops.start("controller", case=case, namespace="/fleeting", program=program)
    controller.expected_status = None
    loops.wait_for_nodes("/fleeting/plant", "/fleeting/controller")
    options = {**QUICK, "polish": 0, "loop_timeout": 5.0, "answer_timeout": 1.0, "result": str(result)}
    process = loops.start("tuner", "-p", f"case:={case}", namespace="/fleeting", type="pid", seed=8, **options)
    process.expected_status = 2
    loops.wait_until(lambda: process.process.poll() is not None, 60, "the end of the tuner")
    plant.stop()
    assert "no loop to tune: /fleeting: " in process.log
    assert f"; the best gains so far could not be set on the controller, but are in {result}" in process.log
    study = Study(as_the_node_has_it(kind="pid", seed=8, polish=0))
    study.run(Objective(study.problem), lambda study: study.generation < generations)
    assert gains_from_mapping(read_parameters(result, "controller")) == study.result.gains


@pytest.mark.parametrize("way", ["Ctrl-C", "deactivate"])
def test_it_ends_with_the_generation_and_leaves_the_best_so_far(
    loops: Any, tuner_file: Callable[[str], Path], tmp_path: Path, way: str
) -> None:
    """On the controller and in the result file, and says so."""
    from sensor_msgs.msg import JointState

    progress = loops.collect("/p3/tuning_progress", JointState)
    case = str(tuner_file("p3-c1"))
    options = {**QUICK, "generations": 500, "result": str(tmp_path / "tuned.yaml")}
    process = loops.start("tuner", "-p", f"case:={case}", namespace="/p3", type="pid", **options)
    loops.wait_until(lambda: len(progress) >= 2, 60, "two generations")
    if way == "deactivate":
        process.stopped = True
        assert loops.change_state("/p3/tuner", "deactivate")
        loops.wait_until(lambda: process.process.poll() is not None, 10, "the end of the tuner")
    assert process.stop() < 5.0
    assert "interrupted after" in process.log
    evaluations = int(process.log.split("interrupted after ")[1].split()[0])
    study = Study(as_the_node_has_it("p3-c1", "pid", seed=0, generations=500))
    study.run(Objective(study.problem), lambda study: study.evaluations < evaluations)
    best = study.result.gains
    assert loops.get_parameters("/p3/controller", "type", "kp", "ki", "kd") == ["pid", best.kp, best.ki, best.kd]
    assert f"the best gains so far are on the controller and in {tmp_path / 'tuned.yaml'};" in process.log
    assert gains_from_mapping(read_parameters(tmp_path / "tuned.yaml", "controller")) == best
    assert loops.get_parameters("/p3/plant", "lanes") == [1]


@pytest.mark.parametrize(("episode", "ms"), [("reset", 1.7), ("alternate", 0.0)])
def test_what_the_case_s_file_asks_of_the_search_holds(
    loops: Any, tuner_file: Callable[[str], Path], episode: str, ms: float
) -> None:
    """As in `tdof-npid tune FILE`; a margin only where there is a model."""
    case = tuner_file("p1-c0.5")
    case.write_text(case.read_text().replace("    bounds:\n", "    ms: 1.7\n    free: sigma\n    bounds:\n"))
    waiting = loops.start(
        "tuner", "-p", f"case:={case}", namespace=f"/asked/{episode}", type="npid", episode=episode, autostart=False
    )
    loops.wait_for_nodes(f"/asked/{episode}/tuner")
    assert loops.get_parameters(f"/asked/{episode}/tuner", "ms", "free") == [ms, "sigma"]
    waiting.stop()


# A plant that cannot be reset


def test_a_plant_that_cannot_be_reset_is_tuned_by_steps_back_and_forth(loops: Any, tuner: LiveTuner) -> None:
    from rcl_interfaces.msg import ParameterEvent
    from rclpy.parameter import parameter_value_to_python
    from sensor_msgs.msg import JointState

    from tdof_npid_ros.graph.tuner.alternate_loop import AlternateLoop
    from tdof_npid_ros.graph.tuner.patience import Patience
    from tdof_npid_ros.tuning.alternate import StepTest

    coarse = {"sample_period": 0.05, "mode": "realtime"}
    loops.start("plant", case="p1-c0.5", namespace="/real", speed=4.0, effort_timeout=10.0, **coarse)
    loops.start("controller", case="p1-c0.5", namespace="/real", kp=3.0, ki=1.0, kd=0.5, output_timeout=0.0, **coarse)
    loops.wait_for_nodes("/real/plant", "/real/controller")
    outputs, events = loops.collect("/real/output", JointState), loops.collect("/parameter_events", ParameterEvent)
    bounds = {"kp": (0.5, 20.0), "ki": (0.1, 5.0), "kd": (0.0, 2.0)}  # kp above some 16 is unstable
    case = replace(short("p1-c0.5"), bounds=bounds)
    which = TuningProblem(case, "pid", seed=35, population=3, generations=1, polish=0)
    test = StepTest((0.0, 1.0), 0.1, 1.0, 25.0, (-1.0, 2.0), (-40.0, 40.0))
    loop = AlternateLoop(tuner.node, which, test, "/real", Patience(60.0, 5.0, lambda: None))
    study = Study(which)
    loops.publisher("/real/output", JointState).publish(JointState())  # malformed; nobody stumbles over it
    run = threading.Thread(
        target=lambda: (study.run(loop.evaluate), loop.restore(study.result.gains, study.best_value))
    )
    run.start()
    loops.wait_until(lambda: not run.is_alive(), 90, "the end of the tuning")

    applied: dict[str, list[float]] = {"kp": [], "ki": [], "kd": []}
    for event in events:
        if event.node == "/real/controller":
            for parameter in event.changed_parameters:
                if parameter.name in applied:
                    applied[parameter.name].append(parameter_value_to_python(parameter.value))
    for name, (low, high) in zip(which.names, which.bounds, strict=True):
        assert applied[name]
        assert all(low <= value <= high for value in applied[name])
    gains = study.result.gains
    assert loops.get_parameters("/real/controller", "kp", "ki", "kd") == [gains.kp, gains.ki, gains.kd]
    reached = [message.position[0] for message in outputs if message.position]
    assert 0.0 < max(max(reached) - 2.0, -1.0 - min(reached)) < 3.0  # one was aborted, soon after it left -1 .. 2
    assert study.best_value < 5.0


def test_steps_back_and_forth_that_are_interrupted_at_once_leave_the_best_candidate(
    loops: Any, tuner_file: Callable[[str], Path], tmp_path: Path
) -> None:
    """Within the first generation, of which the search knows nothing yet."""
    from sensor_msgs.msg import JointState

    coarse = {"sample_period": 0.05, "mode": "realtime"}
    loops.start("plant", case="p1-c0.5", namespace="/cut", speed=20.0, effort_timeout=10.0, **coarse)
    loops.start("controller", case="p1-c0.5", namespace="/cut", kp=1.0, ki=0.3, kd=0.0, output_timeout=0.0, **coarse)
    setpoints, result = loops.collect("/cut/setpoint", JointState), tmp_path / "tuned.yaml"
    process = loops.start(
        "tuner", "-p", f"case:={tuner_file('p1-c0.5')}", namespace="/cut", type="pid", episode="alternate",
        settle_band=0.1, time_limit=25.0, result=str(result), **{**QUICK, "population": 200},
        bounds__kp=[1.0, 5.0], bounds__ki=[0.3, 1.0], bounds__kd=[0.0, 0.5],
    )  # fmt: skip
    loops.wait_until(lambda: len({m.position[0] for m in setpoints}) == 2 and len(setpoints) > 8, 90, "candidates")
    process.send(signal.SIGINT)
    loops.wait_for_log(process, "stops with this generation")  # two signals that wait to be taken count as one
    process.send(signal.SIGINT)
    process.stopped = True
    loops.wait_until(lambda: process.process.poll() is not None, 30, "the end of the tuner")
    (said,) = [line for line in process.log.splitlines() if "interrupted" in line]
    assert f"0 of 800 evaluations: the best gains so far are on the controller and in {result};" in said
    kept = gains_from_mapping(read_parameters(result, "controller"))
    assert loops.get_parameters("/cut/controller", "type", "kp", "ki", "kd") == ["pid", kept.kp, kept.ki, kept.kd]
    assert (kept.kp, kept.ki, kept.kd) != (1.0, 0.3, 0.0)


def test_an_integral_action_that_a_killed_tuner_holds_is_not_taken_for_the_operator_s(
    loops: Any, tuner: LiveTuner
) -> None:
    from tdof_npid_ros.graph.tuner.alternate_loop import AlternateLoop
    from tdof_npid_ros.graph.tuner.patience import Patience
    from tdof_npid_ros.tuning.alternate import StepTest

    held = {"integral_min": 0.3, "integral_max": 0.3}
    loops.start("plant", case="p1-c0.5", namespace="/held", mode="realtime", effort_timeout=10.0)
    loops.start("controller", case="p1-c0.5", namespace="/held", output_timeout=0.0, **held)
    loops.wait_for_nodes("/held/plant", "/held/controller")
    before = loops.get_parameters("/held/controller", "kp", *held)
    test = StepTest((0.0, 1.0), 0.1, 0.2, 1.0, (-1.0, 2.0), (-40.0, 40.0))
    loop = AlternateLoop(tuner.node, problem(kind="pid"), test, "/held", Patience(60.0, 5.0, lambda: None))
    with pytest.raises(TuningError, match=r"/held/controller has integral_min and integral_max 0\.3, as a"):
        loop.evaluate(np.ones((1, 3)))
    assert loop.restore(None, float("inf")) == (None, True)
    assert loops.get_parameters("/held/controller", "kp", *held) == before


def test_of_a_robot_s_joints_the_one_that_the_controller_drives_is_tuned(loops: Any, tuner: LiveTuner) -> None:
    from sensor_msgs.msg import JointState

    from tdof_npid_ros.graph.tuner.alternate_loop import AlternateLoop
    from tdof_npid_ros.graph.tuner.patience import Patience
    from tdof_npid_ros.tuning.alternate import StepTest

    output = JointState(name=["shoulder", "elbow"], position=[5.0, 0.0], effort=[90.0, 0.0])
    publisher = loops.node.create_publisher(JointState, "/arm/output", 10)

    def follow(setpoint: JointState) -> None:
        output.position = [5.0, setpoint.position[0]]

    def publish() -> None:
        output.header.stamp = loops.node.get_clock().now().to_msg()
        publisher.publish(output)

    loops.node.create_subscription(JointState, "/arm/setpoint", follow, 10)
    timer = loops.node.create_timer(0.02, publish)
    loops.start(
        "controller", namespace="/arm", type="pid", joint_names=["elbow"], sample_period=0.02, output_timeout=0.0
    )
    loops.wait_for_nodes("/arm/controller")
    test = StepTest((0.0, 1.0), 0.1, 0.2, 5.0, (-1.0, 2.0), (-40.0, 40.0))
    loop = AlternateLoop(tuner.node, problem(kind="pid"), test, "/arm", Patience(60.0, 5.0, lambda: None))
    found: list[Scores] = []
    run = threading.Thread(target=lambda: found.append(loop.evaluate(np.ones((1, 3)))))
    run.start()
    loops.wait_until(lambda: not run.is_alive(), 60, "the end of the trial")
    loops.node.destroy_timer(timer)
    assert found and found[0].violation.tolist() == [0.0] and found[0].objective[0] < 1.0
