"""A loop as a bag holds it: its signals in the order in which they were published, plans and parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tdof_npid_ros.analysis.parameters import ParameterHistory
from tdof_npid_ros.bag.columns import SEQUENCE
from tdof_npid_ros.bag.reader import BagReader
from tdof_npid_ros.names import namespace_of
from tdof_npid_ros.scenario import Plan, PlanError
from tdof_npid_ros.wire import SECOND

PLAN_AFTER_RESET_NS = 1_000_000_000  # in realtime the scenario says the plan once it has reset the plant
JOINT_TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
_FIELDS = ("header.stamp", "header.frame_id", "name", "position", "velocity", "effort")


@dataclass(frozen=True)
class Signal:
    """The messages of one JointState topic.

    Attributes:
        stamp_ns: of the headers, (messages,).
        frame_id: of the headers, (messages,).
        publish_ns: when they were published, ns since the epoch, (messages,).
        sequence: the publisher's count of its messages, (messages,); 0 where the bag does not tell.
        position, velocity, effort: (messages, lanes), or (messages,) of arrays where the number of lanes changes.
        name: likewise, of strings.
    """

    stamp_ns: np.ndarray
    frame_id: np.ndarray
    publish_ns: np.ndarray
    sequence: np.ndarray
    name: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    effort: np.ndarray

    def __len__(self) -> int:
        """Number of messages."""
        return len(self.stamp_ns)

    def runs(self) -> list[slice]:
        """Stretches of messages with the same `frame_id`."""
        if not len(self):
            return []
        starts = [0, *(np.flatnonzero(self.frame_id[1:] != self.frame_id[:-1]) + 1).tolist(), len(self)]
        return [slice(a, b) for a, b in zip(starts, starts[1:], strict=False)]


@dataclass(frozen=True)
class Surroundings:
    """What a bag tells of a loop besides its signals.

    Attributes:
        bag: its path, for messages.
        namespace: of plant, controller and scenario; ends with a slash.
        plans: by digest.
        plan_times: when plans were published, ns since the epoch, with their digests, in order.
        histories: the parameters of every node in the bag, by its full name.
    """

    bag: str
    namespace: str
    plans: Mapping[str, Plan]
    plan_times: Sequence[tuple[int, str]]
    histories: Mapping[str, ParameterHistory]

    @classmethod
    def read(
        cls, reader: BagReader, bag: str, namespace: str, histories: Mapping[str, ParameterHistory]
    ) -> Surroundings:
        """Of the loop in a namespace.

        Raises:
            BagError: the bag is damaged.
        """
        return cls(bag, namespace, *_plans(reader, f"{namespace}scenario_plan"), histories)

    def plan_followed(self, start_ns: int) -> str:
        """The digest of the plan that the scenario plays in an episode of a realtime loop; empty: none is known.

        It is published just after the plant has been reset.
        """
        before = [digest for time_ns, digest in self.plan_times if time_ns <= start_ns + PLAN_AFTER_RESET_NS]
        return before[-1] if before else ""

    @cached_property
    def plant(self) -> ParameterHistory | None:
        """The parameters of the node that simulates the plant."""
        return self._node_with("model", "lanes")

    @cached_property
    def scenario(self) -> ParameterHistory | None:
        """The parameters of the scenario."""
        return self._node_with("episodes")

    @cached_property
    def controller(self) -> ParameterHistory | None:
        """The parameters of the controller."""
        return self._node_with("kp", "anti_windup")

    def _node_with(self, *parameters: str) -> ParameterHistory | None:
        names = set(parameters)
        for node, history in self.histories.items():
            if namespace_of(node) == self.namespace and names <= {name for _, set_ in history.events for name in set_}:
                return history
        return None


@dataclass(frozen=True)
class Loop(Surroundings):
    """One closed loop in a bag, with the messages of our own controller.

    Attributes:
        topic: the output's.
        output: what is controlled; `effort` the effort really applied.
        effort_topic: the control effort's; empty in a bag without.
        control_effort: the controller's answers; None in a bag without.
    """

    topic: str
    output: Signal
    effort_topic: str
    control_effort: Signal | None


def signal_of(reader: BagReader, topic: str) -> Signal:
    """The messages of a JointState topic.

    Raises:
        BagError: the topic cannot be read.
    """
    columns = reader.columns(topic, [*_FIELDS, SEQUENCE])
    return Signal(
        columns["header.stamp"],
        columns["header.frame_id"],
        columns["publish_time"],
        columns[SEQUENCE],
        columns["name"],
        columns["position"],
        columns["velocity"],
        columns["effort"],
    )


def _plans(reader: BagReader, topic: str) -> tuple[dict[str, Plan], list[tuple[int, str]]]:
    """The valid plans on a topic by digest, and when each was published; a message that is no plan is one that every
    node refused."""
    plans: dict[str, Plan] = {}
    times: list[tuple[int, str]] = []
    if topic not in reader.topics or topic in reader.unreadable or reader.topics[topic].type != JOINT_TRAJECTORY:
        return plans, times
    for _, publish_ns, message in reader.decoded(topic):
        points = [point["time_from_start"] for point in message["points"]]
        try:
            plan = Plan(
                tuple(message["joint_names"]),
                tuple(time["sec"] * SECOND + time["nanosec"] for time in points),
                tuple(tuple(point["positions"].tolist()) for point in message["points"]),
            )
        except PlanError:
            continue
        plans[plan.digest] = plan
        times.append((publish_ns, plan.digest))
    return plans, times
