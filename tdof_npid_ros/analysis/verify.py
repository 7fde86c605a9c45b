"""replayed = recorded: every control effort of a bag, computed again from what the controller was given, is the
recorded one, bit for bit.

The answers are taken in the controller's order, each with the output that it names by stamp and episode, the
setpoint that it bears, and the parameters whose digest it bears. They go through the same `Session` as in the
controller node.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tdof_npid_ros.analysis.account import Difference, Verification, numbers
from tdof_npid_ros.analysis.errors import AnalysisError
from tdof_npid_ros.analysis.loops import recorded_loops
from tdof_npid_ros.analysis.parameters import Configuration, configurations
from tdof_npid_ros.analysis.recording import Loop
from tdof_npid_ros.analysis.sources import NOTHING_CHOSEN, Chosen
from tdof_npid_ros.analysis.tracks import NAMED_LANE
from tdof_npid_ros.analysis.verify_messages import check_messages
from tdof_npid_ros.analysis.verify_plant import check_outputs
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
NO_PLAN = "their plan is not in the bag, so the setpoint that they bear is not checked"
OTHER_NAMES = "they bear other names than the controller gives them"


def verify(path: str | Path, chosen: Chosen = NOTHING_CHOSEN, law_only: bool = False) -> Verification:
    """Compute every control effort of a bag again, and check what else can be known of the loop.

    Args:
        chosen: topics of output and control effort, where they are not called so.
        law_only: check the efforts alone, against the law: nothing of plan and plant.

    Raises:
        AnalysisError: there are no control efforts in it.
        BagError: no bag, or it is damaged.
    """
    with BagReader(path) as reader:
        loops = [loop for loop in recorded_loops(reader, str(path), chosen) if loop.control_effort is not None]
        account = Verification(str(path), tuple(reader.missing))
        if not loops:
            raise AnalysisError(
                f"{path}: no control efforts in it to verify: record the controller's namespace, or name their topic "
                "with --effort"
            )
        for loop in loops:
            replay = _Replay(loop, account, law_only)
            replay.run()
            if not law_only:
                check_outputs(loop, account)
                check_messages(reader, loop, replay.terms, replay.unverified, account)
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

    def __init__(self, loop: Loop, account: Verification, law_only: bool) -> None:
        assert loop.control_effort is not None
        self._law_only = law_only
        self.terms: dict[int, list[np.ndarray]] = defaultdict(list)  # of the verified answers, by stamp
        self.unverified: Counter[int] = Counter()  # the other answers, by stamp
        self._noted: Place | None = None  # whose terms were noted last
        self._loop = loop
        self._answers = loop.control_effort
        self._account = account
        self._topic = loop.effort_topic
        self._configurations = configurations(loop.histories)
        self._session: Session | None = None
        self._passed_over: Place | None = None  # the latest answer that could not be computed again
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
            self.unverified[answer.stamp_ns] += 1
            self._passed_over = place
            if self._session is not None:
                self._session.pass_over(place)
            return
        assert configuration is not None and y is not None
        expected = self._answer_again(self._session_with(configuration), answer, place, y, r)
        if not self._known:
            self._account.unverifiable[UNKNOWN_STATE] += 1
            self.unverified[answer.stamp_ns] += 1
            return
        assert self._session is not None
        self._note_terms(place, self._session.controller.terms)
        planned = None if self._law_only else self._planned(answer, len(r))
        if expected.tobytes() != u.tobytes():
            self._differs("control effort", answer, y, r, u, expected)
        elif planned is not None and planned.tobytes() != r.tobytes():
            self._differs("setpoint", answer, y, r, r, planned)
        elif planned is None and not self._law_only and answer.episode is not None and answer.episode.plan:
            self._account.unverifiable[NO_PLAN] += 1
        elif not self._law_only and (wrong := self._wrong_names(answer, len(r))):
            self._account.unverifiable[wrong] += 1
        else:
            self._account.equal += 1

    def _note_terms(self, place: Place, terms: np.ndarray) -> None:
        """Of an answer that is given again, the controller publishes the terms once."""
        noted = self.terms[place.stamp_ns]
        if place != self._noted or terms.tobytes() != noted[-1].tobytes():
            noted.append(terms.copy())
        self._noted = place

    def _wrong_names(self, answer: _Answer, lanes: int) -> str:
        """Why an answer to our plant bears other names than its controller gives; empty if it does not."""
        if answer.episode is None or self._loop.controller is None:
            return ""
        values = self._loop.controller.at(int(self._answers.publish_ns[answer.step]))
        given = [name for name in values.get("joint_names", ()) if name]
        names = [str(name) for name in self._answers.name[answer.step]]
        allowed: tuple[list[str], ...] = ([], given or [f"{NAMED_LANE}{lane}" for lane in range(lanes)])
        return "" if names in allowed else OTHER_NAMES

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
            if self._passed_over is not None:  # the loop had begun before: this answer is no start
                session.pass_over(self._passed_over)
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
        inputs: dict[str, Any] = {
            "setpoint": numbers(r.tolist()),
            "output": numbers(y.tolist()),
            "parameters": answer.digest,
        }
        inputs |= controller.gains.as_dict() | controller.options.as_dict()
        inputs |= {term: numbers(row.tolist()) for term, row in zip(TERMS, controller.terms, strict=True)}
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
