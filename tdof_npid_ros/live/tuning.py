"""Better gains for a loop that runs: searched for in a process of its own, looked at, and only then applied."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import threading
from pathlib import Path
from typing import NamedTuple

from tdof_npid_ros.case import Case
from tdof_npid_ros.control.gains import Gains
from tdof_npid_ros.graph.__main__ import PARENT
from tdof_npid_ros.plotting import Panel

LACKS_CASE = (
    "Tuning simulates the loop, and of this one no parameter file is known: name it with the loop, "
    "as in tdof-npid live heater.yaml --join /loop"
)


class Request(NamedTuple):
    """What is searched for.

    Attributes:
        case: parameter file: plant, episodes, bounds.
        gains: of one lane, as they are now; their type is tuned.
    """

    case: Path
    gains: Gains


class Progress(NamedTuple):
    """How far a search is: evaluations of its budget, and the best so far in a few words."""

    evaluations: int
    budget: int
    best: str


class Proposal(NamedTuple):
    """Gains that were found, and what they are predicted to do beside those that were set.

    Attributes:
        gains: of one lane.
        panels: the episodes, before and after.
        numbers, values: metrics with margins, and gains, as tables with titles first.
    """

    gains: Gains
    panels: list[Panel]
    numbers: list[list[str]]
    values: list[list[str]]


class Failure(NamedTuple):
    """Why there are no gains."""

    reason: str


State = Progress | Proposal | Failure


class Tuning:
    """The search of one loop, at most one at a time; all pages see the same.

    Args:
        case: the loop's; None: not known.
        path: of its parameter file.

    Attributes:
        state: how far it is, or what has come of it; None: there is nothing to tell.
    """

    def __init__(self, case: Case | None, path: Path | None) -> None:
        self._path = path if case is not None else None
        self._process: subprocess.Popen[bytes] | None = None
        self.state: State | None = None

    @property
    def runs(self) -> bool:
        """Whether a search goes on."""
        return isinstance(self.state, Progress)

    def start(self, gains: Gains) -> None:
        """Begin a search from these gains of one lane."""
        if self.runs:
            return
        if self._path is None:
            self.state = Failure(LACKS_CASE)
            return
        self.state = Progress(0, 0, "the search begins")
        # A session of its own: Ctrl-C reaches the program alone, which then ends the search.
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tdof_npid_ros.live.search"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
            env={**os.environ, PARENT: str(os.getpid())},
        )
        threading.Thread(
            target=self._follow, args=(self._process, Request(self._path, gains)), name="tuning", daemon=True
        ).start()

    def stop(self) -> None:
        """End the search, or forget what it found."""
        process, self._process, self.state = self._process, None, None
        if process is not None:
            process.kill()
            process.wait()

    close = stop

    def _follow(self, process: subprocess.Popen[bytes], request: Request) -> None:
        assert process.stdin is not None and process.stdout is not None
        last: State = Failure("the search has ended without a result")
        with process, process.stdin, process.stdout:
            try:
                pickle.dump(request, process.stdin)
                process.stdin.close()
                while True:
                    last = pickle.load(process.stdout)
                    self._tell(process, last)
            except (EOFError, pickle.UnpicklingError, OSError):  # it has ended
                pass
        if isinstance(last, Progress):
            last = Failure("the search has ended without a result")
        self._tell(process, last)

    def _tell(self, process: subprocess.Popen[bytes], state: State) -> None:
        if self._process is process:
            self.state = state
