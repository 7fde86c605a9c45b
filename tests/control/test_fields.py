"""The output and the setpoint from fields of any topic."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tdof_npid_ros.control.fields import FieldReader, parse_fields
from tdof_npid_ros.field_path import FieldPathError

HEADER = {"stamp": {"sec": 3, "nanosec": 5}, "frame_id": "imu"}
IMU = {"header": HEADER, "angular_velocity": {"x": 1.0, "y": 2.0, "z": 3.0}}
JOINTS = {"header": HEADER, "name": ["a", "b"], "position": np.array([1.0, 2.0]), "velocity": np.array([3.0, 4.0])}
STAMPED, SENT_NS = 3_000_000_005, 7


def read(texts: Any, message: Any) -> Any:
    fields = parse_fields(texts)
    return FieldReader(fields).read(fields[0].path.topic, message, SENT_NS)


@pytest.mark.parametrize(
    ("texts", "message", "names", "values", "stamp_ns"),
    [
        ("/imu sensor_msgs/msg/Imu angular_velocity.z", IMU, (), [3.0], STAMPED),
        ("/imu sensor_msgs/Imu angular_velocity.z 2", IMU, (), [6.0], STAMPED),
        ("/imu sensor_msgs/msg/Imu angular_velocity.z -2 0.5", IMU, (), [-5.5], STAMPED),
        (["/imu sensor_msgs/msg/Imu angular_velocity.z", "/imu sensor_msgs/msg/Imu angular_velocity.x 10"], IMU, (),
         [3.0, 10.0], STAMPED),
        ("/js sensor_msgs/msg/JointState velocity", JOINTS, ("a", "b"), [3.0, 4.0], STAMPED),
        ("/js sensor_msgs/msg/JointState velocity[b]", JOINTS, (), [4.0], STAMPED),
        ("/level std_msgs/msg/Float64 data", {"data": 0.25}, (), [0.25], SENT_NS),
    ],
)  # fmt: skip
def test_fields_are_lanes_with_scale_offset_and_stamp(
    texts: Any, message: Any, names: tuple[str, ...], values: list[float], stamp_ns: int
) -> None:
    sample = read(texts, message)
    assert (sample.name, sample.position.tolist(), sample.stamp_ns) == (names, values, stamp_ns)


def test_nothing_given_is_no_field() -> None:
    assert parse_fields("") == parse_fields([""]) == []


@pytest.mark.parametrize(
    ("texts", "reason"),
    [
        ("/imu angular_velocity.z", "no field with its type"),
        ("/imu:angular_velocity.z", "no field with its type"),
        ("/imu sensor_msgs/msg/Imu angular_velocity.z x", "must be numbers"),
        ("/imu sensor_msgs/msg/Imu angular_velocity.z 0", "the scale not 0"),
        ("/imu sensor_msgs/msg/Imu angular_velocity.z 1 inf", "finite"),
        ("/imu sensor_msgs/msg/Imu z 1 2 3", "no field with its type"),
        ("/i-mu sensor_msgs/msg/Imu z", "is no topic"),
        (["/a std_msgs/msg/Float64 data", "/a std_msgs/msg/Float32 data"], "a topic has one type"),
        ("/imu sensor_msgs/msg/Imu angular_velocity.w", "no field 'w'"),
        ("/imu sensor_msgs/msg/Imu angular_velocity", "leads to no number"),
    ],
)
def test_what_is_no_field_is_refused_with_the_reason(texts: Any, reason: str) -> None:
    with pytest.raises(FieldPathError, match=reason):
        read(texts, IMU)


@pytest.mark.parametrize(("sec", "nanosec"), [(3, 10**9), (2**31 - 1, 2**32 - 1), (2**31, 0)])
def test_a_stamp_that_is_no_time_is_refused_and_nothing_of_its_message_is_taken(sec: int, nanosec: int) -> None:
    reader = FieldReader(parse_fields(TWO))
    header = {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": ""}
    bad = {"header": header, "angular_velocity": {"x": 7.0, "y": 7.0, "z": 7.0}}
    assert reader.read("/imu", IMU, SENT_NS) is None
    with pytest.raises(FieldPathError, match="is no time"):
        reader.read("/imu", bad, SENT_NS)
    sample = reader.read("/b", {"data": 0.5}, 6)
    assert sample is not None and (sample.stamp_ns, sample.position[1]) == (STAMPED, 6.0)


@pytest.mark.parametrize("sent_ns", [2**31 * 10**9, -(2**31) * 10**9 - 1, 2**63 - 1])
def test_a_time_of_sending_that_no_stamp_holds_is_refused(sent_ns: int) -> None:
    reader = FieldReader(parse_fields("/level std_msgs/msg/Float64 data"))
    with pytest.raises(FieldPathError, match="is no time"):
        reader.read("/level", {"data": 0.25}, sent_ns)
    sample = reader.read("/level", {"data": 0.25}, -1)
    assert sample is not None and sample.stamp_ns == -1


TWO = [
    "/b std_msgs/msg/Float64 data",
    "/imu sensor_msgs/msg/Imu angular_velocity.z 2",
    "/b std_msgs/msg/Float64 data -1",
]


def test_an_output_from_several_topics_waits_until_each_has_something_new() -> None:
    reader = FieldReader(parse_fields(TWO))
    assert reader.read("/b", {"data": 0.5}, 4) is None and reader.awaited == ["/imu"]
    assert reader.read("/b", {"data": 0.25}, 6) is None  # the latest counts
    sample = reader.read("/imu", IMU, SENT_NS)
    assert sample is not None
    assert (sample.stamp_ns, sample.position.tolist()) == (STAMPED, [0.25, 6.0, -0.25])
    assert reader.read("/imu", IMU, SENT_NS) is None and reader.awaited == ["/b"]


def test_a_setpoint_from_several_topics_leaves_the_lanes_of_the_others() -> None:
    reader = FieldReader(parse_fields(TWO), whole=False)
    for topic, message, values in (("/b", {"data": 0.5}, [0.5, np.nan, -0.5]), ("/imu", IMU, [np.nan, 6.0, np.nan])):
        sample = reader.read(topic, message, SENT_NS)
        assert sample is not None and np.array_equal(sample.position, values, equal_nan=True)
