"""The plant: a simulated process that publishes its output and takes control effort."""

from __future__ import annotations

import contextlib
import math
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

from std_srvs.srv import Trigger

from tdof_npid_ros.control.joints import Joints
from tdof_npid_ros.graph.plant.lockstep import LockstepPlant
from tdof_npid_ros.graph.plant.port import TWO_CLOCKS, PlantPort
from tdof_npid_ros.graph.plant.realtime import RealtimePlant
from tdof_npid_ros.graph.runtime.loop_end import LoopEnd
from tdof_npid_ros.graph.runtime.node import OK, WARN
from tdof_npid_ros.graph.runtime.run import run_node
from tdof_npid_ros.parameter_file import ParameterFileError, read_parameters
from tdof_npid_ros.parameters import NOISE, PLANT, sample_period_in_ns
from tdof_npid_ros.plants.catalog import effort_limits, make_plant, model_table, named_model
from tdof_npid_ros.plants.plant import EachLane, Plant
from tdof_npid_ros.plants.start import plant_at_start

LIMITS = ("effort_min", "effort_max")
MODES: dict[str, type[LockstepPlant] | type[RealtimePlant]] = {"lockstep": LockstepPlant, "realtime": RealtimePlant}


class PlantNode(LoopEnd):
    """Publishes `output`, takes `control_effort` and `disturbance`; `plant/reset` starts it over."""

    def __init__(self) -> None:
        super().__init__("plant")
        model = self.declare(PLANT["model"])
        self.model = named_model(model, self._folder_of_file_with_model(model))
        self.model_names = list(model_table(self.model))
        given = self.declare_all({**PLANT, **model_table(self.model)})
        period_ns = sample_period_in_ns(given["sample_period"])
        self.mode = given["mode"]
        self.joints = Joints(given["joint_names"])
        self.own_plants: bool | None = None  # whether each lane has one
        self.checked({})
        self.accept_changes()
        self.port = PlantPort(self, self.model, self.model_names, period_ns, self.joints)
        self.way_of_running = MODES[self.mode](self.port)

    def _folder_of_file_with_model(self, model: Any) -> Path | None:
        """The folder of the parameter file on the command line that gives the model; None if it is given otherwise."""
        files = [Path(file) for option, file in pairwise(sys.argv) if option == "--params-file"]
        for file in reversed(files):
            with contextlib.suppress(ParameterFileError):  # ROS has read it in its own way
                if read_parameters(file, self.get_name()).get("model") == model:
                    return file.parent
        return None

    def activate(self) -> None:
        """Create topics, services and timers."""
        self.prepare_for_realtime()
        p = self.values_of(["speed", "publish_clock"])
        realtime = self.mode == "realtime"
        # At the speed of the wall clock, that is the clock; else time has to be told.
        is_clock = p["publish_clock"] and not (realtime and p["speed"] == 1.0)
        self.port.activate(is_clock, realtime, self.way_of_running.on_matched)
        self.create_service(Trigger, "plant/reset", self._on_reset)
        self.way_of_running.activate()

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success, response.message = self.way_of_running.reset()
        return response

    # Parameters and state

    def checked(self, changes: dict[str, Any]) -> None:
        """Refuse changes that do not make a valid whole."""
        p = {**self.values_of([*self.model_names, *NOISE, "lanes", "start", *LIMITS]), **changes}
        plant, limits = make_plant(self.model, p), effort_limits(p)
        self._check_lanes(plant, p["lanes"])
        # A plan may change the plant itself so that it could not rest where it began; then `reset` refuses.
        if math.isfinite(p["start"]) and changes.keys() & {"start", *LIMITS}:
            plant_at_start(lambda _: plant, p["start"], {}, limits)
        if self.joints.names and len(self.joints.names) != p["lanes"]:
            raise ValueError(
                f"joint_names has {len(self.joints.names)} names, but lanes is {p['lanes']}: give one name per lane"
            )

    def _check_lanes(self, plant: Plant, lanes: int) -> None:
        """Refuse plants for other lanes, and another kind while it runs: it would be compiled in the midst of it."""
        own = isinstance(plant, EachLane)
        if isinstance(plant, EachLane) and len(plant.plants) != lanes:
            raise ValueError(
                f"there are parameters for {len(plant.plants)} lanes, but lanes is {lanes}: give one number per lane"
            )
        if self.own_plants not in (None, own):
            raise ValueError("whether each lane has a plant of its own is decided at the start: start with lists")
        self.own_plants = own

    def changed(self, changes: dict[str, Any]) -> None:
        """Take over accepted changes."""
        self.way_of_running.changed()

    def summary(self) -> str:
        """The model, the way of running, and what it waits for."""
        lanes = self.port.simulator.lanes
        waits = "scenario_plan" if self.mode == "lockstep" else "control_effort"
        own = ", each with its own plant" if self.own_plants else ""
        return (
            f"{self.model}, {lanes} lane{'s' if lanes > 1 else ''}{own}, {self.mode} at "
            f"{1e9 / self.port.period_ns:g} Hz, waiting for {self.resolve_topic_name(waits)}"
        )

    def state(self) -> tuple[int, str, dict[str, object]]:
        """For the diagnostics."""
        level, text, facts = self.way_of_running.state()
        if self.active and self.port.has_rival_clock() and level == OK:
            level, text = WARN, TWO_CLOCKS
        return level, text, {"mode": self.mode, "lanes": self.port.simulator.lanes, **facts}


def main(args: list[str] | None = None) -> None:
    """Run the node."""
    run_node(PlantNode, sys.argv if args is None else args)
