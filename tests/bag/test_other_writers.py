"""Bags as other recorders write them, and as robots fill them: what can be read is read, the rest is named."""

import contextlib
import shutil
import sqlite3
import zlib

import lz4.frame
import numpy as np
import pytest
import yaml
import zstandard
from bag_samples import JOINT_STATE, TYPES, header, joint_state, serialize, write_bag
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Header, Schema
from mcap.records import Message as Record
from mcap.writer import Writer
from numpy.testing import assert_array_equal

from tdof_npid_ros.analysis import AnalysisError
from tdof_npid_ros.analysis.report import analyze
from tdof_npid_ros.bag import BagError, records
from tdof_npid_ros.bag.qos import QosProfile
from tdof_npid_ros.bag.reader import BagReader
from tdof_npid_ros.bag.recover import recover
from tdof_npid_ros.bag.schema import definition
from tdof_npid_ros.bag.writer import BagWriter

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


def chunked(path, compression: str, compressed: bytes, content: bytes):
    """A file of one chunk of records."""
    chunk = Chunk(
        compression=compression, data=compressed, message_start_time=0, message_end_time=9,
        uncompressed_crc=zlib.crc32(content), uncompressed_size=len(content),
    )  # fmt: skip
    path.write_bytes(records.MAGIC + records.as_bytes(Header(profile="ros2", library=""), chunk))
    return path


def ten_messages() -> bytes:
    announced = [
        Schema(id=1, name=JOINT_STATE, encoding="ros2msg", data=definition(JOINT_STATE).encode()),
        Channel(id=1, schema_id=1, topic="/joint_states", message_encoding="cdr", metadata={}),
    ]
    messages = [
        Record(channel_id=1, sequence=0, log_time=step, publish_time=step, data=data)
        for step, data in enumerate(STATES)
    ]
    return records.as_bytes(*announced, *messages)


def zstd(data: bytes, **options) -> bytes:
    compressor = zstandard.ZstdCompressor(**options)
    if options.get("write_content_size") is False:
        stream = compressor.compressobj()
        return stream.compress(data) + stream.flush()
    return compressor.compress(data)


TEN = ten_messages()
HALF = len(TEN) // 2
SKIPPABLE = (0x184D2A55).to_bytes(4, "little") + (5).to_bytes(4, "little") + b"hello"
FRAMES = {
    "zstd, one frame": ("zstd", zstd(TEN)),
    "zstd, without the content's size": ("zstd", zstd(TEN, write_content_size=False)),
    "zstd, with a checksum": ("zstd", zstd(TEN, write_checksum=True)),
    "zstd, in two frames": ("zstd", zstd(TEN[:HALF]) + zstd(TEN[HALF:])),
    "zstd, frames to be skipped": ("zstd", SKIPPABLE + zstd(TEN[:HALF]) + SKIPPABLE + zstd(TEN[HALF:]) + SKIPPABLE),
    "zstd, an empty frame after": ("zstd", zstd(TEN) + zstd(b"")),
    "zstd, zeros after": ("zstd", zstd(TEN, write_checksum=True) + bytes(100)),
    "lz4, one frame": ("lz4", lz4.frame.compress(TEN)),
    "lz4, without the content's size": ("lz4", lz4.frame.compress(TEN, store_size=False)),
    "lz4, linked blocks and checksums": (
        "lz4", lz4.frame.compress(TEN, block_linked=True, content_checksum=True, block_checksum=True)
    ),
    "lz4, in two frames": ("lz4", lz4.frame.compress(TEN[:HALF]) + lz4.frame.compress(TEN[HALF:])),
    "lz4, frames to be skipped around": ("lz4", SKIPPABLE + lz4.frame.compress(TEN) + SKIPPABLE),
    "lz4, an empty frame after": ("lz4", lz4.frame.compress(TEN) + lz4.frame.compress(b"")),
    "lz4, zeros after": ("lz4", lz4.frame.compress(TEN) + bytes(7)),
    "none, by name": ("none", TEN),
}  # fmt: skip


@pytest.mark.parametrize("how", FRAMES)
def test_chunks_as_other_compressors_make_them(tmp_path, how) -> None:
    path = chunked(tmp_path / "a.mcap", *FRAMES[how], TEN)
    with BagReader(path) as reader:
        assert_array_equal(reader.columns("/joint_states")["position"][:, 0], np.arange(10) / 10)
    assert recover(path, tmp_path / "new").messages == {"/joint_states": 10}


