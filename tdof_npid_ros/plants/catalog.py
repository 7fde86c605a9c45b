"""Models by name: from a plant's parameters to a plant."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tdof_npid_ros.one_line import one_line
from tdof_npid_ros.parameter import Parameter, ParameterError, check_limits
from tdof_npid_ros.parameters import MODELS, NOISE, OFFSETS, PLANT
from tdof_npid_ros.plants.linear import TransferFunction
from tdof_npid_ros.plants.noise import NoisyPlant
from tdof_npid_ros.plants.ode import Ode, Sprott, class_table, load_class, loaded_class
from tdof_npid_ros.plants.plant import EachLane, Plant, PlantError


def model_table(model: str) -> dict[str, Parameter]:
    """The parameters of a model, by name.

    Raises:
        PlantError: no such model, or a class that the user has not named (`named_model`).
    """
    if ":" in model:
        return class_table(loaded_class(model))
    if model not in MODELS:
        raise PlantError(
            f"model {one_line(model, 100)!r} is unknown: take one of {', '.join(MODELS)}, or package.module:Class"
        )
    return MODELS[model]


def named_model(value: Any, folder: Path | None = None) -> str:
    """The `model` that the user gives: on the command line, or in a parameter file in a folder. Its class is imported.

    Raises:
        PlantError: no such model.
    """
    model = str(value)
    if ":" in model:
        load_class(model, folder)
    model_table(model)
    return model


def model_parameters(model: str) -> dict[str, float | list[float]]:
    """The parameters of a model by name, with their defaults.

    Raises:
        PlantError: no such model, or a class that the user has not named (`named_model`).
    """
    return {name: parameter.default for name, parameter in model_table(model).items()}


def changeable_parameters(model: str) -> list[str]:
    """The parameters of a model that may change while the loop runs.

    Raises:
        PlantError: no such model.
    """
    return [name for name, one in model_table(model).items() if not (one.fixed or one.is_list)]


def effort_limits(values: Mapping[str, Any]) -> tuple[float, float]:
    """The actuator's lower and upper limit, from a plant's parameters.

    Raises:
        PlantError: a limit is no number, or no finite effort lies between them.
    """
    try:
        limits = (PLANT["effort_min"], PLANT["effort_max"])
        low, high = (limit.checked(values.get(limit.name, limit.default)) for limit in limits)
        check_limits("effort_min", low, "effort_max", high)
    except ParameterError as error:
        raise PlantError(str(error)) from None
    return low, high


def values_of_lanes(model: str, values: Mapping[str, Any]) -> list[dict[str, Any]] | None:
    """The parameters of each lane's plant; None if all have the same, as no parameter has a list for the lanes.

    Raises:
        PlantError: no such model, or lists of different length.
    """
    names = [name for name, one in model_table(model).items() if one.per_lane and _is_list(values.get(name))]
    if not names:
        return None
    lanes = len(values[names[0]])
    for name in names:
        if len(values[name]) != lanes or not lanes:
            raise PlantError(
                f"{names[0]} has {lanes} values, but {name} has {len(values[name])}: give one number, or one per lane"
            )
    return [{**values, **{name: float(values[name][lane]) for name in names}} for lane in range(lanes)]


def _is_list(value: Any) -> bool:
    return hasattr(value, "__len__") and not isinstance(value, (str, bytes, Mapping))


def make_plant(model: str, values: Mapping[str, Any]) -> Plant:
    """The plant of a model, with noise where it has any; what is not given keeps its default, others are passed over.

    Where parameters have a list of numbers, one for each lane, it is an `EachLane`.

    Raises:
        PlantError: no such model, or a parameter of the wrong type or range, or lists of different length.
    """
    lanes = values_of_lanes(model, values)
    if lanes is not None:
        return EachLane(tuple(make_plant(model, one) for one in lanes))
    plant = _make_plant(model, values)
    try:
        noise, quantum, seed = (one.checked(values.get(name, one.default)) for name, one in NOISE.items())
    except ParameterError as error:
        raise PlantError(str(error)) from None
    return NoisyPlant(plant, noise, quantum, seed) if noise or quantum else plant


def _make_plant(model: str, values: Mapping[str, Any]) -> Plant:
    its = model_table(model).items()
    try:
        p = {name: parameter.checked(values.get(name, parameter.default)) for name, parameter in its}
    except ParameterError as error:
        raise PlantError(str(error)) from None
    if ":" in model:
        initial_state, substeps = p.pop("initial_state"), p.pop("substeps")
        return Ode(loaded_class(model), p, tuple(initial_state), substeps)
    if model == "sprott":
        return Sprott(p["a"], p["b"], p["c"], tuple(p["initial_state"]))
    offsets = {name: p[name] for name in OFFSETS}
    if model == "transfer_function":
        return TransferFunction(tuple(p["numerator"]), tuple(p["denominator"]), p["dead_time"], **offsets)
    t = p["time_constant"]
    if model == "first_order":
        return TransferFunction((p["gain"],), (t, 1.0), p["dead_time"], **offsets)
    if model == "second_order":
        return TransferFunction((p["gain"],), (t * t, 2.0 * t, 1.0), p["dead_time"], **offsets)
    k, c = p["gain"], p["zero_time_constant"]
    return TransferFunction((-k * c, k), (t * t * t, 3.0 * t * t, 3.0 * t, 1.0), p["dead_time"], **offsets)
