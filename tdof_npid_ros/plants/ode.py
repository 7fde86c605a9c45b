"""Nonlinear plants: the Sprott circuit, and a user's own differential equation."""

from __future__ import annotations

import copy
import hashlib
import importlib
import importlib.machinery
import inspect
import math
import pickle
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numba
import numpy as np

from tdof_npid_ros.one_line import one_line
from tdof_npid_ros.parameter import FINITE, Parameter, ParameterError, Range, table
from tdof_npid_ros.parameters import MODELS, SUBSTEPS
from tdof_npid_ros.plants.kernels import SampledOde, SampledSprott, sprott_derivative
from tdof_npid_ros.plants.plant import PlantError

_SPROTT = MODELS["sprott"]
State = tuple[float, ...]
RESTING = 1e-9  # largest |dx/dt|, relative to the state's size, at which a plant counts as at rest


@dataclass(frozen=True)
class Sprott:
    """The Sprott circuit (14)-(16): chaotic when left alone; u enters x2', d enters x3', y = x1.

    Integrated by the classical Runge-Kutta method, one step a sample: at the paper case's 1 ms the error of a smooth
    stretch is of order 1e-13 a second, and a sign change inside a step shifts x3 by less than 2·c·1 ms.
    """

    a: float = _SPROTT["a"].default
    b: float = _SPROTT["b"].default
    c: float = _SPROTT["c"].default
    initial_state: tuple[float, ...] = tuple(_SPROTT["initial_state"].default)
    initial_effort: float = 0.0

    def __post_init__(self) -> None:
        try:
            for name in ("a", "b", "c"):
                object.__setattr__(self, name, _SPROTT[name].checked(getattr(self, name)))
            object.__setattr__(self, "initial_state", tuple(_SPROTT["initial_state"].checked(self.initial_state)))
        except ParameterError as error:
            raise PlantError(str(error)) from None

    @property
    def initial_output(self) -> float:
        """y at time 0."""
        return self.initial_state[0]

    def derivative(self, x: State, u: float, d: float) -> State:
        """dx/dt in the state x under effort u and disturbance d."""
        return tuple(sprott_derivative(self.sampled(1), x, u, d))

    def output(self, x: State) -> float:
        """y in the state x."""
        return x[0]

    def at_rest(self, output: float, disturbance: float = 0.0) -> Sprott:
        """The same circuit, beginning at rest with this output: x2 = 0, x3 = -u = (c sgn(y) - b y + d)/a."""
        if self.a == 0.0:
            raise PlantError(f"no effort holds the output at {output:g}: a is 0")
        third = (math.copysign(self.c, output) * (output != 0.0) - self.b * output + disturbance) / self.a
        return replace(self, initial_state=(output, 0.0, third), initial_effort=-third)

    def sampled(self, sample_period_ns: int) -> SampledSprott:
        """The plant as the closed loop steps it."""
        return SampledSprott(self.a, self.b, self.c, sample_period_ns / 1e9, 0)


class Ode:
    """A user's plant from a class with `parameters`, `initial_state`, `derivative` and `output`.

    `derivative(x, u, d, p)` returns dx/dt as a tuple, `output(x, p)` the output; both are static functions that Numba
    can compile. x is the state as a tuple, u the effort, d the disturbance, p the parameters' values in order.
    See `docs/your-own-plant.md`.

    Raises:
        PlantError: the class lacks a part, or its functions do not compile or return the wrong shape.
    """

    def __init__(
        self, description: type, values: Mapping[str, float], initial_state: tuple[float, ...], substeps: float
    ):
        try:
            self.substeps = int(SUBSTEPS.checked(substeps))
        except ParameterError as error:
            raise PlantError(str(error)) from None
        self.description = description
        self.values = tuple(float(value) for value in values.values())
        self.initial_state = _state(initial_state, len(initial_state))
        self._derivative = _compiled(description.derivative)  # type: ignore[attr-defined]
        self._output = _compiled(description.output)  # type: ignore[attr-defined]
        self.initial_effort = 0.0
        self._try_out()

    @property
    def initial_output(self) -> float:
        """y at time 0."""
        return self.output(self.initial_state)

    def derivative(self, x: State, u: float, d: float) -> State:
        """dx/dt in the state x under effort u and disturbance d."""
        return tuple(self._derivative(x, u, d, self.values))

    def output(self, x: State) -> float:
        """y in the state x."""
        return float(self._output(x, self.values))

    def at_rest(self, output: float, disturbance: float = 0.0) -> Ode:
        """The same plant, beginning where dx/dt = 0 with this output; found numerically from `initial_state`."""
        state, effort = _resting(self, output, disturbance)
        resting = copy.copy(self)
        resting.initial_state, resting.initial_effort = state, effort
        return resting

    def sampled(self, sample_period_ns: int) -> SampledOde:
        """The plant as the closed loop steps it."""
        step = sample_period_ns / 1e9 / self.substeps
        return SampledOde(self._derivative, self._output, self.values, step, self.substeps, 0)

    def _try_out(self) -> None:
        name = f"{self.description.__module__}:{self.description.__qualname__}"
        try:
            slope = self._derivative(self.initial_state, 0.0, 0.0, self.values)
            y = self._output(self.initial_state, self.values)
        except numba.core.errors.NumbaError as error:
            raise PlantError(f"{name} does not compile: {_reason(error)}") from error
        except TypeError as error:
            raise PlantError(
                f"{name}: {error}: derivative(x, u, d, p) and output(x, p) must be static methods"
            ) from error
        if not isinstance(slope, tuple) or len(slope) != len(self.initial_state):
            raise PlantError(
                f"{name}.derivative returns {slope!r}: it must be a tuple of {len(self.initial_state)} numbers"
            )
        if not all(isinstance(value, float) for value in (*slope, y)):
            raise PlantError(f"{name}: derivative and output must return floats, not {slope!r} and {y!r}")
        if not all(map(math.isfinite, (*slope, y))):
            raise PlantError(f"{name}: in its initial state dx/dt is {slope!r} and y is {y!r}: they must be finite")


