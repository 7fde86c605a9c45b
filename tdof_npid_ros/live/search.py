"""`python -m tdof_npid_ros.live.search`: the process that searches for gains, behind all that runs in real time.

It reads a request and writes how far it is and what it finds, pickled, for the program that has started it.
"""

from __future__ import annotations

import os
import pickle
import sys
import time
from collections.abc import Callable
from dataclasses import replace

from tdof_npid_ros.case import load_case
from tdof_npid_ros.graph.__main__ import end_with_parent
from tdof_npid_ros.live.tuning import Failure, Progress, Proposal, Request, State
from tdof_npid_ros.prediction import gains_table, numbers, panels, simulated
from tdof_npid_ros.tuning.objective import Objective
from tdof_npid_ros.tuning.problem import TuningProblem
from tdof_npid_ros.tuning.study import Study

NICE = 10  # how far behind the loop's nodes it stands
TOLD_EVERY = 0.2  # s


def search(request: Request, tell: Callable[[State], None]) -> Proposal:
    """Tune the type of the request's gains as its parameter file says, beginning with these gains.

    Raises:
        ValueError: the file or its bounds are wrong, or nothing is found; the message says what.
    """
    case = replace(load_case(request.case), gains=request.gains)
    study = Study(TuningProblem.of_case(case, request.gains.type, warm=True, until_converged=True))
    told = -TOLD_EVERY

    def after_generation(study: Study) -> bool:
        nonlocal told
        if time.monotonic() - told > TOLD_EVERY:
            told = time.monotonic()
            tell(Progress(study.evaluations, study.budget, study.best_told))
        return True

    study.run(Objective(study.problem), after_generation)
    study.require_feasible()
    of = {"now": request.gains, "tuned": study.result.gains}
    return Proposal(study.result.gains, panels(case, simulated(case, of)), numbers(case, of), gains_table(of))


def main() -> None:
    """Serve one request."""
    end_with_parent()
    os.nice(NICE)
    output = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # whatever is printed goes to the log

    def tell(state: State) -> None:
        pickle.dump(state, output)
        output.flush()

    try:
        tell(search(pickle.load(sys.stdin.buffer), tell))
    except ValueError as error:
        tell(Failure(str(error)))


if __name__ == "__main__":
    main()
