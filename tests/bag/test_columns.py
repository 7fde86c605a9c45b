import numpy as np
import pytest
from bag_samples import JOINT_STATE, START_NS, TYPES, header, joint_state, serialize, stamp, write_bag
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from tdof_npid_ros.bag import BagError, schema
from tdof_npid_ros.bag.cdr import decode
from tdof_npid_ros.bag.columns import ColumnBuilder
from tdof_npid_ros.bag.definition import parse
from tdof_npid_ros.bag.reader import BagReader
from tdof_npid_ros.bag.scan import Table
from tdof_npid_ros.bag.writer import BagWriter


def columns_of(type_name, messages, fields=None, times=None):
    """Return the columns of serialized messages that lie one after the other."""
    builder = ColumnBuilder(parse(type_name, schema.definition(type_name)), fields, "test")
    length = np.array([len(message) for message in messages], np.int64)
    times = np.arange(len(messages)) if times is None else np.array(times, np.int64)
    builder.add(
        Table(
            np.frombuffer(b"".join(messages), np.uint8),
            np.ones(len(messages), np.uint16),
            np.zeros(len(messages), np.uint32),
            times,
            times,
            np.cumsum(length) - length,
            length,
        )
    )
    return builder.finish()


def test_loop_signals_are_plain_arrays(tmp_path) -> None:
    write_bag(tmp_path / "bag", 20_000)
    with BagReader(tmp_path / "bag") as reader:
        columns = reader.columns("/output")
    steps = np.arange(0, 20_000, 2)
    assert_array_equal(columns["position"], np.sin(steps)[:, np.newaxis])
    assert_array_equal(columns["effort"], np.cos(steps)[:, np.newaxis])
    assert_array_equal(columns["log_time"], START_NS + steps * 1000)
    assert_array_equal(columns["publish_time"], START_NS + steps * 1000 - 7)
    assert_array_equal(columns["header.stamp"], steps * 1000)
    assert columns["header.stamp"].dtype == np.int64
    assert set(columns["header.frame_id"]) == {"a1b2c3/0"}
    assert columns["name"].shape == (10_000, 0)


def test_only_the_fields_asked_for(tmp_path) -> None:
    write_bag(tmp_path / "bag", 10)
    with BagReader(tmp_path / "bag") as reader:
        assert set(reader.columns("/output", ["effort"])) == {"log_time", "publish_time", "effort"}
        with pytest.raises(BagError, match=r"no field 'torque': choose from .*effort"):
            reader.columns("/output", ["torque"])
        with pytest.raises(BagError, match=r"no topic '/input'"):
            reader.columns("/input")


