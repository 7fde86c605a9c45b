"""Decompress chunks of which nothing can be believed, not even their size."""

from __future__ import annotations

import zlib
from typing import Final

import lz4.frame
import numpy as np
import zstandard

from tdof_npid_ros.bag.errors import BagError
from tdof_npid_ros.bag.records import ChunkHead
from tdof_npid_ros.bag.scan import Bytes

MAX_CHUNK_BYTES: Final = 256 << 20  # recorders write chunks of a few MiB; no chunk may take more memory than this

_MAX_WINDOW_BYTES: Final = 128 << 20
_LZ4_STEP_BYTES: Final = 8 << 20


def check_size(size: int, where: str) -> None:
    """Raise BagError when something is too large to be taken into memory at once."""
    if size > MAX_CHUNK_BYTES:
        raise BagError(
            f"{where}: {size} bytes in one piece are more than {MAX_CHUNK_BYTES >> 20} MiB: the file is"
            " damaged, or rewrite it with smaller chunks"
        )


def _read_zstd(data: bytes, target: Bytes) -> bool:
    """Fill `target`; tell whether the data held exactly that much."""
    decompressor = zstandard.ZstdDecompressor(max_window_size=_MAX_WINDOW_BYTES)
    with decompressor.stream_reader(data, read_across_frames=True) as stream:
        filled = 0
        view = target.data
        while filled < len(target):
            got = stream.readinto(view[filled:])
            if not got:
                return False
            filled += got
        return not stream.read(1)


def _read_lz4(data: bytes, target: Bytes) -> bool:
    decompressor = lz4.frame.LZ4FrameDecompressor()
    filled = 0
    rest = data
    while filled < len(target):
        piece = decompressor.decompress(rest, max_length=min(_LZ4_STEP_BYTES, len(target) - filled))
        rest = b""
        if not piece and (decompressor.eof or decompressor.needs_input):
            return False
        target[filled : filled + len(piece)] = np.frombuffer(piece, np.uint8)
        filled += len(piece)
    return decompressor.eof or not decompressor.decompress(rest, max_length=1)


def decompress(head: ChunkHead, data: bytes, where: str) -> Bytes:
    """Return a chunk's records.

    Raises
    ------
    BagError
        The compression is unknown, the data is damaged, of another size than announced, or larger than
        `MAX_CHUNK_BYTES`.
    """
    check_size(head.uncompressed_size, where)
    if not head.compression:
        records = np.frombuffer(data, np.uint8)
        whole = len(data) == head.uncompressed_size
    elif head.compression in ("zstd", "lz4"):
        records = np.empty(head.uncompressed_size, np.uint8)
        try:
            whole = (_read_zstd if head.compression == "zstd" else _read_lz4)(data, records)
        except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError) as error:
            raise BagError(
                f"{where}: cannot be decompressed ({error}): the file is damaged, run `tdof-npid recover`"
            ) from None
    else:
        raise BagError(
            f"{where}: compression {head.compression[:20]!r} is unknown: rewrite the bag with zstd, lz4 or none"
        )
    if not whole:
        raise BagError(
            f"{where}: does not hold the {head.uncompressed_size} bytes that it announces: the file is"
            " damaged, run `tdof-npid recover`"
        )
    if head.crc and zlib.crc32(records.data) != head.crc:
        raise BagError(f"{where}: its checksum is wrong: the file is damaged, run `tdof-npid recover`")
    return records
