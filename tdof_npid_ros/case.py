"""A case: plant, controller and scenario of one ROS parameter file, as values that run in process."""

from __future__ import annotations

import math
import sys
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from tdof_npid_ros import loop
from tdof_npid_ros.control.gains import (
    CONTROLLER_TYPES,
    PER_LANE,
    ControllerType,
    Gains,
    GainsError,
    gains_from_mapping,
)
from tdof_npid_ros.control.options import PLAIN, ControllerOptions, options_from_mapping
from tdof_npid_ros.metrics import DisturbanceMetrics, SetpointMetrics, disturbance_metrics, setpoint_metrics
from tdof_npid_ros.parameter_file import ParameterFileError, read_parameters
from tdof_npid_ros.parameters import OF_NODE, unknown_parameters
from tdof_npid_ros.plants.catalog import FIXED_WHILE_RUNNING, make_plant, model_parameters, named_model
from tdof_npid_ros.plants.plant import Plant, PlantError
from tdof_npid_ros.scenario import Plan, PlanError, SampledPlan, parse_plan

DEFAULT_SAMPLE_PERIOD = 0.01  # s
Bounds = tuple[float, float]


@dataclass(frozen=True)
class Case:
    """A closed loop to run: what is in a parameter file.

    Attributes:
        name: for messages and tables.
        sample_period_ns: of the loop.
        model: the plant's model, and `plant_values` its parameters.
        effort_limits: the plant's own limits on the effort.
        gains: the controller's, and `options` what is set around its law.
        episodes: the scenario's lines by episode, in the order in which they run.
        bounds: of the tuner's search, by gain.
        weight: w of the objective (10).
    """

    name: str
    sample_period_ns: int
    model: str
    plant_values: Mapping[str, Any]
    effort_limits: tuple[float, float]
    gains: Gains
    episodes: Mapping[str, tuple[str, ...]]
    bounds: Mapping[str, Bounds] = field(default_factory=dict)
    weight: float = 1.0
    options: ControllerOptions = PLAIN

    @property
    def sample_period(self) -> float:
        """In s."""
        return self.sample_period_ns / 1e9

    @cached_property
    def plant(self) -> Plant:
        """The plant as configured."""
        return self.plant_at({})

    def plant_at(self, changes: Mapping[str, float]) -> Plant:
        """The plant with some parameters changed."""
        return make_plant(self.model, {**self.plant_values, **changes})

    @cached_property
    def plans(self) -> dict[str, Plan]:
        """The plan of each episode.

        Raises:
            PlanError: a line is wrong; the message names the episode and the line.
        """
        changeable = changeable_parameters(self.model, self.plant_values)
        plans = {}
        for name, lines in self.episodes.items():
            try:
                plans[name] = parse_plan(lines, self.sample_period_ns, changeable)
            except PlanError as error:
                raise PlanError(f"{self.name}, episode {name!r}: {error}") from None
        return plans

    @cached_property
    def signals(self) -> dict[str, SampledPlan]:
        """The plan of each episode, sampled."""
        return {name: plan.sampled(self.sample_period_ns) for name, plan in self.plans.items()}

    @cached_property
    def largest_step(self) -> float:
        """The largest change of the setpoint at once, over all plans, in the output's unit; 0 without any.

        A setpoint that does not begin at the output with which the plant begins steps there.
        """
        steps = [0.0]
        for signals in self.signals.values():
            first = self.plant.initial_output if signals.start is None else signals.start
            steps.append(float(np.abs(np.diff(signals.setpoint, prepend=first)).max()))
        return max(steps)

    def simulate(self, episode: str, gains: Gains | None = None) -> loop.Trajectory:
        """Run an episode in process; gains for one lane or many, by default the case's.

        Raises:
            PlanError: the case has no such episode.
        """
        if episode not in self.episodes:
            known = ", ".join(self.episodes) or "none"
            raise PlanError(f"{self.name} has no episode {episode!r}: its scenario's episodes are {known}")
        gains, signals = gains or self.gains, self.signals[episode]
        if self.options.is_plain:
            return loop.simulate(self.plant_at, gains, signals, self.effort_limits)
        return loop.simulate_operated(self.plant_at, gains, self.options, signals, self.effort_limits)

    def integrals(self, episode: str, gains: Gains) -> loop.Integrals:
        """Run an episode in process and keep only its integrals."""
        if not self.options.is_plain:
            raise PlantError(
                f"{self.name}: tuning runs the law alone; take these out of the controller's parameters first: "
                + ", ".join(name for name, value in self.options.as_dict().items() if value != PLAIN.as_dict()[name])
            )
        return loop.integrals(self.plant_at, gains, self.signals[episode], self.effort_limits)

    def setpoint_response(self, gains: Gains | None = None) -> SetpointMetrics:
        """Metrics of the episode `setpoint`: a step of the setpoint at its start, from 0.

        Raises:
            PlanError, GainsError: there is no such response; the message says why.
        """
        y, setpoint, disturbance = self._response("setpoint", gains)
        if setpoint == 0.0 or disturbance != 0.0:
            raise _no_single_step(self, "setpoint", f"the setpoint is {setpoint:g} and the disturbance {disturbance:g}")
        return setpoint_metrics(y, 0.0, setpoint, self.sample_period)

    def disturbance_response(self, gains: Gains | None = None) -> DisturbanceMetrics:
        """Metrics of the episode `disturbance`: a step of the disturbance at its start, the setpoint held.

        Raises:
            PlanError, GainsError: there is no such response; the message says why.
        """
        y, setpoint, _ = self._response("disturbance", gains)
        if not np.isclose(setpoint, y[0]):
            raise _no_single_step(
                self, "disturbance", f"the setpoint is {setpoint:g}, but the output begins at {y[0]:g}"
            )
        return disturbance_metrics(y, setpoint, self.sample_period)

    def _response(self, episode: str, gains: Gains | None) -> tuple[np.ndarray, float, float]:
        """The output (steps + 1,) of an episode of one lane; setpoint and disturbance that it holds from its start
        on."""
        lanes = (gains or self.gains).lanes
        if lanes > 1:
            raise GainsError(
                f"{self.name}: the gains are for {lanes} lanes, but metrics are of one: give one number each"
            )
        output = self.simulate(episode, gains).output[:, 0]
        signals = self.signals[episode]
        for name, values in (("setpoint", signals.setpoint), ("disturbance", signals.disturbance)):
            if np.any(values != values[0]):
                raise _no_single_step(self, episode, f"the {name} changes after 0 s")
        if len(signals.segments) > 1:
            raise _no_single_step(self, episode, "the plant changes after 0 s")
        return output, float(signals.setpoint[0]), float(signals.disturbance[0])


