"""What every plant has in common."""

from __future__ import annotations

from typing import Any, Protocol


class PlantError(ValueError):
    """A plant that cannot be built or sampled; the message names the parameter, its value and the remedy."""


class Plant(Protocol):
    """A plant with its parameters fixed: its state at rest and how the closed loop steps it."""

    @property
    def initial_state(self) -> tuple[float, ...]:
        """The state at time 0."""
        ...

    def sampled(self, sample_period_ns: int) -> Any:
        """A named tuple of `plants.kernels`, for steps of `sample_period_ns`."""
        ...


def nanoseconds(seconds: float) -> int:
    """Seconds as the nearest whole number of nanoseconds."""
    return round(seconds * 1e9)
