"""In a bag of our own loop in lockstep, a flipped bit of a stamp, label, value, plan or parameter is found."""

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from loop_bags import JOINT_STATE, TRAJECTORY, LoopBag, joint_state, plan_message

from tdof_npid_ros.analysis.account import DIFFERENT, UNCHECKED, VERIFIED
from tdof_npid_ros.analysis.verify import verify
from tdof_npid_ros.bag import BagError
from tdof_npid_ros.bag.reader import BagReader
from tdof_npid_ros.bag.records import MAGIC
from tdof_npid_ros.bag.writer import BagWriter
from tdof_npid_ros.case import Case, load_case
from tdof_npid_ros.control.controller import Controller

ALL = os.environ.get("TDOF_NPID_ALL_BITS") == "1"  # every bit of every byte, instead of one of each fifth
INTEGER, DOUBLE = 2, 3  # rcl_interfaces/msg/ParameterType
Messages = list[tuple[str, str, int, bytes]]  # topic, type, log time, data


@pytest.fixture(scope="module")
def case() -> Case:
    """Without dead time, so that the plant moves at once."""
    case = load_case("p1-c0.5")
    plan = ("0 setpoint 1", "0.01 disturbance 0.5", "0.02 end")
    return replace(case, episodes={"s": plan}, plant_values={**case.plant_values, "dead_time": 0.0})


@pytest.fixture(scope="module")
def messages(case, tmp_path_factory) -> Messages:
    """A whole episode of five outputs, as our nodes publish it."""
    folder = tmp_path_factory.mktemp("bits") / "bag"
    plan, run = case.plans["s"], case.simulate("s")
    label = f"{plan.digest}/0011aabb.1"
    controller = Controller(case.gains, case.sample_period_ns)
    with LoopBag(folder) as bag:
        bag.configuration(case, case.gains)
        bag.write("scenario_plan", TRAJECTORY, plan_message(plan))
        for stamp in plan.times_ns[:-1]:
            bag.write("setpoint", JOINT_STATE, joint_state(stamp, "", [plan.value_at("setpoint", stamp)]))
            bag.write("disturbance", JOINT_STATE, joint_state(stamp, "", [], [plan.value_at("disturbance", stamp)]))
        applied = [0.0]
        for k in range(len(run.time)):
            stamp = k * case.sample_period_ns
            controller.answer(stamp, run.setpoint[k : k + 1], run.output[k])
            bag.write("output", JOINT_STATE, joint_state(stamp, label, run.output[k], applied))
            answer = joint_state(stamp, f"{controller.digest} {label}", run.setpoint[k : k + 1], controller.effort)
            bag.write("control_effort", JOINT_STATE, answer)
            applied = controller.effort.tolist()
    with BagReader(folder) as reader:
        return [(topic, reader.topics[topic].type, log_ns, bytes(data)) for topic, log_ns, _, data in reader.messages()]


def write(folder: Path, messages: Messages) -> Path:
    with BagWriter(folder) as writer:
        topics: dict[str, int] = {}
        counts: dict[str, int] = {}
        for topic, type_name, log_ns, data in messages:
            if topic not in topics:
                topics[topic] = writer.add_topic(topic, type_name)
            counts[topic] = counts.get(topic, 0) + 1
            writer.write(topics[topic], data, log_ns, log_ns - 1000, counts[topic])
    return folder


def flips(messages: Messages, topic: str) -> Iterator[tuple[int, int, int, Messages]]:
    """Bytes of a topic's messages with one bit flipped: message, byte, bit, and the bag's messages then."""
    for i, (name, type_name, log_ns, data) in enumerate(messages):
        if name != topic:
            continue
        for at in range(0 if ALL else i % 5, len(data), 1 if ALL else 5):
            for bit in range(8) if ALL else (at % 8,):
                changed = data[:at] + bytes([data[at] ^ 1 << bit]) + data[at + 1 :]
                yield i, at, bit, [*messages[:i], (name, type_name, log_ns, changed), *messages[i + 1 :]]


def says_the_same(reader: BagReader, topic: str, one: bytes, other: bytes) -> bool:
    """Whether the flipped bit lies in padding, in the encoding's unused options, or writes a number in another way."""
    try:
        return repr(plain(reader.decode(topic, one))) == repr(plain(reader.decode(topic, other)))
    except BagError:
        return False


def plain(value: object) -> object:
    if isinstance(value, dict):
        if value.get("type") == DOUBLE and value["double_value"] == 0.0:
            value = value | {"type": INTEGER, "double_value": 0.0}  # 0 and -0.0 for 0.0: the same parameter
        if lines := value.get("string_array_value"):
            value = value | {"string_array_value": [list(map(word, line.split())) for line in lines]}
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return value.tobytes()
    return [plain(item) for item in value] if isinstance(value, list) else value


