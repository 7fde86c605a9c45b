"""One grammar says which field of which topic a signal is, for bags (mappings) and nodes (messages) alike."""

from types import SimpleNamespace

import numpy as np
import pytest

from tdof_npid_ros.field_path import FieldPath, FieldPathError, Step

JOINTS = {"header": {"frame_id": ""}, "name": ["shoulder", "elbow"], "position": np.array([5.0, 1.0])}
IMU = {"angular_velocity": {"x": 0.0, "y": 0.0, "z": 0.25}}
STATES = {"dof_states": [{"name": "a", "feedback": 1.0}, {"name": "b", "feedback": 2.0}]}
TRAJECTORY = {"joint_names": ["a", "b"], "points": [{"positions": np.array([3.0, 4.0])}]}


@pytest.mark.parametrize(
    ("text", "message", "names", "values"),
    [
        ("/joint_states:position[elbow]", JOINTS, ("elbow",), [1.0]),
        ("/joint_states:position[0]", JOINTS, ("shoulder",), [5.0]),
        ("/joint_states:position", JOINTS, ("shoulder", "elbow"), [5.0, 1.0]),
        ("/imu/data:angular_velocity.z", IMU, (), [0.25]),
        ("/imu/data sensor_msgs/msg/Imu angular_velocity.z", IMU, (), [0.25]),
        ("/pid/state:dof_states[b].feedback", STATES, ("b",), [2.0]),
        ("/pid/state:dof_states[0].feedback", STATES, ("a",), [1.0]),
        ("/pid/state:dof_states.feedback", STATES, ("a", "b"), [1.0, 2.0]),
        ("/plan:points[0].positions[b]", TRAJECTORY, ("b",), [4.0]),
        ("/ref:data", {"data": 7}, (), [7.0]),
        ("/cmd:data[1]", {"data": [1.0, 2.0]}, (), [2.0]),
        ("/on:data", {"data": True}, (), [1.0]),
        ("/digits:position['7']", {"name": ["7"], "position": [3.0]}, ("7",), [3.0]),
    ],
)
def test_a_path_finds_its_numbers_and_their_names(text, message, names, values) -> None:
    found = FieldPath.parse(text).select(message)
    assert (found.names, found.values.tolist()) == (names, values)


@pytest.mark.parametrize(
    "text",
    [
        "/a:b",
        "/a/b:c.d[0].e[left hand]",
        "rel/topic:x",
        "/a pkg/msg/Type x.y[3]",
        "/a:b['7']",
        "/joint_states",
        "~/a:b",
    ],
)
def test_what_is_written_is_read_again(text) -> None:
    assert str(FieldPath.parse(text)) == text
    assert FieldPath.parse(str(FieldPath.parse(text))) == FieldPath.parse(text)


def test_a_type_is_known_by_either_name() -> None:
    assert FieldPath.parse("/imu sensor_msgs/Imu x").type == "sensor_msgs/msg/Imu"
    assert FieldPath.parse("/imu:x").type == ""
    assert FieldPath.parse("/imu").steps == ()
    assert FieldPath.parse("/a:b[2]").steps == (Step("b", 2),)


@pytest.mark.parametrize(
    "text",
    ["", ":x", "/a:", "/a:.b", "/a:b..c", "/a:b[", "/a:b[]", "/a:b[-1]", "/a:b]", "/a b", "/a:b c", "3/a:x", "/a:b.c."],
)
def test_what_cannot_be_read_is_refused_with_the_grammar(text) -> None:
    with pytest.raises(FieldPathError, match="write TOPIC:FIELD"):
        FieldPath.parse(text)


@pytest.mark.parametrize(
    ("text", "message", "reason"),
    [
        ("/j:effort", JOINTS, "no field 'effort': there are header, name, position"),
        ("/j:position[wrist]", JOINTS, "no element of position is called 'wrist': there are shoulder, elbow"),
        ("/j:position[2]", JOINTS, "position has 2 elements, so none at place 2"),
        ("/c:data[elbow]", {"data": [1.0]}, "names none, so choose by place"),
        ("/i:angular_velocity", IMU, "leads to no number: go on to one of x, y, z"),
        ("/i:angular_velocity[0]", IMU, "is no array"),
        ("/p:points.positions", TRAJECTORY, "choose an element"),
        ("/s:dof_states", STATES, "go on to one of name, feedback"),
        ("/j:name", JOINTS, "leads to no number"),
        ("/j:header.frame_id", JOINTS, "leads to no number"),
    ],
)
def test_what_is_not_there_is_said(text, message, reason) -> None:
    with pytest.raises(FieldPathError, match=reason):
        FieldPath.parse(text).select(message)


class Message(SimpleNamespace):
    """As rclpy's: attributes, and a method that lists them."""

    def get_fields_and_field_types(self) -> dict[str, str]:
        return dict.fromkeys(vars(self), "")


def test_messages_of_rclpy_are_read_alike_and_checked_before_there_is_one() -> None:
    message = Message(name=["a", "b"], position=[1.0, 2.0], pose=Message(x=3.0))
    assert FieldPath.parse("/t:position[b]").select(message).values.tolist() == [2.0]
    empty = Message(name=[], position=[], pose=Message(x=0.0))
    FieldPath.parse("/t:position[b]").check(empty)
    FieldPath.parse("/t:pose.x").check(empty)
    for wrong in ("/t:effort[0]", "/t:pose", "/t:pose.x[0]", "/t:pose.y"):
        with pytest.raises(FieldPathError):
            FieldPath.parse(wrong).check(empty)
