"""Loops side by side in namespaces of one domain: processor time, memory, discovery, missed answers."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.harness import Curve, Result, Table, Verdict, main, processor_seconds, resident_mib
from tdof_npid_ros.graph.processes import NodeProcesses
from tdof_npid_ros.graph.runtime.middleware import stay_on_this_machine

TITLE = "Loops side by side"
METHOD = (
    "1, 2, 4, 8 and 16 loops, each a plant and a controller as two processes in a namespace of its own, all in one "
    "domain of this machine, in realtime at 20 Hz; more are started beside those that run. Processor time is that of "
    "all nodes' processes in a window of seconds, memory their resident sets. *Discovery*: the time from the start of "
    "the new loops' processes until the last of them has been answered, start-up included. Missed: outputs in the "
    "window that no "
    "effort bears the stamp of, by an onlooker that hears all loops. The exponent is the slope in the logarithmic "
    "picture."
)
PEERS = ("ros-jazzy-rclpy",)
NOTES = (
    "What bounds it is discovery: each process tells each other one what it has, and 32 processes start on two cores. "
    "On two slow cores two more loops answer after 5 s beside two, 19 s beside eight, 34 s beside ten, and 16 that "
    "start at once after 35 s to more than 110 s. See docs/fleets.md: a domain each, or a discovery server.",
    "What bounds processor time: each process announces itself to all others each half second. With announcements "
    "every 3 s after the first ten seconds or two, 16 loops took 0.79 to 0.89 of a processor in place of 0.97, and the "
    "exponent was 0.95 to 1.03; but then a tuner of the test suite did not hear of its loop within 2 s, as a "
    "lost reply to an announcement waits for the next one. So they stay as they are.",
)

PERIOD = 0.05  # s
TIMEOUT = 240.0  # s
LATE = 0.5  # s before the window's end: answers may be on their way
DOMAIN = "91"


def run(size: str) -> Result:
    """More and more loops."""
    counts, window = ((1, 2, 4, 8, 16), 15.0) if size == "full" else ((1, 2), 3.0)
    found: list[float] = []
    cpu, memory, missed, rows = [], [], 0, []
    result = Result()
    with _this_machine(), tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        file = Path(folder) / "fleet.yaml"
        file.write_text(
            f"/**: {{ros__parameters: {{sample_period: {PERIOD}, mode: realtime}}}}\n"
            "/**/controller: {ros__parameters: {kp: 2.0, ki: 1.0, sigma: 1.0, setpoint: 1.0}}\n"
        )
        onlooker = stack.enter_context(_Onlooker())
        loops: list[NodeProcesses] = []
        for count in counts:
            started = time.monotonic()
            for number in range(len(loops), count):
                loops.append(stack.enter_context(NodeProcesses(file, f"/loop{number}")))
                for node in ("controller", "plant"):
                    loops[-1].start(node)
                onlooker.watch(number)
            try:
                onlooker.wait_for_answers(count, loops)
            except TimeoutError as error:
                if len(found) < 2:  # no fleet, but a fault
                    raise
                result.notes.append(str(error))
                break
            found.append(time.monotonic() - started)
            pids = [pid for loop in loops for pid in loop.pids.values()]
            before, begin = sum(map(processor_seconds, pids)), time.monotonic()
            lost, outputs = onlooker.missed(window)
            cpu.append((sum(map(processor_seconds, pids)) - before) / (time.monotonic() - begin))
            memory.append(sum(map(resident_mib, pids)))
            missed += lost
            rows.append(
                [str(count), f"{cpu[-1]:.3f}", f"{memory[-1]:,.0f}", f"{found[-1]:.1f}", f"{outputs}", f"{lost}"]
            )
    sizes = [float(count) for count in counts[: len(found)]]
    result.verdicts.append(Verdict("loops that all answer", sizes[-1], counts[-1]))
    for name, values in (("processor time", cpu), ("memory", memory)):
        exponent = float(np.polyfit(np.log(sizes), np.log(values), 1)[0])
        goal = 1.1 if name == "processor time" else None
        result.verdicts.append(
            Verdict(f"{name} with 1 to {sizes[-1]:.0f} loops: exponent", exponent, goal, at_most=True)
        )
    result.verdicts.append(Verdict("outputs without an answer, all loops", missed, 0, at_most=True))
    header = ["loops", "processors used", "memory, MiB", "until all answer, s", "outputs", "unanswered"]
    result.tables.append(Table("Loops of two processes at 20 Hz", header, rows))
    result.curves = [
        Curve("processors used", "loops", sizes, cpu, "processors"),
        Curve("memory", "loops", sizes, memory, "MiB"),
        Curve("until all of the new loops answer", "loops", sizes, found),
    ]
    return result


@contextmanager
def _this_machine() -> Iterator[None]:
    """A domain of its own, on the loopback interface, where more processes find each other than by ROS's default."""
    before = dict(os.environ)
    os.environ["ROS_DOMAIN_ID"] = DOMAIN
    stay_on_this_machine()
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


class _Onlooker:
    """Hears outputs and efforts of all loops, by their stamps."""

    def __enter__(self) -> _Onlooker:
        import rclpy

        rclpy.init()
        self._node = rclpy.create_node("onlooker", start_parameter_services=False)
        self._heard: dict[tuple[int, str], set[int]] = {}
        return self

    def __exit__(self, *_: object) -> None:
        import rclpy

        self._node.destroy_node()
        rclpy.try_shutdown()

    def watch(self, loop: int) -> None:
        """Hear a loop."""
        from sensor_msgs.msg import JointState

        for topic in ("output", "control_effort"):
            stamps = self._heard[loop, topic] = set()

            def hear(message: Any, stamps: set[int] = stamps) -> None:
                stamps.add(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)

            self._node.create_subscription(JointState, f"/loop{loop}/{topic}", hear, 100)

    def wait_for_answers(self, loops: int, running: list[NodeProcesses]) -> None:
        """Until each loop's efforts have been heard.

        Raises:
            TimeoutError: some are not.
        """
        end = time.monotonic() + TIMEOUT
        while not all(self._heard[loop, "control_effort"] for loop in range(loops)):
            if time.monotonic() > end:
                raise TimeoutError(f"of {loops} loops, not all answer within {TIMEOUT:g} s")
            for one in running:
                one.check()
            self._spin(0.1)

    def missed(self, seconds: float) -> tuple[int, int]:
        """Outputs of a window of seconds that nothing answers, and all outputs in it."""
        for stamps in self._heard.values():
            stamps.clear()
        self._spin(seconds)
        lost = outputs = 0
        for (loop, topic), stamps in self._heard.items():
            if topic != "output" or not stamps:
                continue
            first, last = min(stamps) + round(LATE * 1e9), max(stamps) - round(LATE * 1e9)
            asked = {stamp for stamp in stamps if first <= stamp <= last}
            outputs += len(asked)
            lost += len(asked - self._heard[loop, "control_effort"])
        return lost, outputs

    def _spin(self, seconds: float) -> None:
        import rclpy

        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0.0:
            rclpy.spin_once(self._node, timeout_sec=left)


if __name__ == "__main__":
    main("fleet")
