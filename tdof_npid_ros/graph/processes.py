"""The loop's nodes as processes of this program, stopped whatever happens."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

from tdof_npid_ros.graph.__main__ import PARENT
from tdof_npid_ros.interruption import afterwards
from tdof_npid_ros.parameter_file import for_ros, read_parameters, write_parameters

STOP_TIMEOUT = 10.0  # s until a process that does not stop is killed


class NodeProcessError(RuntimeError):
    """A node that could not be started or has ended; the message shows the end of its log."""


class NodeProcesses:
    """Starts nodes and stops all of them on leaving the context.

        with NodeProcesses(file, "/loop") as nodes:
            nodes.start("plant", {"lossless": True})
            nodes.start("tuner", {"case": "p1-c4"}, ends=True)
            while not nodes.has_ended("tuner"):
                nodes.check()
                ...

    Args:
        parameter_file: given to every node.
        namespace: in which they run.
        remap: topics that they call otherwise, by the names that they have here.
    """

    def __init__(self, parameter_file: Path, namespace: str = "/", remap: Mapping[str, str] | None = None) -> None:
        self._parameter_file = parameter_file
        self._names = {"__ns": namespace, **(remap or {})}
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self._end_by_themselves: set[str] = set()
        self._logs = Path(tempfile.mkdtemp(prefix="tdof-npid-"))

    def start(self, node: str, parameters: Mapping[str, Any] | None = None, ends: bool = False) -> None:
        """Start a node, its log in a temporary file.

        Args:
            node: plant, controller, scenario, tuner, recorder or replay.
            parameters: by name, in place of those of the file.
            ends: it ends by itself when it is done; every other node that ends has failed.
        """
        if ends:
            self._end_by_themselves.add(node)
        file = self._parameter_file
        if parameters:  # one file: of a number in one file and a list in another, ROS takes the number
            values = {**read_parameters(file, node), **parameters}
            plain = {name: for_ros(value) if isinstance(value, str | Path) else value for name, value in values.items()}
            file = self._logs / f"{node}.yaml"
            write_parameters(file, {node: plain})
        command = [sys.executable, "-m", "tdof_npid_ros.graph", node, "--ros-args", "--params-file", for_ros(file)]
        command += [word for name, other in self._names.items() for word in ("-r", f"{name}:={other}")]
        with self.log(node).open("wb") as log, afterwards():  # else one that is not noted yet would never be stopped
            # A session of its own: Ctrl-C reaches this program alone, which then stops its nodes in order.
            self._processes[node] = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                env={**os.environ, PARENT: str(os.getpid())},
            )

    def log(self, node: str) -> Path:
        """Where a node's log is."""
        return self._logs / f"{node}.log"

    @property
    def pids(self) -> dict[str, int]:
        """The nodes' processes, by node."""
        return {node: process.pid for node, process in self._processes.items()}

    def has_ended(self, node: str) -> bool:
        """Whether a node's process has ended."""
        return self._processes[node].poll() is not None

    def check(self) -> None:
        """Make sure that all nodes run.

        Raises:
            NodeProcessError: one has ended that should not have, or with an error.
        """
        for node, process in self._processes.items():
            if process.poll() is not None and (process.returncode or node not in self._end_by_themselves):
                tail = " | ".join(self.log(node).read_text(errors="replace").strip().splitlines()[-5:])
                raise NodeProcessError(f"the node {node} ended with status {process.returncode}: {tail}")

    def stop(self) -> None:
        """Interrupt one node after the other, the last started first, and wait for it; kill what does not end.

        So a recorder that was started first hears all that the others had to say. Ctrl-C waits until all have ended.
        """
        with afterwards():
            for process in reversed(self._processes.values()):
                if process.poll() is None:
                    process.send_signal(signal.SIGINT)
                try:
                    process.wait(STOP_TIMEOUT)
                except subprocess.TimeoutExpired:
                    os.killpg(process.pid, signal.SIGKILL)
                    process.wait()

    def __enter__(self) -> NodeProcesses:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()