def word(text: str) -> float | str:
    """A plan's line may say .5 for 0.5."""
    try:
        return float(text)
    except ValueError:
        return text


def test_the_bag_is_verified(messages, tmp_path) -> None:
    account = verify(write(tmp_path / "bag", messages))
    assert account.status == VERIFIED, account.lines()
    assert {what: one.equal for what, one in account.checks.items() if what != "parameters"} == {
        "plant outputs": 5,
        "applied efforts": 5,
        "plans": 1,
        "setpoints and disturbances of the plan": 4,
    }


@pytest.mark.parametrize("topic", ["/output", "/control_effort", "/scenario_plan", "/setpoint", "/disturbance"])
def test_every_bit_of_the_loop_s_messages_is_checked(topic, messages, tmp_path) -> None:
    unseen, tried = [], 0
    with BagReader(write(tmp_path / "original", messages)) as reader:
        for i, at, bit, changed in flips(messages, topic):
            if says_the_same(reader, topic, messages[i][3], changed[i][3]):
                continue
            tried += 1
            if verify(write(tmp_path / f"{i}-{at}-{bit}", changed)).status == VERIFIED:
                unseen.append((i, at, bit))
    assert tried > 10 and not unseen


NODE_NAME = range(12, 32)  # bytes of a parameter event: a node may bear any name
SET_AT = range(12)  # and its parameters may be set at any time


@pytest.mark.parametrize("node", [b"/controller", b"/scenario"])
def test_every_bit_of_controller_and_scenario_is_checked(node, messages, tmp_path) -> None:
    topic = "/parameter_events"
    unseen, tried = [], 0
    with BagReader(write(tmp_path / "original", messages)) as reader:
        for i, at, bit, changed in flips(messages, topic):
            is_free = at in NODE_NAME or at in SET_AT
            if node not in messages[i][3] or is_free or says_the_same(reader, topic, messages[i][3], changed[i][3]):
                continue
            tried += 1
            if verify(write(tmp_path / f"{i}-{at}-{bit}", changed)).status == VERIFIED:
                unseen.append((i, at, bit, messages[i][3][max(at - 60, 0) : at + 8]))
    assert tried > 20
    assert not unseen, unseen[:5]


def test_a_flipped_bit_anywhere_in_the_file_is_found(messages, tmp_path) -> None:
    """Also one of a plant's parameter on which no output depends: by the file's checksums."""
    data = next(write(tmp_path / "bag", messages).glob("*.mcap")).read_bytes()
    path = tmp_path / "flipped.mcap"
    for at in range(0, len(data) - len(MAGIC), 1 if ALL else 53):  # without the last bytes it is as after a crash
        path.write_bytes(data[:at] + bytes([data[at] ^ 1 << at % 8]) + data[at + 1 :])
        try:
            assert verify(path).status != VERIFIED, at
        except BagError:
            continue


@pytest.mark.parametrize(
    ("name", "value", "status"),
    [
        ("gain", 1.0 + 1e-9, DIFFERENT),
        ("time_constant", 5.0 - 1e-9, DIFFERENT),
        ("dead_time", 0.001, DIFFERENT),
        ("lanes", 2, DIFFERENT),
        ("effort_max", 3.0, DIFFERENT),
        ("model", "second_order", DIFFERENT),
        ("model", "no_such", UNCHECKED),
        ("mode", "lockstop", UNCHECKED),
        ("sample_period", 0.01, DIFFERENT),
    ],
)
def test_a_plant_of_other_parameters_is_found(name, value, status, case, messages, tmp_path) -> None:
    other = replace(case, plant_values={**case.plant_values, "lanes": 1, "mode": "lockstep", name: value})
    with LoopBag(tmp_path / "parameters") as bag:
        limits = {"effort_min": -np.inf, "effort_max": np.inf}
        bag.parameters("plant", {**limits, **other.plant_values, "model": case.model, name: value})
    with BagReader(tmp_path / "parameters") as reader:
        ((_, _, _, event),) = reader.messages()
        changed = bytes(event)
    topic, type_name, log_ns, original = messages[0]
    assert b"/plant" in original
    account = verify(write(tmp_path / "bag", [(topic, type_name, log_ns, changed), *messages[1:]]))
    assert account.status == status, account.lines()


def test_a_bag_that_misses_outputs_is_not_wrong_but_not_all_checked(messages, tmp_path) -> None:
    outputs = [i for i, message in enumerate(messages) if message[0] == "/output"]
    account = verify(write(tmp_path / "bag", [m for i, m in enumerate(messages) if i != outputs[2]]))
    assert account.status == UNCHECKED and not account.differs
