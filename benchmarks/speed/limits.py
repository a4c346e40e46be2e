"""Measure lower limits: the work that every reader has to do."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.recorder import STEP_TOPIC, ChunkHeader, McapReader, chunk_header, crc32, map_file

PLAIN = "plain zstd of the same chunks"
LEAST_WORK = "mapped file, decompressed, CRCs checked"


def plain(path: Path, *topics: str, **times: int) -> Callable[[], None]:
    """Return a function that decompresses a log's chunks, by default those of `/rl/step`."""
    chunks = compressed_chunks(path, topics or (STEP_TOPIC,), **times)
    return lambda: plain_zstd(chunks)


def least(path: Path, *topics: str, **times: int) -> Callable[[], object]:
    """Return a function that does the minimum work of a reader of columns."""
    headers = chunk_headers(path, topics or (STEP_TOPIC,), **times)
    return lambda: least_work(path, headers)


def plain_level_1(path: Path) -> Callable[[], None]:
    """Recompress the chunks of `/rl/step` at level 1; return a function that decompresses them."""
    chunks = level_1_chunks(raw_chunks(path, STEP_TOPIC))
    return lambda: plain_zstd(chunks)


def compressed_chunks(path: Path, topics: tuple[str, ...], **times: int) -> list[memoryview]:
    """Return the compressed bytes of the chunks that `chunk_headers` finds."""
    view = map_file(path)
    return [view[header.data] for header in chunk_headers(path, topics, **times)]


def plain_zstd(chunks: Sequence[bytes | memoryview]) -> None:
    """Decompress chunks, and do nothing else."""
    import zstandard

    for data in chunks:
        zstandard.decompress(data)


def chunk_headers(
    path: Path, topics: tuple[str, ...], start_ns: int = 0, stop_ns: int = 2**63
) -> list[ChunkHeader]:
    """Return the headers of the chunks that contain a topic in a time range."""
    reader = McapReader(path)
    ids = {channel.id for channel in reader.channels.values() if channel.topic in topics}
    return [
        chunk_header(reader.view, chunk.chunk_start_offset)
        for chunk in reader.chunks
        if ids & set(chunk.message_index_offsets)
        and chunk.message_start_time < stop_ns
        and chunk.message_end_time >= start_ns
    ]


def least_work(path: Path, headers: Sequence[ChunkHeader]) -> None:
    """Map a file, decompress these chunks one after the other, and check their CRCs.

    A reader must also create columns in new memory, and find and validate messages.
    """
    import zstandard

    decompressor, view = zstandard.ZstdDecompressor(), map_file(path)
    memory = np.empty(max(header.uncompressed_bytes for header in headers), np.uint8)
    for header in headers:
        records = memory.data[: header.uncompressed_bytes]
        with decompressor.stream_reader(view[header.data]) as reader:
            read = reader.readinto(records)
        assert (read, crc32(records)) == (len(records), header.crc)


def least_copied(path: Path, columns: Sequence[NDArray[Any]], threads: int) -> Callable[[], None]:
    """Return a function that does the minimum work of a reader in several threads.

    Each thread decompresses every k-th chunk, checks its CRC, and copies the same share of the
    columns into new memory.
    """
    headers = chunk_headers(path, (STEP_TOPIC,))

    def work(number: int, new: Sequence[NDArray[Any]]) -> None:
        least_work(path, headers[number::threads])
        for old, column in zip(columns, new, strict=True):
            part = slice(len(old) * number // threads, len(old) * (number + 1) // threads)
            column[part] = old[part]

    def run() -> None:
        new = [np.empty_like(column) for column in columns]
        others = [Thread(target=work, args=(number, new)) for number in range(1, threads)]
        for thread in others:
            thread.start()
        work(0, new)
        for thread in others:
            thread.join()

    return run


def raw_chunks(path: Path, topic: str) -> list[bytes]:
    """Return the decompressed records of a topic's chunks."""
    import zstandard

    return [zstandard.decompress(data) for data in compressed_chunks(path, (topic,))]


def level_1_chunks(chunks: list[bytes]) -> list[bytes]:
    """Compress the records of each chunk by zstd at level 1."""
    import zstandard

    compressor = zstandard.ZstdCompressor(level=1)
    return [compressor.compress(records) for records in chunks]