def _no_single_step(case: Case, episode: str, why: str) -> PlanError:
    return PlanError(
        f"{case.name}, episode {episode!r}: {why}, but the metrics are of one step of the {episode} at 0 s; "
        "record it and measure every step with 'tdof-npid analyze'"
    )


def changeable_parameters(model: str, values: Mapping[str, Any]) -> dict[str, float]:
    """The plant's parameters that may change while the loop runs, with their configured values."""
    return {
        name: float(values.get(name, default))
        for name, default in model_parameters(model).items()
        if name not in FIXED_WHILE_RUNNING and not isinstance(default, list)
    }


def sample_period_in_ns(value: Any) -> int:
    """A sample period in s as a whole number of nanoseconds.

    Raises:
        ParameterFileError: not a number of seconds above 0, or no whole number of nanoseconds.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < math.inf:
        raise ParameterFileError(f"sample_period is {value!r}: it must be a number of seconds above 0")
    period_ns = round(value * 1e9)
    if period_ns < 1 or abs(period_ns - value * 1e9) > 1e-3:
        raise ParameterFileError(f"sample_period is {value!r} s: it must be a whole number of nanoseconds")
    return period_ns


def load_case(name: str | Path) -> Case:
    """A case by its name (`p1-c0.5`) or by the path of its parameter file; misspelt parameters are warned of.

    Raises:
        ParameterFileError, PlantError, PlanError, GainsError: the file is missing or something in it is wrong.
    """
    path = find_parameter_file(name)
    nodes = {node: read_parameters(path, node) for node in ("plant", "controller", "scenario", "tuner")}
    plant, controller, scenario, tuner = nodes.values()
    periods = {
        node: values["sample_period"]
        for node, values in (("plant", plant), ("controller", controller), ("scenario", scenario))
        if "sample_period" in values
    }
    if len(set(periods.values())) > 1:
        told = " and ".join(f"{period} in {node}" for node, period in periods.items())
        raise ParameterFileError(f"{path}: sample_period is {told}: the nodes of a loop need the same, give it to /**")
    try:
        case = Case(
            name=path.stem,
            sample_period_ns=sample_period_in_ns(plant.get("sample_period", DEFAULT_SAMPLE_PERIOD)),
            model=named_model(plant.get("model", "first_order"), path.parent),
            plant_values=plant,
            effort_limits=_effort_limits(plant),
            gains=gains_from_mapping(controller),
            episodes=read_episodes(scenario),
            bounds=_bounds(tuner),
            weight=_number("weight", tuner.get("weight", 1.0)),
            options=options_from_mapping(controller),
        )
        _ = case.plant, case.plans
    except ValueError as error:
        raise type(error)(f"{path}: {error}") from error
    for node, values in nodes.items():
        known = (*OF_NODE[node], *(model_parameters(case.model) if node == "plant" else ()))
        for warning in unknown_parameters(values, known):
            warnings.warn(f"{path}: {node}: {warning}", stacklevel=2)
    return case


def find_parameter_file(name: str | Path) -> Path:
    """Where the parameter file of a case lies: the path itself, or `config/<name>.yaml` of the package.

    Raises:
        ParameterFileError: there is none.
    """
    path = Path(name)
    if path.suffix in (".yaml", ".yml") or path.is_file():
        return path
    folder = config_folder()
    found = folder / f"{name}.yaml"
    if not found.is_file():
        known = ", ".join(sorted(p.stem for p in folder.glob("*.yaml"))) or "none"
        raise ParameterFileError(f"no case {str(name)!r}: the cases are {known}, or give the path of a parameter file")
    return found


def config_folder() -> Path:
    """The folder of the package's parameter files: beside the package in a checkout, else under `share/`."""
    package = Path(__file__).parent
    candidates = [package.parent / "config"]
    candidates += [parent / "share" / "tdof_npid_ros" / "config" for parent in (*package.parents, Path(sys.prefix))]
    return next((folder for folder in candidates if folder.is_dir()), candidates[0])


