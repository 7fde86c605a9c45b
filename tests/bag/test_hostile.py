"""Damaged and hostile files: one BagError, bounded memory, nothing else."""

import contextlib
import random
import re
import sqlite3
import struct
import subprocess
import sys
import time
from collections.abc import Iterator

import lz4.frame
import pytest
import zstandard
from bag_samples import JOINT_STATE, TYPES, budget, joint_state, write_bag
from hypothesis import example, given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.records import Channel, Header, Schema, Statistics
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter

from tdof_npid_ros.bag import BagError, records, schema
from tdof_npid_ros.bag.cdr import decode
from tdof_npid_ros.bag.decompress import MAX_CHUNK_BYTES
from tdof_npid_ros.bag.definition import parse
from tdof_npid_ros.bag.reader import BagReader
from tdof_npid_ros.bag.recover import recover

# More than 10,000 inputs in each run; TDOF_NPID_FUZZ=10000 gives each test so many.
MUTATIONS = budget("TDOF_NPID_FUZZ", 4000)
EXAMPLES = budget("TDOF_NPID_FUZZ", 1000)


def read_all(path) -> int:
    """Read a bag in every way, and return how many messages it yields."""
    with BagReader(path) as reader:
        count = sum(1 for _ in reader.messages())
        for topic in reader.topics:
            reader.columns(topic)
        for topic, _, _, data in reader.messages():
            reader.decode(topic, data)
            break
    return count


def mutate(data: bytes, chance: random.Random) -> bytes:
    """Return data with a few things changed, as a bad disk or a bad person would."""
    changed = bytearray(data)
    for _ in range(chance.choice([1, 1, 2, 8])):
        at = chance.randrange(len(changed))
        kind = chance.randrange(6)
        if kind == 0:
            changed[at] ^= 1 << chance.randrange(8)
        elif kind == 1:
            changed[at] = chance.choice([0, 1, 0x7F, 0x80, 0xFF])
        elif kind == 2:
            value = chance.choice([0, 1, 2**31, 2**32 - 1, 2**63, 2**64 - 1, len(data)])
            changed[at : at + 8] = struct.pack("<Q", value)
        elif kind == 3:
            del changed[at : at + chance.randrange(1, 40)]
        elif kind == 4:
            changed[at:at] = changed[chance.randrange(len(changed)) :][: chance.randrange(1, 40)]
        else:
            changed[at : at + 4] = struct.pack("<I", chance.choice([2**31, 2**32 - 1, 5]))
        if not changed:
            return b"\0"
    return bytes(changed)


def files_to_mutate(folder) -> list[bytes]:
    """Return small bags of every kind."""
    found = []
    for compression in ("zstd", "lz4", "none"):
        write_bag(folder / compression, 20, compression=compression)
        found.append((folder / compression / f"{compression}_0.mcap").read_bytes())
    # Without checksums the damage gets further in.
    for data in found[:]:
        found.append(without_checksums(data))
    return found


def without_checksums(data: bytes) -> bytes:
    """Return an MCAP file with its checksums set to zero, which means that there are none."""
    changed = bytearray(data)
    position = len(records.MAGIC)
    while position < len(data) - len(records.MAGIC):
        opcode, length = records.read_prefix(data, position)
        content = position + records.PREFIX_BYTES
        if opcode == Opcode.CHUNK:
            changed[content + 24 : content + 28] = bytes(4)
        elif opcode == Opcode.DATA_END:
            changed[content : content + 4] = bytes(4)
        elif opcode == Opcode.FOOTER:
            changed[content + 16 : content + 20] = bytes(4)
        position = content + length
    return bytes(changed)


