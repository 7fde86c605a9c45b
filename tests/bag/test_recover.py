"""`recover` finds all that can be found, and its account of the rest is true."""

import random
import shutil

import pytest
from bag_samples import JOINT_STATE, budget, joint_state, write_bag
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Header, MessageIndex, Schema
from mcap.records import Message as Record
from mcap.writer import Writer

from tdof_npid_ros.bag import BagError, records
from tdof_npid_ros.bag.reader import BagReader
from tdof_npid_ros.bag.recover import recover
from tdof_npid_ros.bag.schema import definition

FLIPS = budget("TDOF_NPID_FUZZ", 1000) // 10
CHUNKS, EACH = 10, 40


def finished_bag(folder, **options) -> bytes:
    """The file of a bag of `CHUNKS` chunks of `EACH` messages."""
    count = CHUNKS * EACH
    write_bag(folder, count, each=lambda writer, step: writer.flush() if step and step % EACH == 0 else None, **options)
    return (folder / f"{folder.name}_0.mcap").read_bytes()


def places(data: bytes) -> list[tuple[int, Opcode, int]]:
    """Where each record lies: first byte, kind, first byte of the next."""
    found = []
    position = len(records.MAGIC)
    while position < len(data) - len(records.MAGIC):
        opcode, length = records.read_prefix(data, position)
        end = position + records.PREFIX_BYTES + length
        found.append((position, Opcode(opcode), end))
        position = end
    return found


def unfinished(data: bytes) -> bytes:
    """The file as a killed recorder leaves it."""
    return data[: next(begin for begin, kind, _ in places(data) if kind == Opcode.DATA_END)]


def recovered(tmp_path, data: bytes):
    path = tmp_path / "damaged.mcap"
    path.write_bytes(data)
    shutil.rmtree(tmp_path / "new", ignore_errors=True)
    report = recover(path, tmp_path / "new")
    with BagReader(tmp_path / "new") as reader:
        assert not reader.truncated
        assert sum(report.messages.values()) == len(list(reader.messages()))
    return report


def test_a_chunk_whose_head_is_damaged_is_read_by_the_chunk_index(tmp_path) -> None:
    data = finished_bag(tmp_path / "bag")
    chunks = [(begin, end) for begin, kind, end in places(data) if kind == Opcode.CHUNK]
    begin, _ = chunks[4]
    for at in range(begin, begin + records.PREFIX_BYTES + 40):
        damaged = bytearray(data)
        damaged[at] ^= 0x55
        report = recovered(tmp_path, bytes(damaged))
        assert sum(report.messages.values()) >= (CHUNKS - 1) * EACH
        lost = CHUNKS * EACH - sum(report.messages.values())
        assert sum(report.missing_messages.values()) == lost
        assert report.whole == (lost == 0)
        assert report.mended or report.missing
    damaged = bytearray(data)
    damaged[begin : begin + records.PREFIX_BYTES] = b"\xff" * records.PREFIX_BYTES
    report = recovered(tmp_path, bytes(damaged))
    assert sum(report.messages.values()) == CHUNKS * EACH and report.whole
    assert "read by the chunk index" in report.mended[0]


@pytest.mark.parametrize("length", [3, 10**6, 2**40, 2**64 - 1])
def test_a_chunk_of_wrong_length_is_read_by_its_own_size_where_there_is_no_index(tmp_path, length) -> None:
    data = unfinished(finished_bag(tmp_path / "bag"))
    begin = [begin for begin, kind, _ in places(data) if kind == Opcode.CHUNK][4]
    damaged = bytearray(data)
    damaged[begin + 1 : begin + 9] = length.to_bytes(8, "little")
    report = recovered(tmp_path, bytes(damaged))
    assert sum(report.messages.values()) == CHUNKS * EACH
    assert "read by the size of its data" in report.mended[0]
    assert report.missing == (f"{tmp_path / 'damaged.mcap'}: the index and summary: the recording was never finished",)