def _resting(plant: Ode, wanted: float, disturbance: float) -> tuple[State, float]:
    """State and effort with dx/dt = 0 and output `wanted`; to 12 digits, so that they are the same on every machine.

    Raises:
        PlantError: there are none near the plant's initial state.
    """
    from scipy.optimize import root

    def unbalanced(unknown: np.ndarray) -> list[float]:
        x = tuple(map(float, unknown[:-1]))
        return [*plant.derivative(x, float(unknown[-1]), disturbance), plant.output(x) - wanted]

    best = math.inf
    for effort in (0.0, 1.0, wanted, -1.0):
        for method in ("hybr", "lm"):
            found = root(unbalanced, [*plant.initial_state, effort], method=method, tol=1e-13)
            rounded = [float(f"{value:.12g}") for value in found.x]
            residual = np.abs(unbalanced(np.array(rounded)))
            best = min(best, float(np.nan_to_num(residual.max(), nan=math.inf)))
            if best <= RESTING * (1.0 + np.abs(rounded).max()):
                return tuple(rounded[:-1]), rounded[-1]
    raise PlantError(
        f"no state at rest was found with the output at {wanted:g} (nearest: dx/dt or y off by {best:.3g})"
    )


_loaded: dict[str, Any] = {}  # classes by the `model` that the user named


def load_class(path: str, folder: Path | None = None) -> Any:
    """Import the class that `model: package.module:Class` names, for a `model` that the user gave.

    It is looked for where Python looks for modules, and then in a folder. From here on `loaded_class` has it.

    Args:
        folder: of the parameter file in which the user named it.

    Raises:
        PlantError: it cannot be imported or lacks a part of a plant.
    """
    module_name, _, class_name = path.partition(":")
    with _importing_from(folder):
        try:
            _check_same_module(path, module_name)
            found: Any = getattr(importlib.import_module(module_name), class_name)
        except PlantError:
            raise
        except (ImportError, AttributeError, ValueError) as error:
            raise PlantError(
                f"model {path!r} cannot be loaded ({error}): is its package installed, on PYTHONPATH, or in the "
                "parameter file's folder?"
            ) from error
        except Exception as error:  # the user's code: whatever goes wrong in it
            raise PlantError(f"model {path!r} cannot be loaded: {type(error).__name__}: {error}") from error
    _check_description(path, found)
    _loaded[path] = found
    return found


def loaded_class(path: str) -> Any:
    """The class of a `model` that may come from a bag or from another node; it is never imported for that.

    Raises:
        PlantError: the user has named no such class.
    """
    if path not in _loaded:
        raise PlantError(
            f"the plant's model {one_line(path, 100)!r} is not built in, and classes are loaded only if you name them: "
            "give the parameter file that does (--case FILE)"
        )
    return _loaded[path]


def class_by_value(path: str) -> bytes:
    """A class that the user has named, with all of its module that it uses, for a process that has not its file.

    It runs there under the same Python, and imports there what its module imports.
    """
    import cloudpickle

    module = sys.modules[path.partition(":")[0].partition(".")[0]]
    cloudpickle.register_pickle_by_value(module)
    try:
        return bytes(cloudpickle.dumps(loaded_class(path)))
    finally:
        cloudpickle.unregister_pickle_by_value(module)


