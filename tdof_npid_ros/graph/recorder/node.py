"""The recorder: every topic of its namespace into an MCAP bag."""

from __future__ import annotations

import sys
import threading
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rcl_interfaces.msg import ParameterEvent
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    QoSCompatibility,
    QoSProfile,
    ReliabilityPolicy,
    qos_check_compatible,
)
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState

from tdof_npid_ros.bag import BagError, schema
from tdof_npid_ros.bag.cdr import without_padding
from tdof_npid_ros.bag.qos import QosProfile
from tdof_npid_ros.bag.writer import BagWriter
from tdof_npid_ros.graph.recorder.lossless import NO_LOG, TOPIC
from tdof_npid_ros.graph.recorder.snapshot import ParameterSnapshots
from tdof_npid_ros.graph.recorder.wanted import is_wanted, other_loops
from tdof_npid_ros.graph.runtime.messages import set_stamp, signal_message
from tdof_npid_ros.graph.runtime.node import ERROR, OK, STEADY, WARN, LoopNode
from tdof_npid_ros.graph.runtime.qos import SIGNAL_QOS
from tdof_npid_ros.graph.runtime.run import run_node
from tdof_npid_ros.graph.runtime.tap import LogProgress, Taken, Tap, TapThread
from tdof_npid_ros.interfaces import message_class
from tdof_npid_ros.one_line import one_line
from tdof_npid_ros.parameters import RECORDER
from tdof_npid_ros.wire import JOINT_STATE

DISCOVERY_PERIOD = 0.1  # s between two looks at the graph, as long as it changes
CALM_DISCOVERY_PERIOD = 0.5  # s, when it does not
CALM_LOOKS = 20  # looks without a change
PARAMETER_EVENTS = "/parameter_events"
# The loop's own topics are subscribed before their publishers come, so that not even the first message is missed.
EXPECTED = {
    "output": JOINT_STATE,
    "control_effort": JOINT_STATE,
    "setpoint": JOINT_STATE,
    "disturbance": JOINT_STATE,
    "controller_state": JOINT_STATE,
    "scenario_plan": "trajectory_msgs/msg/JointTrajectory",
    "episode": "diagnostic_msgs/msg/KeyValue",
    "/clock": "rosgraph_msgs/msg/Clock",
}


FROM_ROBOTS = ("output", "setpoint")
LATCHED = ("scenario_plan", "episode")


