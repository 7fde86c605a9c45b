"""How fast messages go into a bag, beside software that we did not write."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np

from benchmarks.harness import Result, Verdict, main, seconds, summary

TITLE = "Writing a bag"
METHOD = (
    "Serialized JointState messages of one lane, as the plant publishes them, into an MCAP bag, by the class that the "
    "recorder node writes with. The raw `mcap` writer and `rosbags` (MCAP storage) write the same messages; all with "
    "chunks of 1 MiB, once compressed with zstd at the level that each sets (1 in ours, the library's own in theirs) "
    "and once not compressed, so that the compressor does not decide. Ours also counts, by a reader that is not ours, "
    "whether every message is in the bag."
)
PEERS = ("mcap", "rosbags", "zstandard")
NOTES: tuple[str, ...] = ()

TOPIC = "/output"
JOINT_STATE = "sensor_msgs/msg/JointState"
CHUNK_BYTES = 1 << 20
COMPRESSIONS = ("zstd", "none")


def run(size: str) -> Result:
    """The writers in turn on the same messages, so that all see the same machine."""
    messages, rounds = (200_000, 3) if size == "full" else (5_000, 1)
    made = [message(step) for step in range(messages)]
    writers: dict[str, Callable[[Path, Sequence[bytes], str], None]] = {
        "tdof_npid_ros": write_ours, "mcap": write_raw, "rosbags": write_rosbags,
    }  # fmt: skip
    for write in writers.values():  # warm
        for compression in COMPRESSIONS:
            with tempfile.TemporaryDirectory() as folder:
                write(Path(folder) / "bag", made[:100], compression)
    result, lost = Result(), 0
    for compression in COMPRESSIONS:
        speeds: dict[str, list[float]] = {name: [] for name in writers}
        for _ in range(rounds):
            for name, write in writers.items():
                with tempfile.TemporaryDirectory() as folder:
                    bag = Path(folder) / "bag"
                    taken = seconds(lambda write=write, bag=bag, how=compression: write(bag, made, how))  # type: ignore[misc]
                    speeds[name].append(messages / taken)
                    if write is write_ours:
                        lost += messages - _count(bag)
        rates = {
            name: summary(f"{name}, {compression}", "messages/s", speeds[name], ours=name == "tdof_npid_ros")
            for name in writers
        }
        result.rates += rates.values()
        ours = rates["tdof_npid_ros"].median
        result.verdicts.append(
            Verdict(f"chunks in {compression}, times the raw mcap writer", ours / rates["mcap"].median, 0.7)
        )
        result.verdicts.append(Verdict(f"chunks in {compression}, times rosbags", ours / rates["rosbags"].median, None))
    result.verdicts.append(Verdict(f"lost of {2 * rounds * messages:,} messages", lost, 0, at_most=True))
    return result


def message(step: int) -> bytes:
    """A serialized JointState of one lane, as the plant publishes it."""
    stamp = step * 5_000_000
    frame = b"0b723cdfd489/1\0"
    head = b"\0\1\0\0" + (stamp // 10**9).to_bytes(4, "little") + (stamp % 10**9).to_bytes(4, "little")
    text = head + len(frame).to_bytes(4, "little") + frame + b"\0" * (-len(frame) % 4)
    body = bytearray(text + (0).to_bytes(4, "little"))  # no names
    for values in ((np.sin(step / 100),), (), (np.cos(step / 100),)):
        body += len(values).to_bytes(4, "little")
        for value in values:
            body += b"\0" * (-(len(body) - 4) % 8) + np.float64(value).tobytes()
    return bytes(body)


def write_ours(folder: Path, messages: Iterable[bytes], compression: str = "zstd") -> None:
    """Write with our writer."""
    from tdof_npid_ros.bag.writer import BagWriter

    with BagWriter(folder, compression=compression) as writer:  # type: ignore[arg-type]
        topic = writer.add_topic(TOPIC, JOINT_STATE)
        for step, data in enumerate(messages):
            writer.write(topic, data, step * 1000, step * 1000, step)


def write_raw(folder: Path, messages: Iterable[bytes], compression: str) -> None:
    """Write the same with the `mcap` package."""
    from mcap.writer import CompressionType, Writer

    from tdof_npid_ros.bag.schema import definition

    folder.mkdir()
    kind = {"zstd": CompressionType.ZSTD, "none": CompressionType.NONE}[compression]
    with (folder / "bag.mcap").open("wb") as file:
        writer = Writer(file, compression=kind, chunk_size=CHUNK_BYTES)
        writer.start("ros2")
        schema = writer.register_schema(JOINT_STATE, "ros2msg", definition(JOINT_STATE).encode())
        channel = writer.register_channel(TOPIC, "cdr", schema)
        for step, data in enumerate(messages):
            writer.add_message(channel, step * 1000, data, step * 1000, step)
        writer.finish()


def write_rosbags(folder: Path, messages: Iterable[bytes], compression: str) -> None:
    """Write the same with `rosbags`."""
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    writer = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
    if compression == "zstd":
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection(TOPIC, JOINT_STATE, typestore=get_typestore(Stores.ROS2_JAZZY))
        for step, data in enumerate(messages):
            writer.write(connection, step * 1000, data)


def _count(bag: Path) -> int:
    from mcap.reader import make_reader

    with next(bag.glob("*.mcap")).open("rb") as file:
        summary_ = make_reader(file).get_summary()
        chunks = sum(1 for _ in make_reader(file).iter_messages())
    assert summary_ is not None and summary_.statistics is not None
    return min(chunks, int(summary_.statistics.message_count))


if __name__ == "__main__":
    main("writer")
