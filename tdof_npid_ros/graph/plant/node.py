"""The plant: a simulated process that publishes its output and takes control effort."""

from __future__ import annotations

import contextlib
import math
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

from std_srvs.srv import Trigger

from tdof_npid_ros.case import sample_period_in_ns
from tdof_npid_ros.control.joints import Joints
from tdof_npid_ros.graph.plant.lockstep import LockstepPlant
from tdof_npid_ros.graph.plant.port import PlantPort
from tdof_npid_ros.graph.plant.realtime import RealtimePlant
from tdof_npid_ros.graph.runtime.loop_end import TIMING_RANGES, LoopEnd
from tdof_npid_ros.graph.runtime.node import number, run_node
from tdof_npid_ros.parameter_file import ParameterFileError, read_parameters
from tdof_npid_ros.plants.catalog import FIXED_WHILE_RUNNING, make_plant, model_parameters, named_model

MODES: dict[str, type[LockstepPlant] | type[RealtimePlant]] = {"lockstep": LockstepPlant, "realtime": RealtimePlant}
FALLBACKS = ("effort", "hold")
RANGES = {
    "reply_timeout": (0.01, 3600.0),
    "retries": (0, 1e9),
    "speed": (1e-3, 1e3),
    "effort_timeout": (0.0, 3600.0),
    "return_time": (0.0, 3600.0),
    "fallback_effort": (-1e300, 1e300),
    **TIMING_RANGES,
}


class PlantNode(LoopEnd):
    """Publishes `output`, takes `control_effort` and `disturbance`; `plant/reset` starts it over."""

    def __init__(self) -> None:
        super().__init__("plant")
        period = self.declare_value("sample_period", 0.01, "s; time of one step", fixed=True)
        period_ns = sample_period_in_ns(period)
        self.mode = self.declare_value(
            "mode", "realtime", "lockstep: wait for each answer; realtime: steady timer", fixed=True
        )
        self._declare_model()
        self._declare_options()
        self.declare_value(
            "lossless", False, "lockstep: never run ahead of what the recorder has got; needs a recorder", fixed=True
        )
        names = self.declare_value("joint_names", [""], "name of each lane in output; none: lane0, …", fixed=True)
        self.joints = Joints([str(name) for name in names])
        self.checked({})
        self.accept_changes()
        self.port = PlantPort(self, self.model, self.model_names, period_ns, self.joints)
        self.way_of_running = MODES[self.mode](self.port)

    def _declare_model(self) -> None:
        given = self.declare_value("model", "first_order", "model of the plant, or package.module:Class", fixed=True)
        self.model = named_model(given, self._folder_of_file_with_model(given))
        self.model_names = list(model_parameters(self.model))
        for name, default in model_parameters(self.model).items():
            fixed = name in FIXED_WHILE_RUNNING
            self.declare_value(name, default, f"parameter {name} of the model {self.model}", fixed=fixed)

    def _folder_of_file_with_model(self, model: Any) -> Path | None:
        """The folder of the parameter file on the command line that gives the model; None if it is given otherwise."""
        files = [Path(file) for option, file in pairwise(sys.argv) if option == "--params-file"]
        for file in reversed(files):
            with contextlib.suppress(ParameterFileError):  # ROS has read it in its own way
                if read_parameters(file, self.get_name()).get("model") == model:
                    return file.parent
        return None

    def _declare_options(self) -> None:
        declare = self.declare_value
        declare("lanes", 1, "independent copies of the plant in one message; taken over at the next reset")
        declare("effort_min", -math.inf, "lower limit of the actuator, in the effort's unit")
        declare("effort_max", math.inf, "upper limit of the actuator, in the effort's unit")
        declare("reply_timeout", 0.5, "lockstep: s of wall time until an unanswered output is repeated", fixed=True)
        declare("retries", 20, "lockstep: how often an output is repeated before the plant stops")
        declare("publish_clock", True, "lockstep: publish the loop's time on /clock", fixed=True)
        declare("speed", 1.0, "realtime: simulated seconds per wall-clock second", fixed=True)
        declare("effort_timeout", 0.5, "realtime: s of wall time without control_effort until the fallback; 0: never")
        declare(
            "fallback", "effort", "realtime: after effort_timeout, effort: take fallback_effort; hold: keep the last"
        )
        declare("fallback_effort", 0.0, "realtime: effort without a controller")
        declare("return_time", 0.5, "realtime: s in which the plant goes over to efforts that come again")
        self.declare_timing("output", "control_effort")

    def activate(self) -> None:
        """Create topics, services and timers."""
        self.prepare_for_realtime()
        self.port.activate(self.mode == "realtime", self.way_of_running.on_matched)
        self.create_service(Trigger, "plant/reset", self._on_reset)
        self.way_of_running.activate()

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success, response.message = self.way_of_running.reset()
        return response

    # Parameters and state

    def checked(self, changes: dict[str, Any]) -> None:
        """Refuse changes that do not make a valid whole."""
        p = {**self.values_of([*self.model_names, "lanes", "effort_min", "effort_max", "fallback", *RANGES]), **changes}
        if self.mode not in MODES:
            raise ValueError(f"mode is {self.mode!r}: it must be one of {', '.join(MODES)}")
        make_plant(self.model, p)
        for name, (low, high) in RANGES.items():
            number(name, p[name], low, high)
        if p["fallback"] not in FALLBACKS:
            raise ValueError(f"fallback is {p['fallback']!r}: it must be one of {', '.join(FALLBACKS)}")
        if isinstance(p["lanes"], bool) or not isinstance(p["lanes"], int) or not 1 <= p["lanes"] <= 100_000:
            raise ValueError(f"lanes is {p['lanes']!r}: it must be a whole number from 1 to 100000")
        if self.joints.names and len(self.joints.names) != p["lanes"]:
            raise ValueError(
                f"joint_names has {len(self.joints.names)} names, but lanes is {p['lanes']}: give one name per lane"
            )
        if not number("effort_min", p["effort_min"]) <= number("effort_max", p["effort_max"]):
            raise ValueError(
                f"effort_min is {p['effort_min']} and effort_max {p['effort_max']}: need effort_min <= effort_max"
            )
        if p["effort_min"] == math.inf or p["effort_max"] == -math.inf:
            raise ValueError("effort_min or effort_max leaves no finite effort: set them to what the actuator can do")

    def changed(self, changes: dict[str, Any]) -> None:
        """Take over accepted changes."""
        self.way_of_running.changed()

    def state(self) -> tuple[int, str, dict[str, object]]:
        """For the diagnostics."""
        level, text, facts = self.way_of_running.state()
        return level, text, {"mode": self.mode, "lanes": self.port.simulator.lanes, **facts}


def main(args: list[str] | None = None) -> None:
    """Run the node."""
    run_node(PlantNode, sys.argv if args is None else args)
