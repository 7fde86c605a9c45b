"""Bags are read by software that we did not write, and we read theirs."""

import json
import shutil
import subprocess
from pathlib import Path

import mcap.reader
import numpy as np
import pytest
from bag_samples import JOINT_STATE, START_NS, TYPES, joint_state, write_bag
from mcap.writer import CompressionType, Writer
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.writer import Writer as Ros2Writer
from numpy.testing import assert_array_equal
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Reader as RosbagsReader
from rosbags.rosbag2 import Writer as RosbagsWriter

from tdof_npid_ros.bag.reader import BagReader

COMPRESSIONS = ["zstd", "lz4", "none"]
NODE_PACKAGES = ["@mcap/core@2", "@foxglove/rosmsg@5", "@foxglove/rosmsg2-serialization@3", "fzstd@0.1"]


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_rosbags_reads_ours(tmp_path, compression) -> None:
    written = write_bag(tmp_path / "bag", 3000, compression=compression, max_bytes=50_000)
    with RosbagsReader(tmp_path / "bag") as reader:
        found = [(connection.topic, time, bytes(data)) for connection, time, data in reader.messages()]
    assert found == [(topic, time, data) for topic, time, _, data in written]


def test_any_reader_decodes_ours(tmp_path) -> None:
    write_bag(tmp_path / "bag", 100)
    with AnyReader([tmp_path / "bag"]) as reader:
        efforts = [reader.deserialize(data, connection.msgtype).effort[0] for connection, _, data in reader.messages()]
    assert_array_equal(efforts, np.cos(np.arange(100)))


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_mcap_and_its_ros2_decoder_read_ours(tmp_path, compression) -> None:
    written = write_bag(tmp_path / "bag", 3000, compression=compression)
    with (tmp_path / "bag" / "bag_0.mcap").open("rb") as file:
        reader = mcap.reader.make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        assert summary.statistics.message_count == 3000
        assert reader.get_header().profile == "ros2"
        for (topic, log_time, publish_time, data), found in zip(written, reader.iter_decoded_messages(), strict=True):
            assert (found.channel.topic, found.message.log_time) == (topic, log_time)
            assert (found.message.publish_time, found.message.data) == (publish_time, data)
            assert found.decoded_message.header.frame_id == "a1b2c3/0"
            assert found.channel.metadata["topic_type_hash"].startswith("RIHS01_")


@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
@pytest.mark.parametrize("storage_compression", [False, True])
def test_we_read_bags_of_rosbags(tmp_path, plugin, storage_compression) -> None:
    if storage_compression and plugin == StoragePlugin.SQLITE3:
        pytest.skip("SQLite storage has no compression")
    writer = RosbagsWriter(tmp_path / "bag", version=9, storage_plugin=plugin)
    writer.set_custom_data("case", "p1-c4")
    if storage_compression:
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer:
        topics = [writer.add_connection(name, JOINT_STATE, typestore=TYPES) for name in ("/output", "/control_effort")]
        for step in range(20_000):
            writer.write(topics[step % 2], START_NS + step, joint_state(step, "frame", position=[step]))
    with BagReader(tmp_path / "bag") as reader:
        assert not reader.truncated
        assert reader.custom_data == {"case": "p1-c4"}
        assert reader.topics["/output"].count == 10_000
        assert reader.topics["/output"].type_hash or plugin == StoragePlugin.MCAP
        assert (reader.start_ns, reader.end_ns) == (START_NS, START_NS + 19_999)
        assert_array_equal(reader.columns("/output")["position"][:, 0], np.arange(0, 20_000, 2))
        assert [message[1] for message in reader.messages()] == list(range(START_NS, START_NS + 20_000))
    (storage,) = [path for path in (tmp_path / "bag").iterdir() if path.suffix in (".mcap", ".db3")]
    with BagReader(storage) as reader:
        assert_array_equal(reader.columns("/control_effort")["header.stamp"], np.arange(1, 20_000, 2))


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("chunked", [True, False])
@pytest.mark.parametrize("indexed", [True, False])
def test_we_read_files_of_mcap(tmp_path, compression, chunked, indexed) -> None:
    path = tmp_path / "file.mcap"
    writer = Writer(
        str(path),
        chunk_size=4096,
        compression=compression,
        use_chunking=chunked,
        use_statistics=indexed,
        repeat_channels=indexed,
        repeat_schemas=indexed,
        enable_data_crcs=True,
    )
    writer.start("ros2")
    schema = writer.register_schema(JOINT_STATE, "ros2msg", joint_state_definition())
    channel = writer.register_channel("/output", "cdr", schema)
    for step in range(3000):
        writer.add_message(channel, 5 * step, joint_state(step, effort=[step]), 5 * step, step)
    writer.finish()
    with BagReader(path) as reader:
        assert not reader.truncated
        assert_array_equal(reader.columns("/output")["effort"][:, 0], np.arange(3000))