@pytest.mark.timeout(300 + MUTATIONS // 10)
def test_mutated_bags_raise_nothing_but_bag_errors(tmp_path) -> None:
    chance = random.Random(3)
    samples = files_to_mutate(tmp_path)
    path = tmp_path / "mutated.mcap"
    refused = 0
    slowest = 0.0
    for number in range(MUTATIONS):
        path.write_bytes(mutate(samples[number % len(samples)], chance))
        begin = time.monotonic()
        try:
            read_all(path)
        except BagError as error:
            refused += 1
            assert "\n" not in str(error)
        if number % 10 == 0:
            with contextlib.suppress(BagError):
                recover(path, tmp_path / f"recovered_{number}")
        slowest = max(slowest, time.monotonic() - begin)
    print(f"{MUTATIONS} mutated MCAP files: {refused} refused, no other error; the slowest took {slowest:.2f} s")


def test_bits_flipped_in_a_finished_bag_never_go_unnoticed(tmp_path) -> None:
    write_bag(tmp_path / "bag", 20)
    data = (tmp_path / "bag" / "bag_0.mcap").read_bytes()
    path = tmp_path / "flipped.mcap"
    chance = random.Random(4)
    summary_end = len(data) - len(records.MAGIC)
    for _ in range(MUTATIONS // 4):
        changed = bytearray(data)
        changed[chance.randrange(len(records.MAGIC), summary_end)] ^= 1 << chance.randrange(8)
        path.write_bytes(changed)
        with pytest.raises(BagError):
            read_all(path)


def test_mutated_sqlite_bags_raise_nothing_but_bag_errors(tmp_path) -> None:
    with RosbagsWriter(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        topic = writer.add_connection("/output", JOINT_STATE, typestore=TYPES)
        for step in range(200):
            writer.write(topic, step, joint_state(step, "frame", position=[step]))
    data = (tmp_path / "bag" / "bag.db3").read_bytes()
    chance = random.Random(5)
    path = tmp_path / "mutated.db3"
    for _ in range(MUTATIONS // 4):
        path.write_bytes(mutate(data, chance))
        with contextlib.suppress(BagError):
            read_all(path)


@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE messages SET data = 'text' WHERE id = 5",
        "UPDATE messages SET timestamp = 'noon' WHERE id = 5",
        "UPDATE messages SET timestamp = -1 WHERE id = 5",
        "UPDATE messages SET timestamp = 9223372036854775807 WHERE id = 5",
        "UPDATE messages SET topic_id = 99 WHERE id = 5",
        "UPDATE topics SET id = 70000",
        "UPDATE topics SET name = x'ff'",
        "UPDATE topics SET name = CAST(x'ff' AS TEXT)",
        "DROP TABLE messages",
        "DROP TABLE messages; CREATE TABLE messages"
        "(id INTEGER, topic_id INTEGER, timestamp INTEGER, data AS (zeroblob(200000000)))",
        "DROP TABLE messages; CREATE VIRTUAL TABLE messages USING fts5(topic_id, timestamp, data)",
        "DROP TABLE messages; CREATE VIEW messages AS SELECT 1 id, 1 topic_id, 1 timestamp, x'' data",
    ],
)
def test_wrong_sqlite_content_is_refused(tmp_path, statement) -> None:
    with RosbagsWriter(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        topic = writer.add_connection("/output", JOINT_STATE, typestore=TYPES)
        for step in range(10):
            writer.write(topic, step, joint_state(step))
    with sqlite3.connect(tmp_path / "bag" / "bag.db3") as database:
        database.executescript(statement)
    with pytest.raises(BagError, match=r"bag.db3|topic"):
        read_all(tmp_path / "bag")


@given(st.binary(max_size=400))
@example(b"")
@example(records.MAGIC)
@settings(max_examples=EXAMPLES, deadline=None)
def test_any_bytes_as_a_file(tmp_path_factory, data) -> None:
    path = tmp_path_factory.getbasetemp() / "any.mcap"
    for content in (data, records.MAGIC + data, records.MAGIC + data + records.MAGIC):
        path.write_bytes(content)
        with contextlib.suppress(BagError):
            read_all(path)


@given(
    st.sampled_from([JOINT_STATE, "trajectory_msgs/msg/JointTrajectory", "rcl_interfaces/msg/ParameterEvent"]),
    st.sampled_from([b"\0\1\0\0", b"\0\0\0\0", b""]),
    st.binary(max_size=300),
)
@settings(max_examples=EXAMPLES, deadline=None)
def test_any_bytes_as_a_message(type_name, head, data) -> None:
    with contextlib.suppress(BagError):
        decode(type_name, schema.definition(type_name), head + data)


@given(st.text(alphabet="abfloat3264string[]<=0 \n#/_MSG:=", max_size=200))
@settings(max_examples=EXAMPLES, deadline=None)
def test_any_text_as_a_definition(text) -> None:
    with contextlib.suppress(BagError):
        assert parse("a/msg/B", text).paths is not None


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("B inner", "contains itself"),
        (f"C c\n{'=' * 80}\nMSG: a/C\nD d\n{'=' * 80}\nMSG: a/D\nC[] c", "contains itself"),
        ("Missing field", "definition of a/Missing is missing"),
        ("float64 x\nfloat64 x", "two fields bear one name"),
        ("wstring x", "wide strings"),
        ("float64 !", "not a field"),
        (f"builtin_interfaces/Time t\n{'=' * 80}\nMSG: builtin_interfaces/Time\nstring x", "sec and nanosec"),
    ],
)
def test_wrong_definitions_are_refused(text, reason) -> None:
    with pytest.raises(BagError, match=reason):
        parse("a/msg/B", text)


def test_exploding_definition_is_refused() -> None:
    types = [f"{'=' * 80}\nMSG: a/T{k}\nT{k + 1} x\nT{k + 1} y" for k in range(30)]
    text = "\n".join(["T0 x", *types, f"{'=' * 80}\nMSG: a/T30\nuint8 x"])
    with pytest.raises(BagError, match=r"more than"):
        assert parse("a/msg/B", text).paths
    with pytest.raises(BagError, match=r"of a message of"):
        decode("a/msg/B", text, b"\0\1\0\0")


ABSURD = ["float64[4000000000]", "float64[]", "string[]", "Empty[]", "string", "Empty[9999999]"]


@pytest.mark.parametrize("field", ABSURD)
def test_absurd_lengths_in_a_message_are_refused(field) -> None:
    text = f"{field} x\n{'=' * 80}\nMSG: a/Empty\n"
    with pytest.raises(BagError, match=r"length|field of"):
        decode("a/msg/B", text, b"\0\1\0\0" + b"\xff\xff\xff\x7f" * 4)


def mcap_with(content: bytes) -> bytes:
    """Return an unfinished MCAP file with these records after its header."""
    return records.MAGIC + records.as_bytes(Header(profile="ros2", library="test")) + content


def chunk(data: bytes, size: int, compression: str, crc: int = 0) -> bytes:
    head = struct.pack("<QQQI", 0, 2**63, size, crc) + text(compression) + struct.pack("<Q", len(data))
    return record(Opcode.CHUNK, head + data)


def text(value: str) -> bytes:
    return struct.pack("<I", len(value)) + value.encode()


def record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


END = record(Opcode.DATA_END, bytes(4))
LATER = chunk(b"", 0, "")  # so that the damaged chunk is not the last, which a crash may have torn


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (chunk(b"abc", 3, "brotli"), "compression 'brotli' is unknown"),
        (chunk(b"abc", 3, "zstd"), "cannot be decompressed"),
        (chunk(b"abc", 3, "lz4"), "does not hold the 3 bytes"),
        (chunk(zstandard.compress(b"abc"), 4, "zstd"), "does not hold the 4 bytes"),
        (chunk(zstandard.compress(bytes(1000)), 4, "zstd"), "does not hold the 4 bytes"),
        (chunk(bytes(9), 9, "", crc=1), "checksum"),
        (chunk(b"x", 2**40, "zstd"), "more than 256 MiB"),
        (chunk(b"x", 2**64 - 1, ""), "more than 256 MiB"),
        (chunk(b"\x05" + b"\xff" * 8, 9, ""), "longer than what holds it"),
        (chunk(b"\x05" + bytes(8), 9, ""), "too short for its own fields"),
        (chunk(record(5, b"\1\0" + bytes(20)), 31, ""), "channel 1, which is not announced"),
        (chunk(record(6, b""), 9, ""), "a record of kind 6"),
        (record(0x20, b""), "unknown kind 32"),
        (record(3, b"\1\0\xff\xff\xff\xff"), "a field is longer than the record"),
        (record(3, b"\1\0\2\0\0\0\xff\xfe"), "not UTF-8"),
        (record(4, b"\1\0\1\0" + bytes(12)), "nowhere in the file"),
    ],
)
def test_hostile_records_are_refused(tmp_path, content, reason) -> None:
    path = tmp_path / "hostile.mcap"
    path.write_bytes(mcap_with(content + LATER))
    with pytest.raises(BagError, match=reason):
        read_all(path)


