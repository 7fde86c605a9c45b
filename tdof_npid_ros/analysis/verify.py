"""replayed = recorded: every control effort of a bag, computed again from what the controller was given, is the
recorded one, bit for bit.

The answers are taken in the controller's order, each with the output that it names by stamp and episode, the
setpoint that it bears, and the parameters whose digest it bears. They go through the same `Session` as in the
controller node.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tdof_npid_ros.analysis.errors import AnalysisError
from tdof_npid_ros.analysis.loops import recorded_loops
from tdof_npid_ros.analysis.parameters import Configuration, configurations
from tdof_npid_ros.analysis.recording import Loop
from tdof_npid_ros.bag.reader import BagReader
from tdof_npid_ros.control.controller import Controller
from tdof_npid_ros.control.joints import Joints
from tdof_npid_ros.control.law import TERMS
from tdof_npid_ros.control.session import Judgement, Place, Session, is_at_beginning
from tdof_npid_ros.wire import AnswerLabel, EpisodeLabel

# Why an answer cannot be verified.
NO_PARAMETERS = "the parameters that they bear the digest of are not in the bag"
NO_OUTPUT = "the outputs that they answer are not in the bag"
UNKNOWN_STATE = "the controller's state is not known: the bag lacks earlier answers of the episode"
OTHER_LANES = "their length is not that of the gains"


@dataclass(frozen=True)
class Difference:
    """An answer that is not what its inputs give.

    Attributes:
        what: `control effort`, or `setpoint` for one that is not the plan's.
        step: index of the answer in the topic.
        inputs: what went in, by name, for people.
        recorded, expected: (lanes,).
    """

    what: str
    topic: str
    step: int
    stamp_ns: int
    episode: str
    inputs: Mapping[str, Any]
    recorded: tuple[float, ...]
    expected: tuple[float, ...]

    def lines(self) -> list[str]:
        """The difference for people, numbers in full."""
        place = (
            f"{self.topic}, message {self.step}, at {self.stamp_ns / 1e9:.9g} s of {self.episode or 'the recording'}"
        )
        return [
            f"first difference: {self.what} in {place}",
            *(f"  {name:22} {value}" for name, value in self.inputs.items()),
            f"  {'recorded':22} {_numbers(self.recorded)}",
            f"  {'expected':22} {_numbers(self.expected)}",
        ]


@dataclass
class Verification:
    """The account of one bag.

    Attributes:
        equal, different: answers that were computed again.
        unverifiable: answers that could not be, by reason.
        missing: what a bag that was cut off lacks, a line for each thing.
        first: the first difference.
    """

    bag: str
    missing: tuple[str, ...] = ()
    equal: int = 0
    different: int = 0
    unverifiable: Counter[str] = field(default_factory=Counter)
    first: Difference | None = None

    @property
    def sound(self) -> bool:
        """Whether something was verified and all of it is equal."""
        return self.equal > 0 and self.different == 0

    def lines(self) -> list[str]:
        """The account for people."""
        found = [f"{self.bag}: {self.equal} control efforts verified bit for bit, {self.different} differ"]
        found += [f"  {count} not verifiable: {reason}" for reason, count in self.unverifiable.items()]
        if not self.equal and not self.different:
            found.append("  nothing was verified")
        found += [f"  missing: {line}" for line in self.missing]
        return [*found, *(self.first.lines() if self.first else [])]


def verify(path: str | Path) -> Verification:
    """Compute every control effort of a bag again.

    Raises:
        AnalysisError: there are no control efforts in it.
        BagError: no bag, or it is damaged.
    """
    with BagReader(path) as reader:
        loops = [loop for loop in recorded_loops(reader, str(path)) if loop.control_effort is not None]
        missing = tuple(reader.missing)
    if not loops:
        raise AnalysisError(f"{path}: no control efforts in it to verify: record the controller's namespace")
    account = Verification(str(path), missing)
    for loop in loops:
        _Replay(loop, account).run()
    return account


class _Answer(NamedTuple):
    """One recorded answer, and the output that it answers; `output` is -1 when that is not in the bag."""

    step: int
    stamp_ns: int
    digest: str
    episode: EpisodeLabel | None
    output: int
    new_publisher: bool  # the controller was activated before this answer
    follows: bool  # no answer is missing between this one and the one before


class _Replay:
    """A controller that is fed from a bag."""

    def __init__(self, loop: Loop, account: Verification) -> None:
        assert loop.control_effort is not None
        self._loop = loop
        self._answers = loop.control_effort
        self._account = account
        self._topic = f"{loop.namespace}control_effort"
        self._configurations = configurations(loop.histories)
        self._session: Session | None = None
        self._known = False  # whether the controller's state is that of the recorded one

    def run(self) -> None:
        """Take every answer of the loop, in order."""
        setpoints, efforts = self._answers.position, self._answers.effort
        for answer in _answers(self._loop):
            self._take(answer, self._output(answer), setpoints[answer.step], efforts[answer.step])

    def _output(self, answer: _Answer) -> np.ndarray | None:
        return None if answer.output < 0 else self._picked(answer, self._loop.output.position[answer.output])

    def _picked(self, answer: _Answer, field: np.ndarray) -> np.ndarray:
        """The lanes' values in a field of an output, by the joints that the answer names."""
        wanted, names = self._answers.name[answer.step], self._loop.output.name[answer.output]
        if not len(wanted) or not set(wanted) <= set(names) or len(field) != len(names):
            return field
        there = list(names)
        return np.array([field[there.index(name)] for name in wanted])

    def _take(self, answer: _Answer, y: np.ndarray | None, r: np.ndarray, u: np.ndarray) -> None:
        place = Place(answer.episode, answer.stamp_ns)
        configuration = self._configurations.get(answer.digest)
        reason = self._obstacle(configuration, y, r)
        self._known = self._known and answer.follows
        if self._session is not None and answer.new_publisher:
            self._session.begin()
        if reason is not None:
            self._known = False
            self._account.unverifiable[reason] += 1
            if self._session is not None:
                self._session.pass_over(place)
            return
        assert configuration is not None and y is not None
        expected = self._answer_again(self._session_with(configuration), answer, place, y, r)
        if not self._known:
            self._account.unverifiable[UNKNOWN_STATE] += 1
        elif expected.tobytes() != u.tobytes():
            self._differs("control effort", answer, y, r, u, expected)
        elif (planned := self._planned(answer, len(r))) is not None and planned.tobytes() != r.tobytes():
            self._differs("setpoint", answer, y, r, r, planned)
        else:
            self._account.equal += 1

    @staticmethod
    def _obstacle(configuration: Configuration | None, y: np.ndarray | None, r: np.ndarray) -> str | None:
        if configuration is None:
            return NO_PARAMETERS
        if y is None:
            return NO_OUTPUT
        lanes = configuration.gains.lanes
        return OTHER_LANES if len(y) != lanes or len(r) != lanes else None

    def _session_with(self, configuration: Configuration) -> Session:
        """The session, its controller with these parameters."""
        gains, options, period_ns = configuration
        session = self._session
        if session is None:
            session = self._session = Session(Controller(gains, period_ns, options), Joints(()))
        elif session.controller.sample_period_ns != period_ns:
            session.controller = Controller(gains, period_ns, options)
        elif (session.controller.gains, session.controller.options) != (gains, options):
            session.controller.change(gains, options)
        return session

    def _answer_again(
        self, session: Session, answer: _Answer, place: Place, y: np.ndarray, r: np.ndarray
    ) -> np.ndarray:
        """The answer as the controller's session gives it; notes whether its state is that of the recorded one."""
        lanes = session.controller.lanes
        told = self._answers.velocity[answer.step]
        applied = self._picked(answer, self._loop.output.effort[answer.output])
        reported = applied.copy() if len(applied) == lanes and np.isfinite(applied).all() else None
        if answer.episode is not None and answer.episode.plan in self._loop.plans:
            session.plan = self._loop.plans[answer.episode.plan]
        judgement = session.retake(place, r, y, reported, told if len(told) == lanes else None)
        self._known = self._known or self._begins(judgement, answer, place)
        assert session.answer is not None
        return session.answer.effort

    @staticmethod
    def _begins(judgement: Judgement, answer: _Answer, place: Place) -> bool:
        """Whether the controller's state is known from here on, whatever it was before."""
        if judgement.decision == "start":
            return is_at_beginning(place) or answer.new_publisher or (answer.step > 0 and answer.follows)
        return judgement.decision == "join"

    def _planned(self, answer: _Answer, lanes: int) -> np.ndarray | None:
        """The plan's setpoint, (lanes,); None where there is no plan."""
        plan = self._loop.plans.get(answer.episode.plan) if answer.episode is not None else None
        if plan is None:
            return None
        return np.full(lanes, plan.value_at("setpoint", answer.stamp_ns))

    def _differs(
        self, what: str, answer: _Answer, y: np.ndarray, r: np.ndarray, recorded: np.ndarray, expected: np.ndarray
    ) -> None:
        self._account.different += 1
        if self._account.first is not None:
            return
        assert self._session is not None
        controller = self._session.controller
        inputs: dict[str, Any] = {"setpoint": _numbers(r), "output": _numbers(y), "parameters": answer.digest}
        inputs |= controller.gains.as_dict() | controller.options.as_dict()
        inputs |= {term: _numbers(row) for term, row in zip(TERMS, controller.terms, strict=True)}
        self._account.first = Difference(
            what,
            self._topic,
            answer.step,
            answer.stamp_ns,
            str(answer.episode or ""),
            inputs,
            tuple(recorded.tolist()),
            tuple(expected.tolist()),
        )


