"""Bags as other recorders write them, and as robots fill them: what can be read is read, the rest is named."""

import numpy as np
import pytest
from bag_samples import JOINT_STATE, TYPES, header, joint_state, serialize
from mcap.writer import Writer
from numpy.testing import assert_array_equal

from tdof_npid_ros.bag import BagError
from tdof_npid_ros.bag.reader import BagReader
from tdof_npid_ros.bag.schema import definition

MALFORMED = b"\0\1\0\0\xff"
STATE = """
std_msgs/Header header
SingleDOFState[] dof_states
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
================================================================================
MSG: control_msgs/SingleDOFState
string name
float64 reference
float64 feedback
float64[] gains
builtin_interfaces/Time at
"""


class Channels:
    """An MCAP file with any channels, as the `mcap` package writes it."""

    def __init__(self, path) -> None:
        self.path = path
        self._file = path.open("wb")
        self._writer = Writer(self._file)
        self._writer.start("ros2")

    def add(self, topic, type_name, messages, *, encoding="cdr", schema="ros2msg", text=None, metadata=None) -> None:
        """Add messages at 0, 1, 2, … ns; `schema` None: the channel has none."""
        number = 0
        if schema is not None:
            content = definition(type_name) if text is None else text
            number = self._writer.register_schema(type_name, schema, content.encode())
        channel = self._writer.register_channel(topic, encoding, number, metadata or {})
        for time, data in enumerate(messages):
            self._writer.add_message(channel, time, data, time)

    def close(self):
        self._writer.finish()
        self._file.close()
        return self.path


STATES = [joint_state(step, "frame", ["a"], [step / 10]) for step in range(10)]
SPOILERS = {
    "a channel without schema": lambda file: file.add("/odd", "", [b"{}"] * 3, encoding="json", schema=None),
    "CDR without schema": lambda file: file.add("/odd", "", [MALFORMED] * 3, schema=None),
    "an unknown encoding": lambda file: file.add("/odd", "x", [b"1"], encoding="protobuf", schema="protobuf", text=""),
    "no encoding": lambda file: file.add("/odd", JOINT_STATE, STATES, encoding=""),
    "two types": lambda file: (
        file.add("/odd", "std_msgs/msg/Bool", [b"\0\1\0\0\1"]),
        file.add("/odd", "std_msgs/msg/String", [b"\0\1\0\0\1\0\0\0\0"]),
    ),
    "two definitions of one type": lambda file: (
        file.add("/odd", "a/msg/B", [b"\0\1\0\0\1"], text="bool x"),
        file.add("/odd", "a/msg/B", [b"\0\1\0\0\1\0\0\0"], text="int32 x"),
    ),
    "a service event": lambda file: file.add("/odd", "std_srvs/srv/SetBool_Event", [MALFORMED], schema="", text=""),
    "a type without definition": lambda file: file.add("/odd", "my_msgs/msg/Mine", [MALFORMED], schema="", text=""),
    "a damaged definition": lambda file: file.add("/odd", "a/msg/B", [MALFORMED], text="!!"),
    "an array of absurd length": lambda file: file.add("/odd", "a/msg/B", [MALFORMED], text=f"uint8[{'9' * 5000}] x"),
    "wide strings": lambda file: file.add("/odd", "a/msg/B", [MALFORMED], text="wstring x"),
    "a name that is a path": lambda file: file.add("/odd", "../../../etc/passwd", [MALFORMED], schema="", text=""),
}


@pytest.mark.parametrize("spoiler", SPOILERS)
def test_one_bad_topic_spoils_nothing_else(tmp_path, spoiler) -> None:
    file = Channels(tmp_path / "a.mcap")
    SPOILERS[spoiler](file)
    file.add("/joint_states", JOINT_STATE, STATES)
    with BagReader(file.close()) as reader:
        assert_array_equal(reader.columns("/joint_states")["position"][:, 0], np.arange(10) / 10)
        assert list(reader.unreadable) == ["/odd"]
        assert len(reader.unreadable["/odd"]) < 700 and "\n" not in reader.unreadable["/odd"]
        with pytest.raises(BagError, match=r"topic /odd cannot be decoded: "):
            reader.columns("/odd")


@pytest.mark.parametrize("bad", [MALFORMED, b"", b"\0", b"\0\7\0\0" + STATES[0][4:], STATES[0][:40], b"\0\1\0\0" * 20])
def test_malformed_messages_are_skipped_and_counted(tmp_path, bad) -> None:
    file = Channels(tmp_path / "a.mcap")
    file.add("/setpoint", JOINT_STATE, [*STATES[:5], bad, *STATES[5:], bad])
    with BagReader(file.close()) as reader:
        assert_array_equal(reader.columns("/setpoint")["position"][:, 0], np.arange(10) / 10)
        assert reader.skipped["/setpoint"].count == 2 and reader.skipped["/setpoint"].reason
        reader.skipped.clear()
        assert [message["position"][0] for _, _, message in reader.decoded("/setpoint")] == [k / 10 for k in range(10)]
        assert reader.skipped["/setpoint"].count == 2
        assert not reader.unreadable