def read_episodes(scenario: Mapping[str, Any]) -> dict[str, tuple[str, ...]]:
    """The lines of each episode from the scenario's parameters `episodes` and `plan.<episode>`.

    Raises:
        PlanError: `episodes` is no list of names, or an episode has no plan.
    """
    names = scenario.get("episodes", [])
    if not isinstance(names, (list, tuple)) or not all(isinstance(name, str) for name in names):
        raise PlanError(f"episodes is {names!r}: it must be a list of names, as [setpoint, disturbance]")
    episodes = {}
    for name in names:
        lines = scenario.get(f"plan.{name}")
        if not isinstance(lines, (list, tuple)) or not lines:
            raise PlanError(f"episode {name!r} has no plan: give its lines as the list of strings plan.{name}")
        episodes[name] = tuple(str(line) for line in lines)
    return episodes


def _effort_limits(plant: Mapping[str, Any]) -> tuple[float, float]:
    low = _number("effort_min", plant.get("effort_min", -math.inf))
    high = _number("effort_max", plant.get("effort_max", math.inf))
    if not low <= high:
        raise ParameterFileError(f"effort_min is {low:g} and effort_max {high:g}: need effort_min <= effort_max")
    return low, high


def _number(name: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or math.isnan(value):
        raise ParameterFileError(f"{name} is {value!r}: it must be a number")
    return float(value)


def _bounds(tuner: Mapping[str, Any]) -> dict[str, Bounds]:
    bounds = {}
    for name in PER_LANE:
        if f"bounds.{name}" in tuner:
            bounds[name] = read_bounds(name, tuner[f"bounds.{name}"])
    return bounds


def read_bounds(name: str, value: Any) -> Bounds:
    """Lower and upper bound of a gain.

    Raises:
        ParameterFileError: not two finite numbers in order.
    """
    good = isinstance(value, (list, tuple)) and len(value) == 2 and all(isinstance(v, (int, float)) for v in value)
    if not good or not -math.inf < value[0] < value[1] < math.inf:
        raise ParameterFileError(
            f"bounds.{name} is {value!r}: it must be [lower, upper] with lower < upper, both finite"
        )
    return float(value[0]), float(value[1])


def controller_type(value: str) -> ControllerType:
    """A controller type by name.

    Raises:
        ParameterFileError: there is no such type.
    """
    for known in CONTROLLER_TYPES:
        if value == known:
            return known
    raise ParameterFileError(f"no controller type {value!r}: the types are {', '.join(CONTROLLER_TYPES)}")


__all__ = ["Case", "PlantError", "load_case"]
