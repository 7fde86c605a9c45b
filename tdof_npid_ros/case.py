"""A case: plant, controller and scenario of one ROS parameter file, as values that run in process."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from tdof_npid_ros import loop
from tdof_npid_ros.control.gains import PER_LANE, Gains, GainsError, gains_from_mapping
from tdof_npid_ros.control.options import PLAIN, ControllerOptions, options_from_mapping
from tdof_npid_ros.metrics import DisturbanceMetrics, SetpointMetrics, disturbance_metrics, setpoint_metrics
from tdof_npid_ros.one_line import as_text
from tdof_npid_ros.parameter import Table
from tdof_npid_ros.parameter_file import ParameterFileError, find_parameter_file, read_parameters
from tdof_npid_ros.parameters import NODES, NOISE, PLANT, SAMPLE_PERIOD, WEIGHT, misspelt, sample_period_in_ns
from tdof_npid_ros.plants.catalog import (
    changeable_parameters,
    effort_limits,
    make_plant,
    model_table,
    named_model,
    values_of_lanes,
)
from tdof_npid_ros.plants.noise import largest_noise, noiseless
from tdof_npid_ros.plants.ode import class_by_value, take_class
from tdof_npid_ros.plants.per_lane import LanePlants, lane_plants
from tdof_npid_ros.plants.plant import Plant, one_plant
from tdof_npid_ros.responses import largest_move
from tdof_npid_ros.scenario import Plan, PlanError, SampledPlan, parse_plan, read_episodes
from tdof_npid_ros.units import Units

Bounds = tuple[float, float]
EPISODES = ("setpoint", "disturbance")
"""Whose responses the metrics and margins' pictures are of, and whose IAE_SP and IAE_DIS the objective (10) is."""
SIGMA_BOUNDS = (0.2, 20.0)  # of the tuner's search, as multiples of the setpoint's largest step


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
        search: what else the file gives the tuner, by the names of its parameters: `free`, `ms`, …
    """

    name: str
    sample_period_ns: int
    model: str
    plant_values: Mapping[str, Any]
    effort_limits: tuple[float, float]
    gains: Gains
    episodes: Mapping[str, tuple[str, ...]]
    bounds: Mapping[str, Bounds] = field(default_factory=dict)
    weight: float = WEIGHT.default
    options: ControllerOptions = PLAIN
    search: Mapping[str, Any] = field(default_factory=dict)

    def __getstate__(self) -> dict[str, Any]:
        """What a worker is sent: the fields, and a user's plant class by value."""
        state = {one.name: getattr(self, one.name) for one in fields(self)}
        return state | {"class": class_by_value(self.model)} if ":" in self.model else state

    def __setstate__(self, state: dict[str, Any]) -> None:
        by_value = state.pop("class", None)
        self.__dict__.update(state)
        if by_value is not None:
            self.__dict__["model"] = take_class(self.model, by_value)

    @property
    def sample_period(self) -> float:
        """In s."""
        return self.sample_period_ns / 1e9

    @cached_property
    def plant(self) -> Plant:
        """The plant as configured, without the noise of what is measured.

        Raises:
            PlantError: each lane has its own.
        """
        return one_plant(noiseless(self.plant_at({})))

    @cached_property
    def as_played(self) -> Case:
        """The case with the plant as its plan leaves it, at the end of the episode `setpoint`, or of the first."""
        played = self.set_by_plan
        return replace(self, plant_values={**self.plant_values, **played}) if played else self

    @property
    def set_by_plan(self) -> dict[str, float]:
        """What of the plant's parameters the plan has set by then."""
        return self.usual_signals.segments[-1].plant if self.usual_signals is not None else {}

    @property
    def usual_signals(self) -> SampledPlan | None:
        """Of the episode `setpoint`, or of the first; None without episodes."""
        return self.signals.get("setpoint") or next(iter(self.signals.values()), None)

    @cached_property
    def alone(self) -> list[Case]:
        """The case with each lane's plant alone, where each lane has its own; else the case."""
        values = values_of_lanes(self.model, self.plant_values)
        return [self] if values is None else [replace(self, plant_values=one) for one in values]

    @property
    def units(self) -> Units:
        """Of output and effort, as far as the plant's parameters tell."""
        return Units.of(self.plant_values)

    @cached_property
    def noise_bound(self) -> float:
        """How far a measured output is from the plant's at the most, in the output's unit."""
        return largest_noise(self.plant_at({}))

    def noise_bound_at(self, changes: Mapping[str, Any]) -> float:
        """As `noise_bound`, with some of the plant's parameters changed."""
        return largest_noise(self.plant_at(changes)) if changes.keys() & NOISE.keys() else self.noise_bound

    def plant_at(self, changes: Mapping[str, float]) -> Plant:
        """The plant with some parameters changed; an `EachLane` where each lane has its own."""
        return make_plant(self.model, {**self.plant_values, **changes})

    def parameters(self, gains: Gains | None = None) -> dict[str, dict[str, Any]]:
        """The case as a parameter file gives it, by node; with the case's gains, or others of one lane."""
        period = {"sample_period": self.sample_period}
        plain = PLAIN.as_dict()
        options = {name: value for name, value in self.options.as_dict().items() if value != plain[name]}
        plans = {f"plan.{name}": list(lines) for name, lines in self.episodes.items()}
        return {
            "plant": {**self.plant_values, "model": self.model, **period},
            "controller": {**period, **(gains or self.gains).as_dict(), **options},
            "scenario": {**period, "episodes": list(self.episodes), **plans},
            "tuner": dict(self.search),
        }

    @cached_property
    def plans(self) -> dict[str, Plan]:
        """The plan of each episode.

        Raises:
            PlanError: a line is wrong; the message names the episode and the line.
        """
        changeable = changeable_parameters(self.model)
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
            for first in self._first_outputs(signals):
                steps.append(float(np.abs(np.diff(signals.setpoint, prepend=first)).max()))
        return max(steps)

    @cached_property
    def largest_move(self) -> float:
        """As `largest_step`, but a ramp or sine counts as far as it goes, and an angle by the shorter way: what the
        band of the recovery is a fraction of."""
        moves = [0.0]
        for signals in self.signals.values():
            for first in self._first_outputs(signals):
                moves.append(largest_move(signals.setpoint, first, self.options.turn))
        return max(moves)

    def _first_outputs(self, signals: SampledPlan) -> set[float]:
        """With which the lanes begin."""
        return {one.plant.initial_output for one in self.alone} if signals.start is None else {signals.start}

    def lane_plants(self, episode: str, changes: Sequence[Mapping[str, Any]]) -> LanePlants:
        """A plant of its own for each lane of an episode: the case's with these parameters changed.

        Raises:
            PlantError: a lane's plant cannot be made, or they are of different kinds.
        """
        own = [replace(self, plant_values={**self.plant_values, **changed}).plant_at for changed in changes]
        return lane_plants(own, self.signals[episode], self.effort_limits)

    def simulate(self, episode: str, gains: Gains | None = None, plants: LanePlants | None = None) -> loop.Trajectory:
        """Run an episode in process; gains for one lane or many, by default the case's.

        Args:
            plants: of the lanes, from `lane_plants`; None: the case's, one for all or for each its own.

        Raises:
            PlanError: the case has no such episode.
        """
        if episode not in self.episodes:
            known = ", ".join(self.episodes) or "none"
            raise PlanError(f"{self.name} has no episode {episode!r}: its scenario's episodes are {known}")
        gains, signals = gains or self.gains, self.signals[episode]
        if self.options.is_plain:
            return loop.simulate(plants or self._plants(episode), gains, signals, self.effort_limits)
        if plants is not None:
            raise self._not_the_law_alone("lanes with plants of their own run")
        return loop.simulate_operated(self.plant_at, gains, self.options, signals, self.effort_limits)

    def integrals(self, episode: str, gains: Gains, plants: LanePlants | None = None) -> loop.Integrals:
        """Run an episode in process and keep only its integrals; arguments as for `simulate`."""
        if not self.options.is_plain:
            raise self._not_the_law_alone("tuning runs")
        return loop.integrals(plants or self._plants(episode), gains, self.signals[episode], self.effort_limits)

    def _plants(self, episode: str) -> loop.Plants:
        if len(self.alone) == 1:
            return self.plant_at
        return lane_plants([one.plant_at for one in self.alone], self.signals[episode], self.effort_limits)

    def _not_the_law_alone(self, who: str) -> GainsError:
        return GainsError(
            f"{self.name}: {who} the law alone, without "
            + ", ".join(name for name, value in self.options.as_dict().items() if value != PLAIN.as_dict()[name])
            + ": let it have a copy of the file without these; gains that it finds go with this file, too (--gains)"
        )

    def setpoint_response(self, gains: Gains | None = None) -> SetpointMetrics:
        """Metrics of the episode `setpoint`: a step of the setpoint at its start, from the output there.

        Raises:
            PlanError, GainsError: there is no such response; the message says why.
        """
        return self.setpoint_metrics(self.response("setpoint", gains).output[:, 0])

    def setpoint_metrics(self, y: np.ndarray) -> SetpointMetrics:
        """Those of an output (steps + 1,) of the episode `setpoint`; raises as `setpoint_response`."""
        setpoint, disturbance = self._held("setpoint")
        if np.isclose(setpoint, y[0]) or disturbance != 0.0:
            told = f"the setpoint is {setpoint:g} and the disturbance {disturbance:g}, the output begins at {y[0]:g}"
            raise _no_single_step(self, "setpoint", told)
        return setpoint_metrics(y, float(y[0]), setpoint, self.sample_period, self.options.turn)

    def disturbance_response(self, gains: Gains | None = None) -> DisturbanceMetrics:
        """Metrics of the episode `disturbance`: a step of the disturbance at its start, the setpoint held.

        Raises:
            PlanError, GainsError: there is no such response; the message says why.
        """
        return self.disturbance_metrics(self.response("disturbance", gains).output[:, 0])

    def disturbance_metrics(self, y: np.ndarray, noise_bound: float | None = None) -> DisturbanceMetrics:
        """Those of an output (steps + 1,) of the episode `disturbance`; raises as `disturbance_response`.

        Args:
            noise_bound: of the plant whose output it is; None: of the case's.
        """
        setpoint, _ = self._held("disturbance")
        bound = self.noise_bound if noise_bound is None else noise_bound
        if not np.isclose(setpoint, y[0], atol=1e-8 + bound):
            raise _no_single_step(
                self, "disturbance", f"the setpoint is {setpoint:g}, but the output begins at {y[0]:g}"
            )
        return disturbance_metrics(y, setpoint, self.sample_period, self.largest_move, self.options.turn)

    def response(self, episode: str, gains: Gains | None = None) -> loop.Trajectory:
        """As `simulate`, of one lane, as metrics need it.

        Raises:
            PlanError, GainsError: the case has no such episode, or the gains are for several lanes.
        """
        lanes = (gains or self.gains).lanes
        if lanes > 1:
            raise GainsError(
                f"{self.name}: the gains are for {lanes} lanes, but metrics are of one: give one number each"
            )
        _ = self.plant  # refuses where each lane has its own
        return self.simulate(episode, gains)

    def _held(self, episode: str) -> tuple[float, float]:
        """Setpoint and disturbance that an episode holds from its start on.

        Raises:
            PlanError: it does not.
        """
        signals = self.signals[episode]
        for name, values in (("setpoint", signals.setpoint), ("disturbance", signals.disturbance)):
            if np.any(values != values[0]):
                raise _no_single_step(self, episode, f"the {name} changes after 0 s")
        if len(signals.segments) > 1:
            raise _no_single_step(self, episode, "the plant changes after 0 s")
        return float(signals.setpoint[0]), float(signals.disturbance[0])


