"""What else a bag of our own loop holds, beside outputs and answers: plans, signals of the plan, parameters, terms."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tdof_npid_ros.analysis.account import Difference, Verification
from tdof_npid_ros.analysis.parameters import TOPIC as PARAMETERS
from tdof_npid_ros.analysis.parameters import VALUE_FIELDS, ParameterHistory, scenario_plans
from tdof_npid_ros.analysis.recording import JOINT_TRAJECTORY, Loop, Signal, signal_of
from tdof_npid_ros.bag.reader import BagReader
from tdof_npid_ros.control.law import TERMS
from tdof_npid_ros.parameter import ParameterError
from tdof_npid_ros.parameters import NODES, OF_ROS, SAMPLE_PERIOD
from tdof_npid_ros.plants.catalog import model_parameters
from tdof_npid_ros.scenario import Plan, PlanError
from tdof_npid_ros.wire import JOINT_STATE, SECOND, EpisodeLabel

PLANS, SIGNALS, STATE, PARAMETER = "plans", "setpoints and disturbances of the plan", "terms of the law", "parameters"
NO_PLANS = "signals: there is no plan in the bag to compare them with"
NO_ANSWER = "terms of the law: the answers that they belong to are not verifiable"
NOT_OF_SCENARIO = "plans: the scenario's parameters in the bag do not make them"
UNKNOWN_PARAMETER = "parameters that no such node has, out of their range, or not the same in the loop's nodes"
Terms = Mapping[int, Sequence[np.ndarray]]  # of verified answers, (6, lanes), by stamp, in order


def check_messages(
    reader: BagReader, loop: Loop, terms: Terms, unverified: Mapping[int, int], account: Verification
) -> None:
    """Check plans, their signals, the law's terms and parameters; what cannot be decoded is not checked.

    Args:
        unverified: how many other answers there are, by stamp.
    """
    labels = {EpisodeLabel.parse(str(frame)) for frame in np.unique(loop.output.frame_id.astype(str))}
    planned = {label.plan for label in labels if label is not None and label.plan}
    _check_plans(reader, loop, planned, account)
    if planned and all(label is not None and label.plan for label in labels):
        for name, field in (("setpoint", "position"), ("disturbance", "effort")):
            _check_signal(reader, loop, name, field, account)
    old = any(label is not None and not label.activation for label in labels)
    _check_terms(reader, loop, terms, unverified, old, account)
    if planned:
        _check_parameters(reader, loop, account)
    names = ("output", "control_effort", "setpoint", "disturbance", "controller_state", "scenario_plan")
    for topic in (PARAMETERS, loop.topic, *(loop.namespace + name for name in names)):
        if topic in reader.skipped:
            skipped = reader.skipped[topic]
            account.unchecked[f"{topic}: cannot be decoded: {skipped.reason}"] = skipped.count


def _check_plans(reader: BagReader, loop: Loop, planned: set[str], account: Verification) -> None:
    """A plan's message bears the digest of its content, and the scenario's parameters make it."""
    topic = f"{loop.namespace}scenario_plan"
    if topic not in reader.topics or topic in reader.unreadable or reader.topics[topic].type != JOINT_TRAJECTORY:
        return
    for step, (_, _, message) in enumerate(reader.decoded(topic)):
        told = message["header"]["frame_id"]
        found = _digest(message)
        stamp_ns = message["header"]["stamp"]["sec"] * SECOND + message["header"]["stamp"]["nanosec"]
        if stamp_ns == 0 and (found == told or (not told and found)):
            account.note(PLANS)
        else:
            account.note(PLANS, Difference("plan", topic, step, stamp_ns, "", {}, (told,), (found or "no plan",)))
    foreign = planned - _digests_of_scenario(loop)
    if loop.scenario is not None and foreign:
        account.unchecked[NOT_OF_SCENARIO] += len(foreign)


def _digest(message: Mapping[str, Any]) -> str:
    """Of the plan that a message is; empty if it is none, or holds more than a plan."""
    points = message["points"]
    if any(len(point[name]) for point in points for name in ("velocities", "accelerations", "effort")):
        return ""
    times = [point["time_from_start"] for point in points]
    try:
        return Plan(
            tuple(message["joint_names"]),
            tuple(time["sec"] * SECOND + time["nanosec"] for time in times),
            tuple(tuple(point["positions"].tolist()) for point in points),
        ).digest
    except PlanError:
        return ""


def _digests_of_scenario(loop: Loop) -> set[str]:
    sets = loop.scenario.sets() if loop.scenario is not None else ()
    return {plan.digest for _, values in sets for plan in scenario_plans(values).values()}


def _check_signal(reader: BagReader, loop: Loop, name: str, field: str, account: Verification) -> None:
    """In lockstep the scenario's signals are the plan's, by their stamps."""
    topic = loop.namespace + name
    if topic not in reader.topics or topic in reader.unreadable or reader.topics[topic].type != JOINT_STATE:
        return
    signal = signal_of(reader, topic)
    if not loop.plans:
        account.unchecked[NO_PLANS] += len(signal)
        return
    for step in range(len(signal)):
        stamp_ns, values = int(signal.stamp_ns[step]), np.asarray(getattr(signal, field)[step], np.float64)
        planned = {plan.value_at(name, stamp_ns) for plan in loop.plans.values() if stamp_ns in plan.times_ns}
        others = sum(
            len(getattr(signal, other)[step]) for other in ("position", "velocity", "effort") if other != field
        )
        more = others or signal.frame_id[step]
        same = planned and values.size and not more and all(value.tobytes() in _bytes(planned) for value in values)
        recorded, expected = tuple(values.tolist()), tuple(sorted(planned)) or ("nothing at this time",)
        account.note(SIGNALS, None if same else Difference(name, topic, step, stamp_ns, "", {}, recorded, expected))


def _bytes(values: set[float]) -> set[bytes]:
    return {np.float64(value).tobytes() for value in values}


def _check_terms(
    reader: BagReader, loop: Loop, terms: Terms, unverified: Mapping[int, int], old: bool, account: Verification
) -> None:
    """`controller_state` holds the terms that the answers were made of. It bears their stamp alone: those of several
    episodes are told apart by their values."""
    topic = f"{loop.namespace}controller_state"
    if topic not in reader.topics or topic in reader.unreadable or reader.topics[topic].type != JOINT_STATE:
        return
    signal = signal_of(reader, topic)
    stamps = signal.stamp_ns.tolist()
    others = {  # what cannot be compared, for its answer was not verified or is not in the bag
        stamp: max(count - len(terms.get(stamp, ())), unverified.get(stamp, 0))
        for stamp, count in Counter(stamps).items()
    }
    waiting = {stamp: list(found) for stamp, found in terms.items()}
    for step, stamp in enumerate(stamps):
        found = np.asarray(signal.position[step], np.float64)
        candidates = waiting.get(stamp, [])
        at = next((i for i, expected in enumerate(candidates) if _same_terms(found, expected, old)), None)
        if at is not None and _names_of_terms(signal, step):
            del candidates[: at + 1]
            account.note(STATE)
        elif at is None and others[stamp] > 0:
            others[stamp] -= 1
            account.unchecked[NO_ANSWER] += 1
        else:
            expected = tuple(candidates[at or 0].ravel().tolist()) if candidates else ()
            told = tuple(found.tolist()), expected or ("nothing at this time",)
            account.note(STATE, Difference("term", topic, step, stamp, "", {}, *told))


def _same_terms(found: np.ndarray, expected: np.ndarray, old: bool) -> bool:
    """Bit for bit; but recordings of before have another exponential's last bit in the scaled error."""
    if found.size != expected.size:
        return False
    rows = [row for row, term in enumerate(TERMS) if not (old and term == "scaled_error")]
    return found.reshape(expected.shape)[rows].tobytes() == expected[rows].tobytes()


