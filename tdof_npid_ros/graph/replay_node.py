"""The replay: publishes a bag again, at will against a live controller whose efforts it compares with the recorded."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from rclpy.publisher import Publisher
from rosgraph_msgs.msg import Clock

from tdof_npid_ros.analysis import AnalysisError
from tdof_npid_ros.analysis.compare import Comparison, Key, Recorded
from tdof_npid_ros.analysis.sources import Chosen
from tdof_npid_ros.bag import BagError
from tdof_npid_ros.bag.reader import BagReader, Message
from tdof_npid_ros.bag.storage import CDR_DEFINITIONS
from tdof_npid_ros.graph.runtime.messages import set_stamp
from tdof_npid_ros.graph.runtime.node import OK, LoopNode
from tdof_npid_ros.graph.runtime.qos import LATCHED_QOS, SIGNAL_QOS
from tdof_npid_ros.graph.runtime.run import run_node
from tdof_npid_ros.interfaces import message_class
from tdof_npid_ros.names import in_namespace
from tdof_npid_ros.one_line import one_line
from tdof_npid_ros.parameters import REPLAY
from tdof_npid_ros.wire import SECOND, AnswerLabel, Sample

CLOCK = "/clock"
NOT_REPLAYED = ("/parameter_events", "/rosout", "/diagnostics", CLOCK)  # they tell of the nodes that run now
SCENARIO_PLAN = "scenario_plan"  # what a controller is given, besides output and setpoint
MATCH_TIMEOUT = 10.0  # s until subscribers must have come, where an answer is needed
REPLY_TIMEOUT = 0.5  # s until an output is published again
RETRIES = 20
PROGRESS_PERIOD = 10.0  # s of wall time between two words about how far it is


class ReplayNode(LoopNode):
    """Publishes a bag's messages at their recorded distances, as the bytes that they are in the bag.

    With `compare`, only what a controller is given: each output waits for the answer to the one before, and the answer
    is compared with the recorded one. Parameters are not applied: with those of the recording the efforts are equal
    bit for bit, with others the comparison tells how much they differ.
    """

    def __init__(self) -> None:
        super().__init__("replay")
        given = self.declare_all(REPLAY)
        self.tell: Callable[[Comparison], None] = lambda _: None
        self.bag = Path(given["bag"])
        self.rate, self.start = given["rate"], given["start"]
        self.loop, self.clock, self.compare = given["loop"], given["clock"], given["compare"]
        self.accept_changes()
        try:
            self.reader = BagReader(self.bag)
            chosen = Chosen.read(*(given[role] or None for role in ("output", "setpoint", "effort")))
            self.recorded = Recorded.read(self.reader, str(self.bag), chosen) if self.compare else None
            self.begin_ns = self.reader.begin_ns
        except (AnalysisError, BagError) as error:
            raise ValueError(str(error)) from None
        if self.begin_ns > self.reader.start_ns:
            before = (self.begin_ns - self.reader.start_ns) / SECOND
            self.get_logger().warning(
                f"{self.bag}: its first messages lie {before:g} s before all others: they are published at once"
            )
        duration = (self.reader.end_ns - self.begin_ns) / SECOND
        if not self.reader.end_ns or self.start > duration:
            raise ValueError(f"{self.bag}: nothing in it after {self.start:g} s: it lasts {duration:g} s")
        self.namespace = self.recorded.namespace if self.recorded else self.reader.custom_data.get("namespace", "/")
        self.comparison = Comparison()

    def activate(self) -> None:
        """Publish from a thread, so that the node stays at hand."""
        self.stopping = threading.Event()
        self.answered = threading.Condition()
        self.answer: Key | None = None
        self.publishers_of = {topic: publisher for topic in self._topics() if (publisher := self._publisher(topic))}
        self.clock_publisher = self.create_publisher(Clock, CLOCK, 10) if self.clock else None
        if self.compare:
            self.subscribe_signal("control_effort", self._on_answer, SIGNAL_QOS)
        self.thread = threading.Thread(target=self._play, name="replay", daemon=True)
        self.thread.start()

    def deactivate(self) -> None:
        """Stop publishing."""
        self.stopping.set()
        self.thread.join()
        self.reader.close()

    # What is published

    def _topics(self) -> list[str]:
        if self.recorded is not None:
            given = {self.recorded.output, self.recorded.setpoint, self.recorded.namespace + SCENARIO_PLAN}
            return [topic for topic in self.reader.topics if topic in given]
        return [topic for topic in self.reader.topics if topic not in NOT_REPLAYED and "transition_event" not in topic]

    def _relative(self, topic: str) -> str:
        """A topic's name in the recorded loop's namespace."""
        return topic.removeprefix(in_namespace(self.namespace))

    def _publisher(self, topic: str) -> Publisher | None:
        qos = LATCHED_QOS if self._is_latched(topic) else SIGNAL_QOS
        info = self.reader.topics[topic]
        try:
            if info.problem or info.encoding not in CDR_DEFINITIONS:
                raise ValueError(info.problem or f"it is in {info.encoding}, not CDR")
            return self.create_publisher(message_class(info.type), self._relative(topic), qos)
        except Exception as error:  # of ours, or whatever rclpy has against a name that a bag may hold
            self.get_logger().warning(f"{one_line(topic)} is not replayed: {one_line(error)}")
            return None

    def _is_latched(self, topic: str) -> bool:
        offered = self.reader.topics[topic].profiles
        latched = any(profile.durability == "transient_local" for profile in offered)
        return latched or self._relative(topic) == "scenario_plan"

    # Playing, in the thread

    def _play(self) -> None:
        try:
            if self.recorded is not None:
                self._wait_for_controller(self.recorded.output)
            self._play_through()
            while self.loop and not self.stopping.is_set():
                self._play_through()
            if self.recorded is not None and not self.comparison.compared and not self.stopping.is_set():
                raise TimeoutError(
                    f"nothing was compared: no recorded answer to {self.recorded.output} after the start"
                )
        except (BagError, TimeoutError) as error:
            self.get_logger().error(str(error))
            self.comparison.failure = str(error)
        finally:
            os.kill(os.getpid(), signal.SIGINT)  # ends the node in order, as Ctrl-C does

    def _play_through(self) -> None:
        first_ns = self.begin_ns + round(self.start * SECOND)
        began = self.told = time.monotonic()
        for topic, log_ns, _, data in self._messages(first_ns):
            due = began + (log_ns - first_ns) / SECOND / self.rate if self.recorded is None else 0.0
            while not self.stopping.wait(min(max(0.0, due - time.monotonic()), PROGRESS_PERIOD)):
                self._tell_progress(log_ns)
                if time.monotonic() >= due:
                    break
            self._publish(topic, log_ns, bytes(data))
            if self.stopping.is_set():
                return

    def _tell_progress(self, log_ns: int) -> None:
        """Say now and then how far it is; the message logged at `log_ns` is the next one."""
        if time.monotonic() - self.told > PROGRESS_PERIOD:
            self.told = time.monotonic()
            passed, whole = ((ns - self.begin_ns) / SECOND for ns in (log_ns, self.reader.end_ns))
            self.get_logger().info(f"at {passed:.1f} of {whole:.1f} s, {self.counts['published']} messages published")

    def _messages(self, first_ns: int) -> Iterator[Message]:
        """From a time on; before it, what a latecomer would still be given, and first messages far before the rest."""
        before = [topic for topic in self.publishers_of if self._is_latched(topic) or not self.start]
        for message in self.reader.messages(before, stop_ns=first_ns) if before else ():
            yield message[0], first_ns, message[2], message[3]
        topics = [*self.publishers_of, *([CLOCK] if self.clock and CLOCK in self.reader.topics else [])]
        yield from self.reader.messages(topics, start_ns=first_ns)

    def _publish(self, topic: str, log_ns: int, data: bytes) -> None:
        if self.clock_publisher is not None and (topic == CLOCK or CLOCK not in self.reader.topics):
            self._publish_clock(topic, log_ns, data)
        if topic == CLOCK:
            return
        if self.recorded is not None and topic == self.recorded.output:
            self._publish_and_wait(self.recorded, data)
        else:
            self.publishers_of[topic].publish(data)
        self.counts["published"] += 1

    def _publish_clock(self, topic: str, log_ns: int, data: bytes) -> None:
        assert self.clock_publisher is not None
        message = Clock()
        set_stamp(message.clock, log_ns)
        self.clock_publisher.publish(data if topic == CLOCK else message)

    # Comparing

    def _wait_for_controller(self, topic: str) -> None:
        subscribers = self.publishers_of[topic].get_subscription_count
        self._until(lambda: bool(subscribers()), MATCH_TIMEOUT, f"no controller takes {self._relative(topic)}")

    def _publish_and_wait(self, recorded: Recorded, data: bytes) -> None:
        expected = recorded.key(data)
        if expected is None:
            return  # the recorded controller did not answer it either
        for _ in range(RETRIES):
            self.publishers_of[recorded.output].publish(data)
            with self.answered:
                if self.answered.wait_for(lambda: self.answer == expected or self.stopping.is_set(), REPLY_TIMEOUT):
                    return
        raise TimeoutError(
            f"no answer to the output at {expected[1] / SECOND:g} s: start a controller in this namespace"
        )

    def _on_answer(self, answer: Sample) -> None:
        assert self.recorded is not None
        digest, episode = AnswerLabel.parse(answer.frame_id)
        key = episode, answer.stamp_ns
        with self.answered:
            if key != self.answer:
                self.comparison.take(self.recorded, key, digest, answer.effort)
                self.answer = key
                self.answered.notify()

    def _until(self, condition: Callable[[], bool], timeout: float, otherwise: str) -> None:
        end = time.monotonic() + timeout
        while not condition():
            if time.monotonic() > end:
                raise TimeoutError(f"{otherwise}: start one in this namespace")
            if self.stopping.wait(0.02):
                return

    def finished(self, status: int) -> int:
        """Tell what was compared; 1 if it failed, or differs without a reason."""
        self.tell(self.comparison)
        failed = self.comparison.failure or (self.compare and not self.comparison.sound)
        return 1 if status == 0 and failed else status

    def state(self) -> tuple[int, str, dict[str, object]]:
        """What is replayed, and how the comparison stands."""
        facts: dict[str, object] = {"bag": self.bag, "rate": self.rate}
        return OK, f"replaying {self.bag}", facts | (self.comparison.as_dict() if self.compare else {})


def replay(arguments: list[str], tell: Callable[[Comparison], None]) -> int:
    """Run the node to its end; returns its exit status.

    Args:
        arguments: the command line, the program's name first.
        tell: called with what was compared, at the node's end.
    """

    def make() -> ReplayNode:
        node = ReplayNode()
        node.tell = tell
        return node

    try:
        run_node(make, arguments)
    except SystemExit as end:
        return int(end.code or 0)
    return 0


def main(args: list[str] | None = None) -> None:
    """Run the node."""

    def tell(comparison: Comparison) -> None:
        with contextlib.suppress(BrokenPipeError):
            print("\n".join(comparison.lines()), flush=True)

    sys.exit(replay(sys.argv if args is None else args, tell))
