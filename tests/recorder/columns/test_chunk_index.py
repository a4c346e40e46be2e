"""Chunk indexes and message indexes, compared with the output of the `mcap` library."""

from __future__ import annotations

import itertools
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import ChunkIndex

import mcaprl
from mcaprl.errors import CorruptLogError
from mcaprl.recorder.columns.chunks import (
    ChunkIndexes,
    chunk_index_record,
    indexes_of_one,
    parse_chunk_index,
)
from mcaprl.recorder.columns.reader import McapReader
from mcaprl.recorder.columns.records import RECORD_HEADER, message_index
from mcaprl.recorder.columns.summary import Summary
from tests.support.recordings import MIXED_SPACE, record

_U8 = st.integers(0, 2**64 - 1)
CHUNK_INDEXES = st.builds(
    ChunkIndex,
    chunk_length=_U8,
    chunk_start_offset=_U8,
    compression=st.sampled_from(["", "zstd", "lz4", "größer"]),
    compressed_size=_U8,
    message_end_time=_U8,
    message_index_length=_U8,
    message_index_offsets=st.dictionaries(st.integers(0, 2**16 - 1), _U8, max_size=3),
    message_start_time=_U8,
    uncompressed_size=_U8,
)

CHUNKS_OF_ONE = CHUNK_INDEXES.map(
    lambda chunk: replace(chunk, compression="zstd", message_index_offsets={7: 8})
)


def content_of(chunk: ChunkIndex, after: bytes = b"") -> memoryview:
    """Return the content of the record that the library writes, followed by the bytes `after`."""
    builder = RecordBuilder()
    chunk.write(builder)
    return memoryview(builder.end()[RECORD_HEADER.size :] + after)


@given(CHUNK_INDEXES, st.sampled_from([b"", b"of later versions"]))
def test_chunk_indexes_equal_those_of_the_library(chunk: ChunkIndex, after: bytes) -> None:
    assert parse_chunk_index(content_of(chunk, after)) == chunk
    assert chunk_index_record(chunk)[RECORD_HEADER.size :] == content_of(chunk)


@given(st.lists(CHUNK_INDEXES | CHUNKS_OF_ONE, max_size=4), st.binary(max_size=120))
def test_rows_of_chunk_indexes_are_parsed_like_each_one(
    chunks: list[ChunkIndex], after: bytes
) -> None:
    records = list(map(chunk_index_record, chunks))
    alike = list(
        itertools.takewhile(
            lambda chunk: chunk.compression == "zstd" and len(chunk.message_index_offsets) == 1,
            chunks,
        )
    )
    found = indexes_of_one(memoryview(b"".join(records) + b"\0" + after))
    assert found.nbytes == sum(map(len, records[: len(alike)]))
    alike.sort(key=lambda chunk: chunk.chunk_start_offset)
    assert list(ChunkIndexes(found)) == alike


@given(st.lists(CHUNK_INDEXES | CHUNKS_OF_ONE, max_size=9))
def test_values_of_chunk_indexes_are_those_of_the_objects(every: list[ChunkIndex]) -> None:
    """Indexes can be parsed together or one by one, in any order."""
    rows = indexes_of_one(memoryview(b"".join(map(chunk_index_record, every))))
    chunks = ChunkIndexes(rows, every[len(rows) :])
    expected = sorted(every, key=lambda chunk: chunk.chunk_start_offset)
    assert len(chunks) == len(expected)
    assert list(chunks) == [chunks[k] for k in range(len(chunks))] == expected
    for k, chunk in enumerate(expected):
        ids = list(chunk.message_index_offsets)
        assert chunks.channels[k] == (ids[0] if len(ids) == 1 else -1)
        start, length, indexes = (
            min(number, 2**60)
            for number in (
                chunk.chunk_start_offset,
                chunk.chunk_length,
                chunk.message_index_length,
            )
        )
        assert (chunks.starts[k], chunks.ends[k]) == (start, start + length + indexes)
        assert chunks.counts[k] == max(indexes - 15, 0) // 16
    follow_in_time = all(
        before.message_end_time <= after.message_start_time
        for before, after in itertools.pairwise(expected)
    )
    assert chunks.follow_in_time(np.arange(len(chunks))) == follow_in_time
    with pytest.raises(IndexError):
        chunks[len(expected)]


