"""What every plant has in common."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NoReturn, Protocol


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


@dataclass(frozen=True)
class EachLane:
    """A plant of its own for each lane, all of one kind; what needs one plant refuses it in one line.

    Attributes:
        plants: in the order of the lanes.
    """

    plants: tuple[Plant, ...]

    @property
    def initial_state(self) -> tuple[float, ...]:
        """Each lane has its own.

        Raises:
            PlantError: always.
        """
        self._refuse()

    @property
    def initial_output(self) -> float:
        """As `initial_state`."""
        self._refuse()

    @property
    def initial_effort(self) -> float:
        """As `initial_state`."""
        self._refuse()

    def at_rest(self, output: float) -> EachLane:
        """Each at rest with this output."""
        return EachLane(tuple(plant.at_rest(output) for plant in self.plants))

    def sampled(self, sample_period_ns: int) -> Any:
        """As `initial_state`: `PlantSimulator` samples them together."""
        self._refuse()

    def _refuse(self) -> NoReturn:
        raise PlantError(
            f"each of {len(self.plants)} lanes has a plant of its own, but this takes one plant: give each of its "
            "parameters one number"
        )


def one_plant(plant: Plant) -> Plant:
    """The plant, if all lanes have the same.

    Raises:
        PlantError: each has its own.
    """
    if isinstance(plant, EachLane):
        _ = plant.initial_state
    return plant


PlantAt = Callable[[dict[str, float]], Plant]  # the plant with some parameters changed


def nanoseconds(seconds: float) -> int:
    """Seconds as the nearest whole number of nanoseconds."""
    return round(seconds * 1e9)
