"""What every plant has in common."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol


class PlantError(ValueError):
    """A plant that cannot be built or sampled; the message names the parameter, its value and the remedy."""


class Plant(Protocol):
    """A plant with its parameters fixed: its state at rest and how the closed loop steps it."""

    @property
    def initial_state(self) -> tuple[float, ...]:
        """The state at time 0."""
        ...

    @property
    def initial_output(self) -> float:
        """The output y at time 0."""
        ...

    @property
    def initial_effort(self) -> float:
        """The effort that was on before time 0, and is still on its way through the dead time."""
        ...

    def at_rest(self, output: float) -> Plant:
        """The same plant, beginning at rest with this output and the effort that holds it there, undisturbed.

        Raises:
            PlantError: no effort holds it there.
        """
        ...

    def sampled(self, sample_period_ns: int) -> Any:
        """A named tuple of `plants.kernels`, for steps of `sample_period_ns`."""
        ...


PlantAt = Callable[[dict[str, float]], Plant]  # the plant with some parameters changed


def plant_at_start(
    plant_at: PlantAt, start: float | None, parameters: dict[str, float], effort_limits: tuple[float, float]
) -> Plant:
    """The plant with which an episode begins: as configured, or at rest where the plan starts.

    Args:
        start: the output at rest; None: the plan does not say.
        parameters: of the plant, as the plan has them at its start.
        effort_limits: the actuator's.

    Raises:
        PlantError: nothing holds it there, or not within the effort's limits.
    """
    if start is None:
        return plant_at({})
    plant = plant_at(parameters).at_rest(start)
    low, high = effort_limits
    if not low <= plant.initial_effort <= high:
        raise PlantError(
            f"start {start:g}: the plant rests there with an effort of {plant.initial_effort:g}, "
            f"beyond its limits {low:g} to {high:g}"
        )
    return plant


def nanoseconds(seconds: float) -> int:
    """Seconds as the nearest whole number of nanoseconds."""
    return round(seconds * 1e9)
