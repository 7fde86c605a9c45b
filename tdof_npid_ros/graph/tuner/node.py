"""The tuner: tunes the controller that runs, through ROS 2 alone."""

from __future__ import annotations

import math
import signal
import sys
import threading
import warnings
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import Protocol

import rclpy
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState
from tqdm import tqdm

from tdof_npid_ros.case import Case, controller_type, load_case, read_bounds
from tdof_npid_ros.control.gains import PER_LANE, Gains
from tdof_npid_ros.graph.runtime.ending import end_within
from tdof_npid_ros.graph.runtime.messages import signal_message
from tdof_npid_ros.graph.runtime.middleware import use_fast_dds_profile
from tdof_npid_ros.graph.runtime.node import (
    ERROR,
    LATCHED_QOS,
    LEAVE_TIMEOUT,
    OK,
    STOP_SIGNALS,
    LoopNode,
    autostart,
    executor_for,
    ignore_further_signals,
    number,
)
from tdof_npid_ros.graph.tuner.alternate_loop import AlternateLoop
from tdof_npid_ros.graph.tuner.loop_pool import EVERY_LOOP, OWN_LOOP, LoopPool, candidate_of
from tdof_npid_ros.output_file import check_writable
from tdof_npid_ros.parameter_file import ParameterFileError, check_replaceable, write_parameters
from tdof_npid_ros.tuning.alternate import StepTest
from tdof_npid_ros.tuning.ask_tell import Array
from tdof_npid_ros.tuning.problem import TuningProblem
from tdof_npid_ros.tuning.study import Study

POPULATION, GENERATIONS = 40, 60  # by default: lanes of a generation, and a run of a minute or two
POLL = 0.05  # s between two looks for a signal
FAILURE = 2  # exit status
EPISODE = ("reset", "alternate")


class InterruptedTuningError(RuntimeError):
    """Somebody asked to stop at once."""


class Evaluator(Protocol):
    """What measures candidates on live loops."""

    @property
    def in_use(self) -> list[str]:
        """Namespaces of the loops in use."""
        ...

    def evaluate(self, candidates: Array) -> Array:
        """Values (n,) of candidates (n, gains)."""
        ...

    def restore(self, gains: Gains | None) -> None:
        """Set these gains, or those before the tuning."""
        ...

    def close(self) -> None:
        """Leave the graph; no executor may spin the node now."""
        ...


