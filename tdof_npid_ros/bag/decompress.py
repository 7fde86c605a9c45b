"""Decompress chunks of which nothing can be believed, not even their size.

A chunk may be several frames, also such that are to be skipped, with zeros after them, as some compressors write it.
"""

from __future__ import annotations

import zlib
from typing import Final

import lz4.frame
import numpy as np
import zstandard

from tdof_npid_ros.bag.errors import BagError, shown
from tdof_npid_ros.bag.records import DAMAGED, ChunkHead
from tdof_npid_ros.bag.scan import Bytes

MAX_CHUNK_BYTES: Final = 256 << 20  # recorders write chunks of a few MiB; no chunk may take more memory than this

_MAX_WINDOW_BYTES: Final = 128 << 20
_LZ4_STEP_BYTES: Final = 8 << 20
_NOTHING: Final = ("", "none")  # names of no compression
COMPRESSIONS: Final = frozenset((*_NOTHING, "zstd", "lz4"))
_SKIPPABLE: Final = range(0x184D2A50, 0x184D2A60)  # the first four bytes of frames without content, in both formats
_ZSTD_FRAME: Final = 0xFD2FB528
_ZSTD_RUN: Final = 1  # a block that is one byte, many times


class _NoFrameError(Exception):
    """Bytes that are no frame where one should begin."""


def check_size(size: int, where: str) -> None:
    """Raise BagError when something is too large to be taken into memory at once."""
    if size > MAX_CHUNK_BYTES:
        raise BagError(
            f"{where}: {size} bytes in one piece are more than {MAX_CHUNK_BYTES >> 20} MiB: the file is"
            " damaged, or rewrite it with smaller chunks"
        )


def decompress(head: ChunkHead, data: bytes, where: str) -> Bytes:
    """Return a chunk's records.

    Raises:
        BagError: the compression is unknown, the data is damaged, of another size than announced, or larger than
            `MAX_CHUNK_BYTES`.
    """
    check_size(head.uncompressed_size, where)
    if head.compression in _NOTHING:
        records = np.frombuffer(data, np.uint8)
        whole = len(data) == head.uncompressed_size
    elif head.compression in ("zstd", "lz4"):
        try:
            records = np.empty(head.uncompressed_size, np.uint8)
            whole = (_read_zstd if head.compression == "zstd" else _read_lz4)(memoryview(data), records)
        except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError, _NoFrameError) as error:
            raise BagError(f"{where}: cannot be decompressed ({error}): {DAMAGED}") from None
    else:
        raise BagError(
            f"{where}: compression {shown(head.compression)!r} is unknown: rewrite the bag with zstd, lz4 or none"
        )
    if not whole:
        raise BagError(f"{where}: does not hold the {head.uncompressed_size} bytes that it announces: {DAMAGED}")
    if head.crc and zlib.crc32(records.data) != head.crc:
        raise BagError(f"{where}: its checksum is wrong: {DAMAGED}")
    return records


def _read_zstd(data: memoryview, target: Bytes) -> bool:
    """Fill `target`; tell whether the data held exactly that much."""
    decompressor = zstandard.ZstdDecompressor(max_window_size=_MAX_WINDOW_BYTES)
    with decompressor.stream_reader(data[: _end_of_zstd(data)], read_across_frames=True) as stream:
        filled = 0
        view = target.data
        while filled < len(target):
            got = stream.readinto(view[filled:])
            if not got:
                return False
            filled += got
        return not stream.read(1)


def _end_of_zstd(data: memoryview) -> int:
    """Return where the frames end, which the library does not tell; only zeros may follow."""
    position = 0
    while position < len(data):
        size = _skipped(data[position:])
        if size is None:
            if int.from_bytes(data[position : position + 4], "little") != _ZSTD_FRAME:
                _check_padding(data[position:])
                return position
            size = _zstd_frame_bytes(data[position:])
        position += size
    return len(data)  # the last frame may be cut short, which the library finds


def _zstd_frame_bytes(data: memoryview) -> int:
    parameters = zstandard.get_frame_parameters(data)
    position = int(zstandard.frame_header_size(data))
    last = False
    while not last and position < len(data):
        block = int.from_bytes(data[position : position + 3], "little")
        last = bool(block & 1)
        position += 3 + (1 if (block >> 1) & 3 == _ZSTD_RUN else block >> 3)
    return position + (4 if parameters.has_checksum else 0)


def _read_lz4(data: memoryview, target: Bytes) -> bool:
    filled = position = 0
    while position < len(data):
        skipped = _skipped(data[position:])
        if skipped is not None:
            position += skipped
            continue
        if data[position] == 0:
            _check_padding(data[position:])
            break
        decompressor = lz4.frame.LZ4FrameDecompressor()
        rest: bytes | memoryview = data[position:]
        while not decompressor.eof:
            most = min(_LZ4_STEP_BYTES, len(target) - filled) or 1
            piece = decompressor.decompress(rest, max_length=most)
            rest = b""
            if filled + len(piece) > len(target) or (not piece and not decompressor.eof and decompressor.needs_input):
                return False
            target[filled : filled + len(piece)] = np.frombuffer(piece, np.uint8)
            filled += len(piece)
        position = len(data) - len(decompressor.unused_data or b"")
    return filled == len(target)


def _skipped(data: memoryview) -> int | None:
    """Return the size of the frame to be skipped with which the data begins, None where it begins otherwise."""
    if int.from_bytes(data[:4], "little") not in _SKIPPABLE:
        return None
    return 8 + int.from_bytes(data[4:8], "little")


def _check_padding(data: memoryview) -> None:
    if any(data):
        raise _NoFrameError(f"{len(data)} bytes after its frames are neither a frame nor zeros")
