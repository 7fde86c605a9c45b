"""The sample bag is sound, and the viewers' layouts show what is in it."""

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
        topic, field, index = re.fullmatch(r"(/\w+)\.(\w+)\[(\d+)\]", path["value"]).groups()
        assert len(values(reader, topic, field, int(index)))
        if topic == "/controller_state":
            assert set(reader.columns(topic, ["name"])["name"][:, int(index)]) == {path["label"]}


def test_plotjuggler_shows_values_that_are_there(reader) -> None:
    """It calls the series of a JointState topic/name/field, and leaves out values without a name."""
    layout = ElementTree.parse(ROOT / "config" / "plotjuggler.xml")
    series = [curve.attrib["name"] for curve in layout.iter("curve")]
    assert len(series) == 8
    loaded = next(layout.iter("parameters")).attrib["selected_topics"].split(";")
    for name in series:
        topic, element, field = re.fullmatch(r"(/\w+)/(\w+)/(\w+)", name).groups()
        assert topic in loaded
        names = reader.columns(topic, ["name"])["name"][0].tolist()
        assert len(values(reader, topic, field, names.index(element)))