def _answers(loop: Loop) -> Iterator[_Answer]:
    """The recorded answers in order, each with its output: the next one of that stamp and episode."""
    answers = loop.control_effort
    assert answers is not None
    outputs = loop.output
    places: dict[Place, list[int]] = defaultdict(list)  # of the outputs, latest first
    for run in reversed(outputs.runs()):
        episode = EpisodeLabel.parse(str(outputs.frame_id[run.start]))
        for i in reversed(range(run.start, run.stop)):
            places[Place(episode, int(outputs.stamp_ns[i]))].append(i)
    latest = before = 0
    for step, (frame, stamp, sequence) in enumerate(
        zip(answers.frame_id.tolist(), answers.stamp_ns.tolist(), answers.sequence.tolist(), strict=True)
    ):
        digest, label = AnswerLabel.parse(frame)
        candidates = places.get(Place(label, stamp), [])
        while candidates and candidates[-1] < latest:
            candidates.pop()
        if candidates:
            latest = candidates[-1]
        new_publisher = sequence == 1 and (step == 0 or before > 0)
        follows = not sequence or sequence == before + 1
        yield _Answer(step, stamp, digest, label, latest if candidates else -1, new_publisher, follows)
        before = sequence


def _numbers(values: Any) -> str:
    return ", ".join(float(value).hex() + f" ({float(value)!r})" for value in values)