READ = """
import sys
from pathlib import Path
from tdof_npid_ros.bag import BagError
from tdof_npid_ros.bag.reader import BagReader

def read(path):
    with BagReader(path) as reader:
        for _ in reader.messages():
            pass
        for topic in reader.topics:
            reader.columns(topic)

def peak():  # not `ru_maxrss`, in which the parent's memory counts
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:"))

read(sys.argv[1])
before = peak()
for path in sys.argv[2:]:
    try:
        read(path)
    except BagError as error:
        print(error)
    else:
        print("read")
print((peak() - before) / 1024)
"""


def compressed(piece: bytes, times: int, compression: str) -> bytes:
    """Return a repeated piece, compressed without ever being whole."""
    if compression == "zstd":
        compressor = zstandard.ZstdCompressor().compressobj()
        return b"".join([compressor.compress(piece) for _ in range(times)] + [compressor.flush()])
    lz4_compressor = lz4.frame.LZ4FrameCompressor()
    parts = [lz4_compressor.begin(), *(lz4_compressor.compress(piece) for _ in range(times))]
    return b"".join([*parts, lz4_compressor.flush()])


def bombs() -> Iterator[tuple[str, bytes]]:
    """Small files that hold much, and what becomes of them."""
    for compression in ("zstd", "lz4"):
        zeros = compressed(bytes(1 << 20), 1024, compression)
        for declared in (100, 1 << 20, 1 << 28, 1 << 32, 1 << 60):
            yield "damaged", mcap_with(chunk(zeros, declared, compression) * 2 + LATER)
        foreign = compressed(record(records.FIRST_PRIVATE, b"") * 4096, 4096, compression)
        yield "more definitions", mcap_with(chunk(foreign, 9 * 4096 * 4096, compression) * 2 + LATER)
        empty = record(Opcode.MESSAGE, b"\1\0" + bytes(20) + b"\0\1\0\0")
        many = compressed(empty * 4096, 512, compression)
        announced = records.as_bytes(
            Schema(id=1, name="std_msgs/msg/Empty", encoding="ros2msg", data=b""),
            Channel(id=1, schema_id=1, topic="/empty", message_encoding="cdr", metadata={}),
        )
        yield "read|of a message of", mcap_with(announced + chunk(many, len(empty) * 4096 * 512, compression))


