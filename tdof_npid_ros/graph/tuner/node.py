"""The tuner: tunes the controller that runs, through ROS 2 alone."""

from __future__ import annotations

import sys
import threading
import warnings
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, Protocol

from sensor_msgs.msg import JointState
from tqdm import tqdm

from tdof_npid_ros.case import Case, load_case, read_bounds
from tdof_npid_ros.control.gains import Gains
from tdof_npid_ros.graph.runtime.messages import signal_message
from tdof_npid_ros.graph.runtime.node import ERROR, OK, LoopNode
from tdof_npid_ros.graph.runtime.qos import LATCHED_QOS
from tdof_npid_ros.graph.runtime.run import Stop, run_node
from tdof_npid_ros.graph.tuner.alternate_loop import AlternateLoop
from tdof_npid_ros.graph.tuner.loop_pool import EVERY_LOOP, OWN_LOOP, LoopPool
from tdof_npid_ros.graph.tuner.patience import POLL, Patience
from tdof_npid_ros.output_file import check_writable
from tdof_npid_ros.parameter import ParameterError
from tdof_npid_ros.parameter_file import check_replaceable, write_parameters
from tdof_npid_ros.parameters import BOUNDS, TUNER
from tdof_npid_ros.tuning import TuningError
from tdof_npid_ros.tuning.alternate import StepTest
from tdof_npid_ros.tuning.ask_tell import Array, Scores
from tdof_npid_ros.tuning.judge import Constraints
from tdof_npid_ros.tuning.problem import TuningProblem, candidate_of
from tdof_npid_ros.tuning.study import Study

FAILURE = 2  # exit status
SEARCHED = ("free", *(one.name for one in fields(Constraints)))  # what a case's file may ask of the search


class InterruptedTuningError(RuntimeError):
    """Somebody asked to stop at once."""


