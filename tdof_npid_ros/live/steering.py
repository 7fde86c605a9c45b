"""The hand on the loop: its parameters as they are now, changes of them, gains tried, margins.

A thread of its own waits for the nodes, so no browser does.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from tdof_npid_ros.case import Case
from tdof_npid_ros.control.gains import GAIN_NAMES, PER_LANE, gains_from_mapping
from tdof_npid_ros.control.options import OPTION_NAMES, options_from_mapping
from tdof_npid_ros.graph.observer import LoopObserver
from tdof_npid_ros.graph.runtime.parameter_client import NoAnswerError, Question, RefusedError
from tdof_npid_ros.live.gain_history import GainHistory
from tdof_npid_ros.one_line import one_line
from tdof_npid_ros.parameter_file import write_parameters
from tdof_npid_ros.parameters import sample_period_in_ns
from tdof_npid_ros.plants.catalog import effort_limits, model_table
from tdof_npid_ros.stability.margins import Margins, margins

LOOK_PERIOD = 1.0  # s between two looks at the parameters: somebody else may change them, too
MOST_MARGINS = 16  # lanes of which margins are computed
_Step = Callable[[GainHistory], dict[str, Any] | None]
CONTROLLER_NAMES = (*GAIN_NAMES, *OPTION_NAMES, "sample_period", "setpoint")


class Steering:
    """What can be changed in a loop, and what it is now.

    Args:
        observer: of the loop.
        case: its parameter file, where the user named one: what a class of his own needs.

    Attributes:
        values: the controller's parameters; empty before it has answered.
        plant: the plant's; empty where there is none that answers.
        history: of the gains with their type; None before the controller has answered.
        problems: why a change was refused, by parameter; what is not a parameter bears its own name.
        margins: of the gains now set, by lane, one where all lanes have the same; empty where they are not known, and
            then `why_no_margins`.
    """

    def __init__(self, observer: LoopObserver, case: Case | None = None) -> None:
        self._observer, self._case = observer, case
        self.values: dict[str, Any] = {}
        self.plant: dict[str, Any] = {}
        self.history: GainHistory | None = None
        self.problems: dict[str, str] = {}
        self.margins: tuple[Margins, ...] = ()
        self.why_no_margins = "the plant's parameters are not known yet"
        self._tasks: queue.Queue[Callable[[], None] | None] = queue.Queue()
        self._margins_of: tuple[Any, ...] = ()
        self._asked_plant: Question[dict[str, Any]] | None = None
        self._thread = threading.Thread(target=self._work, name="steering", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End, after what was asked for so far."""
        self._tasks.put(None)
        self._thread.join(timeout=10.0)

    # Asked for by the page; none of these waits

    def change(self, values: Mapping[str, Any]) -> None:
        """Set parameters of the controller together; a refusal goes to `problems`, under each of them."""
        self._tasks.put(lambda: self._change(dict(values)))

    def undo(self) -> None:
        """The gains before."""
        self._tasks.put(lambda: self._step(GainHistory.undo, GainHistory.redo))

    def redo(self) -> None:
        """The gains that were undone."""
        self._tasks.put(lambda: self._step(GainHistory.redo, GainHistory.undo))

    def reset(self) -> None:
        """Let the plant begin once more."""

        def reset() -> None:
            self._try("reset", lambda: self._observer.remote("plant").trigger("reset"))

        self._tasks.put(reset)

    def setpoint(self, values: Sequence[float]) -> None:
        """Give a setpoint, on the topic: one value, or one for each lane."""
        self._observer.publish("setpoint", values)

    def disturbance(self, values: Sequence[float]) -> None:
        """Give a disturbance, on the topic."""
        self._observer.publish("disturbance", values)

    def keep(self, path: Path) -> None:
        """Write the controller's parameters as a file that every command takes.

        Raises:
            ParameterFileError: it cannot be written.
        """
        kept = {name: value for name, value in self.values.items() if name != "setpoint" and value is not None}
        write_parameters(path, {"controller": kept})

    # In the thread

    def _work(self) -> None:
        self._outlive("look", self._look)
        while True:
            try:
                task = self._tasks.get(timeout=LOOK_PERIOD)
            except queue.Empty:
                pass
            else:
                if task is None:
                    return
                self._outlive("task", task)
            self._outlive("look", self._look)

    def _outlive(self, what: str, task: Callable[[], None]) -> None:
        """Do it; whatever goes wrong is told, and the thread goes on."""
        try:
            task()
        except Exception as error:
            self.problems[what] = one_line(f"{type(error).__name__}: {error}")
        else:
            self.problems.pop(what, None)

    def _try(self, what: str, action: Callable[[], object]) -> bool:
        try:
            action()
        except (RefusedError, NoAnswerError) as error:
            self.problems[what] = str(error).rpartition("refused ")[2]
            return False
        self.problems.pop(what, None)
        return True

    def _change(self, values: dict[str, Any]) -> None:
        try:
            self._observer.remote("controller").set_parameters(values)
        except (RefusedError, NoAnswerError) as error:
            reason = str(error).partition(": ")[2] or str(error)
            self.problems |= dict.fromkeys(values, reason)
            return
        for name in values:
            self.problems.pop(name, None)
        self.values |= values
        if self.history is not None:
            self.history.note(self._gains())

    def _step(self, step: _Step, back: _Step) -> None:
        """A step in the history, and back again where the controller refuses it."""
        if self.history is None or (gains := step(self.history)) is None:
            return
        if self._try("undo", lambda: self._observer.remote("controller").set_parameters(gains)):
            self.values |= gains
        else:
            back(self.history)

    def _gains(self) -> dict[str, Any]:
        return {name: self.values[name] for name in ("type", *PER_LANE)}

    def _look(self) -> None:
        """Whatever has changed: by us, or by somebody else."""
        try:
            found = self._observer.remote("controller").parameters(CONTROLLER_NAMES)
        except NoAnswerError as error:
            self.problems["controller"] = str(error)
            return
        self.problems.pop("controller", None)
        if any(value is None for value in found.values()):
            return
        self.values = found
        if self.history is None:
            self.history = GainHistory(self._gains())
        elif self.history.now != self._gains():
            self.history.note(self._gains())
        if self.plant:
            self._look_at_plant_again()
        elif self._observer.remote("plant").serves("reset"):
            self._look_at_plant()
        self._look_at_margins()

    def _look_at_plant(self) -> None:
        remote = self._observer.remote("plant")
        try:
            known = remote.parameters(["model", "effort_min", "effort_max", "lanes"])
            model = str(known["model"])
            if ":" in model and (self._case is None or self._case.model != model):
                self.plant, self.why_no_margins = known, f"{model} is a class: name its parameter file to know it here"
                return
            self.plant = known | remote.parameters(list(model_table(model)))
        except (NoAnswerError, RefusedError, ValueError) as error:
            self.why_no_margins = str(error)

    def _look_at_plant_again(self) -> None:
        """Take over what has changed, once it is told: a plant that does not answer holds nothing up."""
        asked = self._asked_plant = self._asked_plant or self._observer.remote("plant").ask_parameters(list(self.plant))
        if asked.look():
            self._asked_plant, found = None, asked.answer
            self.plant = found if found["model"] == self.plant["model"] else {}  # begun again as another one

    def _look_at_margins(self) -> None:
        """Margins of what is in force, if that has changed."""
        wanted = (tuple(sorted((k, str(v)) for k, v in self.values.items())), str(self.plant))
        if wanted == self._margins_of or "model" not in self.plant:
            return
        self._margins_of = wanted
        try:
            gains, options = gains_from_mapping(self.values), options_from_mapping(self.values)
            case = Case(
                name="the loop",
                sample_period_ns=sample_period_in_ns(self.values["sample_period"]),
                model=str(self.plant["model"]),
                plant_values=self.plant,
                effort_limits=effort_limits(self.plant),
                gains=gains,
                episodes={},
                options=options,
            )
            self.margins = tuple(margins(case, gains, lane) for lane in range(min(gains.lanes, MOST_MARGINS)))
        except ValueError as error:
            self.margins, self.why_no_margins = (), str(error)