class RecorderNode(LoopNode):
    """Subscribes raw to the topics of its namespace, also those that appear later, and writes what arrives."""

    uses_events_executor = False  # it knows no callback groups, and taps must be left alone

    def __init__(self) -> None:
        super().__init__("recorder")
        given = self.declare_all(RECORDER, bag=f"bags/{time.strftime('%Y%m%d-%H%M%S')}")
        self.folder = self._folder(given["bag"])
        self.compression = given["compression"]
        self.max_bytes, self.max_duration = given["max_bytes"], given["max_duration"]
        self.topics, self.exclude = given["topics"], given["exclude"]
        self.lossless = given["lossless"]
        self.reliable = given["reliability"] == "reliable"  # what robots publish, before one does
        self.accept_changes()
        self._begin_account()
        self.taps: dict[str, Tap] = {}
        self.writer = self._open() if self.autostart else None

    def _begin_account(self) -> None:
        """Each bag has its own."""
        self.failure = ""
        self.counts["recorded"] = 0
        self.topic_ids: dict[str, int] = {}  # in the bag
        self.left: list[Taken] = []  # by taps that were closed
        self.lost_by_topic: Counter[str] = Counter()  # on taps that were closed
        self.missed_by_topic: Counter[str] = Counter()  # published before the recorder came
        self.not_recorded: set[str] = set()
        self.explained: set[str] = set()  # nodes whose parameters are in the bag

    def activate(self) -> None:
        """Open the bag and subscribe."""
        self.writer = self.writer or self._open()
        self._begin_account()
        self.lock = threading.Lock()  # of what this thread and that of the taps share: taps, topic_ids, left
        self.snapshots = ParameterSnapshots(self, self._write_snapshot)
        self.graph: object = None
        self.calm_looks = 0
        for name, kind in EXPECTED.items():
            topic = self.resolve_topic_name(name)
            if self._wanted(topic):
                self._tap(topic, kind, _expected_qos(name, self.reliable))
        if self.lossless:
            self.progress = LogProgress([self.resolve_topic_name(name) for name in ("output", "control_effort")])
            self.progress_publisher = self.create_publisher(JointState, TOPIC, SIGNAL_QOS)
        self.thread = TapThread(self._take, self._write)
        self.discovery = self.create_timer(DISCOVERY_PERIOD, self._discover, clock=STEADY)
        self._look()

    def deactivate(self) -> None:
        """Close the bag with its account."""
        if self.writer is not None:
            self.discovery.cancel()
            self.snapshots.stop()
            self.thread.stop()
            writer, self.writer = self.writer, None
            account = self._account()
            writer.custom_data.update(account)
            try:
                writer.write_metadata("recording", account)
                writer.close()
            except BagError as error:
                self.failure = self.failure or str(error)
            self._let_go()
            failure = f"; {self.failure}" if self.failure else ""
            print(f"bag {self.folder}: {account['recorded']} messages, {account['lost']} lost{failure}", flush=True)

    def finished(self, status: int) -> int:
        """A bag that could not be written whole is no success."""
        return max(status, 1) if self.failure else status

    def checked(self, changes: dict[str, Any]) -> None:
        """Refuse another folder while recording."""
        if "bag" in changes:
            self._folder(changes["bag"])
            if self.active:
                raise ValueError("bag cannot be changed while recording: deactivate the recorder first")

    def changed(self, changes: dict[str, Any]) -> None:
        """Take over the folder of the next bag."""
        if "bag" in changes:
            self.folder = self._folder(changes["bag"])

    def _folder(self, bag: Any) -> Path:
        if not isinstance(bag, str) or not bag:
            raise ValueError(f"bag is {bag!r}: it must be the path of a folder")
        return Path(bag)

    # What there is to record

    def _discover(self) -> None:
        if self.failure:
            self._let_go()
            self._tell_failure()
        else:
            self._look()
        calm = bool(self.failure) or self.calm_looks >= CALM_LOOKS
        self.discovery.timer_period_ns = round((CALM_DISCOVERY_PERIOD if calm else DISCOVERY_PERIOD) * 1e9)

    def _look(self) -> None:
        topics = self.get_topic_names_and_types()
        graph = topics, [self.count_publishers(topic) for topic, _ in topics]
        self.calm_looks = self.calm_looks + 1 if graph == self.graph else 0
        self.snapshots.look()
        if self.calm_looks > CALM_LOOKS:
            return
        self.graph = graph
        others = other_loops(topics, self.get_namespace())
        for topic, types in topics:
            if topic not in self.not_recorded and self._wanted(topic, others):
                self._follow(topic, types)

    def _wanted(self, topic: str, others: Sequence[str] = ()) -> bool:
        return is_wanted(topic, self.get_namespace(), self.topics, self.exclude, others)

    def _follow(self, topic: str, types: list[str]) -> None:
        """Subscribe to a topic, or again if a publisher offers less than what was asked for."""
        tap = self.taps.get(topic)
        publishers = self.get_publishers_info_by_topic(topic)
        offered = [info.qos_profile for info in publishers if tap is None or info.topic_type == tap.type_name]
        if not offered or self.writer is None:
            return  # only subscribed so far
        if tap is not None and any(qos_check_compatible(qos, tap.qos)[0] == QoSCompatibility.ERROR for qos in offered):
            self.get_logger().warning(f"{topic}: a publisher offers less than the others: subscribing again")
            self._close(topic)
            types = [tap.type_name]
            tap = None
        if tap is None:
            try:
                tap = self._tap(topic, _recordable(types), _as_reliable_as(offered))
            except Exception as error:  # of ours, or whatever rclpy has against a name that anyone may announce
                self.not_recorded.add(topic)
                self.get_logger().warning(f"{topic} is not recorded: {one_line(error)}")
                return

    def _tap(self, topic: str, type_name: str, qos: QoSProfile) -> Tap:
        tap = Tap(self, topic, type_name, qos)
        with self.lock:
            self.taps[topic] = tap
        return tap

    def _close(self, topic: str) -> None:
        """Unsubscribe, and keep what has come and what was lost."""
        with self.lock:
            tap = self.taps.pop(topic)
            self.left += tap.take()
            self.lost_by_topic[topic] += tap.lost
            self.missed_by_topic[topic] += tap.missed
            tap.close()

    def _take(self) -> list[Taken]:
        """Called by the taps' thread."""
        with self.lock:
            found, self.left = self.left, []
            for tap in self.taps.values():
                found += tap.take()
        return found

    # What is written

    def _open(self) -> BagWriter:
        try:
            return BagWriter(
                self.folder,
                compression=self.compression,
                max_bytes=self.max_bytes,
                max_duration_s=self.max_duration,
            )
        except BagError as error:
            raise ValueError(str(error)) from None

    def _write(self, messages: list[Taken]) -> None:
        """Called by the taps' thread."""
        writer = self.writer
        if writer is None or self.failure:
            return
        try:
            for received_ns, published_ns, sequence, tap, data in messages:
                topic_id = self.topic_ids.get(tap.topic) or self._topic_id(writer, tap)
                writer.write(topic_id, data, received_ns, published_ns, sequence)
        except BagError as error:
            self._fail(error)
            return
        self.counts["recorded"] += len(messages)
        if self.lossless and self.progress.take(messages):
            self._tell_progress(self.progress.episode, self.progress.stamp_ns)

    def _tell_progress(self, episode: str, time_ns: int) -> None:
        message = signal_message(episode)
        set_stamp(message.header.stamp, time_ns)
        self.progress_publisher.publish(message)

    def _topic_id(self, writer: BagWriter, tap: Tap) -> int:
        """The topic's number in the bag, where it is announced before its first message."""
        with self.lock:
            if tap.topic not in self.topic_ids:
                self.topic_ids[tap.topic] = self._announce(writer, tap)
            return self.topic_ids[tap.topic]

    def _announce(self, writer: BagWriter, tap: Tap) -> int:
        offered = [_profile(info.qos_profile) for info in self.get_publishers_info_by_topic(tap.topic)]
        return writer.add_topic(tap.topic, tap.type_name, qos=offered or [_profile(tap.qos)])

    def _write_snapshot(self, event: ParameterEvent, asked_ns: int) -> None:
        tap = self.taps.get(PARAMETER_EVENTS)
        writer = self.writer
        if writer is None or self.failure or tap is None:
            return
        data = without_padding(tap.type_name, schema.definition(tap.type_name), serialize_message(event))
        try:
            writer.write(self._topic_id(writer, tap), data, time.time_ns(), asked_ns)
        except BagError as error:
            self._fail(error)
            return
        self.explained.add(event.node)

    def _fail(self, error: BagError) -> None:
        """Say so at once, and let go of the topics: a reader that does not read would hold the loop up."""
        self.failure = str(error)
        self._tell_failure()
        self.get_logger().error(self.failure)
        self.publish_diagnostics()

    def _tell_failure(self) -> None:
        """Again and again: a plant that begins later must not wait for a log, either."""
        if self.lossless:
            self._tell_progress(NO_LOG, 0)

    def _let_go(self) -> None:
        for topic in list(self.taps):
            self._close(topic)

    # State

    def _account(self) -> dict[str, str]:
        missed = self.missed_by_topic + Counter({topic: tap.missed for topic, tap in list(self.taps.items())})
        return {
            "namespace": self.get_namespace(),
            "recorded": str(self.counts["recorded"]),
            "lost": str(self.lost),
            **{f"lost {topic}": str(lost) for topic, lost in self._losses().items()},
            **{f"published before the recorder came {topic}": str(count) for topic, count in missed.items()},
        }

    def _losses(self) -> Counter[str]:
        """Messages lost so far, by topic; topics without are left out."""
        return self.lost_by_topic + Counter({topic: tap.lost for topic, tap in list(self.taps.items())})

    @property
    def lost(self) -> int:
        """Messages lost so far."""
        return self._losses().total()

    def summary(self) -> str:
        """Where it records to."""
        return f"recording to {self.folder}"

    def state(self) -> tuple[int, str, dict[str, object]]:
        """What is recorded where, and what went wrong."""
        losses = self._losses()
        facts: dict[str, object] = {
            "bag": self.folder,
            "topics": len(self.taps),
            "parameters_of": len(self.explained),
            "lost": losses.total(),
        }
        if self.failure:
            return ERROR, self.failure, facts
        if losses:
            worst = losses.most_common(1)[0][0]
            return WARN, f"{losses.total()} messages lost, most on {worst}: set lossless, or leave topics out", facts
        return OK, f"recording {len(self.taps)} topics to {self.folder}", facts


