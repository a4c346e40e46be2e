"""Indexes of chunks and of their messages, read many at a time, as mcap's library reads each."""

from __future__ import annotations

import struct
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import ChunkIndex

from mcaprl.errors import CorruptLogError
from mcaprl.recorder.mcap_records import RECORD_HEADER, chunk_indexes
from mcaprl.recorder.message_records import message_index, message_indexes

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


def contents(chunks: list[ChunkIndex], behind: bytes = b"") -> tuple[memoryview, Any]:
    """Records' contents one behind the other, each with more behind it, and where they are."""
    data, places = bytearray(), []
    for chunk in chunks:
        builder = RecordBuilder()
        chunk.write(builder)
        content = builder.end()[RECORD_HEADER.size :] + behind
        places.append((len(data), len(content)))
        data += content
    return memoryview(bytes(data)), places


@given(st.lists(CHUNK_INDEXES, max_size=12), st.sampled_from([b"", b"of a later version"]))
def test_they_are_what_the_library_wrote(chunks: list[ChunkIndex], behind: bytes) -> None:
    found = chunk_indexes(*contents(chunks, behind))

    def key(chunk: ChunkIndex) -> Any:
        return repr(chunk)

    assert sorted(found, key=key) == sorted(chunks, key=key)


@pytest.mark.parametrize("field", [32, 44])
def test_lengths_that_do_not_fit_are_refused(field: int) -> None:
    """Bytes 32 and 44 begin the lengths of an empty map and of the name."""
    chunk = ChunkIndex(1, 2, "zstd", 3, 4, 5, {}, 6, 7)
    view, places = contents([chunk, chunk])
    for told in (61, 2**31, 2**32 - 1):
        spoilt = bytearray(view)
        struct.pack_into("<I", spoilt, field, told)
        with pytest.raises(CorruptLogError, match="chunk_index record"):
            chunk_indexes(memoryview(spoilt), places)


def test_of_many_message_indexes_the_wrong_one_is_named() -> None:
    entries = struct.pack("<4Q", 1, 2, 3, 4)
    record = struct.pack("<BQHI", Opcode.MESSAGE_INDEX, 6 + len(entries), 7, len(entries)) + entries
    data = bytearray(record * 20)
    places = [number * len(record) for number in range(20)]
    assert [bytes(e) for e in message_indexes(memoryview(data), places, 7)] == [entries] * 20
    for offset, value in ((0, 9), (9, 8), (11, 31), (11, 255)):
        spoilt = bytearray(data)
        spoilt[places[13] + offset] = value
        view = memoryview(bytes(spoilt[: places[14]]))
        # As if asked for that one alone.
        with pytest.raises(CorruptLogError) as alone:
            message_index(view, places[13], 7)
        with pytest.raises(CorruptLogError) as together:
            message_indexes(view, places[:14], 7)
        assert str(together.value) == str(alone.value)
    with pytest.raises(CorruptLogError, match="at byte 5000"):
        message_indexes(memoryview(data), [*places, 5000], 7)
