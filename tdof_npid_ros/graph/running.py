"""A whole loop as processes of this program: started, set, played, recorded and stopped from Python.

from tdof_npid_ros import run

with run("p1-c0.5", bag="bags/first") as loop:
    loop.set(kp=5.0, ki=4.0)
    loop.play("setpoint")
    loop.wait()
print(loop.bag)
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rclpy.node import Node

from tdof_npid_ros.case import Case, load_case
from tdof_npid_ros.control.gains import GAIN_NAMES, Gains
from tdof_npid_ros.graph.conductor import POLL, Conductor, LoopError
from tdof_npid_ros.graph.processes import NodeProcesses
from tdof_npid_ros.graph.runtime.middleware import stay_on_this_machine
from tdof_npid_ros.names import meant_hint
from tdof_npid_ros.output_file import new_folder
from tdof_npid_ros.parameter import ParameterError
from tdof_npid_ros.parameter_file import find_parameter_file, read_parameters
from tdof_npid_ros.parameters import MODE, NODES
from tdof_npid_ros.plants.catalog import model_parameters

Mode = Literal["lockstep", "realtime"]
OF_A_LOOP = ("plant", "controller", "scenario")
END_BY_THEMSELVES = ("tuner", "replay")
START_TIMEOUT = 60.0  # s; the first start compiles
STANDS_STILL = 20.0  # s without a step of the plant until nothing is waited for any longer
GIVEN = ("setpoint", "disturbance", "manual_effort")  # what a script may publish, where no scenario does
# Who publishes a topic of the loop, and who takes it; a recorder comes to what is published.
TOPICS = {
    "output": ("plant", ("controller",)),
    "control_effort": ("controller", ("plant",)),
    "scenario_plan": ("scenario", ("plant", "controller")),
}


class RunningLoop:
    """A loop that runs: what `run` gives.

    Attributes:
        case: what runs.
        bag: the folder that it is recorded to; None: it is not. It is whole once the context has been left.
        node: an rclpy node in the loop's namespace, for publishers and subscriptions of one's own; it is served in
            `wait` and `idle`.
        conductor: a client of the loop's nodes, for whatever is not here.
    """

    def __init__(self, case: Case, conductor: Conductor, processes: NodeProcesses, bag: Path | None) -> None:
        self.case, self.conductor, self.bag, self.node = case, conductor, bag, conductor.node
        self._processes = processes
        self._playing: tuple[str, ...] = ()
        self._wanted = 0  # how often the scenario has played all its episodes, once the present ones have ended
        self._first = 0  # number of the plant's first episode of those

    def start(self, node: str, **parameters: Any) -> None:
        """Start a further node: the tuner, a recorder, a replay.

        Args:
            parameters: after those of the case's file; dots in names as double underscores.
        """
        self._processes.start(node, _plain(parameters), ends=node in END_BY_THEMSELVES)

    def has_ended(self, node: str) -> bool:
        """Whether a tuner or a replay is done.

        Raises:
            NodeProcessError: it has failed.
        """
        self._processes.check()
        return self._processes.has_ended(node)

    def add_node(self, node: Node) -> None:
        """Serve an rclpy node of one's own in `wait` and `idle`, made with `context=loop.node.context`."""
        self.conductor.add_node(node)

    def set(self, node: str = "controller", **values: Any) -> None:
        """Set parameters of a node together: all, or none of them.

        Args:
            values: a number, or several, one per lane; dots in names as double underscores.

        Raises:
            RefusedError: with the node's reason.
            NoAnswerError: it does not answer.
        """
        self.conductor.set_parameters(node, _plain(values))

    def use(self, gains: Gains) -> None:
        """Give the controller its type and all gains together, as `tune` returns them or `case.gains` holds them.

        Raises:
            RefusedError, NoAnswerError: as `set`.
        """
        self.set(**{name: getattr(gains, name) for name in GAIN_NAMES})

    def get(self, *names: str, node: str = "controller") -> dict[str, Any]:
        """Parameters of a node by name; None for those that it does not have."""
        return self.conductor.remote(node).parameters(names)

    def publish(self, topic: str, *values: float, joints: Sequence[str] = ()) -> None:
        """Give a `setpoint`, a `disturbance` or a `manual_effort`: one value, or one per lane. In lockstep the plan
        alone gives setpoint and disturbance.

        Args:
            joints: which of the controller's joints a setpoint is for; none: all.

        Raises:
            LoopError: nobody listens to the topic.
        """
        self.conductor.publish(topic, values, joints, START_TIMEOUT)

    def play(self, *episodes: str) -> None:
        """Begin to play episodes of the case, by default all; those before must have been played (`wait`).

        Raises:
            LoopError: the scenario does not begin, or there is no such episode.
        """
        unknown = [name for name in episodes if name not in self.case.episodes]
        if unknown:
            raise LoopError(f"no episode {', '.join(unknown)}: there are {', '.join(self.case.episodes) or 'none'}")
        self._playing = episodes or tuple(self.case.episodes)
        self.conductor.remote("scenario").set_parameters({"episodes": list(self._playing)})
        self._wanted = self._played + 1
        self.conductor.play(START_TIMEOUT)
        self._first = self.conductor.label.number if self.conductor.label else 0

    @property
    def is_playing(self) -> bool:
        """Whether an episode that `play` began is still to end."""
        return self._played < self._wanted

    @property
    def _played(self) -> int:
        return int(self.conductor.fact("scenario", "played") or 0)

    @property
    def played_s(self) -> float:
        """How much of `to_play_s` has been played, in simulated s, as far as the plant tells."""
        label, ends = self.conductor.label, self._ends_s
        if not self.is_playing:
            return sum(ends)
        done = 0 if label is None else min(max(label.number - self._first, 0), len(ends) - 1)
        time_s = self.conductor.time_ns / 1e9 or float(self.conductor.fact("plant", "time_s") or 0)
        return sum(ends[:done]) + min(time_s, ends[done])

    @property
    def to_play_s(self) -> float:
        """How long that is which `play` began, in simulated seconds."""
        return sum(self._ends_s)

    @property
    def _ends_s(self) -> list[float]:
        return [self.case.plans[name].end_ns / 1e9 for name in self._playing]

    def wait(self, timeout: float | None = None) -> None:
        """Wait until all that is being played has ended.

        Args:
            timeout: s; None: as long as it takes.

        Raises:
            LoopError: it has not ended in time, or the loop stands still; the message says what its nodes warn of.
            NodeProcessError: a node has ended.
        """
        end = None if timeout is None else time.monotonic() + timeout
        last, moved = None, time.monotonic()
        while self.is_playing:
            now = time.monotonic()
            progress = (self.conductor.fact("plant", "time_s"), self.conductor.label, self.conductor.phase)
            if progress != last:
                last, moved = progress, now
            if now - moved > STANDS_STILL:
                warnings = "; ".join(self.conductor.complaints()) or "its nodes warn of nothing"
                raise LoopError(f"the loop has stood still for {STANDS_STILL:g} s: {warnings}")
            if end is not None and now > end:
                raise LoopError(f"the episodes have not ended within {timeout:g} s")
            self.idle(POLL)

    def fact(self, node: str, name: str) -> str:
        """What a node tells in its latest diagnostics, `time_s` say; empty if it has not told it yet."""
        return self.conductor.fact(node, name)

    def wait_until(self, condition: Callable[[], object], what: str = "a condition", timeout: float = 60.0) -> None:
        """Let time pass until a condition holds.

        Raises:
            LoopError: it does not within `timeout` seconds.
            NodeProcessError: a node has ended.
        """
        self.conductor.wait(lambda: bool(condition()), what, timeout)

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
    nodes: Sequence[str] = OF_A_LOOP,
    remap: Mapping[str, str] | None = None,
    **parameters: Any,
) -> Iterator[RunningLoop]:
    """Start a loop's nodes as processes of this program; they end with the context, in order.

    Args:
        case: its name or parameter file.
        bag: a new folder to record to; None: nothing is recorded.
        mode: lockstep or realtime; None: as the file says.
        namespace: of the nodes; several loops run side by side in namespaces of their own.
        nodes: which of plant, controller and scenario are started: a robot, or a plant of your own, takes the place of
            ours. The recorder comes by `bag`.
        remap: other names of topics: {"output": "joint_states"}.
        parameters: of whichever node has them, in place of the file's: `speed=20.0`, `kp=5.0`, `lanes=8`.

    Yields:
        The running loop; its scenario waits for `play`.

    Raises:
        ParameterFileError, PlantError, PlanError, GainsError: something is wrong with the case.
        ParameterError: no node has a parameter of that name.
        OutputError: the bag is there already.
        LoopError, NodeProcessError: the nodes do not start.
    """
    stay_on_this_machine()
    path, loaded = find_parameter_file(case), load_case(case)
    folder = None if bag is None else Path(bag)
    given = _plain(parameters) | ({"mode": mode} if mode else {})
    with NodeProcesses(path, namespace, remap) as processes:
        start_nodes(processes, loaded, path, folder, given, play=False, nodes=nodes)
        conductor = Conductor(namespace, processes.check)
        try:
            if "scenario" not in nodes:
                conductor.prepare_to_publish(*GIVEN)
            counts = _subscribers(nodes, remap or {}, folder is not None, _mode(path, given))
            conductor.wait_for_subscriptions(counts, START_TIMEOUT)
            yield RunningLoop(loaded, conductor, processes, folder)
        finally:
            conductor.close()


