"""What no reader can do without: the limits beside which we and others are measured."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from mcaprl.recorder.columns.checksum import crc32
from mcaprl.recorder.columns.chunks import ChunkHeader, chunk_header
from mcaprl.recorder.columns.reader import McapReader
from mcaprl.recorder.columns.records import map_file
from mcaprl.recorder.format.topics import STEP_TOPIC

PLAIN = "plain zstd of the same chunks"
LEAST_WORK = "mapped file, decompressed, CRCs checked"


def plain(path: Path, *topics: str, **times: int) -> Callable[[], None]:
    """Plain decompression of a log's chunks, by default those of `/rl/step`."""
    chunks = compressed_chunks(path, topics or (STEP_TOPIC,), **times)
    return lambda: plain_zstd(chunks)


def least(path: Path, *topics: str) -> Callable[[], object]:
    """What a reader of columns cannot do without."""
    headers = chunk_headers(path, topics or (STEP_TOPIC,))
    return lambda: least_work(path, headers)


def plain_level_1(path: Path) -> Callable[[], None]:
    """Plain decompression of the records of `/rl/step`, as zstd packs them by itself."""
    chunks = level_1_chunks(raw_chunks(path, STEP_TOPIC))
    return lambda: plain_zstd(chunks)


def compressed_chunks(
    path: Path, topics: tuple[str, ...], start_ns: int = 0, stop_ns: int = 2**63
) -> list[memoryview]:
    """The bytes of the chunks that hold a topic in a time, as they stand in the file."""
    reader = McapReader(path)
    ids = {channel.id for channel in reader.channels.values() if channel.topic in topics}
    found = []
    for chunk in reader.chunks:
        is_then = chunk.message_start_time < stop_ns and chunk.message_end_time >= start_ns
        if ids & set(chunk.message_index_offsets) and is_then:
            start = chunk.chunk_start_offset + chunk.chunk_length - chunk.compressed_size
            found.append(reader.view[start : start + chunk.compressed_size])
    return found


def plain_zstd(chunks: Sequence[bytes | memoryview]) -> None:
    """Decompress chunks, and nothing else: what no reader can do without."""
    import zstandard

    for data in chunks:
        zstandard.decompress(data)


def chunk_headers(path: Path, topics: tuple[str, ...]) -> list[ChunkHeader]:
    """Of the chunks that hold a topic."""
    reader = McapReader(path)
    ids = {channel.id for channel in reader.channels.values() if channel.topic in topics}
    found = [chunk for chunk in reader.chunks if ids & set(chunk.message_index_offsets)]
    return [chunk_header(reader.view, chunk.chunk_start_offset) for chunk in found]


def least_work(path: Path, headers: Sequence[ChunkHeader]) -> None:
    """Map a file, decompress these chunks one after the other, check them against their CRCs.

    No reader can do without: columns in new memory come on top, and finding and checking messages.
    """
    import zstandard

    decompressor, view = zstandard.ZstdDecompressor(), map_file(path)
    memory = np.empty(max(header.uncompressed_bytes for header in headers), np.uint8)
    for header in headers:
        records = memory.data[: header.uncompressed_bytes]
        with decompressor.stream_reader(view[header.data]) as reader:
            read = reader.readinto(records)
        assert (read, crc32(records)) == (len(records), header.crc)


def raw_chunks(path: Path, topic: str) -> list[bytes]:
    """The records of a topic's chunks."""
    import zstandard

    return [zstandard.decompress(data) for data in compressed_chunks(path, (topic,))]


def level_1_chunks(chunks: list[bytes]) -> list[bytes]:
    """Chunks as zstd's level 1 packs them."""
    import zstandard

    compressor = zstandard.ZstdCompressor(level=1)
    return [compressor.compress(records) for records in chunks]
