"""What tuning through a live loop computes: integrals from the outputs that arrive, and which loop runs what.

It knows no ROS. A loop is anything that runs an episode with one lane per candidate and gives their integrals.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from tdof_npid_ros.case import EPISODES
from tdof_npid_ros.loop import LARGEST_OUTPUT, Integrals
from tdof_npid_ros.scenario import SampledPlan
from tdof_npid_ros.tuning.ask_tell import Array
from tdof_npid_ros.wire import EpisodeLabel

Indices = NDArray[np.intp]


class LoopLostError(RuntimeError):
    """A loop that does not answer, or not as it should; the message says what was waited for."""


class LiveLoop(Protocol):
    """A loop that evaluates candidates."""

    def run_episode(self, episode: str, candidates: Array) -> Integrals:
        """Integrals, (n,), of an episode with one lane for each of the candidates (n, gains).

        Raises:
            LoopLostError: the loop stopped answering; nothing of the episode counts.
        """
        ...


L = TypeVar("L", bound=LiveLoop)


def integrals_of(signals: SampledPlan, output: Array) -> Integrals:
    """The integrals of an episode from its outputs (steps + 1, lanes): the same bits as `loop.integrals`."""
    error = np.abs(signals.setpoint[:, None] - output)
    sums = np.cumsum(signals.weight[:, None] * error, axis=0)  # in the order of time
    finite = np.count_nonzero(np.abs(output) < LARGEST_OUTPUT, axis=0)
    early, late, largest = np.zeros((3, output.shape[1]))
    if signals.rest is not None:
        first, middle = signals.rest
        early, late = sums[middle - 1] - sums[first - 1], sums[-1] - sums[middle - 1]
        largest = np.fmax.reduce(error[middle:], axis=0, initial=0.0)
    h = signals.sample_period_ns / 1e9
    return Integrals(sums[-1] * h, finite / (signals.steps + 1), early * h, late * h, largest)


class EpisodeOutputs:
    """Collects the outputs of one episode.

    Of several episodes of the plan the latest counts: a plan that arrives once more starts it over.

    Attributes:
        received: how many different outputs of the latest episode have come.
        cut: the episode cannot become complete any more: another one began, or outputs are missing.
    """

    def __init__(self, digest: str, signals: SampledPlan, lanes: int) -> None:
        self._digest, self._signals, self._lanes = digest, signals, lanes
        self._output = np.empty((signals.steps + 1, lanes))
        self._seen = bytearray(signals.steps + 1)
        self._label: EpisodeLabel | None = None
        self._started: EpisodeLabel | None = None
        self.received = 0
        self.cut = False

    def started(self, label: EpisodeLabel) -> None:
        """The loop says that the episode has begun, and its label: earlier ones do not count."""
        self._started = label

    @property
    def complete(self) -> bool:
        """Whether every output has come, of an episode that counts."""
        whole = self.received > self._signals.steps
        return whole and self._started is not None and self._label is not None and self._counts(self._label)

    @property
    def integrals(self) -> Integrals:
        """Of the complete episode."""
        return integrals_of(self._signals, self._output)

    def take(self, label: EpisodeLabel | None, stamp_ns: int, output: Array) -> None:
        """Take the output (lanes,) of an episode's label and a stamp."""
        if label != self._label and not self._changed_to(label, len(output)):
            return
        step = stamp_ns // self._signals.sample_period_ns
        if len(output) != self._lanes or step > self._signals.steps or self._seen[step]:
            return
        self._output[step] = output
        self._seen[step] = 1
        self.received += 1
        if step == self._signals.steps and self.received <= step:
            self.cut = True

    def _counts(self, label: EpisodeLabel) -> bool:
        """Whether this is the episode that was started, or a later one of the plant's activation."""
        return self._started is not None and (label == self._started or label.follows(self._started))

    def _changed_to(self, label: EpisodeLabel | None, lanes: int) -> bool:
        """Whether outputs of this episode are to be taken from now on."""
        if label is None:
            return False
        if label.plan != self._digest:
            self.cut = self.cut or self._counts(label)
            return False
        now = self._label
        earlier = now is not None and now.activation == label.activation and not label.follows(now)
        if earlier or lanes != self._lanes:
            return False
        self._label = label
        self._seen = bytearray(self._signals.steps + 1)
        self.received = 0
        return True


def work_of_loops(waiting: Mapping[str, Indices], loops: int) -> list[list[tuple[str, Indices]]]:
    """What each of `loops` loops is to run: episodes, each with the candidates that still wait for it.

    An episode takes nearly as long with one lane as with many, so loops are given different episodes first, and only
    then parts of the same one.
    """
    given: list[list[tuple[str, Indices]]] = [[] for _ in range(loops)]
    episodes = [(episode, candidates) for episode, candidates in waiting.items() if candidates.size]
    for i, (episode, candidates) in enumerate(episodes):
        takers = list(range(i, loops, len(episodes))) or [i % loops]
        for taker, part in zip(takers, np.array_split(candidates, len(takers)), strict=True):
            if part.size:
                given[taker].append((episode, part))
    return given


def measure(
    candidates: Array, usable_loops: Callable[[], Sequence[L]], lost: Callable[[L, LoopLostError], None]
) -> tuple[Integrals, Integrals]:
    """Integrals of both episodes for all candidates (n, gains), by all usable loops at once.

    What a loop leaves undone the others do; the outcome does not depend on who does what.

    Args:
        usable_loops: the loops to use now, at least one; called again when one was lost.
        lost: told which loop was lost, and why.
    """
    results = {episode: Integrals(*np.empty((5, len(candidates)))) for episode in EPISODES}
    done = {episode: np.zeros(len(candidates), dtype=bool) for episode in EPISODES}

    def work(loop: L, portion: list[tuple[str, Indices]]) -> None:
        for episode, part in portion:
            measured = loop.run_episode(episode, candidates[part])
            results[episode].put(part, measured)
            done[episode][part] = True

    while not all(finished.all() for finished in done.values()):
        loops = usable_loops()
        waiting = {episode: np.flatnonzero(~finished) for episode, finished in done.items()}
        given = work_of_loops(waiting, len(loops))
        with ThreadPoolExecutor(len(loops)) as pool:
            running = [(loop, pool.submit(work, loop, s)) for loop, s in zip(loops, given, strict=True)]
        for loop, outcome in running:
            try:
                outcome.result()
            except LoopLostError as error:
                lost(loop, error)
    setpoint, disturbance = (results[episode] for episode in EPISODES)
    return setpoint, disturbance
