"""How a node's process begins, serves and ends."""

from __future__ import annotations

import os
import resource
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions

from tdof_npid_ros.graph.runtime.ending import end_within
from tdof_npid_ros.graph.runtime.middleware import use_fast_dds_profile
from tdof_npid_ros.graph.runtime.node import LoopNode
from tdof_npid_ros.graph.runtime.unread import take_unread
from tdof_npid_ros.one_line import one_line

REQUESTS_AT_ONCE = 30  # that are served between two executors: more than clients of a node send at the same time
LEAVE_TIMEOUT = 2.0  # s until a process ends that the middleware does not let go of
SPIN_TIMEOUT = 0.5  # s; the events executor needs one (without it, this build spins a core)
LOOK_PERIOD = 0.05  # s until a thread that spins a node notices that it is to end
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)

N = TypeVar("N", bound=LoopNode)


def run_node(
    make_node: Callable[[], N], arguments: list[str] | None = None, work: Callable[[N, Stop], int] | None = None
) -> None:
    """Run a node until a signal, or until its work is done, and end the process.

    The exit status is 0 on a signal, that of the work, or 2 if the node cannot start, with one line that says why.

    Args:
        make_node: called once ROS has been initialised.
        arguments: the command line, the program's name first.
        work: what to do in this thread, while another one serves the node; returns the exit status. None: only serve.
    """
    stop = Stop()
    node: N | None = None
    status = 1
    try:
        with _start_errors():
            use_fast_dds_profile()
            take_half_of_the_memory_at_most()
            rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
            node = make_node()
            if node.autostart:
                autostart(node)
        if work is None:
            spin(node, stop)
            status = 0
        else:
            with spun(node):
                status = work(node, stop)
    except StartError as error:
        print(f"{_program()}: {error}", file=sys.stderr)
        status = 2
    finally:
        if node is not None:
            status = _end(node, status)
        rclpy.try_shutdown()
        ignore_further_signals()
    sys.exit(status)


def _program() -> str:
    """What the user has called: `controller`, `tdof-npid`."""
    name = sys.argv[0].rsplit("/", 1)[-1]
    return sys.argv[1] if name == "__main__.py" and len(sys.argv) > 1 else name


def take_half_of_the_memory_at_most() -> None:
    """Let what a peer sends cost a refused message, and not the machine.

    The middleware makes room for a message before anybody can look at it, 250 bytes for each parameter in a request;
    where it gets none, it drops the message and goes on. The limit is soft: who needs more may raise it, as `ulimit`
    does, and a lower one that is set already stays.
    """
    half = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2
    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    if all(limit == resource.RLIM_INFINITY or limit > half for limit in (soft, hard)):
        resource.setrlimit(resource.RLIMIT_DATA, (half, hard))


class StartError(RuntimeError):
    """A node that cannot start; the message says why."""


@contextmanager
def _start_errors() -> Iterator[None]:
    try:
        yield
    except (ValueError, OSError, RuntimeError) as error:
        raise StartError(one_line(error)) from error


def autostart(node: LoopNode) -> None:
    """Configure and activate a node.

    Raises:
        RuntimeError: it cannot be activated; the message says why.
    """
    node.trigger_configure()
    node.trigger_activate()
    if node.activation_error is not None:
        raise RuntimeError(one_line(node.activation_error)) from node.activation_error


def _end(node: LoopNode, status: int) -> int:
    try:
        if node.active:
            node.deactivate()
        status = node.finished(status)
    finally:
        end_within(LEAVE_TIMEOUT, status)
        node.destroy_node()
    return status


class Stop:
    """Takes the signals to stop, so that the node ends between two callbacks and in order.

    The executor waits in C++, where no Python handler runs. So a signal is passed through a socket to a thread that
    wakes the executor. Signals that follow are ignored, the node is ending, except by what `calls` is given.
    """

    def __init__(self) -> None:
        self._requested = threading.Event()
        self._wake: Callable[[], None] | None = None
        self._call: Callable[[], None] | None = None
        self._reader, self._writer = socket.socketpair()
        self._writer.setblocking(False)
        signal.set_wakeup_fd(self._writer.fileno(), warn_on_full_buffer=False)
        for number in STOP_SIGNALS:
            signal.signal(number, lambda *_: None)
        threading.Thread(target=self._wait, daemon=True).start()

    @property
    def requested(self) -> bool:
        """Whether a signal has come."""
        return self._requested.is_set()

    def wait(self) -> None:
        """Until a signal comes."""
        self._requested.wait()

    def calls(self, call: Callable[[], None]) -> None:
        """Call this at each signal, in a thread of its own, and now if one has come."""
        self._call = call
        if self.requested:
            call()

    def _wait(self) -> None:
        while self._reader.recv(1):
            self._requested.set()
            for each in (self._call, self._wake):
                if each is not None:
                    each()

    def wakes(self, executor: Any | None) -> None:
        """Wake this executor, or none, when the signal comes."""
        self._wake = executor and executor.wake


def ignore_further_signals() -> None:
    """For the end of the process, also while the interpreter shuts down."""
    for each in STOP_SIGNALS:
        signal.signal(each, signal.SIG_IGN)


def spin(node: LoopNode, stop: Stop | None = None) -> None:
    """Serve a node until it is to stop, or until its context is shut down."""
    while rclpy.ok() and not (stop and stop.requested):
        _spin_until_leftovers(node, stop)
        if node.leftovers:
            _destroy_leftovers(node)


@contextmanager
def spun(node: LoopNode) -> Iterator[None]:
    """Serve a node in a thread of its own meanwhile."""
    ended = threading.Event()

    def serve() -> None:
        executor = executor_for(node)
        while not ended.is_set():
            executor.spin_once(timeout_sec=LOOK_PERIOD)
        executor.remove_node(node)
        executor.shutdown()

    thread = threading.Thread(target=serve, name="spin", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def _spin_until_leftovers(node: LoopNode, stop: Stop | None) -> None:
    executor = executor_for(node)
    if stop is not None:
        stop.wakes(executor)
    while rclpy.ok() and not (stop and stop.requested) and not node.leftovers:
        executor.spin_once(timeout_sec=SPIN_TIMEOUT)
    if stop is not None:
        stop.wakes(None)
    executor.remove_node(node)
    executor.shutdown()


def _destroy_leftovers(node: LoopNode) -> None:
    """Destroy what a transition has left, between two executors.

    The events executor ends the process over an event of something that is destroyed (ros2/rclpy issue 1644), also over
    one that came before. What the node has heard of but not served yet, a request for one, would be lost with it; so
    an executor that looks at what is there, not at events, serves that meanwhile.
    """
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    for _ in range(REQUESTS_AT_ONCE):
        executor.spin_once(timeout_sec=0.0)
    for destroy in node.leftovers:
        destroy()
    node.leftovers = []
    executor.remove_node(node)
    executor.shutdown()


def executor_for(node: LoopNode) -> Any:
    """An executor that serves this node: the fastest, unless the node needs one that knows callback groups."""
    executor = fastest_executor() if node.uses_events_executor else SingleThreadedExecutor()
    executor.add_node(node)
    if node.uses_events_executor:
        take_unread(node)
    return executor


def fastest_executor() -> Any:
    """The fastest executor for one node that this rclpy has."""
    try:
        from rclpy.experimental import EventsExecutor  # in Jazzy since 2025, and two to three times as fast
    except ImportError:
        return SingleThreadedExecutor()
    return EventsExecutor()
