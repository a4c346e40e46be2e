"""Indexes of chunks and of their messages, read many at a time, as mcap's library reads each."""

from __future__ import annotations

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
from numpy.typing import NDArray

import mcaprl
from mcaprl.errors import CorruptLogError
from mcaprl.recorder.columns.chunk_table import ChunkTable
from mcaprl.recorder.columns.message_rows import index_bounds, message_index, parts_of
from mcaprl.recorder.columns.reader import McapReader
from mcaprl.recorder.columns.records import RECORD_HEADER, records_of, runs_of
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


def contents(chunks: list[ChunkIndex], behind: bytes = b"") -> tuple[memoryview, NDArray[Any]]:
    """Records one behind the other, each with more at its end, and the runs of them."""
    data = bytearray()
    for chunk in chunks:
        builder = RecordBuilder()
        chunk.write(builder)
        content = builder.end()[RECORD_HEADER.size :] + behind
        data += RECORD_HEADER.pack(Opcode.CHUNK_INDEX, len(content)) + content
    view = memoryview(bytes(data))
    runs = [(offset + RECORD_HEADER.size, *run) for offset, _, *run in runs_of(view, 0)]
    return view, np.array(runs, np.int64).reshape(-1, 3)


@given(
    st.lists(CHUNK_INDEXES, min_size=1, max_size=40), st.sampled_from([b"", b"of later versions"])
)
def test_they_are_what_the_library_wrote(chunks: list[ChunkIndex], behind: bytes) -> None:
    chunks.sort(key=lambda chunk: chunk.chunk_start_offset)
    for table in (ChunkTable.read(*contents(chunks, behind)), ChunkTable.of(chunks)):
        assert table.chunks == chunks
        numbers = np.arange(len(chunks))[1::2]
        assert list(table.some(numbers)) == chunks[1::2]
        assert table.channel_ids == {id_ for chunk in chunks for id_ in chunk.message_index_offsets}
        for channel_id in [*table.channel_ids, 7]:
            numbers, offsets = table.indexes_of(channel_id)
            found = dict(zip(numbers.tolist(), offsets.tolist(), strict=True))
            maps = enumerate(chunk.message_index_offsets for chunk in chunks)
            assert found == {k: map_[channel_id] for k, map_ in maps if channel_id in map_}


@pytest.mark.parametrize("every", [1, 2])
def test_indexes_that_the_summary_does_not_tell_of_are_found(log_path: Path, every: int) -> None:
    record(log_path, MIXED_SPACE, spaces.Discrete(2), [5, 1, 30])
    reader = McapReader(log_path)
    told = [mcaprl.open(log_path), mcaprl.open(log_path, episodes=1)]
    chunks = [
        replace(chunk, message_index_offsets={}, message_index_length=0)
        if number % every == 0
        else chunk
        for number, chunk in enumerate(reader.chunks)
    ]
    summary = Summary(dict(reader.schemas), dict(reader.channels), reader._counts, chunks)
    data = log_path.read_bytes()[: reader.summary_start]
    log_path.write_bytes(data + summary.to_bytes(len(data)))
    assert McapReader(log_path).chunks != reader.chunks
    found = [mcaprl.open(log_path), mcaprl.open(log_path, episodes=1)]
    assert [data.fingerprint for data in found] == [data.fingerprint for data in told]


@given(st.lists(CHUNK_INDEXES, min_size=2, max_size=12))
def test_they_come_in_the_order_of_the_file(chunks: list[ChunkIndex]) -> None:
    found = ChunkTable.read(*contents(chunks)).chunks
    assert sorted(map(repr, found)) == sorted(map(repr, chunks))
    offsets = [chunk.chunk_start_offset for chunk in found]
    assert offsets == sorted(offsets)


def test_a_channel_that_is_told_of_twice_is_refused() -> None:
    chunk = ChunkIndex(1, 2, "zstd", 3, 4, 5, {7: 8, 9: 10}, 6, 7)
    view, runs = contents([chunk])
    spoilt = bytearray(view)
    spoilt[RECORD_HEADER.size + 36 + 10] = 7
    with pytest.raises(CorruptLogError, match="channel 7 twice"):
        ChunkTable.read(memoryview(spoilt), runs).indexes_of(7)


@pytest.mark.parametrize("field", ["chunk_start_offset", "chunk_length", "message_index_length"])
def test_chunks_beyond_the_end_are_refused(field: str) -> None:
    """Also where the sum of lengths would wrap around to a byte of the file."""
    chunk = ChunkIndex(100, 8, "zstd", 3, 4, 50, {}, 6, 7)
    assert ChunkTable.of([chunk]).stops(200).tolist() == [158]
    for value in (201, 2**63, 2**64 - 1):
        setattr(chunk, field, value)
        with pytest.raises(CorruptLogError, match="end beyond the file"):
            ChunkTable.of([chunk]).stops(200)


RUN = st.tuples(st.sampled_from([1, 2, 255]), st.integers(0, 2), st.integers(1, 99))


@given(st.lists(RUN, max_size=9))
def test_runs_of_records_are_the_records(runs: list[tuple[int, int, int]]) -> None:
    """Whatever follows what, and with half a record at the end."""
    records = [RECORD_HEADER.pack(code, size) + b"\1" * size for code, size, _ in runs]
    data = b"".join(record * run[2] for record, run in zip(records, runs, strict=True))
    view = memoryview(data + b"\1\xff")
    found = [
        (offset + number * (RECORD_HEADER.size + length), opcode, length)
        for offset, opcode, length, count in runs_of(view, 0)
        for number in range(count)
    ]
    assert found == [
        (offset, opcode, len(content)) for offset, opcode, content in records_of(view, 0)
    ]


@pytest.mark.parametrize("field", [32, 44])
def test_lengths_that_do_not_fit_are_refused(field: int) -> None:
    """Bytes 32 and 44 begin the lengths of an empty map and of the name."""
    chunk = ChunkIndex(1, 2, "zstd", 3, 4, 5, {}, 6, 7)
    view, runs = contents([chunk, chunk])
    for told in (61, 2**31, 2**32 - 1):
        spoilt = bytearray(view)
        struct.pack_into("<I", spoilt, RECORD_HEADER.size + field, told)
        with pytest.raises(CorruptLogError, match="chunk_index record"):
            ChunkTable.read(memoryview(spoilt), runs)


def test_of_many_message_indexes_the_wrong_one_is_named() -> None:
    entries = struct.pack("<4Q", 1, 2, 3, 4)
    record = struct.pack("<BQHI", Opcode.MESSAGE_INDEX, 6 + len(entries), 7, len(entries)) + entries
    data = bytearray(record * 20)
    places = [number * len(record) for number in range(20)]
    view = memoryview(bytes(data))
    for count in (3, 20):
        bounds = index_bounds(view, places[:count], [7] * count)
        assert [bytes(found) for found in parts_of(view, bounds)] == [entries] * count
    for offset, value in ((0, 9), (9, 8), (11, 31), (11, 255)):
        spoilt = bytearray(data)
        spoilt[places[13] + offset] = value
        view = memoryview(bytes(spoilt[: places[14]]))
        # As if asked for that one alone.
        with pytest.raises(CorruptLogError) as alone:
            message_index(view, places[13], 7)
        with pytest.raises(CorruptLogError) as together:
            index_bounds(view, places[:14], [7] * 14)
        assert str(together.value) == str(alone.value)
    for beyond in (5000, 2**63, 2**64 - 1):
        with pytest.raises(CorruptLogError, match=f"at byte {beyond}"):
            index_bounds(memoryview(data), [*places, beyond], [7] * 21)
