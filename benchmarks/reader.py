"""How fast columns come out of a bag, beside software that we did not write, and what memory they take."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from benchmarks.harness import Rate, Result, Verdict, main, summary

QUESTION = "Reading stamp, position and effort of every message of a bag into NumPy arrays; writing as many"
TOPIC = "/output"
JOINT_STATE = "sensor_msgs/msg/JointState"
FOREIGN_MESSAGES = {"small": 1.0, "full": 0.1}  # share of the bag that the slow readers read, for the time it takes


def run(size: str) -> Result:
    """The readers in turn on the same bag, so that all see the same machine."""
    messages, rounds = (1_000_000, 3) if size == "full" else (10_000, 1)
    result = Result(QUESTION)
    with tempfile.TemporaryDirectory() as folder:
        bag, part = Path(folder) / "whole", Path(folder) / "part"
        few = round(messages * FOREIGN_MESSAGES[size])
        write_bag(bag, map(message, range(messages)))
        made = [message(step) for step in range(few)]
        written = [
            few / _seconds(lambda: write_bag(part, made)),
            few / _seconds(lambda: write_raw(Path(folder) / "raw.mcap", made)),
        ]
        readers: dict[str, tuple[Callable[[Path], np.ndarray], Path, int]] = {
            "tdof_npid_ros columns": (ours, bag, messages),
            "mcap-ros2-support": (mcap_ros2, part, few),
            "rosbags": (rosbags, part, few),
            "mcap, not decoded": (raw_mcap, part, few),
        }
        ours(part)
        speeds: dict[str, list[float]] = {name: [] for name in readers}
        for _ in range(rounds):
            for name, (read, path, count) in readers.items():
                speeds[name].append(count / _seconds(lambda read=read, path=path: read(path)))
        result.rates = [summary(name, "messages/s", values) for name, values in speeds.items()]
        result.rates += [Rate("written by tdof_npid_ros", "messages/s", written[0], written[0], written[0])]
        result.rates += [Rate("written by the mcap package", "messages/s", written[1], written[1], written[1])]
        rates = {rate.name: rate.median for rate in result.rates}
        mine = rates["tdof_npid_ros columns"]
        result.verdicts.append(Verdict("against mcap-ros2-support", mine / rates["mcap-ros2-support"], 20))
        result.verdicts.append(Verdict("against rosbags", mine / rates["rosbags"], 10))
        result.verdicts.append(Verdict("writing against the mcap package", written[0] / written[1], 1))
        share = peak_memory_share(bag)
        result.verdicts.append(Verdict("peak memory against the columns' size", share, 2, at_most=True))
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


def write_bag(folder: Path, messages: Iterable[bytes]) -> None:
    """Write with our writer."""
    from tdof_npid_ros.bag.writer import BagWriter

    with BagWriter(folder) as writer:
        topic = writer.add_topic(TOPIC, JOINT_STATE)
        for step, data in enumerate(messages):
            writer.write(topic, data, step * 1000, step * 1000, step)


def write_raw(path: Path, messages: Iterable[bytes]) -> None:
    """Write the same with the `mcap` package."""
    from mcap.writer import CompressionType, Writer

    from tdof_npid_ros.bag.schema import definition

    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start("ros2")
        schema = writer.register_schema(JOINT_STATE, "ros2msg", definition(JOINT_STATE).encode())
        channel = writer.register_channel(TOPIC, "cdr", schema)
        for step, data in enumerate(messages):
            writer.add_message(channel, step * 1000, data, step * 1000, step)
        writer.finish()


def ours(bag: Path) -> np.ndarray:
    """Columns."""
    from tdof_npid_ros.bag.reader import BagReader

    with BagReader(bag) as reader:
        columns = reader.columns(TOPIC, ["header.stamp", "position", "effort"])
    return np.asarray(columns["position"])


def mcap_ros2(bag: Path) -> np.ndarray:
    """The decoder that the MCAP project publishes."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    rows = []
    with next(bag.glob("*.mcap")).open("rb") as file:
        for found in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            m = found.decoded_message
            rows.append((m.header.stamp.sec, m.header.stamp.nanosec, m.position[0], m.effort[0]))
    return np.array(rows)


def rosbags(bag: Path) -> np.ndarray:
    """Its `AnyReader`."""
    from rosbags.highlevel import AnyReader

    rows = []
    with AnyReader([bag]) as reader:
        for connection, _, data in reader.messages():
            m = reader.deserialize(data, connection.msgtype)
            rows.append((m.header.stamp.sec, m.header.stamp.nanosec, m.position[0], m.effort[0]))
    return np.array(rows)


def raw_mcap(bag: Path) -> np.ndarray:
    """The `mcap` package, without decoding anything."""
    from mcap.reader import make_reader

    with next(bag.glob("*.mcap")).open("rb") as file:
        return np.array([len(found.data) for _, _, found in make_reader(file).iter_messages()])


def peak_memory_share(bag: Path) -> float:
    """Growth of a fresh process's peak memory while it reads the columns, in sizes of the columns."""
    program = f"""
import json
from pathlib import Path
from tdof_npid_ros.bag.reader import BagReader
def peak():  # not `ru_maxrss`, in which the parent's memory counts
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM:"))
with BagReader({str(bag)!r}) as reader:
    reader.columns({TOPIC!r}, ["header.stamp.nanosec"]) if reader.topics[{TOPIC!r}].count < 20_000 else None
    before = peak()
    columns = reader.columns({TOPIC!r}, ["header.stamp", "position", "effort"])
    print(json.dumps((peak() - before) / sum(column.nbytes for column in columns.values())))
"""
    out = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    return float(json.loads(out))


def _seconds(function: Callable[[], object]) -> float:
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


if __name__ == "__main__":
    main(run)