@pytest.mark.parametrize(
    ("compression", "data", "reason"),
    [
        ("zstd", zstd(TEN) + b"garbage", "neither a frame nor zeros"),
        ("lz4", lz4.frame.compress(TEN) + b"\0garbage", "neither a frame nor zeros"),
        ("zstd", zstd(TEN)[:-3], "does not hold|cannot be decompressed"),
        ("zstd", zstd(TEN) + zstd(b"more"), "does not hold"),
        ("lz4", lz4.frame.compress(TEN) + lz4.frame.compress(b"more"), "does not hold"),
        ("brotli", TEN, "compression 'brotli' is unknown"),
    ],
)
def test_chunks_that_hold_something_else_are_refused(tmp_path, compression, data, reason) -> None:
    path = chunked(tmp_path / "a.mcap", compression, data, TEN)
    whole = path.read_bytes()
    begin = whole.index(bytes([Opcode.CHUNK]), len(records.MAGIC) + 20)
    path.write_bytes(whole + whole[begin:])  # not torn: another one follows
    with pytest.raises(BagError, match=reason):
        BagReader(path)


@pytest.mark.parametrize(
    ("name", "content", "advice"),
    [
        ("a.bag", b"#ROSBAG V2.0\n" + bytes(5000), "rosbags-convert"),
        ("a.mcap.zstd", zstd(TEN), "zstd -d"),
        ("a.mcap.lz4", lz4.frame.compress(TEN), "lz4 -d"),
        ("a.mcap", b"version https://git-lfs.github.com/spec/v1\noid", "git lfs pull"),
        ("a.mcap", b"SQLite format 3\0" + bytes(100), "name it .db3"),
    ],
)
def test_other_files_are_refused_with_what_to_do(tmp_path, name, content, advice) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(BagError, match=advice):
        BagReader(tmp_path / name)


@pytest.mark.parametrize(
    ("name", "content", "advice"),
    [("a.bag", b"#ROSBAG V2.0\n" + bytes(5000), "rosbags-convert"), ("a.mcap.zstd", zstd(TEN), "zstd -d")],
)
def test_a_folder_of_other_files_is_refused_with_what_to_do(tmp_path, name, content, advice) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(BagError, match=advice):
        BagReader(tmp_path)


def test_messages_of_ros_1_are_left_out_with_what_to_do(tmp_path) -> None:
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start("ros1")
        number = writer.register_schema("std_msgs/Float64", "ros1msg", b"float64 data")
        writer.add_message(writer.register_channel("/x", "ros1", number), 1, bytes(8), 1)
        writer.finish()
    with BagReader(tmp_path / "a.mcap") as reader:
        assert "in ros1, not in CDR: convert the ROS 1 bag with `rosbags-convert`" in reader.unreadable["/x"]
    with pytest.raises(AnalysisError, match="its topics are none; missing: 1 messages: topic /x cannot be decoded"):
        analyze([tmp_path / "a.mcap"])


def folder_with(tmp_path, listed: list[str]):
    """A bag folder of two files, bag_0 and a copy of it, with a list of files in its metadata.yaml."""
    write_bag(tmp_path / "bag", 100)
    shutil.copy(tmp_path / "bag" / "bag_0.mcap", tmp_path / "bag" / "bag_0_backup.mcap")
    table = tmp_path / "bag" / "metadata.yaml"
    information = yaml.safe_load(table.read_text())
    information["rosbag2_bagfile_information"]["relative_file_paths"] = listed
    table.write_text(yaml.safe_dump(information))
    return tmp_path / "bag"


def test_a_folder_is_what_its_metadata_lists(tmp_path) -> None:
    folder = folder_with(tmp_path, ["bag_0.mcap"])
    with BagReader(folder) as reader:
        assert len(list(reader.messages())) == 100 and not reader.truncated
    assert sum(recover(folder, tmp_path / "new").messages.values()) == 100


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("bag_1.mcap", "which is not there"),
        ("../outside.mcap", "outside"),
        ("/etc/passwd", "outside"),
        ("a\0b", "outside"),
    ],
)
def test_listed_files_that_cannot_be_read_are_said(tmp_path, name, reason) -> None:
    folder = folder_with(tmp_path, ["bag_0.mcap", name])
    write_bag(tmp_path / "other", 10)
    shutil.copy(tmp_path / "other" / "other_0.mcap", tmp_path / "outside.mcap")
    with BagReader(folder) as reader:
        assert len(list(reader.messages())) == 100 and reader.truncated
        assert len(reader.missing) == 1 and reason in reader.missing[0]
    report = recover(folder, tmp_path / "new")
    assert sum(report.messages.values()) == 100 and not report.whole
    assert reason in report.missing[0]


