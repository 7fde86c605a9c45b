"""Identification of a record: search, choice, the fit to all of it, and what must be refused."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from tdof_npid_ros.identification import IdentificationError
from tdof_npid_ros.identification.fit import NO_WHITENING, Problem, Solution, Stretch
from tdof_npid_ros.identification.intervals import Interval, intervals
from tdof_npid_ros.identification.noise import autocovariance, roughness
from tdof_npid_ros.identification.search import WORTH, Fitted, chosen, criterion, fit_all, floor, noise_model
from tdof_npid_ros.identification.structures import STRUCTURES, Structure

LEAST_SAMPLES = 40
WORKING = 3000  # samples, in which structures are compared; of longer records, averages or a part
RESOLVED = 8.0  # averages: what a plant's dead time and time constant together must last, or fewer are averaged
ALL_STRUCTURES = 50_000  # samples; of longer records not every structure is fitted to all samples …
FEW_STRUCTURES = 2  # … but so many
FULL_ITERATIONS = 12
ARITHMETIC = 100.0  # of the smallest sum of squares: what the intervals count as noise at the least
ROUNDING = 1e-6  # of the effort's range: a smaller load step is the arithmetic's, which a record without noise shows
STEADY = 0.05  # of the effort's range: less is no move
LONGEST_START = 0.25  # of a stretch: more is not left out
FOLDS = 2
FOLD_BLOCKS = 20  # parts of a stretch; every other one is left out in turn, but for the first: all begins there
SIGNIFICANCE = 1e-6  # that the output follows the effort at all
LOOSEST = 0.5  # an interval's half width over the value, beyond which the record does not tell
LEAST_FIT = 50.0  # %, where the rest is not noise
NOT_NOISE = 3.0  # residuals so many times larger than the noise that neighbouring samples show are no noise
LAGS = 20  # for the residuals' correlation


@dataclass(frozen=True)
class Candidate:
    """A structure that was compared.

    Attributes:
        structure: its name.
        criterion: AICc less that of the best; 0 for the best.
        loads: load steps that it found.
    """

    structure: str
    criterion: float
    loads: int


@dataclass(frozen=True)
class LoadStep:
    """A change of the load within a record.

    Attributes:
        stretch: in which, by its place.
        time: when it began to move the plant's output, less the dead time: as if it came in with the effort, s.
        size: in units of the effort.
    """

    stretch: int
    time: float
    size: float


@dataclass(frozen=True)
class Identified:
    """A plant that a record tells.

    Attributes:
        structure: the one chosen, and `reason` why.
        parameters: by name, SI units, with their 95 % intervals.
        candidates: all that were compared, the best first.
        loads: load steps found.
        fit_percent: NRMSE fit on data not used for it: 100 (1 - |y - predicted|/|y - mean|).
        noise: standard deviation of the residuals, in the output's unit.
        noise_model: the residual is white noise plus these times the residuals before, (lags,).
        residual_correlation: the largest correlation of the white noise with itself at lags 1 to 20.
        residual_bound: what this is less than in 99 % of white noises.
        level: the output at which the plant rests with the effort `effort_level`.
        effort_level: the effort before the first stretch; of an integrating plant, the one that holds its output.
        residuals: by stretch, (samples,).
        averaged: samples in a mean where structures were compared; 1: none.
        problem, solution: the fit.
    """

    structure: Structure
    reason: str
    parameters: Mapping[str, Interval]
    candidates: Sequence[Candidate]
    loads: Sequence[LoadStep]
    fit_percent: float
    noise: float
    noise_model: np.ndarray
    residual_correlation: float
    residual_bound: float
    level: float
    effort_level: float
    residuals: Sequence[np.ndarray]
    averaged: int
    problem: Problem
    solution: Solution

    @property
    def values(self) -> dict[str, float]:
        """The parameters alone."""
        return {name: interval.value for name, interval in self.parameters.items()}


def identify(stretches: Sequence[Stretch], structures: Sequence[Structure] = tuple(STRUCTURES.values())) -> Identified:
    """Find the plant that made a record.

    Raises:
        IdentificationError: the record cannot tell; the message says why, and what to record instead.
    """
    _check(stretches)
    fits, whitening, averages = _fitted(stretches, structures)
    without_starts = _without_starts(stretches, chosen(fits).solution.point.dead_time)
    if without_starts is not None:
        stretches = without_starts
        fits, whitening, averages = _fitted(stretches, structures)
    final = chosen(fits)
    structure, solution = final.problem.structure, final.solution
    residuals = final.problem.residuals(solution)
    best = fits[0].criterion
    candidates = [Candidate(f.structure.name, f.criterion - best, sum(f.problem.loaded)) for f in fits]
    white = [_whitened(r, whitening)[s.used[len(whitening) :]] for r, s in zip(residuals, stretches, strict=True)]
    covariance = autocovariance(white, min(LAGS, min(map(len, white)) // 2))
    found = Identified(
        structure,
        _reason(final, fits),
        intervals(final.problem, _with_floor(final, stretches)),
        candidates,
        [
            LoadStep(i, float(solution.point.load_time[i]) - solution.point.dead_time, float(solution.point.load[i]))
            for i, there in enumerate(final.problem.loaded)
            if there and abs(float(solution.point.load[i])) > ROUNDING * float(np.ptp(stretches[i].effort))
        ],
        _held_out_fit(final.problem, solution),
        math.sqrt(float(np.mean(np.concatenate([r[s.used] for r, s in zip(residuals, stretches, strict=True)]) ** 2))),
        whitening,
        float(np.max(np.abs(covariance[1:]), initial=0.0) / covariance[0]) if covariance[0] > 0.0 else 0.0,
        _bound_of_white_noise(sum(map(len, white)), max(len(covariance) - 1, 1)),
        *_operating_point(final.problem, solution),
        residuals,
        averages,
        final.problem,
        solution,
    )
    _refuse(found)
    return found


def _check(stretches: Sequence[Stretch]) -> None:
    """Refuse what cannot tell, whatever the plant is.

    Raises:
        IdentificationError: it cannot.
    """
    if not stretches:
        raise IdentificationError("no samples: record a step of the setpoint, or of the effort")
    count = sum(len(stretch.time) for stretch in stretches)
    if count < LEAST_SAMPLES:
        raise IdentificationError(
            f"only {count} samples: record at least {LEAST_SAMPLES}, better some hundreds, over a step"
        )
    for stretch in stretches:
        if not (np.isfinite(stretch.output).all() and np.isfinite(stretch.effort).all()):
            raise IdentificationError("a sample is not finite: record again, or leave that stretch out")
    if all(np.ptp(stretch.effort) == 0.0 for stretch in stretches):
        raise IdentificationError(
            "the effort never moves, so nothing tells what it does: record a step of the setpoint, or of the effort "
            "by hand"
        )
    if all(np.ptp(stretch.output) == 0.0 for stretch in stretches):
        raise IdentificationError(
            "the output never moves: make the step larger, or check that this output is the one that the effort drives"
        )


def _fitted(stretches: Sequence[Stretch], structures: Sequence[Structure]) -> tuple[list[Fitted], np.ndarray, int]:
    """All structures' fits to all samples, the noise's model, and how many samples were averaged to search for them."""
    working, averages = _working(stretches)
    fits, whitening = fit_all(working, structures)
    if working is not stretches:
        fits, whitening = _on_all_samples(fits, stretches)
    return fits, whitening, averages


def _without_starts(stretches: Sequence[Stretch], dead_time: float) -> list[Stretch] | None:
    """The stretches without the dead time at the start of each that begins in the midst of things; None: none does.

    What the effort was before a record, nobody knows. If it is steady at first, it will have been so before; if
    not, the
    outputs that come from then tell nothing.
    """
    kept = []
    for stretch in stretches:
        first = stretch.time < min(dead_time + 2.0 * stretch.period, LONGEST_START * stretch.duration)
        moved = np.abs(stretch.effort[first] - stretch.effort[0]) > STEADY * np.ptp(stretch.effort)
        midst = not stretch.at_rest and dead_time > 0.0 and bool(moved.any())
        kept.append(replace(stretch, used=stretch.used & ~first) if midst else stretch)
    return kept if any(a is not b for a, b in zip(kept, stretches, strict=True)) else None


def _working(stretches: Sequence[Stretch]) -> tuple[Sequence[Stretch], int]:
    """What structures are compared on, all or averages or the liveliest part, and how many samples are averaged."""
    count = sum(len(stretch.time) for stretch in stretches)
    averages = max(1, count // WORKING)
    if averages == 1:
        return stretches, 1
    probes = [STRUCTURES["first_order"], STRUCTURES["second_order"], STRUCTURES["integrator"]]
    while True:
        working = [_liveliest(stretch.averaged(averages), WORKING // len(stretches)) for stretch in stretches]
        if averages == 1:
            return working, 1
        fits, _ = fit_all(working, probes)
        best = chosen(fits)
        point = best.solution.point
        time = point.dead_time + (best.structure.scale(point.shape) if best.structure.shape else 0.0)
        if time >= RESOLVED * working[0].period or best.structure.integrating:
            return working, averages
        averages = max(1, averages // 6)


def _liveliest(stretch: Stretch, samples: int) -> Stretch:
    """The part of so many samples in which the effort moves most."""
    if len(stretch.time) <= samples:
        return stretch
    moved = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(stretch.effort)))])
    first = int(np.argmax(moved[samples - 1 :] - moved[: len(moved) - samples + 1]))
    part = slice(first, first + samples)
    if first == 0:
        return replace(
            stretch,
            time=stretch.time[part],
            effort=stretch.effort[part],
            output=stretch.output[part],
            used=stretch.used[part],
        )
    return Stretch(
        stretch.time[part] - stretch.time[first],
        stretch.effort[part],
        stretch.output[part],
        False,
        float(stretch.effort[first - 1]),
        stretch.even,
        stretch.shift,
        stretch.used[part],
    )


def _on_all_samples(fits: Sequence[Fitted], stretches: Sequence[Stretch]) -> tuple[list[Fitted], np.ndarray]:
    """The fits made again to all samples, with the noise that all of them show: of a very long record the best ones."""
    count = sum(len(stretch.time) for stretch in stretches)
    likely = list(fits) if count <= ALL_STRUCTURES else list(fits[:FEW_STRUCTURES])
    if (simplest := chosen(fits)) not in likely:
        likely[-1] = simplest
    again = [_refitted(fit, stretches, NO_WHITENING) for fit in likely]
    best = min(again, key=lambda fit: fit.criterion)
    whitening = noise_model(best)
    if len(whitening):
        again = [_refitted(fit, stretches, whitening) for fit in again]
    return sorted(again, key=lambda fit: fit.criterion), whitening


def _refitted(fit: Fitted, stretches: Sequence[Stretch], whitening: np.ndarray) -> Fitted:
    """A fit made again on all samples, with its load steps if they still are worth it."""
    problem = Problem(fit.structure, stretches, (False,) * len(stretches), whitening)
    start = problem.unloaded()
    start = replace(start, shape=fit.solution.point.shape, dead_time=fit.solution.point.dead_time)
    solution = problem.refined(start, FULL_ITERATIONS, 1e-7)
    plain = Fitted(problem, solution, criterion(problem, solution))
    spans = zip(fit.problem.stretches, stretches, strict=True)
    if not any(fit.problem.loaded) or any(part.duration + 3.0 * part.period < all_.duration for part, all_ in spans):
        return plain
    problem = replace(problem, loaded=fit.problem.loaded)
    start = replace(start, load_time=fit.solution.point.load_time, load=fit.solution.point.load)
    solution = problem.refined(start, FULL_ITERATIONS, 1e-7)
    loaded = Fitted(problem, solution, criterion(problem, solution))
    return loaded if loaded.criterion < plain.criterion - WORTH else plain


def _with_floor(fit: Fitted, stretches: Sequence[Stretch]) -> Solution:
    """With residuals that are not below what the arithmetic gives."""
    return replace(fit.solution, rss=fit.solution.rss + ARITHMETIC * floor(stretches))


def _reason(fit: Fitted, fits: Sequence[Fitted]) -> str:
    others = [other for other in fits if other is not fit]
    text = f"{fit.structure.text}: "
    if not others:
        return text + "the only one asked for"
    simpler = [other for other in others if other.structure.parameters < fit.structure.parameters]
    richer = [other for other in others if other.structure.parameters > fit.structure.parameters]
    if richer:
        best = min(richer, key=lambda other: other.criterion)
        gained = fit.criterion - best.criterion
        if gained <= 0.0:
            text += "more parameters gain nothing in AICc"
        else:
            drifts = gained > WORTH and best.is_cancelled
            why = "by a slow pole that a zero cancels: drift, not the plant" if drifts else "which is not worth them"
            text += f"more parameters gain {gained:.1f} in AICc, {why}"
    if simpler:
        text += "; " if richer else ""
        text += f"fewer lose {min(other.criterion for other in simpler) - fit.criterion:.0f}"
    equal = [other for other in others if other.structure.parameters == fit.structure.parameters]
    if equal:
        text += f"; others with as many lose {min(other.criterion for other in equal) - fit.criterion:.0f}"
    return text


def _held_out_fit(problem: Problem, solution: Solution) -> float:
    """NRMSE fit in % over all samples, each predicted by a fit that has not used it."""
    misses, total = 0.0, 0.0
    for fold in range(FOLDS):
        halves = []
        for stretch in problem.stretches:
            block = np.arange(len(stretch.time)) * FOLD_BLOCKS // len(stretch.time)
            halves.append(replace(stretch, used=stretch.used & ((block % FOLDS != fold) | (block == 0))))
        half = replace(problem, stretches=halves)
        fitted = half.refined(solution.point, 4, 1e-6)
        for stretch, left, residual in zip(problem.stretches, halves, half.residuals(fitted), strict=True):
            out = stretch.used & ~left.used
            misses += float(np.sum(residual[out] ** 2))
            total += float(np.sum((stretch.output[out] - stretch.output[stretch.used].mean()) ** 2))
    return 100.0 * (1.0 - math.sqrt(misses / total)) if total > 0.0 else 0.0


def _whitened(residual: np.ndarray, whitening: np.ndarray) -> np.ndarray:
    lags = len(whitening)
    out = residual[lags:].copy()
    for lag, coefficient in enumerate(whitening, start=1):
        out -= coefficient * residual[lags - lag : len(residual) - lag]
    return out


def _bound_of_white_noise(count: int, lags: int) -> float:
    """What the largest of so many correlations, each of standard deviation 1/sqrt(count), stays below in 99 %."""
    return float(stats.norm.isf(0.5 * (1.0 - 0.99 ** (1.0 / lags)))) / math.sqrt(count)


def _operating_point(problem: Problem, solution: Solution) -> tuple[float, float]:
    """Output and effort at which the plant rests, at the first stretch's load."""
    stretch, level = problem.stretches[0], float(solution.level[0][0])
    if problem.structure.integrating:
        slope = level / stretch.duration
        gain = problem.structure.physical(solution.point.shape, 0.0, solution.numerator)["gain"]
        return float(stretch.output[0]), stretch.before - slope / gain
    if problem.structure.unstable:
        growth = math.exp(stretch.period / problem.structure.scale(solution.point.shape))
        level *= -1.0 / growth
    return level, stretch.before


