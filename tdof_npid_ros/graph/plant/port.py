"""The simulated plant at its topics: what both ways of running it see of the node."""

from __future__ import annotations

import math
import secrets
import sys
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from diagnostic_msgs.msg import KeyValue
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState

from tdof_npid_ros.control.joints import Joints
from tdof_npid_ros.graph.runtime.loop_end import LoopEnd
from tdof_npid_ros.graph.runtime.messages import EPISODE, lane_names, time_message
from tdof_npid_ros.graph.runtime.qos import LATCHED_QOS
from tdof_npid_ros.parameters import NOISE
from tdof_npid_ros.plants.catalog import changeable_parameters, effort_limits, make_plant
from tdof_npid_ros.plants.plant import Plant, PlantError
from tdof_npid_ros.plants.simulator import PlantSimulator
from tdof_npid_ros.plants.start import plant_at_start
from tdof_npid_ros.wire import EpisodeLabel, Sample, SignalWriter

TWO_CLOCKS = "others publish /clock, too, so time jumps: set publish_clock to false in all plants but one"
Phase = Literal["waiting", "running", "stopped", "finished"]


class PlantPort:
    """The plant with its output and its efforts, and the label of what it does.

    Args:
        node: declares the plant's parameters; through it everything goes.
        model: of the plant.
        model_names: names of its parameters.
        period_ns: the sample period.
        joints: the lanes' names.

    Attributes:
        simulator: the plant as it is now.
        label: of the episode; its number is 0 before the first one of an activation.
        phase: of the episode.
    """

    def __init__(self, node: LoopEnd, model: str, model_names: list[str], period_ns: int, joints: Joints) -> None:
        self.node = node
        self.period_ns = period_ns
        self.joints = joints
        self._model, self._model_names = model, model_names
        self._output = SignalWriter()
        self.phase: Phase = "waiting"
        self.label = EpisodeLabel("", "", 0)
        self.simulator = self.new_simulator()
        self.simulator.warm_up()

    def activate(self, is_clock: bool, with_deadline: bool, matched: Callable[[Any], None]) -> None:
        """Create the topics `output` and `episode`, and wait.

        Args:
            is_clock: whether it publishes /clock.
            with_deadline: whether `output` promises one.
            matched: told of each subscriber of `output` that comes or goes.
        """
        node = self.node
        qos = node.promised_qos(with_deadline=with_deadline)
        self._latest_output = b""
        self._output_publisher = node.publisher_of(JointState, "output", qos, matched=matched)
        self._episode_publisher = node.create_publisher(KeyValue, EPISODE, LATCHED_QOS)
        self._clock_publisher = node.create_publisher(Clock, "/clock", 10) if is_clock else None
        self._two_clocks = False
        self.label = EpisodeLabel("", secrets.token_hex(4), 0)
        self.tell("waiting")

    # Episodes

    def next_label(self, plan: str) -> EpisodeLabel:
        """Of the episode that would begin now; `plan` is the digest of its plan, empty where there is none."""
        return EpisodeLabel(plan, self.label.activation, self.label.number + 1)

    def begin(self, label: EpisodeLabel, simulator: PlantSimulator) -> None:
        """Begin an episode: outputs are those of this simulator, and bear this label, from now on."""
        self.label, self.simulator = label, simulator
        self._output.label(str(label), self.joints.names or lane_names(simulator.lanes))
        self.tell("running")

    def tell(self, phase: Phase) -> None:
        """Say on `episode` how it stands with the episode."""
        self.phase = phase
        self._episode_publisher.publish(KeyValue(key=str(self.label), value=phase))

    # Signals

    def publish_output(self, time_ns: int) -> None:
        """Publish what the plant puts out now, stamped with the loop's time."""
        simulator = self.simulator
        self._latest_output = self._output.write(time_ns, position=simulator.output, effort=simulator.applied_effort)
        self._output_publisher.publish(self._latest_output)

    def repeat_output(self) -> None:
        """Publish the latest output again, as it was."""
        self._output_publisher.publish(self._latest_output)

    def publish_clock(self, time_ns: int) -> None:
        """Publish the loop's time, if it is this plant that does."""
        if self._clock_publisher is not None:
            self._clock_publisher.publish(Clock(clock=time_message(time_ns)))

    def has_rival_clock(self) -> bool:
        """Whether somebody else publishes /clock as this plant does; warned of when that begins."""
        clock = self._clock_publisher
        rival = clock is not None and self.node.count_publishers(clock.topic_name) > 1
        if rival and not self._two_clocks:
            self.node.get_logger().warning(TWO_CLOCKS)
        self._two_clocks = rival
        return rival

    def takes(self, topic: str, effort: np.ndarray) -> bool:
        """Whether there is one finite value per lane; else it is refused."""
        return self.node.is_valid(topic, effort, self.simulator.lanes, sys.float_info.max)

    def effort_of(self, sample: Sample) -> np.ndarray | None:
        """The control effort, (lanes,), by the joints' names where it bears them; None if it is refused."""
        effort = sample.effort
        if self.joints.names and set(sample.name) == set(self.joints.names):
            effort = self.joints.selected(sample.name, effort)
        return effort if self.takes("control_effort", effort) else None

    # The plant

    def plant_at(self, changes: dict[str, float]) -> Plant:
        """The plant with some parameters changed.

        Raises:
            PlantError: there is no such parameter, or it cannot change while the loop runs, or its value is wrong.
        """
        values = self.node.values_of([*self._model_names, *NOISE])
        changeable = changeable_parameters(self._model)
        for name in changes:
            if name not in changeable:
                raise PlantError(
                    f"plant.{name} cannot change while the loop runs: with model {self._model} these can: "
                    f"{', '.join(changeable) or 'none'}"
                )
        return make_plant(self._model, {**values, **changes})

    def new_simulator(self, episode: int = 0) -> PlantSimulator:
        """The plant at its initial state, with the parameters as they are now and the noise of an episode."""
        p = self.node.values_of(["lanes", "start"])
        start, limits = p["start"] if math.isfinite(p["start"]) else None, self.effort_limits()
        plant = plant_at_start(self.plant_at, start, {}, limits, episode)
        return PlantSimulator(plant, self.period_ns, p["lanes"], limits)

    def effort_limits(self) -> tuple[float, float]:
        """The actuator's."""
        return effort_limits(self.node.values_of(["effort_min", "effort_max"]))