def test_a_folder_of_which_no_listed_file_is_there_says_what_is(tmp_path) -> None:
    folder = folder_with(tmp_path, ["gone.mcap"])
    for attempt in (BagReader, lambda path: recover(path, tmp_path / "new")):
        with pytest.raises(BagError, match=r"gone.mcap.*it holds bag_0.mcap, bag_0_backup.mcap.*delete metadata.yaml"):
            attempt(folder)


def test_paths_as_rosbag2_wrote_them_until_foxy(tmp_path) -> None:
    with BagReader(folder_with(tmp_path, ["bag/bag_0.mcap"])) as reader:
        assert len(list(reader.messages())) == 100 and not reader.truncated


def humble_db3(path, messages: list[bytes]) -> None:
    """An SQLite bag as Foxy to Humble wrote it: without definitions, type hashes and profiles in words."""
    with contextlib.closing(sqlite3.connect(path)) as database, database:
        database.executescript(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,"
            " serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL);"
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL,"
            " data BLOB NOT NULL);"
            "CREATE INDEX timestamp_idx ON messages (timestamp ASC);"
        )
        database.execute("INSERT INTO topics VALUES (1, '/joint_states', ?, 'cdr', ?)", (JOINT_STATE, NUMBERS))
        rows = [(1, step // 3, data) for step, data in enumerate(messages)]
        database.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", rows)


NUMBERS = "- history: 3\n  depth: 0\n  reliability: 1\n  durability: 1\n  liveliness: 1"
WORDS = "- history: unknown\n  depth: 7\n  reliability: best_effort\n  durability: transient_local"


def test_sqlite_bags_without_definitions_are_read_by_the_installed_types(tmp_path) -> None:
    humble_db3(tmp_path / "a.db3", STATES)
    with BagReader(tmp_path / "a.db3") as reader:
        assert_array_equal(reader.columns("/joint_states")["position"][:, 0], np.arange(10) / 10)
        assert reader.topics["/joint_states"].profiles == [QosProfile(durability="transient_local")]


def test_sqlite_bags_are_read_by_bytes_and_left_alone(tmp_path) -> None:
    frame = np.zeros(1 << 20, np.uint8)
    image = TYPES.types["sensor_msgs/msg/Image"](header(0, ""), 1024, 1024, "mono8", 0, 1024, frame)
    humble_db3(tmp_path / "a.db3", [serialize("sensor_msgs/msg/Image", image)] * 40)
    with contextlib.closing(sqlite3.connect(tmp_path / "a.db3")) as database, database:
        database.execute("UPDATE topics SET type = 'sensor_msgs/msg/Image'")
        database.execute("PRAGMA journal_mode = wal").fetchall()
    before = sorted(tmp_path.iterdir())
    content = (tmp_path / "a.db3").read_bytes()
    with BagReader(tmp_path / "a.db3") as reader:
        (file,) = reader._files
        sizes = [piece.load().data.nbytes for piece in file.pieces()]
        assert max(sizes) <= 9 << 20 and len(sizes) >= 5
        assert [message[1] for message in reader.messages()] == [step // 3 for step in range(40)]
        assert sorted(tmp_path.iterdir()) == before and not reader.truncated
    assert sorted(tmp_path.iterdir()) == before and (tmp_path / "a.db3").read_bytes() == content


def test_what_a_killed_recorder_left_beside_an_sqlite_bag_is_said(tmp_path) -> None:
    humble_db3(tmp_path / "a.db3", STATES)
    (tmp_path / "a.db3-wal").write_bytes(b"messages")
    with BagReader(tmp_path / "a.db3") as reader:
        assert reader.truncated and "a.db3-wal" in reader.missing[0]


@pytest.mark.parametrize(
    ("text", "profiles"),
    [
        (NUMBERS, [QosProfile(durability="transient_local")]),
        (WORDS, [QosProfile("best_effort", "transient_local", depth=7)]),
        (
            "- {durability: 2, reliability: 2, history: 2, depth: 5}",
            [QosProfile("best_effort", "volatile", "keep_all", 5)],
        ),
        ("- {durability: 99, depth: -1}\n- 5\n- {depth: true}", [QosProfile(), QosProfile()]),
        ("", []),
        ("!!python/object/apply:os.system [id]", []),
        ("[" * 10_000, []),
        ("&a [" + "*a," * 10 + "]", []),
        ("a: b", []),
    ],
)
def test_qos_profiles_as_every_distribution_wrote_them(tmp_path, text, profiles) -> None:
    file = Channels(tmp_path / "a.mcap")
    file.add("/plan", JOINT_STATE, STATES, metadata={"offered_qos_profiles": text})
    with BagReader(file.close()) as reader:
        assert reader.topics["/plan"].profiles == profiles
    recover(tmp_path / "a.mcap", tmp_path / "new")
    with BagReader(tmp_path / "new") as reader:
        assert reader.topics["/plan"].qos == text
    information = yaml.safe_load((tmp_path / "new" / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    offered = information["topics_with_message_count"][0]["topic_metadata"]["offered_qos_profiles"]
    assert not any(isinstance(profile.get("durability"), int) for profile in offered)


def test_a_first_message_long_before_the_rest_is_told_from_the_rest(tmp_path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        topic = writer.add_topic("/joint_states", JOINT_STATE)
        for time in (0, *range(1000 * 10**9, 1005 * 10**9, 10**8)):
            writer.write(topic, STATES[0], time, time)
    with BagReader(tmp_path / "bag") as reader:
        assert (reader.start_ns, reader.begin_ns) == (0, 1000 * 10**9)
    write_bag(tmp_path / "other", 100)
    with BagReader(tmp_path / "other") as reader:
        assert reader.begin_ns == reader.start_ns


def test_a_summary_that_repeats_the_channels_only_is_legal(tmp_path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file, repeat_schemas=False)
        writer.start("ros2")
        number = writer.register_schema(JOINT_STATE, "ros2msg", definition(JOINT_STATE).encode())
        channel = writer.register_channel("/joint_states", "cdr", number)
        for step, data in enumerate(STATES):
            writer.add_message(channel, step, data, step)
        writer.finish()
    with BagReader(path) as reader:
        assert_array_equal(reader.columns("/joint_states")["position"][:, 0], np.arange(10) / 10)


def test_bytes_after_the_last_field_of_a_record_are_legal(tmp_path) -> None:
    """So that later versions of the format can add fields."""
    data = chunked(tmp_path / "whole.mcap", "", TEN, TEN).read_bytes()
    padded, position = bytearray(records.MAGIC), len(records.MAGIC)
    while position < len(data):
        opcode, length = records.read_prefix(data, position)
        content = data[position + records.PREFIX_BYTES :][:length]
        spare = b"" if opcode == Opcode.CHUNK else b"\x01\xff\xff"
        padded += bytes([opcode]) + (length + len(spare)).to_bytes(8, "little") + content + spare
        position += records.PREFIX_BYTES + length
    (tmp_path / "padded.mcap").write_bytes(padded)
    with BagReader(tmp_path / "padded.mcap") as reader:
        assert_array_equal(reader.columns("/joint_states")["position"][:, 0], np.arange(10) / 10)
    assert recover(tmp_path / "padded.mcap", tmp_path / "new").messages == {"/joint_states": 10}


@pytest.mark.parametrize("mode", ["FILE", "message"])
def test_bags_that_rosbag2_compressed_are_refused_with_what_to_do(tmp_path, mode) -> None:
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "bag_0.mcap.zstd").write_bytes(zstd(TEN))
    (tmp_path / "bag" / "metadata.yaml").write_text(
        f"rosbag2_bagfile_information: {{compression_mode: {mode}, relative_file_paths: [bag_0.mcap.zstd]}}\n"
    )
    for attempt in (BagReader, lambda path: recover(path, tmp_path / "new")):
        with pytest.raises(BagError, match=r"compressed by rosbag2.*(zstd -d|ros2 bag convert)"):
            attempt(tmp_path / "bag")