def _no_single_step(case: Case, episode: str, why: str) -> PlanError:
    return PlanError(
        f"{case.name}, episode {episode!r}: {why}, but the metrics are of one step of the {episode} at 0 s; "
        "record it and measure every step with 'tdof-npid analyze'"
    )


def load_case(name: str | Path) -> Case:
    """A case by its name (`p1-c0.5`) or by the path of its parameter file; misspelt parameters are warned of.

    Raises:
        ParameterFileError, PlantError, PlanError, GainsError: the file is missing or something in it is wrong.

    Example:
        >>> case = load_case("p1-c0.5")
        >>> case.gains.kp, case.sample_period, list(case.episodes)
        (9.426, 0.005, ['setpoint', 'disturbance'])
    """
    path = find_parameter_file(name)
    nodes = {node: read_parameters(path, node) for node in _OF_CASE}
    try:
        return _case_of(as_text(path.stem), nodes, path.parent, str(path))
    except ValueError as error:
        raise type(error)(f"{path}: {error}") from error


def make_case(
    plant: Mapping[str, Any],
    controller: Mapping[str, Any],
    episodes: Mapping[str, Sequence[str]],
    *,
    sample_period: float = SAMPLE_PERIOD.default,
    tuner: Mapping[str, Any] | None = None,
    name: str = "case",
) -> Case:
    """A case without a parameter file: the same parameters, as mappings.

    Args:
        plant: `model` and its parameters, `effort_min`, `effort_max`.
        controller: `type`, the gains and what is set around the law.
        episodes: the lines of each plan, by the episode's name.
        sample_period: s.
        tuner: `bounds.kp`, … and `weight`.

    Raises:
        ParameterFileError, PlantError, PlanError, GainsError: something in it is wrong.

    Example:
        >>> case = make_case(
        ...     {"model": "first_order", "gain": 2.0, "time_constant": 3.0, "dead_time": 0.2},
        ...     {"type": "pid", "kp": 2.0, "ki": 1.0},
        ...     {"setpoint": ["0 setpoint 1", "20 end"]},
        ... )
        >>> round(case.setpoint_response().overshoot_percent, 1)
        5.6
    """
    scenario = {"episodes": list(episodes)} | {f"plan.{one}": list(lines) for one, lines in episodes.items()}
    given = (plant, controller, scenario, tuner or {})
    common = {"sample_period": sample_period}
    nodes = {node: {**common, **values} for node, values in zip(_OF_CASE, given, strict=True)}
    return _case_of(name, nodes, None, name)