def test_a_lost_chunk_is_counted_by_the_statistics_or_by_its_message_indexes(tmp_path) -> None:
    data = finished_bag(tmp_path / "bag")
    begin, end = [(begin, end) for begin, kind, end in places(data) if kind == Opcode.CHUNK][4]
    damaged = bytearray(data)
    damaged[end - 20 : end - 10] = bytes(10)
    for content in (bytes(damaged), unfinished(bytes(damaged))):
        report = recovered(tmp_path, content)
        assert sum(report.messages.values()) == (CHUNKS - 1) * EACH
        assert report.missing_messages == {"/output": EACH // 2, "/control_effort": EACH // 2}
        assert any(f"held {EACH} messages, by its message indexes" in line for line in report.missing)
        assert report.dropped_bytes >= end - begin - 200
        assert not report.whole


def test_the_walk_goes_on_where_records_fit_again(tmp_path) -> None:
    data = unfinished(finished_bag(tmp_path / "bag"))
    chunks = [(begin, end) for begin, kind, end in places(data) if kind == Opcode.CHUNK]
    damaged = bytearray(data)
    middle = (chunks[3][0] + chunks[3][1]) // 2
    damaged[chunks[3][0] : middle] = random.Random(1).randbytes(middle - chunks[3][0])
    report = recovered(tmp_path, bytes(damaged))
    assert sum(report.messages.values()) == (CHUNKS - 1) * EACH
    assert any("the next record was found by what fits" in line for line in report.missing)


@pytest.mark.parametrize("compression", ["zstd", "none"])
def test_one_damaged_byte_costs_one_chunk_at_most(tmp_path, compression) -> None:
    data = finished_bag(tmp_path / "bag", compression=compression)
    chance = random.Random(2)
    definitions_end = next(begin for begin, kind, _ in places(data) if kind == Opcode.CHUNK)
    for content in (data, unfinished(data)):
        for _ in range(FLIPS // 4):
            at = chance.randrange(definitions_end, len(content))
            damaged = bytearray(content)
            damaged[at] ^= 1 << chance.randrange(8)
            report = recovered(tmp_path, bytes(damaged))
            assert sum(report.messages.values()) >= (CHUNKS - 1) * EACH, f"byte {at}"
            lost = CHUNKS * EACH - sum(report.messages.values())
            assert not lost or report.missing, f"byte {at}"


def test_messages_behind_damage_within_a_chunk_are_found_by_the_message_index(tmp_path) -> None:
    content, entries = b"", []
    announced = [
        Schema(id=1, name=JOINT_STATE, encoding="ros2msg", data=definition(JOINT_STATE).encode()),
        Channel(id=1, schema_id=1, topic="/output", message_encoding="cdr", metadata={}),
    ]
    for step in range(10):
        entries.append((step, len(content)))
        message = Record(channel_id=1, sequence=step, log_time=step, publish_time=step, data=joint_state(step))
        content += records.as_bytes(message)
    damaged = bytearray(content)
    damaged[entries[4][1] + 4] = 0xFF  # the fifth message's length; there is no checksum
    chunk = Chunk(
        compression="", data=bytes(damaged), message_start_time=0, message_end_time=9, uncompressed_crc=0,
        uncompressed_size=len(damaged),
    )  # fmt: skip
    index = MessageIndex(channel_id=1, records=entries)
    head = records.MAGIC + records.as_bytes(Header(profile="ros2", library=""), *announced)
    report = recovered(tmp_path, head + records.as_bytes(chunk, index))
    assert report.messages == {"/output": 9}
    assert any("1 messages are lost, by its message indexes" in line for line in report.missing)
    report = recovered(tmp_path, head + records.as_bytes(chunk))
    assert report.messages == {"/output": 4}
    assert any("it has no message index" in line for line in report.missing)


def test_messages_that_cannot_be_decoded_are_kept_and_named(tmp_path) -> None:
    def spoil(writer, step) -> None:
        if step in (10, 20):
            writer.write(1, b"\0\1\0\0\xff", step, step)

    write_bag(tmp_path / "bag", 100, each=spoil)
    report = recover(tmp_path / "bag", tmp_path / "new")
    assert report.undecodable["/output"].count == 2
    assert sum(report.messages.values()) == 102
    assert any("2 of them cannot be decoded (a message of 5 bytes" in line for line in report.lines())
    with BagReader(tmp_path / "new") as reader:
        assert len(reader.columns("/output")["effort"]) == 50
        assert reader.skipped["/output"].count == 2


def test_topics_of_two_types_and_of_unknown_types_are_kept(tmp_path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        for name, text, data in (
            ("std_msgs/msg/Bool", "bool data", b"\0\1\0\0\1"),
            ("std_msgs/msg/Byte", "byte data", b"\0\1\0\0\2"),
            ("my_msgs/msg/Mine", "", b"\0\1\0\0\3"),
        ):
            number = writer.register_schema(name, "ros2msg" if text else "", text.encode())
            channel = writer.register_channel("/odd" if text else "/mine", "cdr", number)
            writer.add_message(channel, 1, data, 1)
        writer.add_attachment(1, 1, "notes", "text/plain", b"all well")
        writer.finish()
    report = recover(path, tmp_path / "new")
    assert report.messages == {"/odd": 2, "/mine": 1} and report.whole
    with BagReader(tmp_path / "new") as reader:
        assert sorted(bytes(data)[4] for _, _, _, data in reader.messages()) == [1, 2, 3]
        assert "two types" in reader.unreadable["/odd"] and "not installed" in reader.unreadable["/mine"]
        (place,) = reader._files[0].attachments
        assert reader._files[0].attachment(*place).data == b"all well"


def test_a_damaged_file_among_several_is_named(tmp_path) -> None:
    write_bag(tmp_path / "bag", 5000, max_bytes=100_000, compression="none", flush_interval_s=60)
    (tmp_path / "bag" / "bag_1.mcap").write_bytes(b"nothing")
    (tmp_path / "bag" / "bag_2.mcap").unlink()
    report = recover(tmp_path / "bag", tmp_path / "new")
    assert 0 < sum(report.messages.values()) < 5000 and not report.whole
    assert any("bag_1.mcap" in line and "does not begin as an MCAP file" in line for line in report.missing)
    assert any("bag_2.mcap, which is not there" in line for line in report.missing)


def test_where_no_bytes_are_missing_but_a_file_none_are_told(tmp_path) -> None:
    write_bag(tmp_path / "bag", 5000, max_bytes=100_000, compression="none", flush_interval_s=60)
    (tmp_path / "bag" / "bag_2.mcap").unlink()
    lines = recover(tmp_path / "bag", tmp_path / "new").lines()
    assert "bag_2.mcap, which is not there" in lines[lines.index("missing:") + 1]


def test_nothing_is_written_where_something_is(tmp_path) -> None:
    write_bag(tmp_path / "bag", 10)
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    with pytest.raises(BagError, match="exists already"):
        recover(tmp_path / "bag", tmp_path / "link")
