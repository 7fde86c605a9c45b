"""Two hosts on one machine: network namespaces joined by a veth pair, DDS between them over UDP alone, packets lost.

Skipped where namespaces, `ip` or `nft` are not to be had.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tdof_npid_ros.case import load_case
from tdof_npid_ros.parameter_file import read_parameters
from tdof_npid_ros.tuning.objective import Objective
from tdof_npid_ros.tuning.problem import TuningProblem
from tdof_npid_ros.tuning.study import Study

REPOSITORY = Path(__file__).resolve().parents[2]
END, PERIOD = (
    16.0,
    0.05,
)  # s, of each episode, which comes to rest in it, and of the samples: few steps on a slow network
STEPS = round(END / PERIOD)  # of each episode
RUN = {"population": 4, "generations": 10, "polish": 4, "seed": 9}
LOSS = 5  # per cent of the packets, each way
TIMEOUT = 100.0  # s
ATTEMPTS = 4  # until the near loop is not through before the far one has been found: packets of discovery are lost, too


class Hosts:
    """Two network namespaces, `a` and `b`, and the nodes that run in them."""

    def __init__(self, folder: Path) -> None:
        self.names = {host: f"tdof{os.getpid()}{host}" for host in "ab"}
        self._folder = folder
        self._processes: list[subprocess.Popen[bytes]] = []

    def build(self) -> None:
        a, b = self.names.values()
        for name in (a, b):
            run("ip", "netns", "add", name)
        run("ip", "link", "add", "veth0", "netns", a, "type", "veth", "peer", "name", "veth0", "netns", b)
        for i, name in enumerate((a, b)):
            run("ip", "-n", name, "link", "set", "lo", "up")
            run("ip", "-n", name, "addr", "add", f"10.77.0.{i + 1}/24", "dev", "veth0")
            run("ip", "-n", name, "link", "set", "veth0", "up", "multicast", "on")
            run("ip", "-n", name, "route", "add", "224.0.0.0/4", "dev", "veth0")

    def lose_packets(self) -> None:
        for name in self.names.values():
            run("ip", "netns", "exec", name, "nft", "add table ip loss")
            run("ip", "netns", "exec", name, "nft", "add chain ip loss input { type filter hook input priority 0; }")
            rule = f"iif veth0 numgen random mod 100 < {LOSS} counter drop"
            run("ip", "netns", "exec", name, "nft", f"add rule ip loss input {rule}")

    def lost(self) -> int:
        """Packets lost so far, both ways."""
        tables = [
            run("ip", "netns", "exec", name, "nft", "list", "table", "ip", "loss") for name in self.names.values()
        ]
        return sum(int(count) for table in tables for count in re.findall(r"packets (\d+)", table))

    def start(self, host: str, node: str, namespace: str, *arguments: str) -> tuple[subprocess.Popen[bytes], Path]:
        command = [
            sys.executable,
            "-m",
            "tdof_npid_ros.graph",
            node,
            "--ros-args",
            "-r",
            f"__ns:={namespace}",
            *arguments,
        ]
        environment = {
            **os.environ,
            "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4",
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET",
            "FASTRTPS_DEFAULT_PROFILES_FILE": str(REPOSITORY / "config" / "fastdds.xml"),  # not that of other tests
            "PYTHONPATH": str(REPOSITORY),
        }
        log = self._folder / f"{len(self._processes)}-{node}.log"
        with log.open("w") as stream:
            process = subprocess.Popen(
                ["ip", "netns", "exec", self.names[host], *command],
                stdout=stream,
                stderr=subprocess.STDOUT,
                env=environment,
            )
        self._processes.append(process)
        return process, log

    def stop(self) -> None:
        for process in self._processes:
            if process.poll() is None:
                process.send_signal(signal.SIGTERM)
        for process in self._processes:
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self._processes.clear()

    def remove(self) -> None:
        self.stop()
        for name in self.names.values():
            subprocess.run(["ip", "netns", "del", name], capture_output=True)


def run(*command: str) -> str:
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


@pytest.fixture
def hosts(tmp_path: Path) -> Iterator[Hosts]:
    for program in ("ip", "nft"):
        if shutil.which(program) is None:
            pytest.skip(f"{program} is not installed")
    built = Hosts(tmp_path)
    try:
        try:
            built.build()
        except subprocess.CalledProcessError as error:
            pytest.skip(f"network namespaces are not permitted here: {error.stderr.strip()}")
        yield built
    finally:
        built.remove()


@pytest.mark.timeout(300)
def test_two_loops_on_two_hosts_with_lost_packets_give_the_offline_result(
    hosts: Hosts, tmp_path: Path, capsys: Any
) -> None:
    case = tmp_path / "case.yaml"
    text = (REPOSITORY / "config" / "p1-c0.5.yaml").read_text()
    case.write_text(text.replace("25 end", f"{END} end").replace("sample_period: 0.005", f"sample_period: {PERIOD}"))
    which = TuningProblem(load_case(case), "tdof_npid2", warm=True, **RUN)  # type: ignore[arg-type]
    study = Study(which)
    study.run(Objective(which))

    steps_per_s = []
    for lossy in (False, True):
        if lossy:
            try:
                hosts.lose_packets()
            except subprocess.CalledProcessError as error:
                pytest.skip(f"packets cannot be dropped here: {error.stderr.strip()}")
        result = tmp_path / f"tuned-{lossy}.yaml"
        for _ in range(ATTEMPTS):
            log = tune_across(hosts, case, result)
            hosts.stop()
            assert read_parameters(result, "controller") == study.result.gains.as_dict()
            if "loop /far is used" in log:
                break
        assert "loop /far is used" in log
        steps_per_s.append(rate(log))
    with capsys.disabled():
        print(
            f"\ntwo hosts: {steps_per_s[0]:.0f} steps/s without loss, {steps_per_s[1]:.0f} steps/s "
            f"with {LOSS} % of the packets lost each way ({hosts.lost()} lost)"
        )
    assert hosts.lost() > 0


def tune_across(hosts: Hosts, case: Path, result: Path) -> str:
    """Tune with one loop on host a, and one whose plant is on b and its controller on a; returns the tuner's log."""
    common = ["--params-file", str(case)]
    quick = ["-p", "reply_timeout:=0.05", "-p", "retries:=1000"]
    hosts.start("a", "plant", "/near", *common, *quick)
    hosts.start("a", "controller", "/near", *common)
    hosts.start("b", "plant", "/far", *common, *quick)
    hosts.start("a", "controller", "/far", *common)
    options = [f"{name}:={value}" for name, value in {**RUN, "case": case, "result": result}.items()]
    options += ["loops:=[/near, /far]", "answer_timeout:=30.0"]
    tuner, log = hosts.start("a", "tuner", "/", *common, *(part for option in options for part in ("-p", option)))
    try:
        assert tuner.wait(TIMEOUT) == 0, log.read_text()
    except subprocess.TimeoutExpired:
        pytest.fail(f"not tuned within {TIMEOUT:g} s: {log.read_text()}")
    return log.read_text()


def rate(log: str) -> float:
    """Steps per second of the loops together, from the first generation's end to the last's."""
    times = [float(time) for time in re.findall(r"\[(\d+\.\d+)\] \[tuner\]: generation", log)]
    return 2 * STEPS * (len(times) - 1) / (times[-1] - times[0])
