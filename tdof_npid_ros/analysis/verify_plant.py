"""The outputs of a simulated plant, computed again from the recorded efforts: values and applied efforts."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from tdof_npid_ros.analysis.account import Difference, Verification, numbers
from tdof_npid_ros.analysis.recording import Loop, Signal
from tdof_npid_ros.control.joints import Joints
from tdof_npid_ros.parameters import PLANT, sample_period_in_ns
from tdof_npid_ros.plants.catalog import changeable_parameters, effort_limits, make_plant
from tdof_npid_ros.plants.lockstep import Episode
from tdof_npid_ros.plants.per_lane import initial_lanes
from tdof_npid_ros.plants.plant import Plant, PlantAt, PlantError
from tdof_npid_ros.plants.simulator import PlantSimulator
from tdof_npid_ros.wire import AnswerLabel, EpisodeLabel

OUTPUT, APPLIED = "plant outputs", "applied efforts"  # kinds of checks
NO_PLANT = "outputs: the plant's parameters are not in the bag"
NO_PLAN = "outputs: their plan is not in the bag"
NO_EFFORT = "outputs: the efforts before them are not in the bag"
GOING_OVER = "applied efforts: between the fallback and an effort, while the plant went over to it"
BEFORE_THE_BAG = "applied efforts: of answers from before the recording"
NOT_ALL_EFFORTS = "applied efforts: none that is recorded, but the bag lacks some"
NO_APPLIED = "outputs: they do not tell the effort applied"
CHANGES_COUNT_NS = 1_000_000_000  # a change of the plant's parameters may be in force this long before or after it
Values = Mapping[str, Any]


class _Run(NamedTuple):
    """Outputs of one episode, in order: their indices in the topic."""

    label: EpisodeLabel
    first: int
    stop: int


def check_outputs(loop: Loop, account: Verification) -> None:
    """Check what a simulated plant put out; a robot's outputs are what they are."""
    checker = _Outputs(loop, account)
    for run in _runs(loop.output):
        checker.check(run)


def _runs(output: Signal) -> Iterator[_Run]:
    """Stretches of outputs that bear one label; one whose stamps begin again is another."""
    for stretch in output.runs():
        label = EpisodeLabel.parse(str(output.frame_id[stretch.start]))
        if label is None:
            continue
        stamps = output.stamp_ns[stretch]
        again = np.flatnonzero((stamps[1:] == 0) & (stamps[:-1] != 0)) + 1
        bounds = [0, *again.tolist(), len(stamps)]
        for a, b in zip(bounds, bounds[1:], strict=False):
            yield _Run(label, stretch.start + a, stretch.start + b)


