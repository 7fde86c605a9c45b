"""What scripts and notebooks call, beside `load_case`, `margins` and `certify`: simulate, sweep, tune, read a bag."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from tdof_npid_ros.bag.reader import BagReader
from tdof_npid_ros.case import Case
from tdof_npid_ros.control.gains import PER_LANE, ControllerType, Gains, GainsError
from tdof_npid_ros.loop import Trajectory
from tdof_npid_ros.robustness.result import RobustResult, sweep_plants
from tdof_npid_ros.robustness.spread import Sampling, spreads_of
from tdof_npid_ros.tuning.judge import Constraints
from tdof_npid_ros.tuning.problem import TuningProblem
from tdof_npid_ros.tuning.study import TuningResult, tune_case
from tdof_npid_ros.workers import workers


def simulate(case: Case, episode: str, gains: Gains | None = None) -> Trajectory:
    """Run an episode of a case in process.

    Args:
        case: from `load_case` or `make_case`.
        episode: its name.
        gains: for one lane or many; None: the case's.

    Returns:
        `time`, `setpoint`, `disturbance`, (steps + 1,); `output`, `control_effort`, (steps + 1, lanes). Times in s.

    Raises:
        PlanError: the case has no such episode.

    Example:
        >>> from tdof_npid_ros import load_case, simulate
        >>> response = simulate(load_case("p1-c0.5"), "setpoint")
        >>> response.output.shape
        (5001, 1)
    """
    return case.simulate(episode, gains)


def sweep(case: Case, episode: str, **values: Sequence[float]) -> Trajectory:
    """Run an episode with many gains at once, one lane for each.

    Args:
        case: from `load_case` or `make_case`.
        episode: its name.
        values: numbers for one gain or more (kp, ki, kd, alpha, beta, sigma), all of one length.

    Returns:
        As `simulate`; lane j has the j-th number of each gain.

    Raises:
        GainsError: a name is no gain, or the lengths differ.

    Example:
        >>> from tdof_npid_ros import load_case, sweep
        >>> import numpy as np
        >>> response = sweep(load_case("p1-c0.5"), "setpoint", kp=np.linspace(5, 12, 100))
        >>> response.output.shape
        (5001, 100)
    """
    unknown = [name for name in values if name not in PER_LANE]
    if unknown:
        raise GainsError(f"{', '.join(unknown)} cannot be swept: these can: {', '.join(PER_LANE)}")
    lengths = {name: len(numbers) for name, numbers in values.items()}
    if not values or len(set(lengths.values())) > 1:
        raise GainsError(f"a sweep needs as many numbers for each gain, at least one: there are {lengths or 'none'}")
    lanes = {name: tuple(map(float, numbers)) for name, numbers in values.items()}
    return case.simulate(episode, case.gains.with_values(**lanes))


def tune(
    case: Case,
    controller: ControllerType | None = None,
    *,
    seed: int = 0,
    weight: float | None = None,
    **options: Any,
) -> TuningResult:
    """Find the gains with the least IAE_SP + weight · IAE_DIS, equation (10), by the hybrid genetic algorithm, from
    random ones, as `tdof-npid tune --cold`.

    What the case asks its tuner for holds here, too: its weight, margins (`ms`, …) and what it frees.

    Args:
        case: with the episodes `setpoint` and `disturbance`, and bounds.
        controller: pid, npid, tdof_npid1 or tdof_npid2; None: the case's.
        seed: the same seed gives the same result, bit for bit.
        weight: None: the case's.
        options: margins that the loop must have, in place of the case's (ms, mt, gain_margin, phase_margin in degrees,
            delay_margin in s), and those of `tdof_npid_ros.tuning.study.tune_case`: population, generations,
            extra=("sigma",) to free sigma, …

    Returns:
        `gains`, `objective`, `evaluations`, `improvements`; `feasible`: whether the loop has these margins.

    Raises:
        TuningError: a bound is missing, or an option is wrong.

    Example:
        >>> from tdof_npid_ros import load_case, tune
        >>> case = load_case("p3-c1")
        >>> before = case.setpoint_response().iae + case.disturbance_response().iae
        >>> tune(case, seed=1).objective < before
        True
    """
    if weight is not None:
        case = replace(case, weight=weight)
    controller = controller or case.gains.type
    asked = TuningProblem.of_case(case, controller)
    given = {field.name: options.pop(field.name) for field in fields(Constraints) if field.name in options}
    how: dict[str, Any] = {"extra": asked.extra, "constraints": replace(asked.constraints, **given), **options}
    return tune_case(case, controller, seed=seed, **how)


def robust(
    case: Case,
    spreads: Sequence[str],
    *,
    gains: Gains | None = None,
    samples: int = 10_000,
    sampling: Sampling = "uniform",
    seed: int = 0,
    scheduler: str | None = None,
) -> RobustResult:
    """What gains achieve on many plants near a case's: how many are unstable, quantiles, sensitivities, the worst.

    Args:
        case: with the episodes `setpoint` and `disturbance`.
        spreads: of the plant's parameters: `gain 20 %` (of the value), `gain 0.1` (in its unit, both ways), or
            `gain 0.8 .. 1.3`.
        gains: of one lane; None: the case's.
        samples: how many plants.
        sampling: uniform, latin, normal or corners.
        seed: the same seed gives the same plants.
        scheduler: of a Dask cluster, address or file; None: threads on all cores. The result is the same.

    Returns:
        `unstable`, (plants,), `values`, (plants, spreads), `metrics`, (plants,) each by name; `unstable_fraction`,
        `quantile(metric, fraction)`, `sensitivity(metric)`, `worst()`, `as_dict()`.

    Raises:
        RobustError, PlantError: a spread is none, or reaches a plant that cannot be.

    Example:
        >>> from tdof_npid_ros import load_case, robust
        >>> result = robust(load_case("p3-c1"), ["gain 30 %", "time_constant 20 %"], samples=64, sampling="latin")
        >>> 0.0 < result.unstable_fraction < 0.2
        True
    """
    its = spreads_of(case, spreads, sampling)
    with workers(scheduler) as here:
        return sweep_plants(here, case, gains or case.gains, its, count=samples, sampling=sampling, seed=seed)


class Bag:
    """A bag that is open: its topics, their fields as columns, as NumPy arrays or as a pandas DataFrame.

    Attributes:
        topics: type and number of messages, by topic.
    """

    def __init__(self, path: str | Path) -> None:
        self._reader = BagReader(Path(path))
        self.topics = {name: (info.type, info.count) for name, info in sorted(self._reader.topics.items())}

    def columns(self, topic: str, fields: Sequence[str]) -> dict[str, np.ndarray]:
        """Fields of a topic's messages by name, as `header.stamp` (ns), `position`, `effort`; and `publish_time` (ns).

        An array field of one length is (messages, length), else (messages,) of arrays.

        Raises:
            BagError: there is no such topic or field, or the bag is damaged.
        """
        return dict(self._reader.columns(topic, list(fields)))

    def to_pandas(self, topic: str, fields: Sequence[str]) -> Any:
        """The same as a DataFrame; an array field becomes columns `position[0]`, `position[1]`, …

        Raises:
            ImportError: pandas is not installed.
            BagError: as `columns`.
        """
        import pandas

        flat: dict[str, np.ndarray] = {}
        for name, column in self.columns(topic, fields).items():
            if column.ndim == 2:
                flat |= {f"{name}[{i}]": column[:, i] for i in range(column.shape[1])}
            else:
                flat[name] = column
        return pandas.DataFrame(flat)

    def close(self) -> None:
        """Let go of the files."""
        self._reader.close()

    def __enter__(self) -> Bag:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def read_bag(path: str | Path) -> Bag:
    """Open a bag: a rosbag2 folder (MCAP or SQLite), or a lone .mcap or .db3 file.

    Raises:
        BagError: there is none, or it is damaged.

    Example:
        >>> from tdof_npid_ros import read_bag
        >>> with read_bag("bags/sample") as bag:
        ...     columns = bag.columns("/output", ["header.stamp", "position"])
        >>> columns["position"].shape[1]
        1
    """
    return Bag(path)
