"""What a controller decides about each output that arrives, and what it answers. It knows no ROS.

The controller node hands every output to `Session.take`, `verify` every recorded answer to `Session.retake`; both go
through the same decisions about where a loop begins, so what the one computed the other finds again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple

import numpy as np

from tdof_npid_ros.control.controller import Controller, rest_setpoint
from tdof_npid_ros.control.gains import LARGEST_SIGNAL
from tdof_npid_ros.control.guard import Guard
from tdof_npid_ros.control.joints import Joints, fault_of, name_joints
from tdof_npid_ros.scenario import Plan
from tdof_npid_ros.wire import NO_VALUES, AnswerLabel, EpisodeLabel, Sample

FAR_NS = 1_000_000_000  # a stamp that far back, or ahead of the time that has passed, is another clock's
IN_A_ROW = 3  # outputs that do not belong to the loop, but follow each other: the loop has changed over to them
FAR_IN_SIGMA = 3.0  # k(3 sigma) = 0.011: beyond it the integral action is as good as dead
RATE_WINDOW = 50  # outputs over which their rate is measured
RATE_TOLERANCE = 0.2  # of the sample period
STUCK_OUTPUTS = 10  # with one stamp
REMEMBERED = 100  # activations of plants whose labels are known to be no new ones

Decision = Literal[
    "start",  # answered, from rest: the label is new
    "join",  # answered, beginning within a loop that runs
    "new",  # answered, going on
    "same",  # answered again as before
    "waiting",  # its plan is on the way
    "late",  # not answered: it is older than the latest
    "refused",  # not answered: see why
]

UNLABELLED = "output refused: it bears no label, but the loop that runs is that of a plant which labels its outputs"
IN_LOCKSTEP = "; deactivate and activate the controller to drive something else"
UNTIL_SILENT = "; it is taken once the plant has been silent for output_timeout"
UNSTAMPED = "output refused: it has no stamp, but those before it have"
NOT_STAMPED_ANEW = "output refused: it has changed, but its stamp has not"
STAMP_IT = "; stamp each message"
FAR_AHEAD = "output refused: its stamp is far ahead of the one before"
OTHER_EPISODE = "output refused: it is of an episode that another has followed"
IF_MORE_FOLLOW = f"; {IN_A_ROW} such in a row are taken"
OUT_OF_STEP = "plant and controller differ in sample_period: give both the same"
OFF_RATE = "outputs come at another rate than sample_period: set that to the time between two outputs"
STUCK = "outputs come, but with the same stamp again and again: stamp each message"


class Place(NamedTuple):
    """Where an output stands: whose it is, and its stamp. `label` is None for a robot's, or anybody's."""

    label: EpisodeLabel | None
    stamp_ns: int


class Judgement(NamedTuple):
    """A decision; where it is `refused`, why (for the log, once) and what to do."""

    decision: Decision
    why: str = ""
    what_to_do: str = ""


START, JOIN, NEW = Judgement("start"), Judgement("join"), Judgement("new")
SAME, LATE = Judgement("same"), Judgement("late")


def is_at_beginning(place: Place) -> bool:
    """Whether the stamp alone says that a controller which comes upon this output comes at the beginning.

    In lockstep the stamp 0 does, which only the first output of an episode has. In recordings of before 2027, realtime
    began with 0, too, and a controller may have missed some outputs by then.
    """
    return place.stamp_ns == 0 or (not (place.label and place.label.plan) and place.stamp_ns < FAR_NS)


class OutputSequence:
    """The outputs that one controller answers, in order: which of them begins, continues or disturbs the loop.

    A loop of our plant begins with a label that is new. (A replay of it begins with that output once more.) What the
    controller comes upon in the middle it joins. Which of the two the first output of all is, nothing before it can
    tell: in lockstep its stamp does; in realtime the loop begins here if nobody drives the plant yet. An output that
    bears no label never begins anything, nor does it come between the outputs of a plant that labels them.

    Args:
        sample_period_ns: of the loop.

    Attributes:
        latest: the output that was answered last; None before the first one.
    """

    def __init__(self, sample_period_ns: int) -> None:
        self.latest: Place | None = None
        self._began: Place | None = None  # the output with which the loop began, from rest
        self._far_ns = max(FAR_NS, IN_A_ROW * sample_period_ns)
        self._known: dict[str, EpisodeLabel] = {}  # the latest label of each activation
        self._astray: Place | None = None
        self._in_a_row = 0

    def judge(
        self, place: Place, silent: bool = False, elapsed_ns: int = 0, driven: Callable[[], bool] = lambda: True
    ) -> Judgement:
        """Decide about an output.

        Args:
            place: the output's.
            silent: the loop has stood still: whoever comes now may go on with it.
            elapsed_ns: since the latest output that was answered came.
            driven: whether there is an effort, or an integral action, to go on from.
        """
        latest = self.latest
        if place == latest:
            return SAME
        if place.label is not None and self._is_start(place, driven):
            self._began = place
            return START
        if latest is None or (silent and self._may_take_over(latest, place)):
            return JOIN
        if place.label != latest.label:
            return self._of_another(latest, place)
        if place.stamp_ns > latest.stamp_ns:
            if place.label is not None or place.stamp_ns - latest.stamp_ns <= self._far_ns + elapsed_ns:
                return NEW
            return JOIN if self._follows_strays(place) else Judgement("refused", FAR_AHEAD, IF_MORE_FOLLOW)
        if place.label is None and place.stamp_ns == 0:
            return Judgement("refused", UNSTAMPED, STAMP_IT)
        return JOIN if self._follows_strays(place) else LATE

    def accept(self, place: Place) -> None:
        """The output is answered: it is the latest now."""
        before, self.latest, self._astray = self.latest, place, None
        label = place.label
        if label is not None and (before is None or label is not before.label):
            self._known[label.activation] = label
            if len(self._known) > REMEMBERED:
                del self._known[next(iter(self._known))]

    def judge_recorded(self, place: Place, joined: bool) -> Judgement:
        """What had been decided about an output that was answered, as the answer tells.

        Args:
            joined: the answer tells the integral action with which the controller began within a running loop.
        """
        latest = self.latest
        if place == latest:
            return SAME
        if joined:
            return JOIN
        return NEW if latest is not None and self._goes_on(latest, place) else START

    @staticmethod
    def _goes_on(latest: Place, place: Place) -> bool:
        return place.label == latest.label and place.stamp_ns > latest.stamp_ns

    def _is_start(self, place: Place, driven: Callable[[], bool]) -> bool:
        label, latest = place.label, self.latest
        assert label is not None
        if place.stamp_ns == 0 or place == self._began:
            return True
        if latest is not None and label == latest.label:
            return False
        if not self._known:
            return is_at_beginning(place) or not (label.plan or driven())
        known = self._known.get(label.activation)
        return known is None or label.follows(known)

    @staticmethod
    def _may_take_over(latest: Place, place: Place) -> bool:
        return latest.label is None or place.label is not None or not latest.label.plan

    def _of_another(self, latest: Place, place: Place) -> Judgement:
        if place.label is None:
            assert latest.label is not None
            return Judgement("refused", UNLABELLED, IN_LOCKSTEP if latest.label.plan else UNTIL_SILENT)
        if latest.label is None:
            return JOIN
        return JOIN if self._follows_strays(place) else Judgement("refused", OTHER_EPISODE, IF_MORE_FOLLOW)

    def _follows_strays(self, place: Place) -> bool:
        """Whether as many as IN_A_ROW have come one after the other, with no output of the loop between them."""
        before, self._astray = self._astray, place
        again = before is not None and before.label == place.label and self._later(before, place)
        self._in_a_row = self._in_a_row + 1 if again else 1
        return self._in_a_row >= IN_A_ROW

    def _later(self, before: Place, place: Place) -> bool:
        """Whether a stray follows another. One that waits for an answer says the same again: a plant in lockstep."""
        repeats = place.label is not None or (self.latest is not None and place.stamp_ns > self.latest.stamp_ns)
        return place.stamp_ns > before.stamp_ns or (repeats and place.stamp_ns == before.stamp_ns)


_FINE = ("", "")


class Answer(NamedTuple):
    """What a controller answers to an output.

    Attributes:
        stamp_ns: of the output.
        label: the parameters that it was computed with, and the output's episode.
        setpoint, effort: (lanes,).
        began_with: the integral action, (lanes,), of an answer with which the controller began within a running loop;
            else empty.
    """

    stamp_ns: int
    label: AnswerLabel
    setpoint: np.ndarray
    effort: np.ndarray
    began_with: np.ndarray


class Outcome(NamedTuple):
    """What became of an output.

    Attributes:
        decision: see there.
        answer: None if it is not answered.
        why: it was refused, or, of an answered one, what is wrong all the same; for the log, once.
        detail: for the log after it: figures, or what to do.
        after_silence: the loop had fallen silent before it.
    """

    decision: Decision
    answer: Answer | None
    why: str = ""
    detail: str = ""
    after_silence: bool = False


class Session:
    """One controller in one loop, from its activation to its end.

    Args:
        controller: computes the answers.
        joints: which elements of the outputs are its lanes.

    Attributes:
        plan: the latest that has come; the setpoint of outputs that bear its digest.
        setpoint: of all others, (1,) or (lanes,).
        holds_output: the setpoint is the first output, until another is given.
        timeout_ns: without an output for so long, a loop in realtime counts as silent; 0: never.
        saved_integral: the integral action to join a loop with, (lanes,); None: the one that leaves the effort.
        waiting: an output whose plan has not come.
        silent: no output comes; the next one is joined.
        is_live: the loop goes on without waiting for answers: in realtime, and on a robot.
        is_out_of_step: the time between outputs is not the sample period.
        guard: of an experiment on the loop.
        end_experiment: called, with the reason, when the experiment must end at an output: it restores the parameters
            and calls `go_back`, before the output is answered.
    """

    def __init__(self, controller: Controller, joints: Joints) -> None:
        self.controller = controller
        self.joints = joints
        self.plan: Plan | None = None
        self.setpoint = np.zeros(1)
        self.holds_output = False
        self.timeout_ns = 0
        self.saved_integral: np.ndarray | None = None
        self.guard = Guard()
        self.end_experiment: Callable[[str], None] = lambda why: None
        self.begin()

    def begin(self) -> None:
        """Forget the loop: the next output is the first one."""
        self.controller.reset()
        self.sequence = OutputSequence(self.controller.sample_period_ns)
        self.waiting: Sample | None = None
        self.silent = self.is_live = self.is_out_of_step = False
        self.answer: Answer | None = None
        self._goes_back = False
        self._answer_label = AnswerLabel("")  # of the latest answer
        self._answered = NO_VALUES  # the latest output that was
        self._arrival_ns: int | None = None
        self._common, self._on_lanes = 0.0, np.zeros(self.controller.lanes)
        self._repeats = 0  # outputs since the latest one with a stamp of its own
        self._measured_from_ns, self._intervals, self._off = 0, 0, 0

    @property
    def label(self) -> EpisodeLabel | None:
        """Of the latest output that was answered; None for a robot's, and before the first."""
        return self.sequence.latest and self.sequence.latest.label

    @property
    def stamp_ns(self) -> int | None:
        """Of the latest output that was answered."""
        return self.sequence.latest and self.sequence.latest.stamp_ns

    @property
    def integral(self) -> np.ndarray | None:
        """The integral action that the loop goes on with, (lanes,): after an experiment, that of before it."""
        return self.saved_integral if self._goes_back or self.controller.stamp_ns is None else self.controller.integral

    def set_setpoint(self, setpoint: np.ndarray) -> None:
        """Take this setpoint, (1,) or (lanes,), for outputs without a plan.

        Lanes that wait for the first output as their setpoint have nan.
        """
        self.setpoint = setpoint
        self.holds_output = self.holds_output and bool(np.isnan(setpoint).any())

    @property
    def lanes_setpoint(self) -> np.ndarray:
        """The live setpoint, (lanes,); nan where it will be the first output."""
        if self.holds_output and not np.isnan(self.setpoint).any():
            return np.full(self.controller.lanes, np.nan)
        return self._live_setpoint()

    @property
    def is_stuck(self) -> bool:
        """Whether a robot's outputs come, but all with one stamp."""
        return self.is_live and self.label is None and self._repeats >= STUCK_OUTPUTS

    @property
    def is_setpoint_far(self) -> bool:
        """Whether the live setpoint is so far from the latest output that the integral action hardly sees the error."""
        if not len(self._answered) or self.controller.gains.type == "pid" or not self.is_live:
            return False
        error = np.abs(self._live_setpoint() - self._answered)
        return bool((error > FAR_IN_SIGMA * self.controller.gains.per_lane("sigma")).any())

    # In the loop

    def take(self, output: Sample, now_ns: int | None) -> Outcome:
        """Decide about an output, and answer it.

        Args:
            now_ns: when it came, on a clock that is never set; or in simulated time, None before that has begun.
        """
        try:
            y = self.joints.selected(output.name, output.position)
        except ValueError as error:
            return Outcome("refused", None, "output refused", f": it {error}")
        if (fault := fault_of("output", y, self.controller.lanes, LARGEST_SIGNAL)) is not None:
            why, detail = fault
            if len(y) > self.controller.lanes and not self.joints.names:
                detail += name_joints(output.name)
            if self.guard.name:
                self.end_experiment(why + detail)
            return Outcome("refused", None, why, detail)
        place = Place(EpisodeLabel.parse(output.frame_id), output.stamp_ns)
        self.waiting = None
        setpoint = self._setpoint_at(place)
        if setpoint is None:
            self.waiting = output
            return Outcome("waiting", None)
        elapsed_ns = 0 if self._arrival_ns is None or now_ns is None else now_ns - self._arrival_ns
        silent = self.is_live and 0 < self.timeout_ns < elapsed_ns
        decision, why, detail = self.sequence.judge(place, silent, elapsed_ns, lambda: self._is_driven(output))
        if decision == "same":
            self._repeats += 1
            if place.label is None and y.tobytes() != self._answered.tobytes():
                return Outcome("refused", None, NOT_STAMPED_ANEW, STAMP_IT)
            return Outcome("same", self.answer)
        if decision in ("late", "refused"):
            return Outcome(decision, None, why, detail)
        if self.guard.name and (breach := self._breach(decision, y)):
            self.end_experiment(breach)
            setpoint = self._live_setpoint()
        if self._goes_back and decision == "new":
            decision = "join"
        follows_plan = place.label is not None and bool(place.label.plan)
        if decision != "new":
            self._measure_from(place)
        else:
            why, detail = self._compare_periods(place) if follows_plan else self._measure_rate(place)
        if self.holds_output and not follows_plan:
            held = self.lanes_setpoint
            self.set_setpoint(np.where(np.isnan(held), y, held))
            setpoint = self._live_setpoint()
        self._answered, self._arrival_ns, self.silent, self._repeats = y, now_ns, False, 0
        applied = self._applied(output) if decision in ("join", "start") else None
        self._proceed(decision, place, setpoint, y, applied, self._take_saved(decision))
        if self.guard.name and (breach := self.guard.breach_of_effort(self.controller.effort)):
            self.end_experiment(breach)
            applied = self._applied(output)
            self._proceed("join", place, self._live_setpoint(), y, applied, self._take_saved("join"))
        return Outcome(decision, self.answer, why, detail, silent)

    def _breach(self, decision: Decision, y: np.ndarray) -> str:
        """Why the experiment must end at this output; empty: it need not."""
        if decision != "new":
            return "the loop has begun anew"
        return self.guard.breach_of_output(y, self.controller.sample_period_ns)

    def go_back(self) -> None:
        """Answer the next output with the integral action of before the experiment, which has ended."""
        self.saved_integral, self._goes_back = self.guard.integral, True

    def check_experiment(self, changes: Mapping[str, Any], settings: Mapping[str, Any]) -> None:
        """Refuse what an experiment cannot be, and one that cannot begin.

        Args:
            settings: the experiment's parameters as they would be.

        Raises:
            ValueError: the reason.
        """
        self.guard.check(changes, settings)
        if not changes.get("experiment") or self.guard.name:
            return
        if self.answer is None or not self.is_live or self.silent:
            raise ValueError("no experiment can begin: it needs a loop in realtime whose outputs come")
        self.guard.check_begin(self._answered, self.controller.effort, settings)

    def _compare_periods(self, place: Place) -> tuple[str, str]:
        """In lockstep outputs come every sample period; if not, plant and controller were given different ones."""
        assert self.sequence.latest is not None
        apart_ns, period_ns = place.stamp_ns - self.sequence.latest.stamp_ns, self.controller.sample_period_ns
        self.is_out_of_step = apart_ns != period_ns
        if not self.is_out_of_step:
            return _FINE
        return OUT_OF_STEP, f": it is {apart_ns / 1e9:g} s and {period_ns / 1e9:g} s"

    def _measure_from(self, place: Place) -> None:
        self._measured_from_ns, self._intervals, self._off = place.stamp_ns, 0, 0

    def _measure_rate(self, place: Place) -> tuple[str, str]:
        """Outputs that nobody waits for come every sample period, too, on the whole; if not, it was set wrong.

        Most intervals must be off, and so must their mean: neither gaps nor jitter are another rate.
        """
        assert self.stamp_ns is not None
        period_ns = self.controller.sample_period_ns
        self._intervals += 1
        self._off += abs(place.stamp_ns - self.stamp_ns - period_ns) > RATE_TOLERANCE * period_ns
        if self._intervals < RATE_WINDOW:
            return _FINE
        mean_ns = (place.stamp_ns - self._measured_from_ns) / RATE_WINDOW
        self.is_out_of_step = self._off > RATE_WINDOW / 2 and abs(mean_ns - period_ns) > RATE_TOLERANCE * period_ns
        self._measure_from(place)
        if not self.is_out_of_step:
            return _FINE
        return OFF_RATE, f": it is {mean_ns / 1e9:.4g} s, and sample_period is {period_ns / 1e9:g} s"

    def look_for_silence(self, now_ns: int | None) -> bool:
        """Whether the loop in realtime has just fallen silent.

        Args:
            now_ns: as for `take`.
        """
        if self.silent or not self.is_live or not self.timeout_ns or now_ns is None:
            return False
        if self._arrival_ns is None or self._arrival_ns > now_ns:  # simulated time that has begun, or begun again
            self._arrival_ns = now_ns
        self.silent = now_ns - self._arrival_ns > self.timeout_ns
        return self.silent

    def _setpoint_at(self, place: Place) -> np.ndarray | None:
        """The setpoint for an output, (lanes,); None if its plan has not come."""
        label = place.label
        if label is None or not label.plan:
            given = self.guard.setpoint
            return self._live_setpoint() if given is None else self._on_every_lane(given)
        if self.plan is None or self.plan.digest != label.plan:
            return None
        return self._on_every_lane(self.plan.value_at("setpoint", place.stamp_ns))

    def _live_setpoint(self) -> np.ndarray:
        return self.setpoint if len(self.setpoint) > 1 else self._on_every_lane(self.setpoint[0])

    def _on_every_lane(self, setpoint: float) -> np.ndarray:
        """A setpoint for every lane, (lanes,); the same array as long as it is the same."""
        if setpoint != self._common or len(self._on_lanes) != self.controller.lanes:
            self._common, self._on_lanes = setpoint, np.full(self.controller.lanes, setpoint)
        return self._on_lanes

    def _applied(self, output: Sample) -> np.ndarray | None:
        """The effort that the output reports, (lanes,); None if it reports none."""
        try:
            applied = self.joints.selected(output.name, output.effort)
        except ValueError:
            return None
        return applied if len(applied) == self.controller.lanes and np.isfinite(applied).all() else None

    def _is_driven(self, output: Sample) -> bool:
        """Whether the plant has an effort, or this controller an integral action, to go on from."""
        applied = self._applied(output)
        return self.saved_integral is not None or applied is None or bool(applied.any())

    def _take_saved(self, decision: Decision) -> np.ndarray | None:
        if decision not in ("join", "start"):
            return None
        self._goes_back = False
        saved, self.saved_integral = self.saved_integral, None
        return saved if saved is not None and len(saved) == self.controller.lanes else None

    # From a bag

    def retake(
        self,
        place: Place,
        setpoint: np.ndarray,
        output: np.ndarray,
        applied: np.ndarray | None,
        integral: np.ndarray | None,
    ) -> Judgement:
        """Answer an output as it was answered before: the answer is in `answer`.

        Args:
            setpoint, output: (lanes,).
            applied: the effort that the output reports; None if it reports none.
            integral: that the recorded answer tells, of a controller that began within a running loop; else None.
        """
        judgement = self.sequence.judge_recorded(place, integral is not None)
        self._proceed(judgement.decision, place, setpoint, output, applied, integral)
        return judgement

    def pass_over(self, place: Place) -> None:
        """An output was answered, but the answer cannot be computed again."""
        self.sequence.accept(place)

    # Both

    def _proceed(
        self,
        decision: Decision,
        place: Place,
        setpoint: np.ndarray,
        output: np.ndarray,
        applied: np.ndarray | None,
        integral: np.ndarray | None,
    ) -> None:
        """Begin if it is decided, and answer."""
        controller = self.controller
        if decision == "start":
            self._start(place, output, applied)
        elif decision == "join":
            self._join(applied, integral)
        self.sequence.accept(place)
        self.is_live = place.label is None or not place.label.plan
        effort = controller.answer(place.stamp_ns, setpoint, output)
        began_with = controller.integral_before if decision == "join" else NO_VALUES
        label = self._answer_label
        if label.parameters is not controller.digest or label.episode is not place.label:
            label = self._answer_label = AnswerLabel(controller.digest, place.label)
        self.answer = Answer(place.stamp_ns, label, setpoint, effort, began_with)

    def _start(self, place: Place, output: np.ndarray, applied: np.ndarray | None) -> None:
        """Begin from rest: settled where the plant rests, or from nothing."""
        self.controller.reset()
        if place.label is None or not place.label.activation or applied is None:
            return  # in recordings of before, every loop began from nothing, a robot's too
        plan = self.plan if self.plan is not None and self.plan.digest == place.label.plan else None
        rest = rest_setpoint(plan.start if plan else None, output, applied)
        if rest is not None:
            self.controller.begin_at_rest(applied, rest)

    def _join(self, applied: np.ndarray | None, integral: np.ndarray | None) -> None:
        """Begin within a running loop: with the effort reported, or our own latest, or with no integral action."""
        if applied is None and self.answer is not None:
            applied = self.controller.effort.copy()
        if applied is None:
            applied = np.zeros(self.controller.lanes)
            integral = applied if integral is None else integral
        self.controller.begin_within(applied, integral)