class _Outputs:
    def __init__(self, loop: Loop, account: Verification) -> None:
        self._loop, self._account = loop, account
        self._output = loop.output
        self._efforts: dict[tuple[EpisodeLabel | None, int], list[int]] = defaultdict(list)
        self._labelled: dict[EpisodeLabel | None, list[int]] = defaultdict(list)
        answers = loop.control_effort
        self._lacks_some = True
        if answers is not None:
            for step, (frame, stamp) in enumerate(
                zip(answers.frame_id.tolist(), answers.stamp_ns.tolist(), strict=True)
            ):
                label = AnswerLabel.parse(frame).episode
                self._efforts[label, stamp].append(step)
                self._labelled[label].append(step)
            gaps = np.diff(answers.sequence)
            self._lacks_some = bool((answers.sequence == 0).any() or ((gaps != 1) & (answers.sequence[1:] != 1)).any())
        self._used = -1  # the latest answer that an output was computed with
        self._sets = list(loop.plant.sets()) if loop.plant is not None else []

    def check(self, run: _Run) -> None:
        """Check the outputs of a run."""
        reason = self._check_in_lockstep(run) if run.label.plan else self._check_applied(run)
        if reason:
            self._account.unchecked[reason] += run.stop - run.first

    # In lockstep

    def _check_in_lockstep(self, run: _Run) -> str:
        plan = self._loop.plans.get(run.label.plan)
        if plan is None:
            return NO_PLAN
        if self._loop.plant is None:
            return NO_PLANT
        values = self._loop.plant.at(int(self._output.publish_ns[run.first]))
        plant_at = _plant_maker(values)
        try:
            lanes, period_ns = len(self._output.position[run.first]), sample_period_in_ns(values["sample_period"])
            if values["lanes"] != lanes:  # before there is memory for them
                told = (f"{lanes} lanes",), (f"{values['lanes']} lanes",)
                self._account.note(OUTPUT, self._difference("plant output", run.first, run.label, *told, {}))
                return ""
            simulator = PlantSimulator(plant_at({}), period_ns, lanes, effort_limits(values))
            episode = Episode(plan, simulator, plant_at, run.label)
        except (KeyError, ValueError, TypeError) as error:
            return f"outputs: the plant cannot be built: {error}"
        joints = Joints(values.get("joint_names", ()))
        self._follow(run, episode, simulator, joints, period_ns)
        return ""

    def _follow(self, run: _Run, episode: Episode, simulator: PlantSimulator, joints: Joints, period_ns: int) -> None:
        for i in range(run.first, run.stop):
            stamp = int(self._output.stamp_ns[i])
            while episode.stamp_ns < stamp:
                effort = self._effort(run.label, episode.stamp_ns, joints, simulator.lanes)
                if effort is None:
                    self._account.unchecked[NO_EFFORT] += run.stop - i
                    return
                if not episode.answer(effort):
                    break
            if episode.stamp_ns != stamp:
                where = (f"one of the plan's, every {period_ns} ns up to {episode.steps * period_ns} ns",)
                self._account.note(OUTPUT, self._difference("stamp", i, run.label, (f"{stamp} ns",), where, {}))
                continue
            inputs = {"applied effort": numbers(simulator.applied_effort.tolist())}
            expected = simulator.output, simulator.applied_effort
            self._compare(OUTPUT, i, run.label, self._output.position[i], expected[0], inputs)
            self._compare(APPLIED, i, run.label, self._output.effort[i], expected[1], {})

    def _effort(self, label: EpisodeLabel, stamp_ns: int, joints: Joints, lanes: int) -> np.ndarray | None:
        """The effort that the plant took for the output of a stamp: that of the next answer to it."""
        answers = self._loop.control_effort
        steps = [step for step in self._efforts.get((label, stamp_ns), ()) if step > self._used]
        if answers is None or not steps:
            return None
        effort = np.asarray(answers.effort[steps[0]], dtype=np.float64)
        names = tuple(map(str, answers.name[steps[0]]))
        if joints.names and set(names) == set(joints.names):
            effort = joints.selected(names, effort)
        if len(effort) != lanes or not np.isfinite(effort).all():
            return None  # the plant refused it, too
        self._used = steps[0]
        return effort

    # In realtime

    def _check_applied(self, run: _Run) -> str:
        """Each effort applied is one that was recorded for an output before, within the plant's limits, or the
        fallback."""
        if not self._sets:
            return NO_PLANT
        answers, output = self._loop.control_effort, self._output
        mine = self._labelled.get(run.label, [])
        if answers is None or not mine:
            return NO_EFFORT
        recorded = [(int(answers.stamp_ns[step]), np.asarray(answers.effort[step], dtype=np.float64)) for step in mine]
        allowed: dict[int, dict[bytes, float]] = {}
        is_start = True  # until the first effort
        began_before = int(output.sequence[0]) != 1 or int(answers.sequence[0]) != 1
        is_joined = run.first == 0 and began_before  # and until the first effort that is in the bag
        for i in range(run.first, run.stop):
            applied = np.asarray(output.effort[i], dtype=np.float64)
            if not applied.size:
                self._account.unchecked[NO_APPLIED] += 1
                continue
            now_ns = int(output.publish_ns[i])
            possible = self._in_force(now_ns)
            for values in possible:
                if id(values) not in allowed:
                    allowed[id(values)] = _allowed(values, recorded, applied.size)
            stamp_ns, told = int(output.stamp_ns[i]), applied.tobytes()
            is_start = is_start and any(told in _at_start(values, applied.size) for values in possible)
            since = [allowed[id(values)].get(told, math.inf) for values in possible]
            if is_start or any(one < stamp_ns for one in since):
                self._account.note(APPLIED)
                is_joined = is_joined and not any(-math.inf < one < stamp_ns for one in since)
            elif is_joined:
                self._account.unchecked[BEFORE_THE_BAG] += 1
            elif self._lacks_some:
                self._account.unchecked[NOT_ALL_EFFORTS] += 1
            elif any(_is_between(applied, values, recorded) for values in possible):
                self._account.unchecked[GOING_OVER] += 1
            else:
                wanted = ("a control effort recorded for an output before, within the limits, or the fallback",)
                self._account.note(
                    APPLIED, self._difference("applied effort", i, run.label, tuple(applied.tolist()), wanted, {})
                )
        return ""

    def _in_force(self, now_ns: int) -> list[Values]:
        """The plant's parameters that may be in force at a time."""
        before = [i for i, (time_ns, _) in enumerate(self._sets) if time_ns <= now_ns - CHANGES_COUNT_NS]
        near = [values for time_ns, values in self._sets if abs(time_ns - now_ns) < CHANGES_COUNT_NS]
        first = self._sets[before[-1]][1] if before else self._sets[0][1]
        last = self._sets[-1][1] if not before and not near else None
        return [values for values in (first, *near, last) if values is not None]

    # Both

    def _compare(
        self, what: str, i: int, label: EpisodeLabel, recorded: Any, expected: np.ndarray, inputs: Mapping[str, Any]
    ) -> None:
        values = np.asarray(recorded, dtype=np.float64)
        if values.tobytes() == expected.tobytes():
            self._account.note(what)
            return
        one = {OUTPUT: "plant output", APPLIED: "applied effort"}[what]
        self._account.note(
            what, self._difference(one, i, label, tuple(values.tolist()), tuple(expected.tolist()), inputs)
        )

    def _difference(
        self,
        what: str,
        i: int,
        label: EpisodeLabel,
        recorded: tuple[Any, ...],
        expected: tuple[Any, ...],
        inputs: Mapping[str, Any],
    ) -> Difference:
        stamp_ns = int(self._output.stamp_ns[i])
        return Difference(what, self._loop.topic, i, stamp_ns, str(label), inputs, recorded, expected)