@pytest.mark.parametrize("every", [1, 2])
def test_indexes_missing_from_the_summary_are_found(log_path: Path, every: int) -> None:
    record(log_path, MIXED_SPACE, spaces.Discrete(2), [5, 1, 30])
    reader = McapReader(log_path)
    reported = [mcaprl.open(log_path), mcaprl.open(log_path, episodes=1)]
    chunks = [
        replace(chunk, message_index_offsets={}, message_index_length=0)
        if number % every == 0
        else chunk
        for number, chunk in enumerate(reader.chunks)
    ]
    summary = Summary(dict(reader.schemas), dict(reader.channels), reader._counts, chunks)
    data = log_path.read_bytes()[: reader.summary_start]
    log_path.write_bytes(data + summary.to_bytes(len(data)))
    assert list(McapReader(log_path).chunks) != list(reader.chunks)
    found = [mcaprl.open(log_path), mcaprl.open(log_path, episodes=1)]
    assert [data.fingerprint for data in found] == [data.fingerprint for data in reported]


def test_chunk_indexes_are_sorted_by_offset(log_path: Path) -> None:
    record(log_path, MIXED_SPACE, spaces.Discrete(2), [5, 1, 30])
    reader = McapReader(log_path)
    data = log_path.read_bytes()[: reader.summary_start]
    before = list(reader.chunks)
    for chunks in (before[::-1], before[1:] + before[:1]):
        summary = Summary(dict(reader.schemas), dict(reader.channels), reader._counts, chunks)
        log_path.write_bytes(data + summary.to_bytes(len(data)))
        assert list(McapReader(log_path).chunks) == before


def test_a_channel_that_is_listed_twice_is_refused() -> None:
    content = bytearray(content_of(ChunkIndex(1, 2, "zstd", 3, 4, 5, {7: 8, 9: 10}, 6, 7)))
    content[36 + 10] = 7
    with pytest.raises(CorruptLogError, match="several indexes of one channel"):
        parse_chunk_index(memoryview(content))


@pytest.mark.parametrize("field", ["chunk_start_offset", "chunk_length", "message_index_length"])
def test_chunks_beyond_the_end_are_refused(log_path: Path, field: str) -> None:
    """Refuse huge offsets and lengths, even if their 64-bit sum would wrap to a valid offset."""
    record(log_path, MIXED_SPACE, spaces.Discrete(2), [5])
    reader = McapReader(log_path)
    data = log_path.read_bytes()[: reader.summary_start]
    for value in (2 * len(data), 2**63, 2**64 - 1):
        fields: dict[str, Any] = {field: value}
        chunks = [*list(reader.chunks)[:-1], replace(reader.chunks[-1], **fields)]
        summary = Summary(dict(reader.schemas), dict(reader.channels), reader._counts, chunks)
        log_path.write_bytes(data + summary.to_bytes(len(data)))
        with pytest.raises(CorruptLogError, match=r"end of the file|no valid record at byte"):
            McapReader(log_path)


@pytest.mark.parametrize("field", [32, 44])
def test_invalid_lengths_are_refused(field: int) -> None:
    """Refuse a wrong length of the empty map, at byte 32, or of the name `zstd`, at byte 44."""
    content = bytearray(content_of(ChunkIndex(1, 2, "zstd", 3, 4, 5, {}, 6, 7)))
    for wrong in (61, 2**31, 2**32 - 1):
        struct.pack_into("<I", content, field, wrong)
        with pytest.raises(CorruptLogError, match="chunk_index record"):
            parse_chunk_index(memoryview(content))


def test_message_indexes_that_are_wrong_are_refused() -> None:
    entries = struct.pack("<4Q", 1, 2, 3, 4)
    data = struct.pack("<BQHI", Opcode.MESSAGE_INDEX, 6 + len(entries), 7, len(entries)) + entries
    assert message_index(memoryview(data), 0, 7).tobytes() == entries
    for offset, value in ((0, 9), (9, 8), (11, 31), (11, 255)):
        spoilt = bytearray(data)
        spoilt[offset] = value
        with pytest.raises(CorruptLogError, match="no message index of channel 7 at byte 0"):
            message_index(memoryview(spoilt), 0, 7)
    for beyond in (5000, 2**63, 2**64 - 1):
        with pytest.raises(CorruptLogError, match=f"at byte {beyond}"):
            message_index(memoryview(data), beyond, 7)
