"""The report of a sweep: how many plants are unstable, quantiles, what they depend on, the worst."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tdof_npid_ros.case import Case
from tdof_npid_ros.control.gains import PER_LANE, Gains
from tdof_npid_ros.metrics import in_units
from tdof_npid_ros.robustness import RobustError
from tdof_npid_ros.robustness.spread import Sampling, Spread, changes_of, samples
from tdof_npid_ros.robustness.sweep import METRICS, Sweep, chunks_of, is_linear, joined, measured
from tdof_npid_ros.workers import ChunkCheckpoint, Workers

QUANTILES = (0.05, 0.5, 0.95)
WORST = 5
CONFIDENCE = 0.95
BINS = 32  # at most, along a parameter, for the part of a metric's variance that it explains
LEAST_IN_BIN = 20
BY_MODES = "modes of the loop, linearised: exact while no limit of the effort is active"
BY_OUTPUTS = "outputs: a loop counts as unstable that has not come to rest by the end of the episodes"


@dataclass(frozen=True)
class Sensitivity:
    """How a metric depends on a parameter, by ranks.

    Attributes:
        correlation: Spearman's, -1 to 1: with its sign, as far as the dependence goes one way.
        explained: the part of the variance of the metric's ranks that the parameter alone explains, 0 to 1, whichever
            way the dependence goes: the first-order index of Sobol', estimated from bins along the parameter.
    """

    correlation: float
    explained: float


@dataclass(frozen=True)
class RobustResult:
    """What gains achieve on many plants.

    Attributes:
        case: the loop with the model's plant; gains: of one lane.
        spreads, sampling, seed: of the plants.
        values: of the plants' parameters, (plants, spreads).
        unstable: (plants,).
        metrics: by the names of `robustness.sweep.METRICS`, (plants,): infinite where there is no number, and for an
            unstable loop.
        fans: outputs of the first plants by episode, at some of the samples, (points, plants).
    """

    case: Case
    gains: Gains
    spreads: tuple[Spread, ...]
    sampling: Sampling
    seed: int
    values: np.ndarray
    unstable: np.ndarray
    metrics: dict[str, np.ndarray]
    fans: dict[str, np.ndarray]

    @property
    def judged_by(self) -> str:
        """What stability was told by."""
        return BY_MODES if is_linear(self.case) else BY_OUTPUTS

    @property
    def unstable_fraction(self) -> float:
        """Of the plants that were tried."""
        return float(np.mean(self.unstable))

    @property
    def unstable_interval(self) -> tuple[float, float] | None:
        """Where the fraction lies, of all plants in the spreads, with a confidence of 95 % (Clopper and Pearson).

        None for corners, which are no random sample.
        """
        if self.sampling == "corners":
            return None
        from scipy.special import betaincinv

        n, k, tail = len(self.unstable), int(self.unstable.sum()), 0.5 * (1.0 - CONFIDENCE)
        low = float(betaincinv(k, n - k + 1, tail)) if k else 0.0
        high = float(betaincinv(k + 1, n - k, 1.0 - tail)) if k < n else 1.0
        return low, high

    def quantile(self, metric: str, fraction: float) -> float:
        """Of a metric over all plants; an unstable loop counts as infinitely bad, so it may be infinite."""
        return float(np.quantile(self.metrics[metric], fraction, method="inverted_cdf"))

    def mean(self, metric: str) -> float:
        """Of a metric over all plants."""
        return float(np.mean(self.metrics[metric]))

    def worst(self, count: int = WORST) -> list[int]:
        """The numbers of the worst plants: unstable ones first, then by the objective."""
        order = np.lexsort((np.arange(len(self.unstable)), -self.metrics["objective"], ~self.unstable))
        return [int(index) for index in order[:count]]

    def changes(self, index: int) -> dict[str, Any]:
        """The plant's parameters of one sample, as a parameter file gives them."""
        return changes_of(self.case, self.spreads, self.values[index].tolist(), index)

    def parameters(self, index: int) -> dict[str, dict[str, Any]]:
        """All parameters of the loop with one of the plants, by node: what `simulate` takes as a file."""
        nodes = self.case.parameters(self.gains)
        return {**nodes, "plant": {**nodes["plant"], **self.changes(index)}}

    def sensitivity(self, metric: str) -> dict[str, Sensitivity]:
        """By parameter; nothing where the metric is the same for all plants."""
        y = _ranks(self.metrics[metric])
        if np.ptp(y) == 0.0:
            return {}
        return {
            spread.name: Sensitivity(_correlation(_ranks(x), y), _explained(x, y))
            for spread, x in zip(self.spreads, self.values.T, strict=True)
        }

    def as_dict(self) -> dict[str, Any]:
        """For JSON; null for what is infinite."""
        interval = self.unstable_interval
        return {
            "case": self.case.name,
            "controller": self.gains.type,
            "gains": {name: getattr(self.gains, name) for name in PER_LANE},
            "spreads": {one.name: {"low": one.low, "high": one.high, "nominal": one.nominal} for one in self.spreads},
            "sampling": self.sampling,
            "seed": self.seed,
            "samples": len(self.unstable),
            "unstable": {
                "count": int(self.unstable.sum()),
                "fraction": self.unstable_fraction,
                "interval_95": None if interval is None else list(interval),
                "by": self.judged_by,
            },
            "quantiles": {name: {f"{q:g}": finite(self.quantile(name, q)) for q in QUANTILES} for name in self.metrics},
            "mean": {name: finite(self.mean(name)) for name in self.metrics},
            "sensitivity": {
                name: {parameter: vars(one) for parameter, one in self.sensitivity(name).items()}
                for name in self.metrics
            },
            "worst": [
                {
                    "sample": index,
                    "plant": self.changes(index),
                    "unstable": bool(self.unstable[index]),
                    **{name: finite(float(values[index])) for name, values in self.metrics.items()},
                }
                for index in self.worst()
            ],
        }

    def unstable_line(self) -> str:
        """In one line for people."""
        count, interval = int(self.unstable.sum()), self.unstable_interval
        told = f"{count} of {len(self.unstable)} plants unstable ({100.0 * self.unstable_fraction:.3g} %)"
        if interval is None:
            return told
        return f"{told}; of all in the spreads {100 * interval[0]:.3g} to {100 * interval[1]:.3g} %, 95 % sure"

    def lines(self) -> list[str]:
        """For people."""
        low, middle, high = (f"{100 * q:g} %" for q in QUANTILES)
        shown = [f"  {self.unstable_line()}", f"  (by {self.judged_by})"]
        shown.append(f"  {'':19}{low:>11}{middle:>11}{high:>11}{'mean':>11}   most sensitive to")
        for name in self.metrics:
            numbers = [*(self.quantile(name, q) for q in QUANTILES), self.mean(name)]
            cells = "".join(f"{in_units(x) if math.isfinite(x) else '-':>11}" for x in numbers)
            ordered = sorted(self.sensitivity(name).items(), key=lambda one: -one[1].explained)
            most = ", ".join(f"{n} {100 * s.explained:.0f} % ({s.correlation:+.2f})" for n, s in ordered[:3])
            shown.append(f"  {name:19}{cells}   {most}")
        if not all(np.isfinite(values).all() for values in self.metrics.values()):
            shown.append("  - : beyond what has a number, as for an unstable loop or a time that is not reached")
        for number, index in enumerate(self.worst(), 1):
            plant = ", ".join(
                f"{n} {v:.6g}" if isinstance(v, float) else f"{n} {v}" for n, v in self.changes(index).items()
            )
            objective = self.metrics["objective"][index]
            told = "unstable" if self.unstable[index] else f"objective {objective:.6g}"
            shown.append(f"  worst {number}: sample {index}, {told}: {plant}")
        return shown