def _plant_maker(values: Values) -> PlantAt:
    """The plant of these parameters, with some of them changed."""

    def plant_at(changes: dict[str, float]) -> Plant:
        model = str(values["model"])
        unknown = [name for name in changes if name not in changeable_parameters(model)]
        if unknown:
            raise PlantError(f"the plan changes {unknown[0]}, which it does not have")
        return make_plant(model, {**values, **changes})

    return plant_at


def _at_start(values: Values, lanes: int) -> set[bytes]:
    """What the plant applies before the first effort comes, by its bytes: none, limited or not, or one to rest with."""
    low, high = effort_limits(values)
    without, resting = np.zeros(lanes), _resting_efforts(values, lanes)
    return {without.tobytes(), *(np.minimum(np.maximum(one, low), high).tobytes() for one in (without, resting))}


def _allowed(values: Values, recorded: list[tuple[int, np.ndarray]], lanes: int) -> dict[bytes, float]:
    """What the plant may apply then, by its bytes: with the first stamp that it answers, in ns; -inf for the
    fallback."""
    low, high = effort_limits(values)
    fallback, effort = (values.get(name, PLANT[name].default) for name in ("fallback", "fallback_effort"))
    always = [(-math.inf, np.full(lanes, float(effort)))] if fallback == "effort" else []
    found: dict[bytes, float] = {}
    for since, effort in (*always, *recorded):
        if effort.size == lanes:
            limited = np.minimum(np.maximum(effort, low), high).tobytes()
            found[limited] = min(since, found.get(limited, math.inf))
    return found


def _resting_efforts(values: Values, lanes: int) -> np.ndarray:
    """The efforts with which the lanes begin, at rest, (lanes,); 0 where they are not known."""
    try:
        plant = make_plant(str(values.get("model", PLANT["model"].default)), values)
        start = float(values.get("start", math.inf))
        begun = plant.at_rest(start) if math.isfinite(start) else plant
        return initial_lanes(begun, lanes)[2]
    except (PlantError, TypeError):
        return np.zeros(lanes)


def _is_between(applied: np.ndarray, values: Values, recorded: list[tuple[int, np.ndarray]]) -> bool:
    """Whether it lies between efforts, as where the plant goes over from its fallback to efforts that come again."""
    if not float(values.get("return_time", 0.0)) > 0 or not float(values.get("effort_timeout", 0.0)) > 0:
        return False
    low, high = effort_limits(values)
    alike = np.array([*(effort for _, effort in recorded if effort.size == applied.size), np.zeros(applied.size)])
    alike = np.clip(alike, low, high)
    return bool(((applied >= alike.min(axis=0)) & (applied <= alike.max(axis=0))).all())