def _names_of_terms(signal: Signal, step: int) -> bool:
    names = [str(name) for name in signal.name[step]]
    lanes = len(names) // len(TERMS)
    wanted = [term if lanes == 1 else f"{term}/{lane}" for term in TERMS for lane in range(lanes)]
    return names == wanted and not len(signal.velocity[step]) and not len(signal.effort[step])


def _check_parameters(reader: BagReader, loop: Loop, account: Verification) -> None:
    """Each parameter of our nodes is one that such a node has, within its range, and holds one value; and what the
    nodes of a loop must have in common is the same."""
    tables = {node: table for node, history in loop.histories.items() if (table := _table_of(loop, node, history))}
    if not tables:
        return
    unknown: set[str] = set()
    common: dict[str, set[bytes]] = defaultdict(set)
    for step, (_, _, event) in enumerate(reader.decoded(PARAMETERS)):
        table = tables.get(event["node"])
        for one in (*event["new_parameters"], *event["changed_parameters"]) if table is not None else ():
            name, value = one["name"], one["value"]
            others = [field for kind, field in VALUE_FIELDS.items() if kind != value["type"]]
            spare = [field for field in others if not _is_unset(value[field])]
            if name == SAMPLE_PERIOD.name:
                common[name].add(np.float64(value["double_value"]).tobytes())
            if spare:
                told = (f"{spare[0]} as well",), ("one value",)
                account.note(PARAMETER, Difference("parameter", PARAMETERS, step, 0, name, {}, *told))
            elif table is not None and not _is_known(name, value, table):
                unknown.add(name)
            else:
                account.note(PARAMETER)
    unknown |= {name for name, values in common.items() if len(values) > 1}
    if unknown:
        account.unchecked[f"{UNKNOWN_PARAMETER}: {', '.join(sorted(unknown))}"] += len(unknown)


def _table_of(loop: Loop, node: str, history: ParameterHistory) -> dict[str, Any] | None:
    """The table of the node of ours that most of these parameters are of; None for another's node."""
    if not node.startswith(loop.namespace):
        return None
    names = {name for _, changes in history.events for name in changes if not name.startswith(OF_ROS)}
    best: dict[str, Any] | None = None
    for role, table in NODES.items():
        known: dict[str, Any] = dict(table)
        if role == "plant":
            try:
                model = next(changes["model"] for _, changes in history.events if "model" in changes)
                known |= dict.fromkeys(model_parameters(str(model)))
            except (StopIteration, ValueError):
                known |= dict.fromkeys(names)  # a plant that cannot be built is told of elsewhere
                known = known if "model" in names else dict(table)
        found = sum(name in known or (name.startswith("plan.") and role == "scenario") for name in names)
        if 2 * found > len(names) and (best is None or found > sum(name in best for name in names)):
            best = known
    return best


def _is_unset(value: Any) -> bool:
    return len(value) == 0 if hasattr(value, "__len__") else np.float64(value).tobytes() == bytes(8)


def _is_known(name: str, value: Mapping[str, Any], table: Mapping[str, Any]) -> bool:
    if name.startswith((*OF_ROS, "plan.")):
        return True
    if name not in table or value["type"] not in VALUE_FIELDS:
        return False
    one = table[name]
    if one is None:
        return True
    content = value[VALUE_FIELDS[value["type"]]]
    try:
        one.checked(content.tolist() if isinstance(content, np.ndarray) else content)
    except ParameterError:
        return False
    return True