def test_empty_topic_has_empty_columns(tmp_path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        writer.add_topic("/output", JOINT_STATE)
    with BagReader(tmp_path / "bag") as reader:
        columns = reader.columns("/output")
        assert all(len(column) == 0 for column in columns.values())
        assert columns["position"].dtype == np.float64
        assert (reader.start_ns, reader.end_ns) == (0, 0)


def test_out_of_order_messages_are_put_in_order() -> None:
    messages = [joint_state(position=[value]) for value in (2.0, 0.0, 1.0)]
    columns = columns_of(JOINT_STATE, messages, times=[20, 0, 10])
    assert_array_equal(columns["position"][:, 0], [0, 1, 2])


def test_big_endian_and_little_endian_mix() -> None:
    messages = [joint_state(k, "frame", ["a"], [k], [], [2 * k], little_endian=k % 3 == 0) for k in range(50)]
    columns = columns_of(JOINT_STATE, messages)
    assert_array_equal(columns["effort"][:, 0], 2.0 * np.arange(50))
    assert_array_equal(columns["header.stamp"], np.arange(50))
    assert columns["effort"].dtype.isnative


def test_strings_of_many_lengths_and_alphabets() -> None:
    frames = ["", "a", "Größe", "日本語", "x" * 30, "a"] * 5
    columns = columns_of(JOINT_STATE, [joint_state(0, frame) for frame in frames])
    assert columns["header.frame_id"].tolist() == frames
    assert columns["header.frame_id"].dtype.kind == "U"


def test_one_huge_string_does_not_blow_up_the_column() -> None:
    frames = ["short"] * 5000 + ["x" * 100_000]
    column = columns_of(JOINT_STATE, [joint_state(0, frame) for frame in frames])["header.frame_id"]
    assert column.dtype == object
    assert column.tolist() == frames


def test_names_are_a_table_of_strings() -> None:
    names = ["error", "scaled_error", "integral"]
    columns = columns_of(JOINT_STATE, [joint_state(0, "", names, [1, 2, 3])] * 4)
    assert columns["name"].shape == (4, 3)
    assert columns["name"][3].tolist() == names


def test_arrays_of_varying_length_become_objects() -> None:
    columns = columns_of(JOINT_STATE, [joint_state(position=range(k % 4)) for k in range(40)])
    assert columns["position"].dtype == object
    assert [value.tolist() for value in columns["position"][:4]] == [[], [0], [0, 1], [0, 1, 2]]
    assert columns["effort"].shape == (40, 0)


def test_more_layouts_of_one_length_than_are_compared() -> None:
    messages = [joint_state(0, "x" * (4 * k), ["y" * (400 - 4 * k)]) for k in range(100)]
    assert len({len(message) for message in messages}) == 1
    columns = columns_of(JOINT_STATE, messages)
    assert [len(frame) for frame in columns["header.frame_id"]] == [4 * k for k in range(100)]


def test_arrays_of_messages_become_dicts() -> None:
    point = TYPES.types["trajectory_msgs/msg/JointTrajectoryPoint"]
    duration = TYPES.types["builtin_interfaces/msg/Duration"]
    trajectory = TYPES.types["trajectory_msgs/msg/JointTrajectory"]
    empty = np.zeros(0)
    points = [point(np.array([1.0, 2.0]), empty, empty, empty, duration(k, 5)) for k in range(3)]
    name = "trajectory_msgs/msg/JointTrajectory"
    data = serialize(name, trajectory(header(7, "plan"), ["setpoint", "disturbance"], points))
    columns = columns_of(name, [data, data])
    assert columns["joint_names"][1].tolist() == ["setpoint", "disturbance"]
    assert [value["time_from_start"]["sec"] for value in columns["points"][1]] == [0, 1, 2]
    message = decode(name, schema.definition(name), data)
    assert message["header"] == {"stamp": {"sec": 0, "nanosec": 7}, "frame_id": "plan"}
    assert_array_equal(message["points"][2]["positions"], [1, 2])


def test_parameter_events_decode() -> None:
    types = TYPES.types
    empty = [np.zeros(0, dtype) for dtype in (np.uint8, bool, np.int64, np.float64)]
    value = types["rcl_interfaces/msg/ParameterValue"](3, True, -5, 2.5, "txt", *empty, ["a", "b"])
    parameter = types["rcl_interfaces/msg/Parameter"]("kp", value)
    name = "rcl_interfaces/msg/ParameterEvent"
    data = serialize(name, types[name](stamp(3), "/controller", [parameter], [parameter, parameter], []))
    message = decode(name, schema.definition(name), data)
    changed = message["changed_parameters"][1]
    assert (changed["name"], changed["value"]["double_value"]) == ("kp", 2.5)
    assert changed["value"]["bool_value"] is True
    assert changed["value"]["string_array_value"] == ["a", "b"]
    assert message["deleted_parameters"] == []


floats = st.lists(st.floats(width=64), max_size=3)
text = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=6)


@given(
    st.lists(
        st.tuples(st.integers(0, 2**31 * 10**9 - 1), text, st.lists(text, max_size=3), floats, floats, floats),
        min_size=1,
        max_size=30,
    ),
    st.booleans(),
)
@settings(max_examples=100, deadline=None)
def test_columns_hold_what_single_messages_hold(contents, little_endian) -> None:
    messages = [joint_state(*content, little_endian=little_endian) for content in contents]
    columns = columns_of(JOINT_STATE, messages)
    for row, data in enumerate(messages):
        message = decode(JOINT_STATE, schema.definition(JOINT_STATE), data)
        seconds, nanoseconds = message["header"]["stamp"].values()
        assert columns["header.stamp"][row] == seconds * 10**9 + nanoseconds == contents[row][0]
        assert columns["header.frame_id"][row] == message["header"]["frame_id"] == contents[row][1]
        assert list(columns["name"][row]) == message["name"] == contents[row][2]
        for field in ("position", "velocity", "effort"):
            assert_array_equal(columns[field][row], message[field])


def test_zeros_at_the_end_of_a_string_are_kept() -> None:
    """As drivers send them that copy texts of fixed length; NumPy's own strings would lose them."""
    messages = [joint_state(0, frame, ["elbow\0\0", "wrist"], [1.0, 2.0]) for frame in ("", "\0", "a\0\0", "base")]
    columns = columns_of(JOINT_STATE, messages)
    assert columns["header.frame_id"].tolist() == ["", "\0", "a\0\0", "base"]
    assert [list(names) for names in columns["name"]] == [["elbow\0\0", "wrist"]] * 4


def test_several_bags_are_one(tmp_path) -> None:
    write_bag(tmp_path / "first", 100)
    write_bag(tmp_path / "second", 100)
    with BagReader(tmp_path / "first", tmp_path / "second") as reader:
        assert reader.topics["/output"].count == 100
        assert len(reader.columns("/output")["effort"]) == 100
        times = [message[1] for message in reader.messages()]
        assert times == sorted(times)
        assert len(times) == 200


def test_messages_of_a_time_and_topic(tmp_path) -> None:
    written = write_bag(tmp_path / "bag", 1000)
    start, stop = written[100][1], written[200][1]
    with BagReader(tmp_path / "bag") as reader:
        found = list(reader.messages(["/output"], start_ns=start, stop_ns=stop))
    assert [message[1] for message in found] == [message[1] for message in written[100:200:2]]
