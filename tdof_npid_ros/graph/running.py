"""A whole loop as processes of this program: started, set, played, recorded and stopped from Python.

from tdof_npid_ros import run

with run("p1-c0.5", bag="bags/first") as loop:
    loop.set(kp=5.0, ki=4.0)
    loop.play("setpoint")
    loop.wait()
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

from tdof_npid_ros.case import Case, load_case
from tdof_npid_ros.graph.conductor import Conductor, LoopError
from tdof_npid_ros.graph.processes import NodeProcesses
from tdof_npid_ros.graph.runtime.middleware import stay_on_this_machine
from tdof_npid_ros.output_file import new_folder
from tdof_npid_ros.parameter_file import find_parameter_file, read_parameters
from tdof_npid_ros.parameters import MODE

Mode = Literal["lockstep", "realtime"]
NODES = ("plant", "controller", "scenario")
START_TIMEOUT = 60.0  # s; the first start compiles
SUBSCRIBERS = {"output": 1, "control_effort": 1, "scenario_plan": 2}  # of a loop that is ready; a recorder comes to it


class RunningLoop:
    """A loop that runs: what `run` gives.

    Attributes:
        case: what runs.
        namespace: of its nodes.
        bag: what it is recorded to; None: it is not.
        conductor: a client of its nodes, for whatever is not here.
    """

    def __init__(self, case: Case, conductor: Conductor, processes: NodeProcesses, bag: Path | None) -> None:
        self.case, self.conductor, self.bag = case, conductor, bag
        self._processes = processes
        self._played = 0
        self._wanted = 0

    def set(self, node: str = "controller", **values: Any) -> None:
        """Set parameters of a node together: all, or none of them.

        Raises:
            RefusedError: with the node's reason.
            NoAnswerError: it does not answer.
        """
        self.conductor.set_parameters(node, values)

    def get(self, *names: str, node: str = "controller") -> dict[str, Any]:
        """Parameters of a node by name; None for those that it does not have."""
        return self.conductor.remote(node).parameters(names)

    def play(self, *episodes: str) -> None:
        """Begin to play episodes of the case, by default all; those before must have been played (`wait`).

        Raises:
            LoopError: the scenario does not begin, or there is no such episode.
        """
        unknown = [name for name in episodes if name not in self.case.episodes]
        if unknown:
            raise LoopError(f"no episode {', '.join(unknown)}: there are {', '.join(self.case.episodes) or 'none'}")
        self.conductor.remote("scenario").set_parameters({"episodes": list(episodes or self.case.episodes)})
        self._wanted = int(self.conductor.fact("scenario", "played") or 0) + 1
        self.conductor.play(START_TIMEOUT)

    @property
    def is_playing(self) -> bool:
        """Whether an episode that `play` began is still to end."""
        return int(self.conductor.fact("scenario", "played") or 0) < self._wanted

    def wait(self, timeout: float | None = None, tell: Callable[[float], None] | None = None) -> None:
        """Wait until all that is being played has ended.

        Args:
            timeout: s; None: as long as it takes.
            tell: called again and again with the loop's time in the present episode, s.

        Raises:
            LoopError: it has not ended in time.
            NodeProcessError: a node has ended.
        """
        end = None if timeout is None else time.monotonic() + timeout
        while self.is_playing:
            if end is not None and time.monotonic() > end:
                raise LoopError(f"the episodes have not ended within {timeout:g} s")
            self.idle(0.1)
            if tell is not None:
                tell(self.conductor.time_ns / 1e9)

    def idle(self, seconds: float) -> None:
        """Let time pass, while the nodes work.

        Raises:
            NodeProcessError: a node has ended.
        """
        end = time.monotonic() + seconds
        self.conductor.wait(lambda: time.monotonic() >= end, "time", seconds + 60.0)


@contextmanager
def run(
    case: str | Path,
    *,
    bag: str | Path | None = None,
    mode: Mode | None = None,
    namespace: str = "/",
    nodes: Sequence[str] = NODES,
    **parameters: Any,
) -> Iterator[RunningLoop]:
    """Start a loop's nodes as processes of this program; they end with the context, in order.

    Args:
        case: its name or parameter file.
        bag: a new folder to record to; None: nothing is recorded.
        mode: lockstep or realtime; None: as the file says.
        namespace: of the nodes; several loops run side by side in namespaces of their own.
        nodes: which are started; the recorder comes by `bag`.
        parameters: for all nodes, after those of the file: `speed=20.0`.

    Yields:
        The running loop; its scenario waits for `play`.

    Raises:
        ParameterFileError, PlantError, PlanError, GainsError: something is wrong with the case.
        OutputError: the bag is there already.
        LoopError, NodeProcessError: the nodes do not start.
    """
    stay_on_this_machine()
    path, loaded = find_parameter_file(case), load_case(case)
    folder = None if bag is None else Path(bag)
    common = parameters | ({"mode": mode} if mode else {})
    with NodeProcesses(path, namespace) as processes:
        start_nodes(processes, loaded, path, folder, common, play=False, nodes=nodes)
        conductor = Conductor(namespace, processes.check)
        try:
            extra = folder is not None
            wanted = {topic: count + extra for topic, count in SUBSCRIBERS.items()}
            if set(nodes) >= set(NODES):
                conductor.wait_for_subscriptions(wanted, START_TIMEOUT)
            yield RunningLoop(loaded, conductor, processes, folder)
        finally:
            conductor.close()


def start_nodes(
    processes: NodeProcesses,
    case: Case,
    path: Path,
    bag: Path | None,
    common: Mapping[str, Any],
    *,
    play: bool,
    nodes: Sequence[str] = NODES,
    controller: Mapping[str, Any] | None = None,
) -> None:
    """Start a case's nodes, the recorder first.

    Args:
        path: of the case's parameter file.
        bag: a new folder to record to; None: nothing is recorded.
        common: parameters for all nodes, after those of the file.
        play: whether the scenario plays at once.
        controller: further parameters for the controller.

    Raises:
        OutputError: the bag is there already.
    """
    if bag is not None:
        new_folder(bag)
    mode = common.get("mode") or read_parameters(path, "plant").get("mode", MODE.default)
    lossless = {"lossless": bag is not None and mode == "lockstep"}
    own: dict[str, dict[str, Any]] = {
        "plant": dict(lossless),
        "controller": {"sigma": case.gains.sigma, **(controller or {})},
        "scenario": {"play": play},
    }
    if bag is not None:
        processes.start("recorder", {**common, "bag": str(bag), **lossless})
    for node in nodes:
        processes.start(node, {**common, **own.get(node, {})})