_OF_CASE = ("plant", "controller", "scenario", "tuner")  # the nodes whose parameters make a case


def _case_of(name: str, nodes: Mapping[str, Mapping[str, Any]], folder: Path | None, told_as: str) -> Case:
    """The case that nodes with these parameters are.

    Args:
        folder: where a plant's class may lie, too.
        told_as: what warnings call it: its file, if there is one.
    """
    model = named_model(nodes["plant"].get("model", PLANT["model"].default), folder)
    tables: dict[str, Table] = {**NODES, "plant": {**PLANT, **model_table(model)}}
    plant, controller, scenario, tuner = (_checked(nodes[node], tables[node]) for node in _OF_CASE)
    periods = {
        node: values["sample_period"]
        for node, values in (("plant", plant), ("controller", controller), ("scenario", scenario))
        if "sample_period" in values
    }
    if len(set(periods.values())) > 1:
        told = " and ".join(f"{period} in {node}" for node, period in periods.items())
        raise ParameterFileError(f"sample_period is {told}: the nodes of a loop need the same, give it to /**")
    case = Case(
        name=name,
        sample_period_ns=sample_period_in_ns(plant.get("sample_period", SAMPLE_PERIOD.default)),
        model=model,
        plant_values=plant,
        effort_limits=effort_limits(plant),
        gains=gains_from_mapping(controller),
        episodes=read_episodes(scenario),
        bounds=read_bounds(tuner),
        weight=tuner.get("weight", WEIGHT.default),
        options=options_from_mapping(controller),
        search=tuner,
    )
    _ = [one.plant for one in case.alone], case.plans
    case = _with_scale(case, "sigma" in controller)
    for node, values in nodes.items():
        for warning in misspelt(values, tables[node]):
            warnings.warn(f"{told_as}: {node}: {warning}", stacklevel=3)
    return case


