"""Signals on the wire against rosbags' CDR, both ways; what is no JointState is refused; labels, both ways."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from tdof_npid_ros.wire import (
    JOINT_STATE,
    NO_VALUES,
    SECOND,
    AnswerLabel,
    EpisodeLabel,
    Sample,
    SignalReader,
    SignalWriter,
)

TYPES = get_typestore(Stores.ROS2_JAZZY)
words = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=9)
values = st.lists(st.floats(width=64), max_size=5).map(np.array).map(np.float64)
samples = st.builds(
    Sample,
    stamp_ns=st.integers(-(2**31) * SECOND, (2**31 - 1) * SECOND),
    frame_id=words,
    name=st.lists(words, max_size=4).map(tuple),
    position=values,
    velocity=values,
    effort=values,
)


def serialized(sample: Sample, little_endian: bool = True) -> bytes:
    of: Any = TYPES.types
    seconds, nanoseconds = divmod(sample.stamp_ns, SECOND)
    header = of["std_msgs/msg/Header"](of["builtin_interfaces/msg/Time"](seconds, nanoseconds), sample.frame_id)
    message = of[JOINT_STATE](header, list(sample.name), sample.position, sample.velocity, sample.effort)
    return bytes(TYPES.serialize_cdr(message, JOINT_STATE, little_endian=little_endian))


def is_same(a: Sample, b: Sample) -> bool:
    return a[:3] == b[:3] and all(one.tobytes() == other.tobytes() for one, other in zip(a[3:], b[3:], strict=True))


@given(st.lists(st.tuples(samples, st.booleans()), min_size=1, max_size=4))
def test_one_reader_reads_whatever_comes(several: list[tuple[Sample, bool]]) -> None:
    reader = SignalReader()
    for sample, little_endian in several * 2:
        assert is_same(reader.read(serialized(sample, little_endian)), sample)


@given(samples, st.integers(0, 10**12))
def test_what_is_written_is_what_others_write(sample: Sample, later_ns: int) -> None:
    writer = SignalWriter()
    writer.label(sample.frame_id, sample.name)
    for stamp_ns in (later_ns, sample.stamp_ns):
        data = writer.write(stamp_ns, sample.position, sample.velocity, sample.effort)
        expected = serialized(sample._replace(stamp_ns=stamp_ns))
        assert data == expected[: len(data)]
        assert not any(expected[len(data) :])


@given(samples, st.data())
def test_a_message_cut_short_is_refused_and_the_next_one_read(sample: Sample, data: st.DataObject) -> None:
    writer, reader = SignalWriter(), SignalReader()
    writer.label(sample.frame_id, sample.name)
    whole = writer.write(sample.stamp_ns, sample.position, sample.velocity, sample.effort)
    cut = data.draw(st.integers(0, len(whole) - 1))
    for _ in range(2):
        with pytest.raises(ValueError, match=f"its {cut} bytes are not a valid JointState"):
            reader.read(whole[:cut])
        assert is_same(reader.read(whole), sample)


@given(st.binary(max_size=200))
def test_any_bytes_are_a_signal_or_refused(data: bytes) -> None:
    reader = SignalReader()
    for head in (b"", b"\0\1\0\0", b"\0\0\0\0"):
        try:
            sample = reader.read(head + data)
        except ValueError as error:
            assert "not a valid JointState" in str(error)
        else:
            assert len(sample.position) <= len(data) / 8


def test_other_encodings_and_stamps_that_are_none_are_refused() -> None:
    data = SignalWriter().write(0)
    hostile = [b"\0\7" + data[2:], b"?\0\0\0" + b"\0" * 8 + b"?" + b"\0" * 600]
    hostile += [data[:8] + nanoseconds.to_bytes(4, sys.byteorder) + data[12:] for nanoseconds in (10**9, 2**32 - 1)]
    for bytes_ in hostile:
        with pytest.raises(ValueError, match="not a valid JointState in plain CDR"):
            SignalReader().read(bytes_)


def test_a_name_that_is_not_utf_8_is_read() -> None:
    writer = SignalWriter()
    writer.label("abc", ["elbow"])
    assert SignalReader().read(writer.write(0).replace(b"elbow", b"\xe9lbow")).name == ("\ufffdlbow",)


def test_values_are_the_signals_own() -> None:
    reader, writer = SignalReader(), SignalWriter()
    sample = reader.read(writer.write(0, effort=np.array([1.0, 2.0])))
    assert sample.position is NO_VALUES
    sample.effort[0] = 3.0  # a node may keep and change it
    assert sample.effort.flags.aligned


@pytest.mark.parametrize(
    ("text", "label"),
    [
        ("0123456789ab/c0ffee11.3", EpisodeLabel("0123456789ab", "c0ffee11", 3)),
        ("-/c0ffee11.12", EpisodeLabel("", "c0ffee11", 12)),
        ("0123456789ab/7", EpisodeLabel("0123456789ab", "", 7)),  # of the old form
    ],
)
def test_a_label_is_what_it_is_written_as(text: str, label: EpisodeLabel) -> None:
    assert EpisodeLabel.parse(text) == label
    assert str(label) == text
    answer = AnswerLabel("deadbeef0123", label)
    assert AnswerLabel.parse(str(answer)) == answer
    assert EpisodeLabel.named_in(text) == EpisodeLabel.named_in(str(answer)) == label


@pytest.mark.parametrize(
    "frame",
    ["", "base_link", "robot1/base_link", "-/x", "-/.1", "-/3", "0123456789ab/", "0123/a.1", "a b/c.1"],
)
def test_any_other_frame_is_no_label(frame: str) -> None:
    assert EpisodeLabel.parse(frame) is None
    assert EpisodeLabel.named_in(frame) is None
    assert AnswerLabel.parse(frame).episode is None


def test_an_answer_to_a_robot_bears_its_parameters_alone() -> None:
    assert str(AnswerLabel("deadbeef0123")) == "deadbeef0123"
    assert AnswerLabel.parse("deadbeef0123") == AnswerLabel("deadbeef0123", None)


def test_later_episodes_are_those_of_the_same_activation() -> None:
    first, second, other = (EpisodeLabel("", *of) for of in (("a", 1), ("a", 2), ("b", 9)))
    assert second.follows(first)
    assert not (first.follows(second) or first.follows(first) or other.follows(first))