def joint_state_definition() -> bytes:
    return TYPES.generate_msgdef(JOINT_STATE, ros_version=2)[0].encode()


def test_we_read_files_of_mcap_ros2(tmp_path) -> None:
    path = tmp_path / "file.mcap"
    with path.open("wb") as file:
        writer = Ros2Writer(file)
        schema = writer.register_msgdef("std_msgs/msg/Float64MultiArray", "float64[] data\nstring unit")
        for step in range(100):
            writer.write_message("/values", schema, {"data": [step, 1.0], "unit": "V"}, log_time=step)
        writer.finish()
    with BagReader(path) as reader:
        assert_array_equal(reader.columns("/values")["data"][:, 0], np.arange(100))
        assert set(reader.columns("/values")["unit"]) == {"V"}


@pytest.fixture(scope="session")
def node_modules(tmp_path_factory) -> Path:
    """Return a folder with the official TypeScript MCAP reader and ROS 2 decoder installed."""
    if shutil.which("node") is None or shutil.which("npm") is None:
        pytest.skip("Node is not installed")
    folder = tmp_path_factory.mktemp("node")
    (folder / "package.json").write_text("{}")
    command = ["npm", "install", "--no-audit", "--no-fund", *NODE_PACKAGES]
    try:
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=180, check=False)
    except subprocess.TimeoutExpired:
        pytest.skip("npm install took too long")
    if done.returncode:
        pytest.skip(f"npm install failed: {done.stderr.strip().splitlines()[-1]}")
    return folder


NODE_SCRIPT = """
const { McapIndexedReader } = require("@mcap/core");
const { parse } = require("@foxglove/rosmsg");
const { MessageReader } = require("@foxglove/rosmsg2-serialization");
const fzstd = require("fzstd");
const { open } = require("node:fs/promises");

async function main(path) {
  const handle = await open(path);
  const readable = {
    size: async () => BigInt((await handle.stat()).size),
    read: async (offset, length) => {
      const buffer = new Uint8Array(Number(length));
      await handle.read(buffer, 0, Number(length), Number(offset));
      return buffer;
    },
  };
  const decompressHandlers = { zstd: (data, size) => fzstd.decompress(data, new Uint8Array(Number(size))) };
  const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers });
  const decoders = new Map();
  const found = [];
  for await (const message of reader.readMessages()) {
    const channel = reader.channelsById.get(message.channelId);
    if (!decoders.has(channel.id)) {
      const schema = reader.schemasById.get(channel.schemaId);
      const definition = parse(new TextDecoder().decode(schema.data), { ros2: true });
      decoders.set(channel.id, new MessageReader(definition));
    }
    const decoded = decoders.get(channel.id).readMessage(message.data);
    found.push([channel.topic, String(message.logTime), decoded.header.frame_id,
                Array.from(decoded.position), Array.from(decoded.effort)]);
  }
  console.log(JSON.stringify(found));
}
main(process.argv[2]);
"""


@pytest.mark.parametrize("compression", ["zstd", "none"])
def test_typescript_reads_ours(tmp_path, node_modules, compression) -> None:
    written = write_bag(tmp_path / "bag", 2000, compression=compression)
    script = node_modules / "read.cjs"
    script.write_text(NODE_SCRIPT)
    done = subprocess.run(
        ["node", str(script), str(tmp_path / "bag" / "bag_0.mcap")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == [
        [topic, str(time), "a1b2c3/0", [float(np.sin(step))], [float(np.cos(step))]]
        for step, (topic, time, _, _) in enumerate(written)
    ]
