"""Nodes' processes that begin where a server has loaded what all nodes need, in a tenth of the time.

The server is multiprocessing's own ("forkserver"): a process without threads of DDS, from which each node is forked.
What a node does from `tdof_npid_ros.graph.__main__.run` on is what it does when it is started by a command.
"""

from __future__ import annotations

import faulthandler
import multiprocessing
import os
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cache
from multiprocessing.forkserver import ensure_running
from pathlib import Path
from subprocess import TimeoutExpired
from typing import IO
from unittest import mock

from tdof_npid_ros.graph.__main__ import run

SERVER = multiprocessing.get_context("forkserver")
SERVER.set_forkserver_preload(["loaded"])


@cache
def start_server() -> None:
    """Once in a process; the server must find what it loads."""
    path = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
    with mock.patch.dict(os.environ, {"PYTHONPATH": path}):
        ensure_running()


class ForkedNode:
    """A node's process, with the part of `subprocess.Popen` that the tests use.

    Args:
        arguments: of the command line, the node's name first.
        environment: instead of the server's.
    """

    def __init__(self, arguments: Sequence[str], environment: Mapping[str, str], log: IO[str], cwd: Path) -> None:
        self.args = list(arguments)
        how = (self.args, dict(environment), log.name, str(cwd))
        start_server()
        self._process = SERVER.Process(target=_run, args=how, name=arguments[0], daemon=True)
        self._process.start()
        assert self._process.pid is not None
        self.pid = self._process.pid

    @property
    def returncode(self) -> int | None:
        """Exit status; less than 0: the signal that ended it; None: it runs."""
        return self._process.exitcode

    def poll(self) -> int | None:
        """As `returncode`."""
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """The exit status, waited for.

        Raises:
            TimeoutExpired: it still runs.
        """
        self._process.join(timeout)
        if self.returncode is None:
            raise TimeoutExpired(self.args, timeout or 0.0)
        return self.returncode

    def send_signal(self, number: int) -> None:
        """Nothing if it has ended."""
        if self.returncode is None:
            with suppress(ProcessLookupError):
                os.kill(self.pid, number)


def _run(arguments: list[str], environment: dict[str, str], log: str, cwd: str) -> None:
    assert "loaded" in sys.modules, "the server has not loaded what it should, which it does not tell"
    stream = os.open(log, os.O_WRONLY | os.O_APPEND)
    for standard in (1, 2):
        os.dup2(stream, standard)
    os.close(stream)
    os.chdir(cwd)
    os.environ.clear()
    os.environ.update(environment)
    sys.path[0:0] = [cwd, *environment["PYTHONPATH"].split(os.pathsep)]
    sys.argv = arguments
    faulthandler.enable()
    run(arguments[0], arguments)
