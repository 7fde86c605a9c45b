"""Real nodes as real processes over real DDS, for the tests of the graph.

A test takes the fixture `graph`: a DDS domain of its own, in which it starts nodes and looks on through one node of
its own. Nothing sleeps for a fixed time: `wait_until` spins until a condition holds. Four things mislead a test that
looks on from outside, and each has its remedy here:

* A message is lost if the other side has not matched yet, and so is an answer to it: `publish_until` repeats it.
* A line may be in a log already: `expect_log` waits for a further one.
* A fact of the diagnostics is up to a second old: `fresh_fact` waits for a report that was made after the call.
* While a test does not spin, messages pile up, and pass for new ones later: `catch_up` takes them first.
"""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from dds_domain import reserved_domain
from forked import ForkedNode

from tdof_npid_ros.graph.runtime.middleware import PROFILE, RANGE, stay_on_this_machine
from tdof_npid_ros.parameter_file import read_parameters, write_parameters


def pytest_configure(config: pytest.Config) -> None:
    """Let the ROS 2 wheels restart the interpreter with their libraries, before pytest's capture would swallow it."""
    if not os.environ.get("_ROS_WHEELS_BOOTSTRAP_COMPLETE"):
        capture = config.pluginmanager.getplugin("capturemanager")
        capture.stop_global_capturing()
        import rclpy  # noqa: F401  (does not return)

        capture.start_global_capturing()


REPOSITORY = Path(__file__).resolve().parents[2]
START_TIMEOUT = 60.0  # s; generous, for a loaded machine
ASK_AGAIN = 5.0  # s until a service that may be asked twice is asked again
REPEAT_PERIOD = 0.1  # s between two times that `publish_until` publishes


class NodeProcess:
    """A node in a process of its own; what it prints is in `log`.

    Args:
        program: Python that runs it; empty: ours.
        fresh: whether it starts as a command does, which takes ten times as long.
    """

    def __init__(
        self,
        node: str,
        arguments: Sequence[str],
        environment: dict[str, str],
        log: Path,
        cwd: Path,
        program: str,
        fresh: bool,
    ) -> None:
        self.node = node
        self._log = log
        self.expected_status: int | None = 0
        self.stopped = False
        self._interrupted = False
        self.process: subprocess.Popen[bytes] | ForkedNode
        with log.open("w") as stream:
            if program or fresh:
                what = ["-c", program] if program else ["-m", "tdof_npid_ros.graph", node]
                self.process = subprocess.Popen(
                    [sys.executable, *what, *arguments], stdout=stream, stderr=subprocess.STDOUT, cwd=cwd,
                    env=environment,
                )  # fmt: skip
            else:
                self.process = ForkedNode([node, *arguments], environment, stream, cwd)

    @property
    def log(self) -> str:
        return self._log.read_text()

    def send(self, signal_number: int) -> None:
        self.process.send_signal(signal_number)
        if signal_number == signal.SIGKILL:
            self.expected_status, self.stopped = None, True
            self.process.wait()

    @property
    def has_failed(self) -> bool:
        """Whether it has ended though nobody stopped it."""
        return not self.stopped and self.expected_status == 0 and self.process.poll() is not None

    def interrupt(self) -> None:
        """Ctrl-C, once: a second one may find Python ending, without its handlers, and kill it."""
        self.stopped = True
        if not self._interrupted and self.process.poll() is None:
            self._interrupted = True
            self.process.send_signal(signal.SIGCONT)
            self.process.send_signal(signal.SIGINT)

    def stop(self, timeout: float = 10.0) -> float:
        """Ctrl-C; returns after how many seconds the process had ended. One that hangs tells in its log where."""
        began = time.monotonic()
        self.interrupt()
        try:
            self.process.wait(timeout)
        except subprocess.TimeoutExpired:
            self.process.send_signal(signal.SIGABRT)  # Python's fault handler prints what each thread does
            self.process.wait()
        return time.monotonic() - began