def test_bombs_take_bounded_memory(tmp_path) -> None:
    write_bag(tmp_path / "warm", 10)
    expected = []
    paths = [tmp_path / "warm"]
    for number, (outcome, content) in enumerate(bombs()):
        expected.append(outcome)
        paths.append(tmp_path / f"{number}.mcap")
        paths[-1].write_bytes(content)
    done = subprocess.run([sys.executable, "-c", READ, *paths], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    *outcomes, mebibytes = done.stdout.splitlines()
    for found, wanted in zip(outcomes, expected, strict=True):
        assert re.search(wanted, found), found
    largest = max(path.stat().st_size for path in paths[1:]) / 2**20
    print(f"bombs of at most {largest:.1f} MiB took {float(mebibytes):.0f} MiB of memory")
    assert float(mebibytes) < 2 * MAX_CHUNK_BYTES / 2**20, (
        "one chunk at a time, while the one before may still be there"
    )


@pytest.mark.parametrize(
    "content",
    [b"\0", b"!!python/object:os.system {}", b"a: b", b"[" * 100_000, b"rosbag2_bagfile_information: 1"],
)
def test_wrong_metadata_yaml_is_refused(tmp_path, content) -> None:
    write_bag(tmp_path / "bag", 10)
    (tmp_path / "bag" / "metadata.yaml").write_bytes(content)
    with pytest.raises(BagError, match=r"metadata.*delete it"):
        read_all(tmp_path / "bag")


def test_bag_without_metadata_yaml_opens(tmp_path) -> None:
    write_bag(tmp_path / "bag", 10)
    (tmp_path / "bag" / "metadata.yaml").unlink()
    assert read_all(tmp_path / "bag") == 10


@pytest.mark.parametrize("name", ["missing", "missing.mcap", "missing.db3", "folder"])
def test_no_bag_there(tmp_path, name) -> None:
    (tmp_path / "folder").mkdir()
    with pytest.raises(BagError, match=r"missing|folder"):
        BagReader(tmp_path / name)


def test_summary_that_tells_of_too_many_messages_is_refused(tmp_path) -> None:
    announced = records.as_bytes(
        Schema(id=1, name=JOINT_STATE, encoding="ros2msg", data=schema.definition(JOINT_STATE).encode()),
        Channel(id=1, schema_id=1, topic="/output", message_encoding="cdr", metadata={}),
    )
    content = mcap_with(announced + END)
    counts = Statistics(
        message_count=2**62, chunk_count=0, message_start_time=0, message_end_time=1, channel_message_counts={1: 2**62},
        schema_count=1, channel_count=1, metadata_count=0, attachment_count=0,
    )  # fmt: skip
    summary = records.as_bytes(counts)
    footer = record(Opcode.FOOTER, struct.pack("<QQI", len(content), 0, 0))
    path = tmp_path / "liar.mcap"
    path.write_bytes(content + summary + footer + records.MAGIC)
    with pytest.raises(BagError, match=r"more messages than fit"):
        read_all(path)
