"""How a plant begins an episode."""

from __future__ import annotations

from tdof_npid_ros.plants.noise import in_episode
from tdof_npid_ros.plants.plant import EachLane, Plant, PlantAt, PlantError


def plant_at_start(
    plant_at: PlantAt,
    start: float | None,
    parameters: dict[str, float],
    effort_limits: tuple[float, float],
    episode: int = 0,
) -> Plant:
    """The plant with which an episode begins: as configured, or at rest where the plan starts.

    Args:
        start: the output at rest; None: the plan does not say.
        parameters: of the plant, as the plan has them at its start.
        effort_limits: the actuator's.
        episode: what the episode is known by: see `SampledPlan.identity`.

    Raises:
        PlantError: nothing holds it there, or not within the effort's limits.
    """
    plant = plant_at({} if start is None else parameters)
    if isinstance(plant, EachLane):
        return EachLane(tuple(_begun(one, start, effort_limits, episode) for one in plant.plants))
    return _begun(plant, start, effort_limits, episode)


def _begun(plant: Plant, start: float | None, effort_limits: tuple[float, float], episode: int) -> Plant:
    if start is None:
        return in_episode(plant, episode)
    plant = plant.at_rest(start)
    low, high = effort_limits
    if not low <= plant.initial_effort <= high:
        raise PlantError(
            f"start {start:g}: the plant rests there with an effort of {plant.initial_effort:g}, "
            f"beyond its limits {low:g} to {high:g}"
        )
    return in_episode(plant, episode)
