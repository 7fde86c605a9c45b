"""`tdof-npid demo` refuses what it could not record to, and stops all that it started."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import reserved_domain

from tdof_npid_ros.cli import main

NODES = 3  # of the tuned loop: plant, controller, tuner
START_TIMEOUT = 60.0  # s
STOP_TIMEOUT = 30.0  # s


def children_of(pid: int) -> list[int]:
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def runs(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.fixture
def demo(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """A demo whose nodes have been started."""
    domain, reservation = reserved_domain()
    program = subprocess.Popen(
        [sys.executable, "-m", "tdof_npid_ros", "demo", "--json", "--bag", str(tmp_path / "bag")],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "ROS_DOMAIN_ID": str(domain)},
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # a shell's background job ignores it
    )
    end = time.monotonic() + START_TIMEOUT
    while len(children_of(program.pid)) < NODES:
        assert program.poll() is None, program.communicate()
        assert time.monotonic() < end
        time.sleep(0.05)
    yield program
    reservation.close()


def test_ctrl_c_stops_every_node(demo: subprocess.Popen[str]) -> None:
    nodes = children_of(demo.pid)
    demo.send_signal(signal.SIGINT)
    out, err = demo.communicate(timeout=STOP_TIMEOUT)
    assert (demo.returncode, out) == (130, "")
    assert err.splitlines() == ["tdof-npid demo: interrupted"]
    assert not [node for node in nodes if runs(node)]


def test_a_node_that_dies_ends_the_demo(demo: subprocess.Popen[str]) -> None:
    nodes = children_of(demo.pid)
    os.kill(nodes[0], signal.SIGKILL)
    out, err = demo.communicate(timeout=STOP_TIMEOUT)
    assert (demo.returncode, out) == (2, "")
    assert err.startswith("tdof-npid demo: the node plant ended with status -9")
    assert err.count("\n") == 1
    assert not [node for node in nodes if runs(node)]


@pytest.mark.parametrize("bag", [".", "/proc/bag"])
def test_a_bag_that_cannot_be_recorded_is_refused_at_once(bag: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["demo", "--bag", bag]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.count("\n") == 1
    assert bag in printed.err