def test_damaged_strings_are_found_also_in_fields_that_nobody_asked_for(tmp_path) -> None:
    unclosed = bytearray(STATES[3])
    unclosed[4 + 8 + 4 + 5] = 7
    not_utf8 = STATES[4].replace(b"frame", b"\xff\xfe\xfd\xfc\xfb")
    file = Channels(tmp_path / "a.mcap")
    file.add("/joint_states", JOINT_STATE, [*STATES, bytes(unclosed), not_utf8])
    with BagReader(file.close()) as reader:
        for fields in (["position"], ["header.frame_id"], None):
            assert len(reader.columns("/joint_states", fields)["log_time"]) == 10
            assert reader.skipped["/joint_states"].count == 2


def test_spare_bytes_after_the_last_field_are_legal(tmp_path) -> None:
    file = Channels(tmp_path / "a.mcap")
    file.add("/joint_states", JOINT_STATE, [data + b"\xaa" * (13 * k) for k, data in enumerate(STATES)])
    with BagReader(file.close()) as reader:
        assert_array_equal(reader.columns("/joint_states")["position"][:, 0], np.arange(10) / 10)
        assert not reader.skipped


def test_an_installed_type_serves_where_the_bag_has_no_definition(tmp_path) -> None:
    file = Channels(tmp_path / "a.mcap")
    file.add("/none", JOINT_STATE, STATES, schema="", text="")
    file.add("/empty", JOINT_STATE, STATES, text="")
    file.add("/idl", JOINT_STATE, STATES, schema="ros2idl", text="module sensor_msgs {}")
    file.add("/other", JOINT_STATE, STATES, schema="", text="", metadata={"topic_type_hash": "RIHS01_" + "0" * 64})
    with BagReader(file.close()) as reader:
        for topic in ("/none", "/empty", "/idl"):
            assert_array_equal(reader.columns(topic)["position"][:, 0], np.arange(10) / 10)
        assert "another one is installed" in reader.unreadable["/other"]


def state(step: int, joints: list[str]) -> bytes:
    """A message of type `STATE`, made by software that is not ours."""
    name = "control_msgs/msg/SingleDOFState"
    store = TYPES
    if name not in store.types or "gains" not in str(store.types[name].__annotations__):
        from rosbags.typesys import get_types_from_msg

        parts = STATE.split("=" * 80 + "\nMSG: ")
        nested = get_types_from_msg(parts[-1].partition("\n")[2], name)
        store.register({**nested, **get_types_from_msg(parts[0], "control_msgs/msg/MultiDOFStateStamped")})
    single, stamp = store.types[name], store.types["builtin_interfaces/msg/Time"]
    states = [single(joint, step + k, step - k, np.arange(2.0), stamp(step, k)) for k, joint in enumerate(joints)]
    whole = "control_msgs/msg/MultiDOFStateStamped"
    return serialize(whole, store.types[whole](header(step, "odom"), states))


def test_fields_within_arrays_of_messages_are_columns(tmp_path) -> None:
    file = Channels(tmp_path / "a.mcap")
    kind = "control_msgs/msg/MultiDOFStateStamped"
    file.add("/state", kind, [state(step, ["shoulder", "arm"]) for step in range(5)], text=STATE)
    file.add("/varying", kind, [state(step, ["arm"] * step) for step in range(5)], text=STATE)
    with BagReader(file.close()) as reader:
        fields = reader.fields("/state")
        assert fields["dof_states"] == "control_msgs/SingleDOFState[]"
        assert fields["dof_states.feedback"] == "float64" and fields["dof_states.gains"] == "float64[]"
        inner = [path for path in fields if path.startswith("dof_states.")]
        columns = reader.columns("/state", inner)
        assert columns["dof_states.name"].tolist() == [["shoulder", "arm"]] * 5
        assert_array_equal(columns["dof_states.feedback"], [[step, step - 1] for step in range(5)])
        assert_array_equal(columns["dof_states.at"], [[step * 10**9, step * 10**9 + 1] for step in range(5)])
        assert columns["dof_states.gains"].shape == (5, 2, 2)
        assert "dof_states.feedback" not in reader.columns("/state")
        varying = reader.columns("/varying", ["dof_states.reference", "dof_states.name"])
        assert [list(row) for row in varying["dof_states.reference"]] == [[*range(n, 2 * n)] for n in range(5)]
        assert [list(row) for row in varying["dof_states.name"]] == [["arm"] * n for n in range(5)]


def test_a_publish_time_of_zero_is_none(tmp_path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        channel = writer.register_channel(
            "/a", "cdr", writer.register_schema(JOINT_STATE, "ros2msg", definition(JOINT_STATE).encode())
        )
        for step in range(1, 5):
            writer.add_message(channel, step, STATES[step], 0 if step < 3 else step - 1)
        writer.finish()
    with BagReader(path) as reader:
        assert reader.columns("/a")["publish_time"].tolist() == [1, 2, 2, 3]
        assert [message[2] for message in reader.messages()] == [1, 2, 2, 3]