def sweep_plants(
    here: Workers,
    case: Case,
    gains: Gains,
    spreads: tuple[Spread, ...],
    *,
    count: int,
    sampling: Sampling = "uniform",
    seed: int = 0,
    checkpoint: Path | None = None,
    resume: bool = False,
) -> RobustResult:
    """What gains achieve on plants near a case's.

    Args:
        here: where the chunks run; the result does not depend on it.
        gains: of one lane.
        checkpoint: where the results of chunks are kept until all are done.
        resume: go on from the checkpoint if it is there (resumed = uninterrupted).

    Raises:
        RobustError: gains for several lanes, or samples that cannot be.
        PlanError: the case has not the episodes `setpoint` and `disturbance`, each of one step.
    """
    if gains.lanes > 1:
        raise RobustError(f"{case.name}: the gains are for {gains.lanes} lanes: give one number each")
    case.setpoint_response(gains), case.disturbance_response(gains)  # refused before hours are spent
    values = samples(spreads, count, sampling, seed)
    chunks = chunks_of(values)
    parts = here.map(
        measured,
        Sweep(case, gains, spreads),
        chunks,
        unit="plant",
        sizes=[len(chunk.values) for chunk in chunks],
        checkpoint=ChunkCheckpoint(checkpoint, _work(case, gains, values), resume) if checkpoint else None,
    )
    found = joined(parts)
    fans = {name.removeprefix("fan."): fan for name, fan in found.items() if name.startswith("fan.")}
    metrics = {name: found[name] for name in METRICS if name in found}
    return RobustResult(case, gains, spreads, sampling, seed, values, found["unstable"] > 0.0, metrics, fans)


def _work(case: Case, gains: Gains, values: np.ndarray) -> dict[str, Any]:
    """All that the result depends on, as JSON holds it."""
    nodes = case.parameters(gains)
    flat = {f"{node}.{name}": repr(value) for node, given in nodes.items() for name, value in given.items()}
    return {**flat, "samples": len(values), "plants": hashlib.sha256(values.tobytes()).hexdigest()}


def finite(value: float) -> float | None:
    """A number as JSON has it."""
    return value if math.isfinite(value) else None


def _ranks(values: np.ndarray) -> np.ndarray:
    """From 0 on; those of equal values are their mean."""
    _, group, counts = np.unique(values, return_inverse=True, return_counts=True)
    ends = np.cumsum(counts)
    return np.asarray((ends - 0.5 * (counts + 1))[group])


def _correlation(x: np.ndarray, y: np.ndarray) -> float:
    x, y = x - x.mean(), y - y.mean()
    size = float(np.sqrt(x @ x * (y @ y)))
    return float(x @ y) / size if size else 0.0


def _explained(x: np.ndarray, y: np.ndarray) -> float:
    """The part of y's variance that is between bins of equal numbers along x, less what chance alone would give."""
    distinct = len(np.unique(x))
    bins = distinct if distinct <= 2 else max(2, min(BINS, len(x) // LEAST_IN_BIN))
    if bins >= len(x) or distinct < 2:
        return 0.0
    group = np.minimum((_ranks(x) * bins / len(x)).astype(int), bins - 1)
    counts = np.bincount(group, minlength=bins)
    sums = np.bincount(group, y, minlength=bins)
    used = counts > 0
    between = float(np.sum(sums[used] ** 2 / counts[used]) - len(y) * y.mean() ** 2)
    total = float(np.sum((y - y.mean()) ** 2))
    k, n = int(used.sum()), len(y)
    within = (total - between) / (n - k)
    return min(1.0, max(0.0, (between - (k - 1) * within) / total)) if total else 0.0
