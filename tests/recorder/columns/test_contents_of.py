"""Tests of scanning the records of a chunk."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.data_stream import RecordBuilder
from mcap.records import Channel

from mcaprl.errors import CorruptLogError
from mcaprl.recorder.columns.records import contents_of, message_record

Messages = list[tuple[int, int, bytes]]
MESSAGES = st.lists(
    st.tuples(st.integers(0, 3), st.integers(0, 2**64 - 1), st.binary(max_size=40)), min_size=1
)


def chunk_of(messages: Messages, between: bytes = b"") -> tuple[bytes, dict[int, list[list[int]]]]:
    """Return a chunk of these messages, with other records before each; and the expected index."""
    records, expected = bytearray(), dict[int, list[list[int]]]()
    for channel_id, time_ns, data in messages:
        records += between
        expected.setdefault(channel_id, []).append([time_ns, len(records)])
        records += message_record(channel_id, 0, time_ns, data)
    return bytes(records), expected


def indexes_of(chunk: bytes) -> dict[int, list[list[int]]]:
    found = contents_of(memoryview(chunk)).indexes
    return {
        channel_id: [list(entry) for entry in index.tolist()] for channel_id, index in found.items()
    }


def channel_record() -> bytes:
    builder = RecordBuilder()
    Channel(7, "/topic", "cdr", {}, 0).write(builder)
    return bytes(builder.end())


@given(MESSAGES)
def test_indexes_have_the_time_and_the_offset_of_every_message(messages: Messages) -> None:
    chunk, expected = chunk_of(messages)
    assert indexes_of(chunk) == expected


@given(MESSAGES)
def test_other_records_between_messages_do_not_change_the_indexes(messages: Messages) -> None:
    chunk, expected = chunk_of(messages, between=channel_record())
    assert indexes_of(chunk) == expected
    assert [topic.id for topic in contents_of(memoryview(chunk)).topics] == [7] * len(messages)


@given(MESSAGES, st.data())
def test_a_chunk_that_is_cut_within_a_message_is_damaged(
    messages: Messages, data: st.DataObject
) -> None:
    chunk, expected = chunk_of(messages)
    last = max(offset for index in expected.values() for _, offset in index)
    cut = data.draw(st.integers(last + 1, len(chunk) - 1))
    with pytest.raises(CorruptLogError):
        contents_of(memoryview(chunk[:cut]))


@pytest.mark.parametrize("length", [21, 2**63])
def test_a_message_with_an_impossible_length_is_damaged(length: int) -> None:
    chunk, _ = chunk_of([(1, 5, b"abc"), (2, 6, b"defg")])
    damaged = chunk[:1] + struct.pack("<Q", length) + chunk[9:]
    with pytest.raises(CorruptLogError):
        contents_of(memoryview(damaged))
