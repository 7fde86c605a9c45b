"""Models by name: from a plant's parameters to a plant."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tdof_npid_ros.one_line import one_line
from tdof_npid_ros.plants.linear import TransferFunction
from tdof_npid_ros.plants.ode import Ode, Sprott, load_class, loaded_class
from tdof_npid_ros.plants.plant import Plant, PlantError

OFFSETS = {"output_offset": 0.0, "effort_offset": 0.0}  # a linear model's operating point

# Parameters of each model and their defaults; the equation is the paper's.
MODELS: dict[str, dict[str, float | list[float]]] = {
    "first_order": {"gain": 1.0, "time_constant": 5.0, "dead_time": 0.5, **OFFSETS},  # (11)
    "second_order": {"gain": 1.0, "time_constant": 2.0, "dead_time": 1.0, **OFFSETS},  # (12), both time constants
    "third_order": {"gain": 1.0, "time_constant": 1.0, "zero_time_constant": 1.0, "dead_time": 0.0, **OFFSETS},  # (13)
    "transfer_function": {"numerator": [1.0], "denominator": [1.0, 1.0], "dead_time": 0.0, **OFFSETS},
    "sprott": {"a": 0.6, "b": 1.2, "c": 2.0, "initial_state": [0.0, 0.0, 0.0]},  # (14)-(16)
}
FIXED_WHILE_RUNNING = (
    "dead_time",
    "output_offset",
    "effort_offset",
    "initial_state",
    "substeps",
    "numerator",
    "denominator",
)


def named_model(value: Any, folder: Path | None = None) -> str:
    """The `model` that the user gives: on the command line, or in a parameter file in a folder. Its class is imported.

    Raises:
        PlantError: no such model.
    """
    model = str(value)
    if ":" in model:
        load_class(model, folder)
    model_parameters(model)
    return model


def model_parameters(model: str) -> dict[str, float | list[float]]:
    """The parameters of a model by name, with their defaults.

    Raises:
        PlantError: no such model, or a class that the user has not named (`named_model`).
    """
    if ":" in model:
        description = loaded_class(model)
        return {
            **{name: float(value) for name, value in description.parameters.items()},
            "initial_state": list(map(float, description.initial_state)),
            "substeps": 1.0,
        }
    if model not in MODELS:
        raise PlantError(
            f"model {one_line(model, 100)!r} is unknown: take one of {', '.join(MODELS)}, or package.module:Class"
        )
    return dict(MODELS[model])


def make_plant(model: str, values: Mapping[str, Any]) -> Plant:
    """The plant of a model; parameters that are not given keep their defaults, others in `values` are passed over.

    Raises:
        PlantError: no such model, or a parameter of the wrong type or range.
    """
    p = {name: _typed(name, values.get(name, default), default) for name, default in model_parameters(model).items()}
    if ":" in model:
        initial_state, substeps = p.pop("initial_state"), p.pop("substeps")
        return Ode(loaded_class(model), p, tuple(initial_state), substeps)
    if model == "sprott":
        return Sprott(p["a"], p["b"], p["c"], tuple(p["initial_state"]))
    offsets = {name: p[name] for name in OFFSETS}
    if model == "transfer_function":
        return TransferFunction(tuple(p["numerator"]), tuple(p["denominator"]), p["dead_time"], **offsets)
    t = _positive("time_constant", p["time_constant"])
    if model == "first_order":
        return TransferFunction((p["gain"],), (t, 1.0), p["dead_time"], **offsets)
    if model == "second_order":
        return TransferFunction((p["gain"],), (t * t, 2.0 * t, 1.0), p["dead_time"], **offsets)
    k, c = p["gain"], p["zero_time_constant"]
    return TransferFunction((-k * c, k), (t * t * t, 3.0 * t * t, 3.0 * t, 1.0), p["dead_time"], **offsets)


def _typed(name: str, value: Any, default: float | list[float]) -> Any:
    numbers = (
        list(value)
        if isinstance(default, list) and not isinstance(value, (str, bytes)) and hasattr(value, "__len__")
        else [value]
    )
    for number in numbers:
        if isinstance(number, bool) or not isinstance(number, (int, float)) or not math.isfinite(number):
            wanted = "a list of finite numbers" if isinstance(default, list) else "a finite number"
            raise PlantError(f"{name} is {value!r}: it must be {wanted}")
    return [float(number) for number in numbers] if isinstance(default, list) else float(value)


def _positive(name: str, value: float) -> float:
    if value <= 0:
        raise PlantError(f"{name} is {value}: it must be above 0")
    return value
