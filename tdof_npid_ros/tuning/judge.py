"""Which candidates may win: those whose loop is stable, comes to rest, and has the margins asked for.

The objective stands for an integral to infinity, but an episode ends. So what would still come counts: its bound is the
error that remains times the time constant of the loop's slowest mode, and where it matters, the candidate is not
allowed. Without a linear model the same is told from the outputs alone.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from tdof_npid_ros.control.gains import Gains
from tdof_npid_ros.loop import Integrals
from tdof_npid_ros.stability.screen import LaneMargins, Screen
from tdof_npid_ros.tuning import TuningError
from tdof_npid_ros.tuning.ask_tell import Array, Scores

LARGEST_TAIL = 1e-3
"""Of the objective: what may come after the episode's end."""

FOR_EVER = 9.0
"""Episodes: so long, at least, lasts an error that does not decay."""

DECAYING = 1.5
"""An error decays with the slowest mode if its integral is at most so many times that mode's: oscillations vary."""

# Violations of what is worse than a margin or a tail; those are at most WORST_EXCESS each.
WORST_EXCESS = 20.0
UNSTABLE, DIVERGED = 200.0, 300.0


@dataclass(frozen=True)
class Constraints:
    """Margins that the linearised loop must have; None where it need not.

    Attributes:
        ms, mt: largest M_s and M_t, above 1.
        gain_margin: least factor on the gains, above 1.
        phase_margin: least, in degrees.
        delay_margin: least, in s.

    Raises:
        TuningError: a value that no loop can have, or every loop has.
    """

    ms: float | None = None
    mt: float | None = None
    gain_margin: float | None = None
    phase_margin: float | None = None
    delay_margin: float | None = None

    def __post_init__(self) -> None:
        least = {"ms": 1.0, "mt": 1.0, "gain_margin": 1.0, "phase_margin": 0.0, "delay_margin": 0.0}
        for name, value in self.given.items():
            most = 180.0 if name == "phase_margin" else math.inf
            if not least[name] < value < most:
                unit = {"phase_margin": " degrees", "delay_margin": " s"}.get(name, "")
                raise TuningError(f"{name} is {value:g}: it must be above {least[name]:g}{unit} and below {most:g}")

    @classmethod
    def of_search(cls, search: Mapping[str, Any]) -> Constraints:
        """What a parameter file asks its tuner for; 0 there: nothing."""
        return cls(**{field.name: search.get(field.name) or None for field in fields(cls)})

    @property
    def given(self) -> dict[str, float]:
        """Those that are asked for, by name."""
        return {field.name: value for field in fields(self) if (value := getattr(self, field.name)) is not None}

    def excess(self, margins: LaneMargins) -> Array:
        """By how much a stable lane misses them, relatively and added up, (lanes,); 0 where it has them all."""
        excess = np.zeros(margins.m_s.shape)
        for name, limit in self.given.items():
            value = _margin(margins, name)
            # With less and less gain a peak falls towards 1.
            missed = (value - limit) / (limit - 1.0) if name in ("ms", "mt") else 1.0 - value / limit
            excess += np.clip(np.nan_to_num(missed, nan=WORST_EXCESS), 0.0, WORST_EXCESS)
        return excess

    def missed(self, margins: LaneMargins) -> list[str]:
        """What the first lane misses, in words."""
        told = []
        for name, limit in self.given.items():
            value = float(_margin(margins, name)[0])
            if not (value <= limit if name in ("ms", "mt") else value >= limit):
                most = "at most" if name in ("ms", "mt") else "at least"
                told.append(f"{name.replace('_', ' ')} {most} {limit:g} (nearest: {value:.4g})")
        return told


def _margin(margins: LaneMargins, name: str) -> Array:
    """The margin that a constraint is about, in its unit, (lanes,)."""
    if name == "gain_margin":
        with np.errstate(divide="ignore"):
            least: Array = np.minimum(margins.gain_margin, 1.0 / margins.gain_margin_low)
        return least
    values = {"ms": margins.m_s, "mt": margins.m_t, "delay_margin": margins.delay_margin}
    return np.degrees(margins.phase_margin) if name == "phase_margin" else values[name]


class Judge:
    """Scores candidates from what was measured in their episodes, wherever these ran.

    Args:
        screen: of the linearised loop; None if there is none: then by the outputs alone.
        constraints: none but without a screen.
        lengths: of the setpoint and the disturbance episode, in s; 0 for one in which no loop can come to rest.
        weight: w of the objective.
        noise_bound: how far a measured output is from the plant's at the most, in its unit.
    """

    def __init__(
        self,
        screen: Screen | None,
        constraints: Constraints,
        lengths: tuple[float, float],
        weight: float,
        noise_bound: float = 0.0,
    ) -> None:
        self._screen = screen
        self._constraints = constraints
        self._lengths = lengths
        self._weight = weight
        self._noise_bound = noise_bound

    def __call__(self, gains: Gains, objective: Array, setpoint: Integrals, disturbance: Integrals) -> Scores:
        """The scores (n,) of candidates.

        Args:
            gains: theirs, n lanes.
            objective: (10), (n,).
            setpoint, disturbance: of their episodes, (n,) each.
        """
        margins = self._screen(gains) if self._screen else None
        return self.scores(gains.per_lane("ki"), margins, objective, setpoint, disturbance)

    def scores(
        self, ki: Array, margins: LaneMargins | None, objective: Array, setpoint: Integrals, disturbance: Integrals
    ) -> Scores:
        """As `__call__`, with the margins known; ki: the candidates', (n,)."""
        tails = [
            tail(self._without_noise(episode), length, ki, margins)
            for episode, length in zip((setpoint, disturbance), self._lengths, strict=True)
        ]
        with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
            beyond = (tails[0] + self._weight * tails[1]) / objective - LARGEST_TAIL
        violation = np.clip(np.nan_to_num(beyond, nan=0.0), 0.0, WORST_EXCESS)
        if margins is not None:
            violation += self._constraints.excess(margins)
            violation = np.where(margins.stable, violation, UNSTABLE)
        lost = 2.0 - setpoint.finite_fraction - disturbance.finite_fraction
        return Scores(objective, np.where(lost > 0.0, DIVERGED + lost, violation))

    def _without_noise(self, episode: Integrals) -> Integrals:
        """What noise alone may explain is no tail."""
        if not self._noise_bound:
            return episode
        return replace(episode, rest_error=np.maximum(episode.rest_error - self._noise_bound, 0.0))


def tail(episode: Integrals, length: float, ki: Array, margins: LaneMargins | None) -> Array:
    """A bound of the IAE that would come after an episode of `length` s, (lanes,); 0 for a length of 0."""
    error, late, early = episode.rest_error, episode.late_rest_iae, episode.early_rest_iae
    if length == 0.0:
        return np.zeros_like(error)
    for_ever = FOR_EVER * length
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        if margins is None:
            left = np.where(late < early, late * late / (early - late), error * for_ever)  # a geometric series
            return np.minimum(left, error * for_ever)
        slowest = margins.time_constant
        decays = (ki != 0.0) & (late <= DECAYING * error * slowest)
        return error * np.where(decays, slowest, np.fmax(slowest, for_ever))