class Evaluator(Protocol):
    """What measures candidates on live loops."""

    @property
    def in_use(self) -> list[str]:
        """Namespaces of the loops in use."""
        ...

    def evaluate(self, candidates: Array) -> Scores:
        """Scores of candidates (n, gains)."""
        ...

    def restore(self, gains: Gains | None, objective: float) -> tuple[Gains | None, bool]:
        """Leave the loops with the best gains.

        Args:
            gains: the best of whole generations, and their objective; None: there are none yet.

        Returns:
            The best gains, those of a generation that was cut short among them (None: the loops have those of before
            the tuning), and whether every loop in use has them.
        """
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
        case = self._declared_case()
        self.problem = self._problem(case)
        self.loops = self.given["loops"]
        self.loop_timeout, self.answer_timeout = self.given["loop_timeout"], self.given["answer_timeout"]
        checkpoint, self.result_file = _path(self.given["checkpoint"]), _path(self.given["result"])
        self.step_test = self._step_test()
        self.uses_events_executor = self.step_test is not None  # else outputs are tapped, and taps must be left alone
        self.stay = self.given["stay"]
        if self.result_file is not None:
            check_writable(self.result_file)
            check_replaceable(self.result_file, "controller", Gains().as_dict())
        self.accept_changes()
        self.study = Study(self.problem, checkpoint, self.given["resume"])
        self.how_to_go_on = "start again to go on" if checkpoint else "without a checkpoint, a new start begins anew"

    def activate(self) -> None:
        """Look for the loops, and let `run` begin."""
        self.progress = signal_message("")
        self.progress_publisher = self.create_publisher(JointState, "tuning_progress", LATCHED_QOS)
        patience = Patience(self.loop_timeout, self.answer_timeout, self.check_interrupted)
        self.evaluator: Evaluator
        if self.step_test is None:
            self.evaluator = LoopPool(self, self.problem, self.loops, patience)
        else:
            loop = self.get_namespace() if self.loops == [OWN_LOOP] else self.loops[0]
            self.evaluator = AlternateLoop(self, self.problem, self.step_test, loop, patience)
        self.activated.set()

    def deactivate(self) -> None:
        """Stop, as at a signal."""
        self.interrupt()

    def _while_active(self, callback: Callable[..., Any]) -> Callable[..., Any]:
        """Also afterwards: `run` hears the loop until it has left it in order."""
        return callback

    def destroy_node(self) -> None:
        """As `LoopNode.destroy_node`, after the loops have been left."""
        if self.activated.is_set():
            self.evaluator.close()
        super().destroy_node()

    def _leave_what_activate_created(self) -> None:
        """Not yet: `run` needs it to leave the loop in order, and it is destroyed with the node."""

    # Parameters

    def _declared_case(self) -> Case:
        """The case, with the bounds and the weight that were given to the tuner itself; all is declared.

        What the case's file asks of the search holds where the tuner is not given it: margins only where there is a
        model to have them.
        """
        name = self.declare(TUNER["case"])
        if not name:
            raise ParameterError("the tuner needs its parameter case: a case's name or its parameter file")
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            case = load_case(name)
        for warning in told:
            self.get_logger().warning(str(warning.message))
        its: dict[str, Any] = {f"bounds.{gain}": list(bounds) for gain, bounds in case.bounds.items()}
        asked = ("free",) if self.declare(TUNER["episode"]) == "alternate" else SEARCHED
        its |= {name: case.search[name] for name in asked if name in case.search}
        unbounded = BOUNDS.keys() - its.keys() - self._parameter_overrides.keys()
        table = {name: parameter for name, parameter in TUNER.items() if name not in unbounded}
        population = self.declare(TUNER["population"])
        self.given = self.declare_all(table, type=case.gains.type, weight=case.weight, polish=population, **its)
        return replace(case, bounds=read_bounds(self.given), weight=self.given["weight"])

    def _problem(self, case: Case) -> TuningProblem:
        given = self.given
        return TuningProblem(
            case,
            given["type"],
            (given["free"],) if given["free"] and given["type"] != "pid" else (),
            case.weight,
            given["algorithm"],
            given["seed"],
            given["population"],
            given["generations"],
            given["polish"],
            Constraints.of_search(given),
            warm=given["start"] == "case",
            until_converged=given["until_converged"],
        )

    def _step_test(self) -> StepTest | None:
        """How candidates are tested on a plant that cannot be reset; None for one in lockstep."""
        given = self.given
        if given["episode"] == "reset":
            return None
        if len(self.loops) != 1 or EVERY_LOOP in self.loops:
            raise ParameterError(f"loops are {self.loops}: episode alternate tunes one loop, name that one")
        if self.problem.constraints.given:
            asked = ", ".join(self.problem.constraints.given)
            raise ParameterError(f"{asked} with episode alternate: margins are those of a model, and this has none")
        levels, safe_output, safe_effort = (
            (given[name][0], given[name][1]) for name in ("levels", "safe_range.output", "safe_range.effort")
        )
        settling = given["settle_band"], given["settle_time"], given["time_limit"]
        return StepTest(levels, *settling, safe_output, safe_effort)

    # The run

    def run(self) -> None:
        """Tune until the budget is spent or somebody asks to stop, and leave the best gains on the controllers.

        Raises:
            TuningError: it cannot go on; the best gains so far are on the controllers that answer, and in the file.
            InterruptedTuningError: asked to stop before it was activated.
        """
        while not self.activated.wait(POLL):
            self.check_interrupted()
        left: tuple[Gains | None, bool] = None, False
        failure: Exception | None = None
        for reason in self.problem.restless.values() if self.step_test is None else ():
            self.get_logger().warning(f"{reason}, so no loop comes to rest in it and none is asked to")
        self.report("tuning", "tuning")
        try:
            with tqdm(
                total=self.study.budget,
                initial=self.study.evaluations,
                unit=" evaluations",
                disable=None,
            ) as self.bar:
                self.study.run(self.evaluator.evaluate, self._after_generation)
            if self.study.done and self.study.feasible and self.step_test is None:
                self._confirm()
        except InterruptedTuningError:
            pass  # what it leaves, is told below
        except (ValueError, RuntimeError, OSError) as error:
            failure = error  # likewise
        finally:
            self.stop_requested = self.stop_at_once = False
            best = self.study.result.gains if self.study.feasible else None
            left = self.evaluator.restore(best, self.study.best_value)
        if failure is not None:
            if left[0] is None:
                raise failure
            try:
                self._write_result(left[0])
            except (ValueError, OSError) as unwritten:
                raise TuningError(f"{failure}; and {unwritten}") from failure
            raise TuningError(f"{failure}; {self._left(*left)}") from failure
        if self.study.done:
            self.study.require_feasible()
            self._write_result(self.study.result.gains)
            self.report("finished", self._finished())
        else:
            if left[0] is not None:
                self._write_result(left[0])
            self.report("interrupted", self._interrupted(*left))

    def interrupt(self) -> None:
        """Stop at the end of the generation; asked again, or while no loop is in use, at once."""
        self.stop_at_once = self.stop_requested or not self.activated.is_set() or not self.evaluator.in_use
        self.stop_requested = True
        if self.phase == "tuning" and not self.stop_at_once:
            self.get_logger().info("stops with this generation; a second Ctrl-C stops at once")

    def check_interrupted(self) -> None:
        """Raise InterruptedTuningError if asked to stop at once, or to stop and no loop is left to end the
        generation."""
        if self.stop_at_once or (self.stop_requested and self.activated.is_set() and not self.evaluator.in_use):
            raise InterruptedTuningError("interrupted before it began")

    def _after_generation(self, study: Study) -> bool:
        self._publish_progress()
        text = f"generation {study.generation}: {study.best_told}"
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
        value = float(self.evaluator.evaluate(candidate_of(self.problem, result.gains)).objective[0])
        if value == result.objective:
            self.get_logger().info(f"confirmed: the controller has the optimum, objective {value:.6g}")
        else:
            self.get_logger().error(f"the optimum gave {result.objective!r} when it was found, and gives {value!r} now")

    def _write_result(self, gains: Gains) -> None:
        if self.result_file is not None:
            write_parameters(self.result_file, {"controller": gains.as_dict()})
            self.get_logger().info(f"gains written to {self.result_file}")

    def _finished(self) -> str:
        study, problem = self.study, self.problem
        told = f"finished: {study.best_told}"
        if saved := study.budget - study.evaluations:
            told += f", converged with {saved} of {study.budget} evaluations to spare"
        ends = problem.at_bounds(study.result.gains)
        return told + "".join(f"; {name} is at its {end} bound" for name, end in ends.items())

    def _interrupted(self, best: Gains | None, is_set: bool) -> str:
        study, left = self.study, self._left(best, is_set)
        return f"interrupted after {study.evaluations} of {study.budget} evaluations: {left}; {self.how_to_go_on}"

    def _left(self, best: Gains | None, is_set: bool) -> str:
        """What the controllers and the result file have, as `Evaluator.restore` tells it."""
        what = "the gains of before" if best is None else "the best gains so far"
        where = f"{what} are on the controller" if is_set else f"{what} could not be set on the controller"
        if best is not None and self.result_file is not None:
            where += f" and in {self.result_file}" if is_set else f", but are in {self.result_file}"
        return where

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


def _path(name: str) -> Path | None:
    return Path(name) if name else None


def tune(node: TunerNode, stop: Stop) -> int:
    """Run the tuning; exit status 0 when it is finished or interrupted, 2 when it fails."""
    stop.calls(node.interrupt)
    status = 0
    try:
        node.run()
    except InterruptedTuningError as error:
        node.report("interrupted", str(error))
    except (ValueError, RuntimeError, OSError) as error:
        node.report("failed", str(error))
        status = FAILURE
    if node.stay:
        stop.wait()
    return status


def main(args: list[str] | None = None) -> None:
    """Run the node."""
    run_node(TunerNode, sys.argv if args is None else args, tune)