def _recordable(types: list[str]) -> str:
    """The one type of a topic.

    Raises:
        ValueError: it has several, or its type is not installed.
    """
    if len(types) > 1:
        raise ValueError(f"its publishers and subscribers do not agree on its type: {', '.join(types)}")
    message_class(types[0])
    try:
        schema.definition(types[0]), schema.type_hash(types[0])
    except BagError as error:
        raise ValueError(str(error)) from None
    return types[0]


def _profile(qos: QoSProfile) -> QosProfile:
    return QosProfile(
        reliability=qos.reliability.name.lower(),
        durability=qos.durability.name.lower(),
        history="keep_last",  # history and depth are not announced over DDS
        depth=qos.depth,
    )


def _expected_qos(name: str, reliable: bool) -> QoSProfile:
    durability = DurabilityPolicy.TRANSIENT_LOCAL if name in LATCHED else DurabilityPolicy.VOLATILE
    hears_all = name in FROM_ROBOTS and not reliable
    reliability = ReliabilityPolicy.BEST_EFFORT if hears_all else ReliabilityPolicy.RELIABLE
    return QoSProfile(history=HistoryPolicy.KEEP_ALL, reliability=reliability, durability=durability)


def _as_reliable_as(offered: list[QoSProfile]) -> QoSProfile:
    """The strongest quality of service that every publisher offers, keep-all."""
    profile = QoSProfile(history=HistoryPolicy.KEEP_ALL)
    if any(qos.reliability == ReliabilityPolicy.BEST_EFFORT for qos in offered):
        profile.reliability = ReliabilityPolicy.BEST_EFFORT
    if all(qos.durability == DurabilityPolicy.TRANSIENT_LOCAL for qos in offered):
        profile.durability = DurabilityPolicy.TRANSIENT_LOCAL
    return profile


def main(args: list[str] | None = None) -> None:
    """Run the node."""
    run_node(RecorderNode, sys.argv if args is None else args)
