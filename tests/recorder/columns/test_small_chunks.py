"""Logs of many short episodes: small chunks and merged chunks contain the same data."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from gymnasium import spaces

import mcaprl
from mcaprl.errors import CorruptLogError
from mcaprl.recorder.columns import output
from mcaprl.recorder.columns.reader import McapReader
from mcaprl.recorder.columns.records import INDEX_ENTRY
from tests.support.recordings import MIXED_SPACE, ScriptedEnv, record

LENGTHS = [1, 5, 2, 40, 3] * 12


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
@pytest.mark.parametrize("threads", [1, 3])
def test_merged_or_not(
    log_path: Path, monkeypatch: pytest.MonkeyPatch, compression: str, threads: int
) -> None:
    record(log_path, MIXED_SPACE, spaces.Discrete(2), LENGTHS, compression=compression)
    merged, chunks = mcaprl.open(log_path, threads=threads, images="memory"), _chunks(log_path)
    assert [episode.length for episode in merged.episodes] == LENGTHS
    monkeypatch.setattr(output, "_MIN_CHUNKS_SAVED", 10**9)
    record(
        log_path,
        MIXED_SPACE,
        spaces.Discrete(2),
        LENGTHS,
        compression=compression,
        overwrite=True,
    )
    apart = mcaprl.open(log_path, threads=threads, images="memory")
    assert chunks * 5 < _chunks(log_path)
    assert merged.fingerprint == apart.fingerprint
    # The summaries are compared as text, because NaN equals NaN in text.
    assert [str(e.summary) for e in merged.episodes] == [str(e.summary) for e in apart.episodes]
    for name in ("rewards", "behavior"):
        assert getattr(merged, name).tobytes() == getattr(apart, name).tobytes()


def _chunks(path: Path) -> int:
    return len(McapReader(path).chunks)


@pytest.mark.usefixtures("small_chunks")
def test_an_index_that_points_outside_its_chunk_is_refused(log_path: Path) -> None:
    record(log_path, spaces.Box(-1, 1, (2,), np.float32), spaces.Discrete(2), [2, 2, 2])
    reader = McapReader(log_path)
    channel = reader.channel_of("/rl/step")
    assert channel is not None
    first, second, *_ = reader.message_ranges(channel)
    assert first.chunk is not None
    spoilt = bytearray(log_path.read_bytes())
    entries = first.chunk.message_index_offsets[channel.id] + 15
    last = entries + INDEX_ENTRY.itemsize * (len(first.index) - 1)
    time_ns, offset = second.index[0].tolist()
    struct.pack_into("<QQ", spoilt, last, time_ns, offset + first.chunk.uncompressed_size)
    log_path.write_bytes(spoilt)
    with pytest.raises(CorruptLogError, match="does not match its index entry"):
        mcaprl.open(log_path)


def test_strings_of_equal_length_and_different_layout(log_path: Path) -> None:
    """Decode messages one by one if they have equal lengths but strings of different lengths."""
    reasons, policies = ["bbbb", "bb", "bbbb"], ["aa", "aaaa", "aa"]
    infos = {"reason": ""}
    rows = [
        (np.zeros(2, np.float32), 0.0, False, False),
        (np.zeros(2, np.float32), 1.0, True, False),
    ]
    space = spaces.Box(-1, 1, (2,), np.float32)
    env = mcaprl.RecordMcap(ScriptedEnv(space, spaces.Discrete(2), [rows] * 3, infos), log_path)
    for reason, policy in zip(reasons, policies, strict=True):
        infos["reason"], env.policy = reason, policy
        env.reset()
        env.step(0)
    env.close()
    lengths = {len(data) for _, data in _episodes_of(McapReader(log_path))}
    assert len(lengths) == 1
    data = mcaprl.open(log_path)
    assert [(type(e.reason), e.reason, e.policy) for e in data.episodes] == [
        (str, reason, policy) for reason, policy in zip(reasons, policies, strict=True)
    ]


def _episodes_of(reader: McapReader) -> list[tuple[int, bytes]]:
    channel = reader.channel_of("/rl/episode")
    assert channel is not None
    return list(reader.messages(channel))
