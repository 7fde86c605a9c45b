"""What the page tells of its recorders: success only where there is a bag."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from dds_domain import reserved_domain
from live_program import eventually

pytest.importorskip("rclpy")

from tdof_npid_ros.live.recordings import Recordings
from tdof_npid_ros.parameter_file import find_parameter_file


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A parameter file; the folder is one of the test's own."""
    number, domain = reserved_domain()
    with domain:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(number))
        monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        monkeypatch.chdir(tmp_path)
        yield find_parameter_file("p1-c0.5")


def has_ended(recordings: Recordings) -> bool:
    recordings.look()
    return not recordings.runs


@pytest.mark.timeout(120)
def test_a_recorder_that_cannot_record_is_told_with_its_reason(file: Path) -> None:
    Path("bags").write_text("no folder")
    recordings = Recordings("/loop", file)
    recordings.switch(True)
    eventually(lambda: has_ended(recordings), "its end")
    assert recordings.failed and "cannot create the bag bags/live-loop-" in recordings.told
    recordings.switch(False)
    assert recordings.failed and not recordings.told.startswith("recorded")


@pytest.mark.timeout(120)
def test_what_ends_before_it_has_begun_is_not_told_as_recorded(file: Path) -> None:
    recordings = Recordings("/loop", file)
    recordings.switch(True)
    recordings.switch(False)
    assert recordings.failed and recordings.told.startswith("nothing is recorded")


@pytest.mark.timeout(120)
def test_two_loops_are_recorded_at_the_same_time(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tdof_npid_ros.live.recordings.time.strftime", lambda _: "now")
    loops = [Recordings(namespace, file) for namespace in ("/", "/a", "/a/b")]
    for loop in loops:
        loop.switch(True)
    bags = [Path(f"bags/live{names}-now") for names in ("", "-a", "-a-b")]
    eventually(lambda: all(list(bag.glob("*.mcap")) for bag in bags), "a bag of each")
    for loop, bag in zip(loops, bags, strict=True):
        assert loop.runs and loop.told == f"recording to {bag}"
        loop.switch(False)
        assert not loop.failed and loop.told.startswith(f"recorded: {bag};")


@pytest.mark.timeout(120)
def test_the_page_shows_what_has_become_of_its_recorder(file: Path) -> None:
    from tdof_npid_ros.live.hand import Hand
    from tdof_npid_ros.live.view import View

    recordings = Recordings("/loop", file)
    steering = SimpleNamespace(problems={}, values={})
    observer = SimpleNamespace(count=0, rows_since=lambda _: ([], 0), lane_names=())
    loop: Any = SimpleNamespace(case=None, recordings=recordings, steering=steering, observer=observer)
    hands = [Hand(View(loop), ()) for _ in range(2)]  # of two browsers
    shown = [hand.layout.select_one({"name": "recorded"}) for hand in hands]
    toggles = [hand.layout.select_one({"name": "record"}) for hand in hands]
    Path("bags").write_text("no folder")
    toggles[0].active = True
    hands[1].look()
    assert [toggle.active for toggle in toggles] == [True, True]
    assert all(one.text.startswith("recording to bags/live-loop-") for one in shown)
    eventually(lambda: has_ended(recordings), "its end")
    for hand in hands:
        hand.look()
    assert [toggle.active for toggle in toggles] == [False, False]
    assert all("refused" in one.text and "cannot create the bag" in one.text for one in shown)