def _refuse(found: Identified) -> None:
    """Refuse a model that the record does not tell.

    Raises:
        IdentificationError: it does not.
    """
    problem, solution = found.problem, found.solution
    stretches = problem.stretches
    period = min(stretch.period for stretch in stretches)
    duration = max(stretch.duration for stretch in stretches)
    numerators = problem.structure.numerators
    without = _without_effort(problem)
    freedom = max(solution.count - problem.structure.parameters - 2 * len(stretches), 1)
    gained = (without / (solution.rss + floor(stretches)) - 1.0) * freedom / (numerators + problem.structure.nonlinear)
    if gained <= stats.f.isf(SIGNIFICANCE, numerators + problem.structure.nonlinear, freedom):
        raise IdentificationError(
            "the output does not follow the effort: what it does is no more than noise; make the step larger, at "
            "least ten times the noise, or check that this effort drives this output"
        )
    time = solution.point.dead_time + (
        problem.structure.scale(solution.point.shape) if problem.structure.shape else 0.0
    )
    if problem.structure.shape and time < 0.5 * period:
        raise IdentificationError(
            f"the plant answers within one sample period ({period:.3g} s), so its time constant cannot be told: record "
            "faster, or check the unit of the stamps"
        )
    if solution.point.dead_time > 0.5 * duration:
        raise IdentificationError(
            f"the dead time would be {solution.point.dead_time:.3g} s of a record of {duration:.3g} s: record "
            "longer, with a step near the start"
        )
    not_noise = found.noise > NOT_NOISE * roughness([s.output for s in stretches]) + math.sqrt(10.0) * 1e-7 * max(
        float(np.ptp(s.output)) for s in stretches
    )
    if found.fit_percent < LEAST_FIT and not_noise:
        raise IdentificationError(
            f"no structure explains the record: {found.structure.text}, the best, predicts data not used to "
            f"{found.fit_percent:.0f} %, and the rest is no noise; record smaller steps about one operating point, "
            "with the load constant, or check that this effort drives this output"
        )
    for name, text in (
        ("gain", "gain"),
        *((n, n.replace("_", " ")) for n in ("time_constant", "time_constant_1", "natural_period")),
    ):
        interval = found.parameters.get(name)
        if interval is not None and interval.relative > LOOSEST:
            raise IdentificationError(
                f"the record does not tell the {text}: 95 % of what fits lies between {interval.low:.3g} and "
                f"{interval.high:.3g}; record a larger step, several steps, or longer, until the output has settled"
            )
    dead_time = found.parameters["dead_time"]
    if dead_time.high - dead_time.value > LOOSEST * (dead_time.value + _total_time(found.values)):
        raise IdentificationError(
            f"the record does not tell the dead time: it may be {dead_time.low:.3g} to {dead_time.high:.3g} s; "
            "record a larger or more sudden step"
        )


def _total_time(values: Mapping[str, float]) -> float:
    names = ("time_constant", "time_constant_1", "time_constant_2", "natural_period")
    total = sum(values.get(name, 0.0) for name in names)
    return total or math.inf


def _without_effort(problem: Problem) -> float:
    """The residual sum of squares, whitened, of levels and ramps alone."""
    rss = 0.0
    for stretch in problem.stretches:
        columns = [np.ones(len(stretch.time)), stretch.time / stretch.duration, stretch.output]
        white = [_whitened(column, problem.whitening) for column in columns]
        used = stretch.used[len(problem.whitening) :]
        design, output = np.stack(white[:2], 1)[used], white[2][used]
        left = output - design @ np.linalg.lstsq(design, output, rcond=None)[0]
        rss += float(left @ left)
    return rss