def _with_scale(case: Case, sigma_given: bool) -> Case:
    """The case with what follows from its setpoint's largest step: sigma and its bounds, where they are not given.

    The paper: sigma is the largest change of the setpoint.

    Raises:
        GainsError: the type needs a sigma, and there is neither one nor a step.
    """
    step = case.largest_step
    if step and "sigma" not in case.bounds:
        case = replace(case, bounds={**case.bounds, "sigma": (SIGMA_BOUNDS[0] * step, SIGMA_BOUNDS[1] * step)})
    if sigma_given:
        return case
    if step:
        return replace(case, gains=case.gains.with_values(sigma=step))
    if case.gains.type != "pid" and case.episodes:
        raise GainsError(
            "sigma is not given, and the setpoint never steps in the case's episodes: set it to the largest change of "
            "the setpoint, in the output's unit"
        )
    return case


def _checked(values: Mapping[str, Any], known: Table) -> dict[str, Any]:
    """What a file gives to a node, as its parameters take it; what they do not know stays as it is.

    Raises:
        ParameterError: a value that its parameter cannot have.
    """
    return {name: known[name].checked(value) if name in known else value for name, value in values.items()}


def read_bounds(tuner: Mapping[str, Any]) -> dict[str, Bounds]:
    """Lower and upper bound of each gain that has some, from the tuner's parameters as their table takes them."""
    return {gain: (tuner[name][0], tuner[name][1]) for gain in PER_LANE if (name := f"bounds.{gain}") in tuner}
