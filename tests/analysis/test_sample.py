"""The sample bag is sound, and the viewers' layouts show what is in it."""

import hashlib
import json
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tdof_npid_ros.analysis.report import analyze
from tdof_npid_ros.analysis.verify import verify
from tdof_npid_ros.bag.reader import BagReader
from tdof_npid_ros.case import load_case
from tdof_npid_ros.control.controller import parameters_digest

ROOT = Path(__file__).parents[2]
SAMPLE = ROOT / "bags" / "sample"


@pytest.fixture(scope="module")
def reader() -> Iterator[BagReader]:
    with BagReader(SAMPLE) as reader:
        yield reader


def values(reader: BagReader, topic: str, field: str, index: int) -> np.ndarray:
    """An element of an array that all messages of a topic have."""
    column: np.ndarray = reader.columns(topic, [field])[field][:, index]
    return column


def test_it_is_whole_and_every_effort_is_verified(reader) -> None:
    assert not reader.truncated and reader.custom_data["lost"] == "0"
    account = verify(SAMPLE)
    assert account.sound and account.equal > 2000 and not account.unverifiable


def test_it_is_the_one_that_was_recorded_in_2026(reader) -> None:
    """What was recorded stays good: this bag is not to be recorded anew. Its labels are of the old form."""
    data = hashlib.sha256((SAMPLE / "sample_0.mcap").read_bytes()).hexdigest()
    assert data == "09a6fe8637776cdc036014da9221eaeefb6dc9f8ca3f8a5c2269eef8141250da"
    frames = set(reader.columns("/output", ["header.frame_id"])["header.frame_id"])
    assert frames == {"9002efe4783f/1", "bb63a0f0eb0b/2"}


def test_options_at_their_defaults_leave_a_parameters_digest_as_it_was(reader) -> None:
    frames = reader.columns("/control_effort", ["header.frame_id"])["header.frame_id"]
    case = load_case("p1-c0.5")
    assert {frame.partition(" ")[0] for frame in frames} == {parameters_digest(case.gains, case.sample_period_ns)}


def test_its_episodes_are_the_simulation(reader) -> None:
    setpoint, disturbance = analyze([SAMPLE]).episodes
    assert (setpoint.episode.name, disturbance.episode.name) == ("setpoint", "disturbance")
    for report in (setpoint, disturbance):
        assert report.episode.missing == 0
        assert report.deviation.output == report.deviation.control_effort == 0.0


def test_foxglove_shows_values_that_are_there(reader) -> None:
    layout = json.loads((ROOT / "config" / "foxglove.json").read_text())
    paths = [path for panel in layout["configById"].values() for path in panel.get("paths", [])]
    assert len(paths) == 8
    for path in paths:
        topic, field, index = re.fullmatch(r"(/\w+)\.(\w+)\[(\d+|:)\]", path["value"]).groups()
        assert path["timestampMethod"] == "headerStamp"
        assert path.get("showLine", True) == (index != ":")  # a line would go to and fro between the lanes
        assert len(values(reader, topic, field, 0 if index == ":" else int(index)))
        if topic == "/controller_state":
            assert set(reader.columns(topic, ["name"])["name"][:, int(index)]) == {path["label"]}


def test_plotjuggler_shows_values_that_are_there(reader) -> None:
    """It calls the series of a JointState topic/name/field, and leaves out values without a name."""
    layout = ElementTree.parse(ROOT / "config" / "plotjuggler.xml")
    series = [curve.attrib["name"] for curve in layout.iter("curve")]
    assert len(series) == 8
    loader = next(layout.iter("parameters")).attrib
    assert (loader["use_timestamp"], loader["use_mcap_log_time"]) == ("1", "0")
    loaded = loader["selected_topics"].split(";")
    for name in series:
        topic, element, field = re.fullmatch(r"(/\w+)/(\w+)/(\w+)", name).groups()
        assert topic in loaded
        names = reader.columns(topic, ["name"])["name"][0].tolist()
        assert len(values(reader, topic, field, names.index(element)))
