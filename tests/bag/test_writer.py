import subprocess
import sys
import time

import pytest
import yaml
from bag_samples import JOINT_STATE, START_NS, joint_state, write_bag
from rosbags.rosbag2 import Reader

from tdof_npid_ros.bag import BagError
from tdof_npid_ros.bag.qos import QosProfile
from tdof_npid_ros.bag.reader import BagReader
from tdof_npid_ros.bag.writer import BagWriter


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_what_is_written_is_read(tmp_path, compression) -> None:
    written = write_bag(tmp_path / "bag", 5000, compression=compression)
    with BagReader(tmp_path / "bag") as reader:
        assert [(*message[:3], bytes(message[3])) for message in reader.messages()] == written
        assert not reader.truncated
        assert reader.topics["/output"].count == 2500
        assert (reader.start_ns, reader.end_ns) == (written[0][1], written[-1][1])


def test_never_overwrites(tmp_path) -> None:
    (tmp_path / "bag").mkdir()
    with pytest.raises(BagError, match="exists already"):
        BagWriter(tmp_path / "bag")
    assert not list((tmp_path / "bag").iterdir())


def test_unknown_compression_is_refused(tmp_path) -> None:
    with pytest.raises(BagError, match="choose one of zstd, lz4, none"):
        BagWriter(tmp_path / "bag", compression="gzip")


def test_splits_by_size(tmp_path) -> None:
    written = write_bag(tmp_path / "bag", 5000, compression="none", max_bytes=100_000, flush_interval_s=60)
    files = sorted((tmp_path / "bag").glob("*.mcap"))
    assert len(files) > 4
    assert all(file.stat().st_size < 250_000 for file in files)
    assert (tmp_path / "bag" / "bag_0.mcap").exists()
    with BagReader(tmp_path / "bag") as reader:
        assert [bytes(message[3]) for message in reader.messages()] == [message[3] for message in written]
    with Reader(tmp_path / "bag") as theirs:
        assert theirs.message_count == 5000
        assert len(theirs.storage.files) == len(files)


def test_splits_by_duration(tmp_path) -> None:
    write_bag(tmp_path / "bag", 1000, max_duration_s=100e-6)  # a message each microsecond
    assert len(list((tmp_path / "bag").glob("*.mcap"))) == 10
    with BagReader(tmp_path / "bag" / "bag_3.mcap") as reader:
        assert reader.end_ns - reader.start_ns == 99_000
        assert sum(topic.count for topic in reader.topics.values()) == 100


def test_metadata_yaml_and_custom_data(tmp_path) -> None:
    with BagWriter(tmp_path / "bag", custom_data={"case": "p1-c4"}) as writer:
        topic = writer.add_topic("/output", JOINT_STATE, qos=[QosProfile(durability="transient_local", depth=3)])
        writer.write(topic, joint_state(), START_NS, START_NS)
        writer.custom_data["steps"] = "1"
    information = yaml.safe_load((tmp_path / "bag" / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert information["version"] == 9
    assert information["custom_data"] == {"case": "p1-c4", "steps": "1"}
    with Reader(tmp_path / "bag") as theirs:
        (connection,) = theirs.connections
        assert connection.ext.offered_qos_profiles[0].depth == 3
        assert connection.ext.offered_qos_profiles[0].durability.name == "TRANSIENT_LOCAL"
        assert connection.digest.startswith("RIHS01_")
    with BagReader(tmp_path / "bag") as reader:
        assert reader.custom_data == {"case": "p1-c4", "steps": "1"}


def test_metadata_records_are_read_back(tmp_path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        writer.write_metadata("loss", {"/output": "0", "µ": "±"})
        writer.write_metadata("loss", {"/output": "1"})
    with BagReader(tmp_path / "bag") as reader:
        assert reader.metadata == [("loss", {"/output": "0", "µ": "±"}), ("loss", {"/output": "1"})]


def test_wrong_use_says_so_and_goes_on(tmp_path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        topic = writer.add_topic("/output", JOINT_STATE)
        for arguments in [(topic + 1, 0, 0), (topic, -1, 0), (topic, 0, 2**64)]:
            with pytest.raises(BagError, match="number"):
                writer.write(arguments[0], b"", *arguments[1:])
        writer.write(topic, joint_state(), START_NS, START_NS)
    with pytest.raises(BagError, match="closed"):
        writer.write(topic, joint_state(), START_NS, START_NS)
    with BagReader(tmp_path / "bag") as reader:
        assert len(list(reader.messages())) == 1


def test_messages_reach_the_disk_without_another_write(tmp_path) -> None:
    with BagWriter(tmp_path / "bag", flush_interval_s=0.05) as writer:
        topic = writer.add_topic("/output", JOINT_STATE)
        writer.write(topic, joint_state(), START_NS, START_NS)
        deadline = time.monotonic() + 5
        count = 0
        while not count and time.monotonic() < deadline:
            with BagReader(tmp_path / "bag") as reader:
                count = len(list(reader.messages()))
        assert count == 1


def test_vanished_folder_is_noticed(tmp_path) -> None:
    with pytest.raises(BagError, match="cannot write"), BagWriter(tmp_path / "bag") as writer:
        topic = writer.add_topic("/output", JOINT_STATE)
        (tmp_path / "bag").rename(tmp_path / "moved")
        writer.write(topic, joint_state(), START_NS, START_NS)
        writer.flush()
    with BagReader(tmp_path / "moved") as reader:
        assert reader.topics["/output"].count == 1


FULL_DISK = """
import resource, signal, sys
from tdof_npid_ros.bag import BagError
from tdof_npid_ros.bag.writer import BagWriter
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))
writer = BagWriter(sys.argv[1], compression="none", max_bytes=0, flush_interval_s=60)
topic = writer.add_topic("/output", "std_msgs/msg/String")
written = 0
try:
    while written < 100_000:
        writer.write(topic, bytes([0, 1, 0, 0, 5, 0, 0, 0]) + b"full\\0", written, written)
        written += 1
        if not written % 100:
            writer.flush()
except BagError as error:
    print(error)
else:
    sys.exit("no error")
try:
    writer.close()
except BagError:
    pass
"""


def test_full_disk_is_said_and_what_is_written_stays(tmp_path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", FULL_DISK, str(tmp_path / "bag")], capture_output=True, text=True, check=True
    )
    assert "recording stopped" in done.stdout
    with BagReader(tmp_path / "bag") as reader:
        assert reader.truncated
        times = [message[1] for message in reader.messages()]
        assert times == list(range(len(times)))
        assert len(times) > 1000
