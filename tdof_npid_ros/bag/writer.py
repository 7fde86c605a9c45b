"""Write a bag: a rosbag2 folder of MCAP files that a crash cannot make unreadable."""

from __future__ import annotations

import struct
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Final, Literal, NamedTuple

from mcap.records import Attachment, Channel, Schema

from tdof_npid_ros.bag import metadata, schema
from tdof_npid_ros.bag.errors import BagError
from tdof_npid_ros.bag.file_writer import COMPRESSIONS, FileWriter
from tdof_npid_ros.bag.qos import QosProfile, qos_text
from tdof_npid_ros.bag.schema import ROS2MSG
from tdof_npid_ros.one_line import as_text

CHUNK_BYTES: Final = 1 << 20  # a chunk is compressed and written when it holds this much
FLUSH_INTERVAL_S: Final = 0.5  # so that a crash loses less than a second, the writing itself included

_NEVER_NS: Final = 2**64
_MAX_TOPICS: Final = 2**16 - 1  # MCAP counts channels in 16 bits, from 1 on


class _Topic(NamedTuple):
    """What is announced of a topic, in each file anew."""

    type: str
    channel: Channel


class BagWriter:
    """A bag being recorded. Use it as a context manager; its methods may be called from any thread.

    Messages gather in a chunk in memory, which goes to the operating system when it is full and at least each
    `flush_interval_s` of wall-clock time, and from there to the disk. What has gone to the disk stays
    readable whatever happens afterwards.

    Attributes:
        folder: the bag.
        custom_data: text by key for `metadata.yaml`; may be changed until the bag is closed.
    """

    def __init__(
        self,
        folder: str | Path,
        *,
        compression: Literal["zstd", "lz4", "none"] = "zstd",
        max_bytes: int = 0,
        max_duration_s: float = 0.0,
        flush_interval_s: float = FLUSH_INTERVAL_S,
        custom_data: Mapping[str, str] | None = None,
    ) -> None:
        """Create the folder, its first file and `metadata.yaml`.

        Args:
            folder: must not exist; its parents are created. Its name becomes the files' name.
            compression: of the chunks.
            max_bytes: a new file begins when a file has reached this size; 0: never. Checked at each chunk.
            max_duration_s: a new file begins when a message's log time lies this long after its file's first; 0: never.
            flush_interval_s: longest time that a message waits in memory.

        Raises:
            BagError: the folder exists or cannot be created, or an option makes no sense.
        """
        if compression not in COMPRESSIONS:
            raise BagError(f"compression {compression!r} is unknown: choose one of {', '.join(COMPRESSIONS)}")
        if max_bytes < 0 or max_duration_s < 0 or not flush_interval_s > 0:
            raise BagError("max_bytes and max_duration_s must not be negative, flush_interval_s must be positive")
        self.folder = Path(folder)
        self.custom_data = dict(custom_data or {})
        self._compression = compression
        self._max_bytes = max_bytes
        self._max_duration_ns = round(max_duration_s * 1e9)
        self._chunk_bytes = min(CHUNK_BYTES, max_bytes) if max_bytes else CHUNK_BYTES
        self._split_at_ns = 0
        self._schemas: dict[tuple[str, str, bytes], Schema] = {}  # by name, encoding and text
        self._topics: list[_Topic] = []
        self._finished: list[FileWriter] = []
        self._error: BagError | None = None
        self._closed = False
        self._lock = threading.RLock()
        try:
            self.folder.mkdir(parents=True)
        except FileExistsError:
            raise BagError(f"{self.folder} exists already and is not overwritten: choose another name") from None
        except OSError as error:
            raise BagError(f"cannot create the bag {self.folder}: {error.strerror}") from None
        self._guarded(self._open_file)
        self._stop = threading.Event()
        self._flusher = threading.Thread(
            target=self._keep_flushing, args=(flush_interval_s,), name="bag flusher", daemon=True
        )
        self._flusher.start()

    def add_topic(
        self,
        name: str,
        type_name: str,
        *,
        qos: Sequence[QosProfile] | str = (),
        definition: str | None = None,
        type_hash: str | None = None,
        encoding: str = ROS2MSG,
    ) -> int:
        """Announce a topic and return its number for `write`.

        Args:
            name: the full topic name.
            type_name: for example "sensor_msgs/msg/JointState".
            qos: what its publishers offer, as profiles or as rosbag2's YAML text.
            definition, type_hash: the type's definition and RIHS01 hash; by default those of the installed type.
            encoding: how the definition is written.

        Raises:
            BagError: the type is not installed, or writing failed.
        """
        data = (schema.definition(type_name) if definition is None else definition).encode()
        digest = schema.type_hash(type_name) if type_hash is None else type_hash
        quality = qos if isinstance(qos, str) else qos_text(qos)
        with self._lock:
            self._check()
            if len(self._topics) == _MAX_TOPICS:
                raise BagError(f"{self.folder}: a bag holds at most {_MAX_TOPICS} topics: record fewer")
            key = type_name, encoding, data
            known = self._schemas.get(key)
            kind = known or Schema(id=len(self._schemas) + 1, name=type_name, encoding=encoding, data=data)
            values = {"offered_qos_profiles": quality, "topic_type_hash": digest}
            channel = Channel(
                id=len(self._topics) + 1, schema_id=kind.id, topic=name, message_encoding="cdr", metadata=values
            )
            if known is None:
                self._guarded(lambda: self._file.add_schema(kind))
                self._schemas[key] = kind
            self._guarded(lambda: self._file.add_channel(channel))
            self._topics.append(_Topic(type_name, channel))
            return int(channel.id)

    def write(
        self,
        topic_id: int,
        data: bytes | bytearray | memoryview,
        log_time_ns: int,
        publish_time_ns: int,
        sequence: int = 0,
    ) -> None:
        """Write a message.

        Args:
            topic_id: from `add_topic`.
            data: the serialized message: CDR with its 4-byte head.
            log_time_ns, publish_time_ns: when it was received and published, in nanoseconds, from 0 on.
            sequence: the publisher's count of messages, where it is known; 0 otherwise.

        Raises:
            BagError: disk full, folder vanished, closed, an unknown topic or a time out of range. What was flushed
                stays.
        """
        with self._lock:
            if self._error is not None or self._closed:
                self._check()
            file = self._file
            try:
                if log_time_ns >= self._split_at_ns:
                    self._begin_duration(log_time_ns)
                    file = self._file
                file.write(topic_id, data, log_time_ns, publish_time_ns, sequence)
            except (KeyError, struct.error):
                raise BagError(
                    f"{self.folder}: no topic has the number {topic_id}, or a time or the sequence number"
                    f" is out of range: {log_time_ns}, {publish_time_ns}, {sequence}"
                ) from None
            if len(file.chunk) >= self._chunk_bytes:
                self._guarded(self._flush_and_split)

    def write_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write named key-value pairs as an MCAP metadata record; it goes to the operating system at once.

        Raises:
            BagError: as `write`.
        """
        with self._lock:
            self._check()
            self._guarded(lambda: self._file.write_metadata(name, dict(values)))

    def write_attachment(self, attachment: Attachment) -> None:
        """Write an attachment; it goes to the operating system at once.

        Raises:
            BagError: as `write`.
        """
        with self._lock:
            self._check()
            self._guarded(lambda: self._file.write_attachment(attachment))

    def flush(self) -> None:
        """Hand all messages to the operating system, and check that the bag is still there.

        Raises:
            BagError: disk full or folder vanished.
        """
        with self._lock:
            self._check()
            self._guarded(self._flush_and_split)

    def close(self) -> None:
        """Write the summary and `metadata.yaml`. A second call does nothing.

        Raises:
            BagError: disk full or folder vanished. What was flushed stays readable.
        """
        with self._lock:
            if self._closed:
                return
            self._closed = True
            self._stop.set()
            try:
                if self._error is not None:
                    raise self._error
                self._guarded(self._finish_file)
                self._guarded(self._write_table)
            finally:
                if self._error is not None:
                    self._file.finish_if_possible()
        self._flusher.join()

    def __enter__(self) -> BagWriter:
        """Return the writer."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close; an error in closing does not hide the one that led here."""
        try:
            self.close()
        except BagError:
            if error is None:
                raise

    def _check(self) -> None:
        if self._error is not None:
            raise self._error
        if self._closed:
            raise BagError(f"{self.folder} is closed: nothing more can be written to it")

    def _guarded(self, action: Callable[[], None]) -> None:
        """Do something with the file; a failure ends the recording."""
        try:
            action()
        except OSError as error:
            where = error.filename or self.folder
            self._error = BagError(
                f"recording stopped, cannot write {where}: {error.strerror};"
                f" what was written to {self.folder} is kept: make room, then record to a new bag"
            )
            raise self._error from None

    def _open_file(self) -> None:
        name = self.folder.resolve().name
        name = name if name == as_text(name) else "bag"  # metadata.yaml names the file, in UTF-8
        path = self.folder / f"{name}_{len(self._finished)}.mcap"
        self._file = FileWriter(path, self._compression)
        for kind in self._schemas.values():
            self._file.add_schema(kind)
        for topic in self._topics:
            self._file.add_channel(topic.channel)
        self._split_at_ns = 0
        self._write_table()

    def _finish_file(self) -> None:
        self._file.check_in_place()
        self._file.finish()
        self._finished.append(self._file)

    def _begin_duration(self, log_time_ns: int) -> None:
        """Note when the file's time is over, at its first message, or begin the next one."""
        if self._max_duration_ns and self._file.message_count:
            self._guarded(self._finish_file)
            self._guarded(self._open_file)
        self._split_at_ns = log_time_ns + self._max_duration_ns if self._max_duration_ns else _NEVER_NS

    def _flush_and_split(self) -> None:
        self._file.check_in_place()
        self._file.flush()
        if self._max_bytes and self._file.size >= self._max_bytes and self._file.message_count:
            self._finish_file()
            self._open_file()

    def _write_table(self) -> None:
        files = [*self._finished] if self._closed else [*self._finished, self._file]
        table = metadata.BagMetadata(
            topics=[
                metadata.TopicEntry(
                    channel.topic,
                    type_name,
                    channel.metadata["offered_qos_profiles"],
                    channel.metadata["topic_type_hash"],
                    sum(file.counts.get(channel.id, 0) for file in files),
                )
                for type_name, channel in self._topics
            ],
            files=[
                metadata.FileEntry(file.path.name, file.start_ns, file.end_ns, file.message_count) for file in files
            ],
            custom_data=self.custom_data,
        )
        metadata.write(self.folder, table)

    def _keep_flushing(self, interval_s: float) -> None:
        while not self._stop.wait(interval_s):
            with self._lock:
                if self._error is not None or self._closed:
                    return
                try:
                    self._guarded(self._flush_and_split)
                except BagError:
                    return  # the next call of the recorder's raises it
                file = self._file
            try:
                file.sync()
            except OSError as error:
                if file is self._file and not self._closed:
                    self._error = BagError(
                        f"recording stopped, the disk does not take {file.path}: {error.strerror};"
                        " what was written is kept: make room, then record to a new bag"
                    )
