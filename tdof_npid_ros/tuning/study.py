"""A study: a tuning problem, its optimiser, and the checkpoint that it can be resumed from.

It is asked for candidates and told their values, so one study serves the offline tuner and the live one:

    study = Study(problem, checkpoint)
    study.run(Objective(problem))        # or, anywhere else: study.tell(measured_scores(study.ask())) until study.done
    study.result.gains
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from tdof_npid_ros.case import Case
from tdof_npid_ros.checkpoint import CheckpointError, first_difference, read_checkpoint, write_checkpoint
from tdof_npid_ros.control.gains import ControllerType, Gains
from tdof_npid_ros.one_line import one_line
from tdof_npid_ros.output_file import hold
from tdof_npid_ros.tuning import TuningError
from tdof_npid_ros.tuning.ask_tell import Array, Optimizer, Scores
from tdof_npid_ros.tuning.judge import Constraints
from tdof_npid_ros.tuning.objective import Objective
from tdof_npid_ros.tuning.optimizers import make_optimizer, restore_optimizer
from tdof_npid_ros.tuning.perturbed import Perturbed
from tdof_npid_ros.tuning.problem import GENERATIONS, POPULATION, TuningProblem


class Improvement(NamedTuple):
    """A generation that found a better candidate, for the convergence plot; `violation`: 0 for one that is allowed."""

    generation: int
    evaluations: int
    value: float
    violation: float


@dataclass(frozen=True)
class TuningResult:
    """What a study has found so far.

    Attributes:
        gains: the best candidate's.
        objective: its value (10).
        feasible: whether it is allowed; if not, nothing that was seen is.
        converged: whether nothing better is to be expected of a longer search.
        evaluations: candidates evaluated in all.
        improvements: how it got there.
    """

    gains: Gains
    objective: float
    feasible: bool
    converged: bool
    evaluations: int
    improvements: tuple[Improvement, ...]


class Study:
    """One tuning run; the outcome depends on the problem alone, however often it is stopped and
    resumed (resumed = uninterrupted)."""

    def __init__(self, problem: TuningProblem, checkpoint: Path | None = None, resume: bool = False) -> None:
        """
        Args:
            checkpoint: written now and after each generation.
            resume: go on from the checkpoint if there is one.

        Raises:
            TuningError: the problem cannot be searched.
            CheckpointError: the checkpoint is of another problem, damaged or of a newer version; or it is there but
                not to be resumed. Nothing is overwritten.
            OutputError: another run writes the checkpoint.
        """
        self.problem = problem
        self._checkpoint = checkpoint
        self._improvements: list[Improvement] = []
        self._optimizer = self._new_optimizer()
        if checkpoint is None:
            return
        hold(checkpoint)
        if not checkpoint.exists():
            self._save()
        elif resume:
            self._restore(checkpoint)
        else:
            raise CheckpointError(f"checkpoint {checkpoint} exists: resume it, or give another file")

    @property
    def done(self) -> bool:
        """Whether the search is over: its budget is spent, or it has converged and was to end then."""
        return self._optimizer.done or (self.problem.until_converged and self.converged)

    @property
    def converged(self) -> bool:
        """Whether nothing better is to be expected of a longer search; only the HGA's tells."""
        return self._optimizer.converged

    @property
    def generation(self) -> int:
        """Generations told."""
        return self._optimizer.generation

    @property
    def evaluations(self) -> int:
        """Candidates told."""
        return self._optimizer.evaluations

    @property
    def budget(self) -> int:
        """Candidates that the study ends after."""
        return self._optimizer.budget

    @property
    def best_value(self) -> float:
        """The objective of the best so far; infinite before the first generation."""
        return self._optimizer.best_value

    @property
    def feasible(self) -> bool:
        """Whether the best so far is allowed: a stable loop that comes to rest with the margins asked for."""
        return self.generation > 0 and self._optimizer.best_violation == 0.0

    @property
    def best_told(self) -> str:
        """The best so far in a few words."""
        return f"best {self.best_value:.6g}" if self.feasible else "nothing allowed yet"

    def require_feasible(self) -> None:
        """Raise TuningError, with the reason, if nothing that was seen is allowed."""
        if not self.feasible:
            violation = self._optimizer.best_violation
            raise TuningError(f"{self.problem.shortfall(self.result.gains, violation)}: no gains are given")

    @property
    def result(self) -> TuningResult:
        """The best so far. Raises TuningError before the first generation."""
        gains = self.problem.gains(self._optimizer.best_x)
        return TuningResult(
            gains, self.best_value, self.feasible, self.converged, self.evaluations, tuple(self._improvements)
        )

    def ask(self) -> Array:
        """The generation's candidates, (n, len(problem.names)); the same ones until they are told."""
        return self._optimizer.ask()

    def tell(self, scores: Scores) -> None:
        """Take the scores of the candidates asked, and save the checkpoint.

        Raises:
            TuningError: not one finite score per candidate.
            CheckpointError: the checkpoint cannot be written.
        """
        optimizer = self._optimizer
        before = optimizer.best_violation, optimizer.best_value
        optimizer.tell(scores)
        after = optimizer.best_violation, optimizer.best_value
        if after < before:
            self._improvements.append(Improvement(self.generation, self.evaluations, *reversed(after)))
        self._save()

    def run(self, evaluate: Callable[[Array], Scores], after_generation: Callable[[Study], bool] | None = None) -> None:
        """Run until the study is done, or until `after_generation` returns False.

        Args:
            evaluate: candidates (n, d) to their scores.
            after_generation: called with the study after each generation; whether to go on.
        """
        while not self.done:
            self.tell(evaluate(self.ask()))
            if after_generation is not None and not after_generation(self):
                return

    def _new_optimizer(self) -> Optimizer:
        problem = self.problem
        lower, upper = zip(*problem.bounds, strict=True)
        return make_optimizer(
            problem.algorithm,
            lower,
            upper,
            seed=problem.seed,
            population=problem.population,
            generations=problem.generations,
            polish=problem.polish,
            logarithmic=problem.logarithmic,
            starts=problem.starts,
        )

    def _save(self) -> None:
        if self._checkpoint is not None:
            content = {
                "problem": self.problem.description(),
                "improvements": self._improvements,
                "optimizer": self._optimizer.state(),
            }
            write_checkpoint(self._checkpoint, "tuning", content)

    def _restore(self, path: Path) -> None:
        content = read_checkpoint(path, "tuning")
        difference = first_difference(content.get("problem"), self.problem.description())
        if difference:
            raise CheckpointError(f"checkpoint {path} is of another problem: {difference}")
        try:
            self._improvements = [Improvement(*one) for one in content["improvements"]]
            self._optimizer = restore_optimizer(content["optimizer"])
        except (LookupError, TypeError, ValueError, ArithmeticError, AttributeError, TuningError) as error:
            raise CheckpointError(
                f"checkpoint {path} is damaged, start anew with another file: {one_line(error)}"
            ) from None


def tune_case(
    case: Case,
    controller: ControllerType,
    *,
    seed: int = 0,
    extra: tuple[str, ...] = (),
    algorithm: str = "hga",
    population: int = POPULATION,
    generations: int = GENERATIONS,
    constraints: Constraints | None = None,
    threads: int | None = None,
    perturbed: Perturbed | None = None,
) -> TuningResult:
    """Tune one controller type on a case, in process, with the case's bounds and weight, from random gains.

    Args:
        extra: `("sigma",)` to free sigma too.
        constraints: margins that the loop must have; whether it has them, `feasible` says.
        threads: by default one per core; the result does not depend on it.
        perturbed: plants near the case's, to tune for all of them at once.

    Raises:
        TuningError: see `TuningProblem`.
    """
    problem = TuningProblem(
        case,
        controller,
        extra,
        case.weight,
        algorithm,
        seed,
        population,
        generations,
        constraints=constraints or Constraints(),
        perturbed=perturbed,
    )
    study = Study(problem)
    study.run(Objective(problem, threads))
    return study.result
