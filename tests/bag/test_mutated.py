"""Whatever is done to a bag, analyze, verify, recover and replay's reader say one line at most, and do no harm."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import random
import shutil
import sqlite3
import struct
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest
from bag_samples import JOINT_STATE, budget, joint_state, write_bag

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "analysis"))
from loop_bags import LoopBag
from mcap.writer import CompressionType, Writer

from tdof_npid_ros.analysis.report import analyze
from tdof_npid_ros.analysis.verify import verify
from tdof_npid_ros.bag.reader import BagReader
from tdof_npid_ros.bag.recover import recover
from tdof_npid_ros.bag.schema import definition
from tdof_npid_ros.case import load_case

MUTATIONS = budget("TDOF_NPID_MUTATED_BAGS", 150)  # 5000 in the long form
SEED = budget("TDOF_NPID_SEED", 11)
LONGEST_S = 60.0  # for one bag in all four ways, on a busy machine
MOST_MIB = 1500.0
CASE = dataclasses.replace(load_case("p1-c0.5"), episodes={"setpoint": ("0 setpoint 1", "0.2 end")})
EVIL = "import pathlib\npathlib.Path({!r}).write_text('run')\n"


def definition_bomb(depth: int = 28) -> str:
    """A definition of 2^depth paths."""
    types = [f"{'=' * 80}\nMSG: a/T{k}\nT{k + 1} x\nT{k + 1} y" for k in range(depth)]
    return "\n".join(["T0 x", *types, f"{'=' * 80}\nMSG: a/T{depth}\nuint8 x"])


HOSTILE_TYPES = [
    ("a/msg/B", definition_bomb()),
    ("a/msg/B", definition_bomb().replace("uint8 x", "")),
    ("a/msg/B", f"uint8[{'9' * 5000}] x"),
    ("a/msg/B", "B[] x"),
    ("a/msg/B", "float64 x" * 20_000),
    ("evil/msg/X", ""),
    ("evil/msg/X", "float64 data"),
    ("../../../../tmp/evil/msg/X", ""),
    ("a\nb/msg/\x1b[31mX", "float64 data"),
    ("n" * 100_000 + "/msg/X", "!"),
    (JOINT_STATE, "string[] name"),
    (JOINT_STATE, definition(JOINT_STATE).replace("float64[] position", "float64[<=1] position")),
]
HOSTILE_TOPICS = ["/setpoint", "/joint_states", "/scenario_plan", "/parameter_events", "x\ny", "t" * 50_000]
MALFORMED = b"\0\1\0\0\xff"
HOSTILE_METADATA = [
    "relative_file_paths: [../outside.mcap, /etc/passwd, {name}]",
    "relative_file_paths: [{name}, {name}, '', '.', '..', 'a\\0b']",
    "relative_file_paths: {{a: b}}",
    "relative_file_paths: 5",
    "custom_data: [1, 2]",
    "compression_mode: [FILE]",
    "x: &a [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]\n  y: &b [*a, *a, *a, *a, *a, *a, *a, *a, *a, *a]\n"
    "  z: &c [*b, *b, *b, *b, *b, *b, *b, *b, *b, *b]\n  w: &d [*c, *c, *c, *c, *c, *c, *c, *c, *c, *c]\n"
    "  v: &e [*d, *d, *d, *d, *d, *d, *d, *d, *d, *d]\n  u: [*e, *e, *e, *e, *e, *e, *e, *e, *e, *e]",
    "x: &a [*a]",
    "x: !!python/object/apply:os.system ['touch {outside}']",
    "x: " + "[" * 5000,
]


@pytest.fixture(scope="module")
def samples(tmp_path_factory) -> list[bytes]:
    """Small bags of loops and robots, of each compression."""
    folder = tmp_path_factory.mktemp("samples")
    with LoopBag(folder / "loop") as writer:
        writer.configuration(CASE, CASE.gains)
        writer.episode(CASE, CASE.gains, "setpoint", 1)
    found = [(folder / "loop" / "loop_0.mcap").read_bytes()]
    for compression in CompressionType:
        path = folder / f"{compression.name}.mcap"
        with path.open("wb") as file:
            writer = Writer(file, compression=compression, chunk_size=3000, enable_crcs=False)
            writer.start("ros2")
            number = writer.register_schema(JOINT_STATE, "ros2msg", definition(JOINT_STATE).encode())
            for topic in ("/joint_states", "/setpoint", "/control_effort"):
                channel = writer.register_channel(topic, "cdr", number)
                for step in range(60):
                    data = joint_state(step * 10**7, "base", ["arm"], [float(step > 9)], [], [1.0])
                    writer.add_message(channel, step * 10**7, data, step * 10**7)
            writer.finish()
        found.append(path.read_bytes())
    return found


def flip(data: bytearray, chance: random.Random) -> None:
    for _ in range(chance.choice([1, 1, 2, 10])):
        data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)


def splice(data: bytearray, chance: random.Random) -> None:
    begin, end = sorted(chance.randrange(len(data)) for _ in range(2))
    at = chance.randrange(len(data))
    data[at:at] = data[begin : min(end, begin + 2000)]


def cut(data: bytearray, chance: random.Random) -> None:
    del data[chance.randrange(len(data)) :]


def drop(data: bytearray, chance: random.Random) -> None:
    at = chance.randrange(len(data))
    del data[at : at + chance.randrange(1, 3000)]


def lengthen(data: bytearray, chance: random.Random) -> None:
    at = chance.randrange(len(data) - 8)
    value = chance.choice([0, 1, 255, 2**16, 2**31, 2**32 - 1, 2**63 - 1, 2**64 - 1, len(data)])
    data[at : at + chance.choice([4, 8])] = struct.pack("<Q", value)[: chance.choice([4, 8])]


def zero(data: bytearray, chance: random.Random) -> None:
    at = chance.randrange(len(data))
    data[at : at + 500] = bytes(len(data[at : at + 500]))


CHANGES: tuple[Callable[[bytearray, random.Random], None], ...] = (flip, flip, splice, cut, drop, lengthen, zero)


def changed_file(folder: Path, sample: bytes, chance: random.Random) -> Path:
    data = bytearray(sample)
    for _ in range(chance.choice([1, 1, 2])):
        if len(data) > 16:
            chance.choice(CHANGES)(data, chance)
    path = folder / "bag_0.mcap"
    path.write_bytes(data)
    return path


def hostile_types(folder: Path, sample: bytes, chance: random.Random) -> Path:
    path = folder / "bag_0.mcap"
    name, text = chance.choice(HOSTILE_TYPES)
    with path.open("wb") as file:
        writer = Writer(file, compression=chance.choice(list(CompressionType)))
        writer.start("ros2")
        topic = chance.choice(
            ["/setpoint", "/joint_states", "/scenario_plan", "/parameter_events", "x\ny", "t" * 50_000]
        )
        hostile = writer.register_schema(name, chance.choice(["ros2msg", "ros2idl", ""]), text.encode())
        qos = {"offered_qos_profiles": chance.choice(["&a [*a]", "- {durability: 1}", "!!python/name:os.system", "["])}
        for channel in (
            writer.register_channel(topic, chance.choice(["cdr", "json"]), hostile, qos),
            writer.register_channel(
                "/joint_states", "cdr", writer.register_schema(JOINT_STATE, "ros2msg", definition(JOINT_STATE).encode())
            ),
        ):
            for step in range(30):
                data = (
                    b"\0\1\0\0\xff" if chance.random() < 0.1 else joint_state(step * 10**7, "", ["a"], [step], [], [0])
                )
                writer.add_message(channel, chance.choice([0, step * 10**7]), data, step)
        writer.finish()
    return path


def hostile_metadata(folder: Path, sample: bytes, chance: random.Random) -> Path:
    (folder / "bag").mkdir()
    (folder / "bag" / "bag_0.mcap").write_bytes(sample)
    text = chance.choice(HOSTILE_METADATA).format(name="bag_0.mcap", outside=folder.parent / "ran")
    (folder / "bag" / "metadata.yaml").write_text(f"rosbag2_bagfile_information:\n  {text}\n")
    return folder / "bag"


def hostile_files(folder: Path, sample: bytes, chance: random.Random) -> Path:
    """A pipe, a device, a link or a folder where a file should be."""
    (folder / "bag").mkdir()
    name = chance.choice(["bag_0.mcap", "metadata.yaml", "bag_0.db3"])
    path = folder / "bag" / name
    if name == "metadata.yaml":
        (folder / "bag" / "bag_0.mcap").write_bytes(sample)
    kind = chance.randrange(5)
    if kind == 0:
        os.mkfifo(path)
    elif kind == 1:
        path.symlink_to(chance.choice(["/dev/zero", "/dev/stdin", "/etc/passwd", path.name, "/"]))
    elif kind == 2:
        path.mkdir()
    elif kind == 3:
        path.write_bytes(b"")
    else:
        path.write_bytes(chance.randbytes(chance.randrange(1, 5000)))
    return chance.choice([folder / "bag", path])


def hostile_sqlite(folder: Path, sample: bytes, chance: random.Random) -> Path:
    path = folder / "bag_0.db3"
    with contextlib.closing(sqlite3.connect(path)) as database, database:
        database.executescript(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name, type, serialization_format, offered_qos_profiles);"
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data);"
        )
        name, _ = chance.choice(HOSTILE_TYPES)
        topics = [(1, "/joint_states", JOINT_STATE, "cdr", "- {durability: 1}"), (2, "/x", name, "cdr", "&a [*a]")]
        database.executemany("INSERT INTO topics VALUES (?, ?, ?, ?, ?)", topics)
        rows = [(1 + step % 2, step * 10**7, joint_state(step * 10**7, "", ["a"], [step])) for step in range(60)]
        database.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", rows)
        if chance.random() < 0.5:
            table, column = chance.choice([("topics", "type"), ("messages", "timestamp"), ("messages", "data")])
            value = chance.choice([None, -1, 2**63 - 1, "x" * 1000, b"\0\1\0\0\xff"])
            with contextlib.suppress(sqlite3.Error):
                database.execute(f"UPDATE {table} SET {column} = ? WHERE id = 1", (value,))
    if chance.random() < 0.5:
        data = bytearray(path.read_bytes())
        chance.choice(CHANGES)(data, chance)
        path.write_bytes(data)
    return path


KINDS = [changed_file] * 6 + [hostile_types, hostile_metadata, hostile_files, hostile_sqlite]


def read_as_replay(path: Path) -> None:
    with BagReader(path) as reader:
        assert reader.begin_ns >= 0 and len(str(reader.unreadable)) < 10_000_000
        for topic in reader.topics.values():
            assert topic.profiles is not None
        for _ in reader.messages():
            pass


def peak_mib() -> float:
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:")) / 1024


def files_in(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir())


def is_ours(error: Exception) -> bool:
    return type(error).__module__.startswith("tdof_npid_ros")


@pytest.mark.timeout(300 + MUTATIONS)
def test_mutated_bags_do_no_harm(tmp_path, samples, monkeypatch) -> None:
    chance = random.Random(SEED)
    evil = tmp_path / "evil"
    evil.mkdir()
    (evil / "__init__.py").write_text(EVIL.format(str(tmp_path / "ran")))
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    write_bag(tmp_path / "other", 10)
    shutil.copy(tmp_path / "other" / "other_0.mcap", tmp_path / "outside.mcap")
    work = tmp_path / "work"
    ways: dict[str, Callable[[Path], object]] = {
        "analyze": lambda path: analyze([path]),
        "verify": verify,
        "recover": lambda path: recover(path, work / "new"),
        "replay": read_as_replay,
    }
    before, start_mib, slowest = files_in(tmp_path), peak_mib(), 0.0
    refused: Counter[str] = Counter()
    for number in range(MUTATIONS):
        shutil.rmtree(work, ignore_errors=True)
        work.mkdir()
        path = chance.choice(KINDS)(work, chance.choice(samples), chance)
        content = files_in(work)
        begin = time.monotonic()
        for name, way in ways.items():
            try:
                way(path)
            except Exception as error:
                assert is_ours(error), f"mutation {number}, {name}: {type(error).__name__}: {str(error)[:300]}"
                assert len(str(error)) < 2000 and "\n" not in str(error), f"mutation {number}, {name}"
                refused[name] += 1
        slowest = max(slowest, time.monotonic() - begin)
        assert slowest < LONGEST_S, f"mutation {number}"
        assert {*files_in(work)} - {*content} <= {work / "new"}, f"mutation {number}"
    shutil.rmtree(work)
    assert files_in(tmp_path) == before
    print(
        f"{MUTATIONS} mutated bags: {dict(refused)} refused; at most {slowest:.1f} s, {peak_mib() - start_mib:.0f} MiB"
    )
    assert peak_mib() - start_mib < MOST_MIB