def take_class(path: str, by_value: bytes) -> str:
    """Load a class that came from another process; returns what its `model` is called here.

    The name tells its content: another version of it, or another class of that name, may be loaded too.
    """
    name = f"{path}@{hashlib.sha256(by_value).hexdigest()[:8]}"
    if name not in _loaded:
        _loaded[name] = pickle.loads(by_value)
    return name


@contextmanager
def _importing_from(folder: Path | None) -> Iterator[None]:
    """Let Python look for modules in a folder too, after all other places."""
    before = list(sys.path)
    if folder is not None:
        sys.path.append(str(folder.resolve()))
    try:
        yield
    finally:
        sys.path[:] = before


def _check_same_module(path: str, module_name: str) -> None:
    """Refuse a module of the same name as one that was loaded from the folder of another parameter file."""
    root = module_name.partition(".")[0]
    loaded = getattr(sys.modules.get(root), "__file__", None)
    wanted = importlib.machinery.PathFinder.find_spec(root) if root and loaded else None
    if loaded and wanted is not None and wanted.origin and not Path(wanted.origin).samefile(loaded):
        raise PlantError(f"model {path!r}: another module {root} is loaded already, {loaded}: rename one of them")


def _check_description(path: str, found: Any) -> None:
    missing = [name for name in ("parameters", "initial_state", "derivative", "output") if not hasattr(found, name)]
    is_class = inspect.isclass(found)
    if not is_class or missing:
        raise PlantError(f"model {path!r} is not a plant class: it lacks {', '.join(missing) or 'being a class'}")
    if not isinstance(found.parameters, Mapping) or not all(map(_is_number, found.parameters.values())):
        raise PlantError(f"{path}.parameters is {found.parameters!r}: it must map names to finite numbers")
    if not isinstance(found.initial_state, (tuple, list)) or not all(map(_is_number, found.initial_state)):
        raise PlantError(f"{path}.initial_state is {found.initial_state!r}: it must be a tuple of finite numbers")
    for attribute in ("descriptions", "ranges"):
        about = getattr(found, attribute, {})
        if not isinstance(about, Mapping) or not about.keys() <= found.parameters.keys():
            raise PlantError(f"{path}.{attribute} is {about!r}: it must map names of parameters")
    _ = class_table(found)


def class_table(description: Any) -> dict[str, Parameter]:
    """The parameters that a user's class brings, with its optional `descriptions` and `ranges`, by name.

    Raises:
        PlantError: a range is no [lower, upper], or its default lies outside.
    """
    texts, ranges = getattr(description, "descriptions", {}), getattr(description, "ranges", {})
    parameters = [
        Parameter(
            name,
            float(value),
            str(texts.get(name, f"parameter of {description.__qualname__}")),
            within=_range(name, ranges[name]) if name in ranges else FINITE,
            per_lane=True,
        )
        for name, value in description.parameters.items()
    ]
    start = Parameter("initial_state", list(map(float, description.initial_state)), "x at time 0", "", FINITE)
    start = replace(start, fixed=True, length=len(start.default))
    try:
        for parameter in parameters:
            parameter.checked(parameter.default)
    except ParameterError as error:
        raise PlantError(f"{description.__qualname__}.parameters: {error}") from None
    return table(*parameters, start, SUBSTEPS)


def _range(name: str, ends: Any) -> Range:
    if not isinstance(ends, (tuple, list)) or len(ends) != 2 or not all(isinstance(end, (int, float)) for end in ends):
        raise PlantError(f"ranges[{name!r}] is {ends!r}: it must be (lower, upper)")
    low, high = map(float, ends)
    return Range(low, high, math.isfinite(low), math.isfinite(high))


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _reason(error: Exception) -> str:
    """Of all that Numba says of a failure: what is wrong, and in which line of the user's file."""
    lines = [line.strip() for line in str(error).splitlines()]
    what = [line for line in lines if line and not line.startswith(("Failed in", "During:", "File ", "- ", "<"))]
    where = [line.removesuffix(":") for line in lines if line.startswith("File ")]
    return "; ".join(what[:1] + where[-1:])


def _state(values: Any, length: int) -> tuple[float, ...]:
    state = tuple(float(value) for value in values)
    if len(state) != length or not all(math.isfinite(value) for value in state):
        raise PlantError(f"initial_state is {list(state)}: it must be {length} finite numbers")
    return state


@lru_cache(maxsize=32)
def _compiled(function: Any) -> Any:
    return numba.njit(error_model="numpy", nogil=True)(function)