class TunerNode(LoopNode):
    """Sets gains, runs episodes and measures them, generation after generation; publishes `tuning_progress`."""

    def __init__(self) -> None:
        super().__init__("tuner")
        self.phase, self.text = "waiting", "waiting for a loop"
        self.stop_requested = self.stop_at_once = False
        self.activated = threading.Event()
        self.problem = self._declare_problem()
        self.loops = self.declare_value(
            "loops", [OWN_LOOP], "namespaces of the loops; . is the tuner's own, * every one on the graph", fixed=True
        )
        self.loop_timeout = self._declare_seconds("loop_timeout", 60.0, "s without any loop until the tuner gives up")
        self.answer_timeout = self._declare_seconds("answer_timeout", 5.0, "s until a silent loop counts as lost")
        checkpoint = self._declare_path("checkpoint", "file, saved after each generation")
        resume = self.declare_value("resume", True, "go on from the checkpoint if it is there", fixed=True)
        self.result_file = self._declare_path("result", "ROS parameter file to write the optimum to")
        self.step_test = self._declare_step_test()
        self.uses_events_executor = self.step_test is not None  # else outputs are tapped, and taps must be left alone
        self.stay = self.declare_value("stay", False, "stay on the graph when done, instead of ending", fixed=True)
        if self.result_file is not None:
            check_writable(self.result_file)
            check_replaceable(self.result_file, "controller", Gains().as_dict())
        self.accept_changes()
        self.study = Study(self.problem, checkpoint, bool(resume))
        self.how_to_go_on = "start again to go on" if checkpoint else "nothing is kept, for there is no checkpoint"

    def activate(self) -> None:
        """Look for the loops, and let `run` begin."""
        self.progress = signal_message("")
        self.progress_publisher = self.create_publisher(JointState, "tuning_progress", LATCHED_QOS)
        timeouts = self.loop_timeout, self.answer_timeout
        self.evaluator: Evaluator
        if self.step_test is None:
            self.evaluator = LoopPool(self, self.problem, self.loops, *timeouts, self.check_interrupted)
        else:
            loop = self.get_namespace() if self.loops == [OWN_LOOP] else self.loops[0]
            self.evaluator = AlternateLoop(self, self.problem, self.step_test, loop, *timeouts, self.check_interrupted)
        self.activated.set()

    def deactivate(self) -> None:
        """Stop, as at a signal."""
        self.interrupt()

    def _leave_what_activate_created(self) -> None:
        """Not yet: `run` needs it to leave the loop in order, and it is destroyed with the node."""

    # Parameters

    def _declare_problem(self) -> TuningProblem:
        case = self._declare_case()
        kind = self.declare_value("type", case.gains.type, "controller type to tune", fixed=True)
        free = self.declare_value("free", "", "what to tune besides the type's gains: sigma, or nothing", fixed=True)
        weight = self.declare_value("weight", case.weight, "w of IAE_SP + w·IAE_DIS, not below 0", fixed=True)
        algorithm = self.declare_value("algorithm", "hga", "hga, de or cmaes", fixed=True)
        seed = self.declare_value("seed", 0, "the same seed gives the same result", fixed=True)
        population = self.declare_value("population", POPULATION, "candidates, and lanes, of a generation", fixed=True)
        generations = self.declare_value("generations", GENERATIONS, "of a whole population each", fixed=True)
        polish = self.declare_value(
            "polish", population, "hga: candidates in a step of its polish; 0: none", fixed=True
        )
        return TuningProblem(
            case,
            controller_type(str(kind)),
            (str(free),) if free else (),
            number("weight", weight),
            str(algorithm),
            seed,
            population,
            generations,
            polish,
        )

    def _declare_case(self) -> Case:
        name = str(self.declare_value("case", "", "case to tune (p1-c0.5, …), or its parameter file", fixed=True))
        if not name:
            raise ParameterFileError("the tuner needs its parameter case: a case's name or its parameter file")
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            case = load_case(name)
        for warning in told:
            self.get_logger().warning(str(warning.message))
        bounds = {
            gain: read_bounds(
                gain, self.declare_value(f"bounds.{gain}", list(its), f"[lower, upper] of {gain}", fixed=True)
            )
            for gain in PER_LANE
            if (its := case.bounds.get(gain))
        }
        return replace(case, bounds=bounds)

    def _declare_step_test(self) -> StepTest | None:
        """How candidates are tested on a plant that cannot be reset; None for one in lockstep."""
        episode = self.declare_value("episode", "reset", f"how a candidate is tested: {', '.join(EPISODE)}", fixed=True)
        if episode not in EPISODE:
            raise ParameterFileError(f"episode is {episode!r}: it must be one of {', '.join(EPISODE)}")
        levels = self._declare_pair("levels", [0.0, 1.0], "alternate: the two setpoints")
        safe_output = self._declare_pair("safe_range.output", [-math.inf, math.inf], "alternate: ends a trial if left")
        safe_effort = self._declare_pair("safe_range.effort", [-math.inf, math.inf], "alternate: ends a trial if left")
        settle_band = self.declare_value(
            "settle_band", 0.02, "alternate: fraction of the step, counts as there", fixed=True
        )
        settle_time = self._declare_seconds("settle_time", 1.0, "alternate: s within settle_band, counts as settled")
        time_limit = self._declare_seconds("time_limit", 60.0, "alternate: s in which the output must settle")
        if episode == "reset":
            return None
        if len(self.loops) != 1 or EVERY_LOOP in self.loops:
            raise ParameterFileError(f"loops are {self.loops}: episode alternate tunes one loop, name that one")
        return StepTest(levels, number("settle_band", settle_band), settle_time, time_limit, safe_output, safe_effort)

    def _declare_pair(self, name: str, default: list[float], description: str) -> tuple[float, float]:
        value = self.declare_value(name, default, description, fixed=True)
        if not isinstance(value, list) or len(value) != 2:
            raise ParameterFileError(f"{name} is {value!r}: it must be two numbers")
        return number(name, value[0]), number(name, value[1])

    def _declare_path(self, name: str, what: str) -> Path | None:
        value = str(self.declare_value(name, "", f"{what}; empty: none", fixed=True))
        return Path(value) if value else None

    def _declare_seconds(self, name: str, default: float, description: str) -> float:
        return number(name, self.declare_value(name, default, description, fixed=True), 0.1, 1e6)

    # The run

    def run(self) -> None:
        """Tune until the budget is spent or somebody asks to stop, and leave the best gains on the controllers.

        Raises:
            TuningError: it cannot go on; the best gains so far are on the controllers that answer.
            InterruptedTuningError: asked to stop at once; likewise.
        """
        while not self.activated.wait(POLL):
            self.check_interrupted()
        self.report("tuning", "tuning")
        try:
            with tqdm(
                total=self.study.budget,
                initial=self.study.evaluations,
                unit=" evaluations",
                disable=not sys.stderr.isatty(),
            ) as self.bar:
                self.study.run(self.evaluator.evaluate, self._after_generation)
            if self.study.done and self.step_test is None:
                self._confirm()
        finally:
            self.stop_requested = self.stop_at_once = False
            self.evaluator.restore(self.study.result.gains if self.study.generation else None)
        if self.study.done:
            self._write_result()
            self.report("finished", f"finished: best {self.study.best_value:.6g}")
        else:
            self.report("interrupted", self._interrupted())

    def interrupt(self) -> None:
        """Stop at the end of the generation; asked again, or while no loop is in use, at once."""
        self.stop_at_once = self.stop_requested or not self.activated.is_set() or not self.evaluator.in_use
        self.stop_requested = True

    def check_interrupted(self) -> None:
        """Raise InterruptedTuningError if asked to stop at once, or to stop and no loop is left to end the
        generation."""
        if self.stop_at_once or (self.stop_requested and self.activated.is_set() and not self.evaluator.in_use):
            raise InterruptedTuningError(self._interrupted())

    def _after_generation(self, study: Study) -> bool:
        self._publish_progress()
        text = f"generation {study.generation}: best {study.best_value:.6g}"
        self.bar.set_description(text, refresh=False)
        self.bar.update(study.evaluations - self.bar.n)
        if self.bar.disable:
            self.get_logger().info(f"{text}, {study.evaluations} of {study.budget} evaluations")
        return not self.stop_requested

    def _publish_progress(self) -> None:
        study, gains = self.study, self.study.result.gains
        facts = {
            "best": study.best_value,
            "generation": study.generation,
            "evaluations": study.evaluations,
            "budget": study.budget,
            **{name: getattr(gains, name) for name in self.problem.names},
        }
        self.progress.header.stamp = self.get_clock().now().to_msg()
        self.progress.name, self.progress.position = list(facts), list(map(float, facts.values()))
        self.progress_publisher.publish(self.progress)

    def _confirm(self) -> None:
        """Measure the optimum once more, alone."""
        self._publish_progress()
        result = self.study.result
        value = float(self.evaluator.evaluate(candidate_of(self.problem, result.gains))[0])
        if value == result.objective:
            self.get_logger().info(f"confirmed: the controller has the optimum, objective {value:.6g}")
        else:
            self.get_logger().error(f"the optimum gave {result.objective!r} when it was found, and gives {value!r} now")

    def _write_result(self) -> None:
        if self.result_file is not None:
            write_parameters(self.result_file, {"controller": self.study.result.gains.as_dict()})
            self.get_logger().info(f"gains written to {self.result_file}")

    def _interrupted(self) -> str:
        return f"interrupted after {self.study.evaluations} of {self.study.budget} evaluations: {self.how_to_go_on}"

    # State

    def report(self, phase: str, text: str) -> None:
        """Say on the log and in the diagnostics what the tuner does now."""
        self.phase, self.text = phase, text
        if phase == "failed":
            self.get_logger().error(text)
        else:
            self.get_logger().info(text)
        self.publish_diagnostics()

    def state(self) -> tuple[int, str, dict[str, object]]:
        """The phase (waiting, tuning, finished, interrupted, failed) and how far the run is."""
        facts: dict[str, object] = {"state": self.phase}
        if self.activated.is_set():
            study = self.study
            facts |= {"generation": study.generation, "evaluations": study.evaluations, "budget": study.budget}
            facts |= {"best": study.best_value, "loops": " ".join(self.evaluator.in_use)}
        return ERROR if self.phase == "failed" else OK, self.text, facts


