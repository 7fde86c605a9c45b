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


def nanoseconds(seconds: float) -> int:
    """Seconds as the nearest whole number of nanoseconds."""
    return round(seconds * 1e9)