def start_nodes(
    processes: NodeProcesses,
    case: Case,
    path: Path,
    bag: Path | None,
    given: Mapping[str, Any],
    *,
    play: bool,
    nodes: Sequence[str] = OF_A_LOOP,
) -> None:
    """Start a case's nodes, the recorder first.

    Args:
        path: of the case's parameter file.
        bag: a new folder to record to; None: nothing is recorded.
        given: parameters of whichever node has them, in place of the file's.
        play: whether the scenario plays at once.
        nodes: which are started.

    Raises:
        OutputError: the bag is there already.
        ParameterError: no node has a parameter of that name.
    """
    if bag is not None:
        new_folder(bag)
    lossless = {"lossless": True} if bag is not None and _mode(path, given) == "lockstep" and "plant" in nodes else {}
    own: dict[str, dict[str, Any]] = {
        "recorder": {"bag": bag, **lossless},
        "plant": dict(lossless),
        "controller": {"sigma": case.gains.sigma},
        "scenario": {"play": play},
    }
    parameters = _by_node(case, given)
    for node in [*(["recorder"] if bag is not None else []), *nodes]:
        processes.start(node, own.get(node, {}) | parameters[node])


def _mode(path: Path, given: Mapping[str, Any]) -> str:
    """How the loop runs: as asked for, or as the file says."""
    return str(given.get("mode") or read_parameters(path, "plant").get("mode", MODE.default))


