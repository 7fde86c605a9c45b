"""Whatever moment a recording ends at, its bag opens and holds all but the last second."""

import os
import random
import signal
import subprocess
import sys
import time

import pytest
from bag_samples import JOINT_STATE, START_NS, budget, joint_state, write_bag
from mcap.writer import Writer

from tdof_npid_ros.bag import BagError
from tdof_npid_ros.bag.mcap_file import McapFile
from tdof_npid_ros.bag.reader import BagReader
from tdof_npid_ros.bag.recover import recover
from tdof_npid_ros.bag.schema import definition
from tdof_npid_ros.cli import main

KILLS = budget("TDOF_NPID_KILLS", 20)  # 200 in the long form
TRUNCATIONS = -(-budget("TDOF_NPID_TRUNCATIONS", 300) // 3)  # for each compression; 2000 in all in the long form
SECOND_NS = 10**9
AT_ONCE = 4

RECORDER = """
import sys, time
from tdof_npid_ros.bag.writer import BagWriter
writer = BagWriter(sys.argv[1])
topic = writer.add_topic("/count", "std_msgs/msg/UInt64", definition="uint64 data", type_hash="")
count = 0
print("recording", flush=True)
while True:
    for _ in range(int(sys.argv[2])):
        now = time.time_ns()
        writer.write(topic, b"\\0\\1\\0\\0" + count.to_bytes(8, "little"), now, now, count + 1)
        count += 1
    time.sleep(0.002)
"""


def _seconds_lost(folder, started_ns, killed_ns) -> float:
    """Check the bag of a killed recorder, and return how much of the recording it lacks."""
    with BagReader(folder) as reader:
        assert reader.truncated
        last_ns = 0
        for expected, (_, log_time_ns, _, data) in enumerate(reader.messages()):
            assert int.from_bytes(data[4:], "little") == expected
            last_ns = log_time_ns
        assert reader.end_ns == last_ns
    return (killed_ns - max(last_ns, started_ns)) / SECOND_NS


@pytest.mark.timeout(120 + 2 * KILLS)
def test_killed_recorders_leave_good_bags(tmp_path) -> None:
    chance = random.Random(1)
    worst = 0.0
    for start in range(0, KILLS, AT_ONCE):
        running = []
        for number in range(start, min(start + AT_ONCE, KILLS)):
            folder = tmp_path / str(number)
            command = [sys.executable, "-c", RECORDER, str(folder), chance.choice(["1", "30", "200"])]
            running.append((folder, subprocess.Popen(command, stdout=subprocess.PIPE, env=os.environ)))
        for _, process in running:
            process.stdout.readline()
        started_ns = time.time_ns()
        for folder, process in running:
            time.sleep(chance.uniform(0.02, 0.9))
            killed_ns = time.time_ns()
            process.send_signal(signal.SIGKILL)
            process.wait()
            process.stdout.close()
            worst = max(worst, _seconds_lost(folder, started_ns, killed_ns))
    print(f"{KILLS} kills: 0 unreadable bags, at most {worst:.2f} s lost")
    assert worst < 1.0


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_truncated_anywhere(tmp_path, compression) -> None:
    written = write_bag(
        tmp_path / "whole",
        400,
        compression=compression,
        each=lambda writer, step: writer.flush() if step % 40 == 39 else None,
    )
    whole = (tmp_path / "whole" / "whole_0.mcap").read_bytes()
    file = McapFile(tmp_path / "whole" / "whole_0.mcap")
    ends = [span.offset + span.size for span in file._spans]
    counts = [piece.load().length.size for piece in file.pieces()]
    file.close()
    chance = random.Random(2)
    cuts = range(len(whole)) if len(whole) <= TRUNCATIONS else chance.sample(range(len(whole)), TRUNCATIONS)
    path = tmp_path / "cut.mcap"
    for cut in cuts:
        path.write_bytes(whole[:cut])
        whole_chunks = sum(count for end, count in zip(ends, counts, strict=True) if end <= cut)
        with BagReader(path) as reader:
            assert reader.truncated
            found = [(*message[:3], bytes(message[3])) for message in reader.messages()]
        assert found == written[:whole_chunks], f"cut at byte {cut}"
    print(f"{len(cuts)} truncations ({compression}): 0 unreadable, 0 wrong")


def test_cut_off_bag_says_what_is_missing(tmp_path) -> None:
    written = write_bag(tmp_path / "bag", 20_000)
    path = tmp_path / "bag" / "bag_0.mcap"
    size = path.stat().st_size
    os.truncate(path, size * 2 // 3)
    with BagReader(tmp_path / "bag") as reader:
        assert reader.truncated
        assert any("a record without its end" in line for line in reader.missing)
        assert any("never finished" in line for line in reader.missing)
        assert 0 < len(list(reader.messages())) < len(written)


def test_zeros_after_a_power_cut_are_no_damage(tmp_path) -> None:
    write_bag(tmp_path / "bag", 20_000)
    path = tmp_path / "bag" / "bag_0.mcap"
    data = path.read_bytes()
    cut = len(data) * 2 // 3
    path.write_bytes(data[:cut] + bytes(len(data) - cut))
    with BagReader(path) as reader:
        assert reader.truncated
        assert 0 < len(list(reader.messages())) < 20_000
    file = McapFile(tmp_path / "bag" / "bag_0.mcap")
    after_chunk = file._spans[-1].offset + file._spans[-1].size
    file.close()
    path.write_bytes(data[:after_chunk] + bytes(100_000))
    with BagReader(path) as reader:
        assert reader.truncated


def test_recovered_bag_is_whole_and_accounts_for_the_rest(tmp_path) -> None:
    written = write_bag(tmp_path / "bag", 40_000, max_bytes=500_000, custom_data={"case": "sprott"})
    last = max((tmp_path / "bag").glob("*.mcap"), key=lambda path: int(path.stem.split("_")[1]))
    os.truncate(last, last.stat().st_size // 2)
    with BagReader(tmp_path / "bag") as reader:
        kept = [(*message[:3], bytes(message[3])) for message in reader.messages()]
    report = recover(tmp_path / "bag", tmp_path / "whole")
    assert sum(report.messages.values()) == len(kept) < len(written)
    assert kept == written[: len(kept)]
    assert report.last_ns == kept[-1][1]
    assert report.lost == {"/output": 0, "/control_effort": 0}
    assert report.dropped_bytes > 0
    assert not report.whole
    with BagReader(tmp_path / "whole") as reader:
        assert not reader.truncated
        assert [(*message[:3], bytes(message[3])) for message in reader.messages()] == kept
        assert reader.custom_data == {"case": "sprott"}
        assert dict(reader.metadata)["recovered"]["report"] == "\n".join(report.lines())
    with pytest.raises(BagError, match=r"exists already"):
        recover(tmp_path / "bag", tmp_path / "whole")


def test_recover_names_the_new_bag_after_the_old(tmp_path, monkeypatch) -> None:
    for name in ("run-c0.5", "run-c0.7"):
        write_bag(tmp_path / name, 10)
        assert main(["recover", str(tmp_path / name)]) == 0
        assert (tmp_path / f"{name}-recovered").is_dir()
    write_bag(tmp_path / "here", 10)
    monkeypatch.chdir(tmp_path / "here")
    assert main(["recover", "."]) == 0
    assert (tmp_path / "here-recovered").is_dir()


def test_recover_leaves_out_a_damaged_chunk(tmp_path) -> None:
    written = write_bag(tmp_path / "bag", 50_000, compression="none")
    path = tmp_path / "bag" / "bag_0.mcap"
    file = McapFile(path)
    middle = file._spans[len(file._spans) // 2]
    count = file.load(middle).length.size
    file.close()
    data = bytearray(path.read_bytes())
    data[middle.offset + middle.size // 2] ^= 0xFF
    path.write_bytes(data)
    with pytest.raises(BagError, match=r"checksum.*recover"), BagReader(path) as reader:
        list(reader.messages())
    report = recover(path, tmp_path / "whole")
    assert sum(report.messages.values()) == len(written) - count
    assert report.dropped_bytes == middle.size
    assert sum(report.lost.values()) == count


def test_recover_leaves_out_what_is_no_cdr_and_says_so(tmp_path) -> None:
    with (tmp_path / "mixed.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start("")
        ros = writer.register_schema(JOINT_STATE, "ros2msg", definition(JOINT_STATE).encode())
        output = writer.register_channel("/output", "cdr", ros)
        note = writer.register_channel("/note", "json", writer.register_schema("note", "jsonschema", b"{}"))
        for step in range(100):
            writer.add_message(output if step % 4 else note, step, joint_state(step) if step % 4 else b"{}", step)
        writer.finish()
    report = recover(tmp_path / "mixed.mcap", tmp_path / "whole")
    assert report.messages == {"/output": 75} and not report.whole
    (line,) = report.missing
    assert "25 messages of topic /note, in json" in line


def test_recovering_a_whole_bag_loses_nothing(tmp_path) -> None:
    written = write_bag(tmp_path / "bag", 1000)
    report = recover(tmp_path / "bag", tmp_path / "again")
    assert report.whole
    assert report.first_ns == START_NS
    with BagReader(tmp_path / "again") as reader:
        assert [bytes(message[3]) for message in reader.messages()] == [message[3] for message in written]
