"""The recorder: every topic of its namespace into an MCAP bag."""

from __future__ import annotations

import importlib
import sys
import time
from pathlib import Path
from typing import Any

from rcl_interfaces.msg import ParameterEvent
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from rclpy.subscription import Subscription

from tdof_npid_ros.bag import schema
from tdof_npid_ros.bag.cdr import without_padding
from tdof_npid_ros.bag.metadata import QosProfile
from tdof_npid_ros.bag.writer import BagWriter
from tdof_npid_ros.graph.node import OK, LoopNode, run_node
from tdof_npid_ros.graph.snapshot import ParameterSnapshots

ALWAYS = ("/parameter_events", "/rosout", "/diagnostics", "/clock")
DISCOVERY_PERIOD = 0.1  # s
DEPTH = 10_000  # messages that may wait for the recorder


class RecorderNode(LoopNode):
    """Subscribes raw to the topics of its namespace, also those that appear later, and writes what arrives."""

    uses_events_executor = False  # it fails on callbacks that take the message's times

    def __init__(self) -> None:
        super().__init__("recorder")
        default = f"bags/{time.strftime('%Y%m%d-%H%M%S')}"
        self.folder = Path(str(self.declare_value("bag", default, "folder of the bag; must not exist", fixed=True)))
        self.compression = self.declare_value("compression", "zstd", "of the chunks: zstd, lz4 or none", fixed=True)
        self.accept_changes()
        self.writer: BagWriter | None = None
        self.recorded: dict[str, Subscription] = {}

    def activate(self) -> None:
        self.writer = BagWriter(self.folder, compression=self.compression)
        self.snapshots = ParameterSnapshots(self, self._write_snapshot)
        self.discovery = self.create_timer(DISCOVERY_PERIOD, self._discover)
        self.get_logger().info(f"recording to {self.folder}")
        self._discover()

    def deactivate(self) -> None:
        if self.writer is not None:
            writer, self.writer = self.writer, None
            self.discovery.cancel()
            writer.close()
            print(f"bag {self.folder}: {self.counts['recorded']} messages", flush=True)

    def _discover(self) -> None:
        namespace = self.get_namespace().rstrip("/") + "/"
        for topic, types in self.get_topic_names_and_types():
            wanted = topic.startswith(namespace) or topic in ALWAYS
            if wanted and topic not in self.recorded and len(types) == 1:
                self._record(topic, types[0])
        self.snapshots.look()

    def _record(self, topic: str, type_name: str) -> None:
        assert self.writer is not None
        offered = [info.qos_profile for info in self.get_publishers_info_by_topic(topic)]
        if not offered:
            return  # only subscribed so far
        topic_id = self.writer.add_topic(topic, type_name, qos=[_profile(qos) for qos in offered])

        def write(data: bytes, info: Any) -> None:
            if self.writer is not None:
                self.writer.write(topic_id, data, time.time_ns(), info["source_timestamp"], self.counts[topic])
                self.counts[topic] += 1
                self.counts["recorded"] += 1

        self.recorded[topic] = self.create_subscription(
            _message_class(type_name), topic, write, _as_reliable_as(offered), raw=True
        )
        if topic == "/parameter_events":
            self.parameter_events = topic_id

    def _write_snapshot(self, event: ParameterEvent) -> None:
        if self.writer is not None and "/parameter_events" in self.recorded:
            now = time.time_ns()
            kind = "rcl_interfaces/msg/ParameterEvent"
            data = without_padding(kind, schema.definition(kind), serialize_message(event))
            self.writer.write(self.parameter_events, data, now, now)

    def state(self) -> tuple[int, str, dict[str, object]]:
        return OK, f"recording {len(self.recorded)} topics to {self.folder}", {"bag": self.folder}


def _message_class(type_name: str) -> Any:
    package, _, name = type_name.partition("/msg/")
    return getattr(importlib.import_module(f"{package}.msg"), name)


def _profile(qos: QoSProfile) -> QosProfile:
    return QosProfile(
        reliability=qos.reliability.name.lower(),
        durability=qos.durability.name.lower(),
        history="keep_last",  # history and depth are not announced over DDS
        depth=qos.depth,
    )


def _as_reliable_as(offered: list[QoSProfile]) -> QoSProfile:
    """The strongest quality of service that every publisher offers."""
    profile = QoSProfile(depth=DEPTH)
    if any(qos.reliability == ReliabilityPolicy.BEST_EFFORT for qos in offered):
        profile.reliability = ReliabilityPolicy.BEST_EFFORT
    if all(qos.durability == DurabilityPolicy.TRANSIENT_LOCAL for qos in offered):
        profile.durability = DurabilityPolicy.TRANSIENT_LOCAL
    return profile


def main(args: list[str] | None = None) -> None:
    """Run the node."""
    run_node(RecorderNode, sys.argv if args is None else args)