def _subscribers(nodes: Collection[str], remap: Mapping[str, str], recorded: bool, mode: str) -> dict[str, int]:
    """How many subscribers each topic has in a loop of these nodes that is ready; a plant in realtime takes no plan."""
    found = {}
    for topic, (publisher, takers) in TOPICS.items():
        there = [node for node in takers if node in nodes]
        if topic == "scenario_plan" and mode == "realtime":
            there = [node for node in there if node != "plant"]
        found[remap.get(topic, topic)] = len(there) + (recorded and publisher in nodes)
    return found


def _by_node(case: Case, given: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """What each node is given of some parameters: those in its table."""
    tables = {name: set(table) for name, table in NODES.items()}
    tables["plant"] |= set(model_parameters(case.model))
    known = set().union(*tables.values())
    for name in given:
        if name not in known:
            raise ParameterError(f"no node has a parameter {name}{meant_hint(name, known)}")
    return {node: {name: value for name, value in given.items() if name in table} for node, table in tables.items()}


def _plain(values: Mapping[str, Any]) -> dict[str, Any]:
    """Parameters as Python has them, as ROS has them: names with dots, arrays and tuples as lists, paths as text."""

    def plain(value: Any) -> Any:
        if isinstance(value, (np.ndarray, np.generic)):
            return value.tolist()
        if isinstance(value, Path):
            return str(value)
        return list(value) if isinstance(value, tuple) else value

    return {name.replace("__", "."): plain(value) for name, value in values.items()}