def main(args: list[str] | None = None) -> None:
    """Run the node: exit status 0 when finished or interrupted, 2 when it fails."""
    use_fast_dds_profile()
    rclpy.init(args=sys.argv if args is None else args, signal_handler_options=SignalHandlerOptions.NO)
    try:
        status = _serve(TunerNode())
    except (ValueError, OSError) as error:
        print(f"tuner: {error}", file=sys.stderr)
        status = FAILURE
    rclpy.try_shutdown()
    ignore_further_signals()
    sys.exit(status)


def _serve(node: TunerNode) -> int:
    """Run the node while another thread spins it; returns the exit status."""
    stopped, ended = threading.Event(), threading.Event()

    def on_signal(number: int, frame: FrameType | None) -> None:
        stopped.set()
        node.interrupt()

    for each in STOP_SIGNALS:
        signal.signal(each, on_signal)
    spinner = threading.Thread(target=_spin, args=(node, ended), name="spin", daemon=True)
    spinner.start()
    status = 0
    try:
        if node.autostart:
            autostart(node)
        node.run()
    except InterruptedTuningError as error:
        node.report("interrupted", str(error))
    except (ValueError, RuntimeError, OSError) as error:
        node.report("failed", str(error))
        status = FAILURE
    if node.stay:
        stopped.wait()
    ended.set()
    spinner.join()
    if node.activated.is_set():
        node.evaluator.close()
    end_within(LEAVE_TIMEOUT, status)
    node.destroy_node()
    return status


def _spin(node: TunerNode, ended: threading.Event) -> None:
    executor = executor_for(node)
    while not ended.is_set():
        executor.spin_once(timeout_sec=POLL)
    executor.remove_node(node)
