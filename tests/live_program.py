"""`tdof-npid live` as a process of its own, and what a browser shows of it: for the tests of the page."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from dds_domain import reserved_domain

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine")


class Program:
    """`tdof-npid live` in a folder of its own."""

    def __init__(self, folder: Path, *arguments: str, beside: Program | None = None) -> None:
        """
        Args:
            beside: another program, whose domain it shares.
        """
        number, self._domain = reserved_domain() if beside is None else (int(beside.environment["ROS_DOMAIN_ID"]), None)
        self.environment = {**os.environ, "ROS_DOMAIN_ID": str(number), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
        self.folder = folder
        self._log = f"errors-{time.monotonic_ns()}.txt"
        command = [sys.executable, "-m", "tdof_npid_ros", "live", *arguments, "--no-browser", "--json"]
        self._errors = (folder / self._log).open("w")
        self.process = subprocess.Popen(
            command, cwd=folder, env=self.environment, stdout=subprocess.PIPE, stderr=self._errors, text=True
        )
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line, (folder / self._log).read_text()
        self.url = str(json.loads(line)["url"])

    def tdof_npid(self, *arguments: str) -> Any:
        """What another subcommand says of the loop, as JSON."""
        command = [sys.executable, "-m", "tdof_npid_ros", *arguments, "--namespace", "/live", "--json"]
        done = subprocess.run(
            command, env=self.environment, cwd=self.folder, capture_output=True, text=True, timeout=60
        )
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    def nodes(self) -> list[int]:
        """Processes that it has started and that still run."""
        found = subprocess.run(
            ["pgrep", "-f", "tdof_npid_ros.graph .*__ns:=/live"], capture_output=True, text=True
        ).stdout
        mine = f"ROS_DOMAIN_ID={self.environment['ROS_DOMAIN_ID']}\0"
        return [pid for pid in map(int, found.split()) if mine in _environment_of(pid)]

    def stop(self, number: int = signal.SIGINT) -> int:
        """Signal it, and wait for its end; its status."""
        if self.process.poll() is None:
            self.process.send_signal(number)
        status = self.process.wait(timeout=60)
        self._errors.close()
        return status


def _environment_of(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/environ").read_text(errors="replace") + "\0"
    except OSError:
        return ""


def eventually(condition: Any, what: Any, timeout: float = 90.0) -> None:
    """Wait for a condition; `what` is told if it does not come, a function's result as it is then."""
    end = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < end, what() if callable(what) else what
        time.sleep(0.1)


def model(page: Any, name: str, expression: str) -> Any:
    """Evaluate an expression of a widget `w` by its name."""
    return page.evaluate(
        f"(() => {{ const w = Bokeh.documents[0].get_model_by_name('{name}'); return {expression}; }})()"
    )


def opened(page: Any, url: str) -> None:
    page.goto(url, timeout=60_000)
    page.wait_for_function("window.Bokeh && Bokeh.documents.length && Bokeh.documents[0].is_idle", timeout=60_000)
    page.wait_for_function("Bokeh.documents[0].get_model_by_name('kp_field').value !== null", timeout=60_000)
