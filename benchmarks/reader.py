"""How fast columns come out of a bag, beside software that we did not write, and what memory they take."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.harness import Result, Verdict, main, seconds, summary
from benchmarks.writer import TOPIC, message, write_ours

TITLE = "Reading a bag into columns"
METHOD = (
    "Stamp, position and effort of every message of one bag of a million JointState messages, into NumPy arrays. "
    "`mcap-ros2-support` decodes through its `DecoderFactory` with the `mcap` reader, `rosbags` through its "
    "`AnyReader`; the row without decoding is the `mcap` reader alone. All read the same bag, in turn."
)
PEERS = ("mcap", "mcap-ros2-support", "rosbags")
NOTES: tuple[str, ...] = ()


def run(size: str) -> Result:
    """The readers in turn on the same bag, so that all see the same machine."""
    messages, rounds = (1_000_000, 2) if size == "full" else (10_000, 1)
    result = Result()
    with tempfile.TemporaryDirectory() as folder:
        bag, few = Path(folder) / "bag", Path(folder) / "few"
        write_ours(bag, map(message, range(messages)))
        write_ours(few, map(message, range(1000)))
        readers: dict[str, Callable[[Path], np.ndarray]] = {
            "tdof_npid_ros, columns": ours,
            "mcap-ros2-support": mcap_ros2,
            "rosbags": rosbags,
            "mcap, not decoded": raw_mcap,
        }
        for read in readers.values():  # warm
            read(few)
        speeds: dict[str, list[float]] = {name: [] for name in readers}
        for _ in range(rounds):
            for name, read in readers.items():
                speeds[name].append(messages / seconds(lambda read=read: read(bag)))  # type: ignore[misc]
        rates = [summary(name, "messages/s", speeds[name], ours=read is ours) for name, read in readers.items()]
        result.rates = rates
        medians = {rate.name: rate.median for rate in rates}
        mine = medians["tdof_npid_ros, columns"]
        result.verdicts.append(Verdict("columns, times mcap-ros2-support", mine / medians["mcap-ros2-support"], 20))
        result.verdicts.append(Verdict("columns, times rosbags", mine / medians["rosbags"], 10))
        share = peak_memory_share(bag, few)
        result.verdicts.append(Verdict("peak of the memory taken, times the columns' size", share, 2, at_most=True))
    return result


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


def peak_memory_share(bag: Path, few: Path) -> float:
    """Growth of a fresh process's memory, at its peak, while it reads the columns, in sizes of the columns.

    The kernel's peak is set back first (/proc/self/clear_refs): else what the imports took would hide it.
    """
    program = f"""
import json
from pathlib import Path
from tdof_npid_ros.bag.reader import BagReader

def read(bag):
    with BagReader(bag) as reader:
        return reader.columns({TOPIC!r}, ["header.stamp", "position", "effort"])

def status(name):
    return int(Path("/proc/self/status").read_text().split(name + ":")[1].split()[0]) * 1024

read({str(few)!r})
Path("/proc/self/clear_refs").write_text("5")
before = status("VmRSS")
columns = read({str(bag)!r})
print(json.dumps((status("VmHWM") - before) / sum(column.nbytes for column in columns.values())))
"""
    out = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    return float(json.loads(out))


if __name__ == "__main__":
    main("reader")