class Graph:
    """A DDS domain with nodes in it, and a node of the test's own that looks on.

    Attributes:
        node: the test's own node, for whatever the methods here do not do.
        diagnostics: the latest facts by a node's full name; `level`, `message` and `stamp_ns` are among them.
    """

    def __init__(self, folder: Path) -> None:
        import rclpy
        from diagnostic_msgs.msg import DiagnosticArray
        from rclpy.experimental import EventsExecutor

        self.domain, self._reservation = reserved_domain()
        self.folder = folder
        self.environment = {
            **os.environ,
            "ROS_DOMAIN_ID": str(self.domain),
            RANGE: "LOCALHOST",
            "PYTHONFAULTHANDLER": "1",
            "PYTHONPATH": os.pathsep.join([str(REPOSITORY), os.environ.get("PYTHONPATH", "")]),
        }
        stay_on_this_machine(self.environment)
        self._usual = dict(self.environment)
        os.environ.update({name: self.environment[name] for name in (PROFILE, RANGE)})
        self.processes: list[NodeProcess] = []
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=self.domain)
        self.node = rclpy.create_node("test", context=self._context)
        self._executor = EventsExecutor(context=self._context)
        self._executor.add_node(self.node)
        self.diagnostics: dict[str, dict[str, Any]] = {}
        self._clients: dict[str, Any] = {}
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 100)

    def close(self) -> None:
        for process in self.processes:
            process.interrupt()
        for process in self.processes:
            process.stop()
        self._executor.remove_node(self.node)
        self._executor.shutdown()  # else the context would stay in the domain
        self.node.destroy_node()
        self._context.shutdown()
        self._context.destroy()
        self._reservation.close()

    # Nodes

    @contextmanager
    def newcomer(self) -> Iterator[Any]:
        """A further onlooker, which is told how the domain is now, not what has happened in it."""
        import rclpy

        context = rclpy.Context()
        rclpy.init(context=context, domain_id=self.domain)
        node = rclpy.create_node("newcomer", context=context)
        try:
            yield node
        finally:
            node.destroy_node()
            context.shutdown()
            context.destroy()

    def start(
        self,
        node: str,
        *arguments: str,
        case: str = "",
        namespace: str = "",
        cwd: Path = REPOSITORY,
        program: str = "",
        fresh: bool = False,
        **parameters: Any,
    ) -> NodeProcess:
        """Start a node.

        Args:
            arguments: more of its `--ros-args`.
            case: name of a file in config/, or a path, whose parameters it gets.
            namespace: to start it in.
            cwd: folder to start it in.
            program: Python that runs it, in place of ours.
            fresh: start it as a command does; so it is, too, where the environment was changed.
            parameters: after those of the case; dots in names as double underscores; None: left out.
        """
        values = dict(parameters)
        if case:
            path = Path(case) if case.endswith(".yaml") else REPOSITORY / "config" / f"{case}.yaml"
            values = read_parameters(path, node) | values
        if node == "controller" and values.get("type") != "pid":
            values.setdefault("sigma", 1.0)  # what the tests' loops have; it must be given
        values = {name: value for name, value in values.items() if value is not None}
        command = ["--ros-args", *arguments]
        if namespace:
            command += ["-r", f"__ns:={namespace}"]
        if values:
            file = self.folder / f"{node}-{len(self.processes)}.yaml"
            write_parameters(file, {node: {name.replace("__", "."): plain(value) for name, value in values.items()}})
            command += ["--params-file", str(file)]
        log = self.folder / f"{node}-{len(self.processes)}.log"
        fresh = fresh or self.environment != self._usual
        process = NodeProcess(node, command, self.environment, log, cwd, program, fresh)
        self.processes.append(process)
        return process

    def wait_for_nodes(self, *names: str) -> None:
        """Wait until nodes of these full names have reported on /diagnostics what holds from now on."""
        now = time.time_ns()
        self.wait_until(
            lambda: all(self.fact(name, "stamp_ns", 0) > now for name in names), START_TIMEOUT, f"{names} to report"
        )

    # Waiting

    def spin_once(self, timeout: float = 0.05) -> None:
        self._executor.spin_once(timeout_sec=timeout)

    def wait_until(self, condition: Callable[[], Any], timeout: float = 20.0, what: str = "a condition") -> Any:
        """Spin until the condition holds; its value is returned."""
        end = time.monotonic() + timeout
        while not (value := condition()):
            if time.monotonic() > end or any(process.has_failed for process in self.processes):
                logs = "\n".join(f"--- {process.node}:\n{process.log}" for process in self.processes)
                pytest.fail(f"waited {timeout:g} s in vain for {what}\n{logs}\n--- diagnostics: {self.diagnostics}")
            self.spin_once()
        return value

    def catch_up(self) -> None:
        """Take every message that has arrived: those that come from here on are new."""
        mark = self._executor.create_task(lambda: None)  # served after what came before
        self.wait_until(mark.done, what="the messages that have arrived")

    def wait_for_log(self, process: NodeProcess, text: str, timeout: float = 20.0) -> None:
        self.wait_until(lambda: text in process.log, timeout, f"{text!r} in the log of {process.node}")

    @contextmanager
    def expect_log(self, process: NodeProcess, text: str, timeout: float = 20.0) -> Iterator[None]:
        """What is done within makes a node log a further line with this text; at the end, wait for it."""
        before = process.log.count(text)
        yield
        self.wait_until(
            lambda: process.log.count(text) > before, timeout, f"one more {text!r} in the log of {process.node}"
        )

    def fact(self, node: str, name: str, default: Any = "") -> Any:
        """A fact of a node's latest diagnostics."""
        return self.diagnostics.get(node, {}).get(name, default)

    def fresh_fact(self, node: str, name: str, default: Any = "") -> Any:
        """A fact as it is now, out of a report that the node makes after the call."""
        self.wait_for_nodes(node)
        return self.fact(node, name, default)

    # Topics, services, parameters

    def collect(self, topic: str, message_type: Any, qos: Any = 10_000) -> list[Any]:
        """Every message that arrives on a topic from now on, in a list that grows."""
        messages: list[Any] = []
        self.node.create_subscription(message_type, topic, messages.append, qos)
        return messages

    def publisher(self, topic: str, message_type: Any, qos: Any = 10) -> Any:
        """A publisher that has found a subscription, which need not have found it: see `publish_until`."""
        publisher = self.node.create_publisher(message_type, topic, qos)
        self.wait_until(publisher.get_subscription_count, START_TIMEOUT, f"a subscriber of {topic}")
        return publisher

    def publish_until(
        self, publisher: Any, message: Any, condition: Callable[[], Any], timeout: float = 20.0, what: str = "an effect"
    ) -> Any:
        """Publish a message again and again until the condition holds; its value is returned."""
        next_time = 0.0

        def published() -> Any:
            nonlocal next_time
            value = condition()
            if not value and time.monotonic() >= next_time:
                next_time = time.monotonic() + REPEAT_PERIOD
                publisher.publish(message)
            return value

        return self.wait_until(published, timeout, what)

    def call(
        self, service: str, service_type: Any, request: Any = None, timeout: float = START_TIMEOUT, again: bool = False
    ) -> Any:
        """The answer of a service.

        Args:
            again: for what may be asked twice: ask again if no answer comes. An answer is lost if the server has not
                found its client yet. Clients are found in the order in which they were made; so for what may be asked
                only once, the node is first asked by a client that is newer.
        """
        from lifecycle_msgs.srv import GetAvailableTransitions

        is_new = service not in self._clients
        if is_new:
            self._clients[service] = self.node.create_client(service_type, service)
        client = self._clients[service]
        if not again:
            probe = f"{service.rpartition('/')[0]}/get_available_transitions"
            if is_new and probe in self._clients:
                self.node.destroy_client(self._clients.pop(probe))
            self.call(probe, GetAvailableTransitions, again=True)
        self.wait_until(client.service_is_ready, timeout, f"the service {service}")
        futures = []
        next_time = 0.0

        def answered() -> Any:
            nonlocal next_time
            if time.monotonic() >= next_time:
                next_time = time.monotonic() + (ASK_AGAIN if again else math.inf)
                futures.append(client.call_async(request or service_type.Request()))
            return next((future for future in futures if future.done()), None)

        return self.wait_until(answered, timeout, f"an answer of {service}").result()

    def client(self, service: str) -> Any:
        """The client of a service that was called before."""
        return self._clients[service]

    def set_parameters(self, node: str, atomically: bool = False, **values: Any) -> list[Any]:
        """Set parameters of a node; returns the results (`successful`, `reason`), one for all if atomically."""
        from rcl_interfaces.srv import SetParameters, SetParametersAtomically
        from rclpy.parameter import Parameter

        parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        if atomically:
            service = SetParametersAtomically
            return [
                self.call(
                    f"{node}/set_parameters_atomically", service, service.Request(parameters=parameters), again=True
                ).result
            ]
        request = SetParameters.Request(parameters=parameters)
        return list(self.call(f"{node}/set_parameters", SetParameters, request, again=True).results)

    def get_parameters(self, node: str, *names: str) -> list[Any]:
        from rcl_interfaces.srv import GetParameters
        from rclpy.parameter import parameter_value_to_python

        request = GetParameters.Request(names=list(names))
        values = self.call(f"{node}/get_parameters", GetParameters, request, again=True).values
        return [parameter_value_to_python(value) for value in values]

    def change_state(self, node: str, transition: str) -> bool:
        """Ask for a transition of a node's life cycle: configure, activate, deactivate, cleanup."""
        from lifecycle_msgs.msg import Transition
        from lifecycle_msgs.srv import ChangeState

        number = getattr(Transition, f"TRANSITION_{transition.upper()}")
        request = ChangeState.Request(transition=Transition(id=number))
        return bool(self.call(f"{node}/change_state", ChangeState, request).success)

    def _on_diagnostics(self, message: Any) -> None:
        for status in message.status:
            facts = {pair.key: pair.value for pair in status.values}
            stamp_ns = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
            self.diagnostics[status.name.removesuffix(": state")] = {
                **facts, "level": status.level[0], "message": status.message, "stamp_ns": stamp_ns
            }  # fmt: skip


def plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


@pytest.fixture
def graph(tmp_path: Path) -> Iterator[Graph]:
    """A domain of the test's own. At its end every node is stopped and must end quietly, with exit status 0."""
    graph = Graph(tmp_path)
    try:
        yield graph
    finally:
        graph.close()
    check_endings(graph)


@pytest.fixture(scope="module")
def shared_graph(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Graph]:
    """As `graph`, shared by the tests of a module."""
    graph = Graph(tmp_path_factory.mktemp("graph"))
    try:
        yield graph
    finally:
        graph.close()
    check_endings(graph)


def check_endings(graph: Graph) -> None:
    for process in graph.processes:
        assert "Traceback" not in process.log, process.log
        if process.expected_status is not None:
            assert process.process.returncode == process.expected_status, process.log
