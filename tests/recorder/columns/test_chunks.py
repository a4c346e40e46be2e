"""Decompression of chunks, and the decompressors that are kept for the next chunks."""

from __future__ import annotations

import pytest
import zstandard

from mcaprl.errors import CorruptLogError
from mcaprl.recorder.columns import chunks
from mcaprl.recorder.columns.chunks import ChunkHeader, Scratch, chunk_records
from mcaprl.recorder.columns.records import crc32

RECORDS = bytes(range(256)) * 40_000
"""10 MB, more than the window of a frame without a size."""


def chunk_of(data: bytes, size: int = len(RECORDS)) -> memoryview:
    """Return a Chunk record with compressed data."""
    header = ChunkHeader(0, 0, size, crc32(RECORDS), "zstd", slice(0, len(data)))
    return memoryview(header.to_record() + data)


def streamed() -> bytes:
    """Return a frame that does not state its size, so that its window takes memory."""
    compressor = zstandard.ZstdCompressor(write_content_size=False).compressobj()
    return compressor.compress(RECORDS) + compressor.flush()


@pytest.fixture(autouse=True)
def idle(monkeypatch: pytest.MonkeyPatch) -> list[zstandard.ZstdDecompressor]:
    kept: list[zstandard.ZstdDecompressor] = []
    monkeypatch.setattr(chunks, "_IDLE", kept)
    return kept


def test_a_decompressor_is_used_again(idle: list[zstandard.ZstdDecompressor]) -> None:
    for _ in range(3):
        found = chunk_records(chunk_of(zstandard.compress(RECORDS)), 0)
        assert bytes(found) == RECORDS
        assert len(idle) == 1


def test_a_decompressor_with_a_large_window_is_not_kept(
    idle: list[zstandard.ZstdDecompressor],
) -> None:
    assert bytes(chunk_records(chunk_of(streamed()), 0)) == RECORDS
    assert not idle


def test_records_after_damaged_data_are_read(idle: list[zstandard.ZstdDecompressor]) -> None:
    data, scratch = zstandard.compress(RECORDS), Scratch()
    for damaged in (data[: len(data) // 2], data[:-1], b"\0" * 50, data + b"\0", data + data):
        with pytest.raises(CorruptLogError):
            chunk_records(chunk_of(damaged), 0, scratch)
        assert bytes(chunk_records(chunk_of(data), 0, scratch)) == RECORDS
    # Several frames are read as one.
    halves = zstandard.compress(RECORDS[:1000]) + zstandard.compress(RECORDS[1000:])
    assert bytes(chunk_records(chunk_of(halves), 0, scratch)) == RECORDS
    with pytest.raises(CorruptLogError, match="declares 99"):
        chunk_records(chunk_of(data, 99), 0, scratch)
