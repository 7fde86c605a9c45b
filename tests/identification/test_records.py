"""Records from bags of our own and of other people: topics and fields as they are, stamped or not."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import pytest

from tdof_npid_ros.analysis.sources import NOTHING_CHOSEN, Chosen
from tdof_npid_ros.case import Case, make_case
from tdof_npid_ros.identification import IdentificationError
from tdof_npid_ros.identification.identify import Identified, identify
from tdof_npid_ros.identification.records import Record, read_records
from tdof_npid_ros.identification.result import draft_of
from tdof_npid_ros.identification.structures import STRUCTURES
from tdof_npid_ros.plants.linear import TransferFunction
from tdof_npid_ros.plants.simulator import PlantSimulator

sys.path.insert(0, str(Path(__file__).parents[1] / "analysis"))
from foreign_bags import (
    FLOAT64,
    FLOAT64_ARRAY,
    H_NS,
    JOINT_STATE,
    START_NS,
    Message,
    float64,
    floats,
    joints,
    write,
)
from loop_bags import LoopBag

GAIN, TIME_CONSTANT, DEAD_TIME = 3.0, 0.2, 0.035
SAMPLES = 600


def driven() -> tuple[np.ndarray, np.ndarray]:
    """Effort and output of a plant at an operating point, stepped up and down."""
    k = np.arange(SAMPLES)
    effort = 20.0 + np.select([k < 60, k < 200, k < 350, k < 470], [0.0, 5.0, -3.0, 4.0], 1.0)
    plant = TransferFunction((GAIN,), (TIME_CONSTANT, 1.0), DEAD_TIME, 50.0, 20.0)
    simulator = PlantSimulator(plant, H_NS, 1, (-math.inf, math.inf))
    output = np.zeros(SAMPLES)
    for i in range(SAMPLES):
        output[i] = simulator.output[0]
        simulator.advance(effort[i : i + 1], np.zeros(1))
    return effort, output


def found_in(records: list[Record]) -> Identified:
    return identify([record.stretch for record in records], [STRUCTURES["first_order"]])


def check(found: Identified, dead_time: float = DEAD_TIME) -> None:
    values = found.values
    assert values["gain"] == pytest.approx(GAIN, rel=1e-3)
    assert values["time_constant"] == pytest.approx(TIME_CONSTANT, rel=1e-2)
    assert values["dead_time"] == pytest.approx(dead_time, abs=1e-3)
    assert found.level == pytest.approx(50.0, abs=0.01)
    assert found.effort_level == pytest.approx(20.0)


def test_float64_topics_without_stamps(tmp_path: Path) -> None:
    effort, output = driven()
    messages: list[Message] = []
    for k in range(SAMPLES):
        messages.append((k * H_NS, "/temperature", FLOAT64, float64(output[k])))
        messages.append((k * H_NS + 1_000_000, "/heater", FLOAT64_ARRAY, floats([0.0, effort[k]])))
    bag = write(tmp_path / "bag", messages)
    chosen = Chosen.read("/temperature:data", None, "/heater:data[1]")
    check(found_in(read_records([bag], chosen=chosen)))


def test_one_joint_of_several_with_its_own_effort(tmp_path: Path) -> None:
    """The effort in the message of an output is the one until then."""
    effort, output = driven()
    messages: list[Message] = []
    for k in range(1, SAMPLES):
        stamp = START_NS + k * H_NS
        values = {"wrist": 0.1 * k, "elbow": output[k]}
        message = joints(values, stamp, effort=[0.0, effort[k - 1]])
        messages.append((k * H_NS, "/joint_states", JOINT_STATE, message))
    bag = write(tmp_path / "bag", messages)
    with pytest.raises(IdentificationError, match=r"2 outputs in it.*elbow.*choose one with --output"):
        read_records([bag])
    chosen = Chosen.read("/joint_states:position[elbow]", None, None)
    (record,) = read_records([bag], chosen=chosen)
    check(found_in([record]))


def test_two_bags_are_one_plant_s(tmp_path: Path) -> None:
    effort, output = driven()
    bags = []
    for name, part in (("a", range(300)), ("b", range(300, SAMPLES))):
        messages: list[Message] = []
        for k in part:
            messages.append((k * H_NS, "/temperature", FLOAT64, float64(output[k])))
            messages.append((k * H_NS + 1_000_000, "/heater", FLOAT64, float64(effort[k])))
        bags.append(write(tmp_path / name, messages))
    records = read_records(bags, chosen=Chosen.read("/temperature:data", None, "/heater:data"))
    assert len(records) == 2
    assert found_in(records).values["gain"] == pytest.approx(GAIN, rel=0.01)


def test_a_bag_without_an_effort_is_refused(tmp_path: Path) -> None:
    _, output = driven()
    bag = write(tmp_path / "bag", [(k * H_NS, "/temperature", FLOAT64, float64(y)) for k, y in enumerate(output)])
    with pytest.raises(IdentificationError, match="choose it with --effort"):
        read_records([bag], chosen=Chosen.read("/temperature:data", None, None))


def started(folder: Path) -> tuple[Case, Path]:
    """A bag of two episodes that begin at rest where the plan starts, far from where the file does."""
    plant = {"model": "first_order", "gain": GAIN, "time_constant": TIME_CONSTANT, "dead_time": DEAD_TIME}
    plans = {
        "setpoint": ["0 start 30", "0 setpoint 31", "3 end"],
        "disturbance": ["0 start 60", "0 setpoint 60", "0 disturbance 2", "3 end"],
    }
    case = make_case(plant, {"type": "pid", "kp": 0.5, "ki": 2.0}, plans, sample_period=0.01)
    with LoopBag(folder) as bag:
        bag.configuration(case, case.gains)
        for number, name in enumerate(plans, 1):
            bag.episode(case, case.gains, name, number)
    return case, folder


def test_the_effort_before_an_episode_is_that_of_where_it_starts(tmp_path: Path) -> None:
    _, bag = started(tmp_path / "bag")
    for chosen in (NOTHING_CHOSEN, Chosen.read(None, None, "/control_effort:effort[0]")):
        records = read_records([bag], chosen=chosen)
        assert [record.stretch.before for record in records] == pytest.approx([10.0, 20.0])
        found = identify([record.stretch for record in records])
        assert found.structure.name == "first_order" and not found.loads
        assert found.values["gain"] == pytest.approx(GAIN, rel=1e-3)
        assert found.values["dead_time"] == pytest.approx(DEAD_TIME, abs=1e-3)


def test_a_chosen_effort_is_that_of_the_same_episode(tmp_path: Path) -> None:
    case, bag = started(tmp_path / "bag")
    records = read_records([bag], chosen=Chosen.read(None, None, "/control_effort:effort[0]"))
    for record, name in zip(records, case.episodes, strict=True):
        run = case.simulate(name)
        asked = run.control_effort[:, 0] + case.signals[name].disturbance
        np.testing.assert_allclose(record.stretch.effort, asked, rtol=1e-12)


def test_noise_at_rest_is_no_step_of_the_setpoint(tmp_path: Path) -> None:
    plant = {"model": "first_order", "gain": GAIN, "time_constant": TIME_CONSTANT, "dead_time": 0.03, "noise": 0.01}
    plans = {"disturbance": ["0 disturbance 2", "3 end"]}
    case = make_case(plant, {"type": "pid", "kp": 0.5, "ki": 2.0}, plans, sample_period=0.01)
    with LoopBag(tmp_path / "bag") as bag:
        bag.configuration(case, case.gains)
        bag.episode(case, case.gains, "disturbance", 1)
    records = read_records([tmp_path / "bag"])
    draft = draft_of(identify([record.stretch for record in records]), records, "a tank")
    assert draft.step == pytest.approx(0.5 * float(np.ptp(records[0].stretch.output)), rel=0.1)


def test_an_operating_point_is_no_step_of_the_setpoint(tmp_path: Path) -> None:
    _, bag = started(tmp_path / "bag")
    records = read_records([bag])
    draft = draft_of(identify([record.stretch for record in records]), records, "a tank")
    assert draft.step == pytest.approx(1.0, rel=0.01)
