"""Logs of many short episodes: their small chunks are visited together, with the same result."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from gymnasium import spaces

import mcaprl
from mcaprl.errors import CorruptLogError
from mcaprl.recorder.columns import joined
from mcaprl.recorder.columns.decoder import Decoder
from mcaprl.recorder.columns.message_rows import INDEX_ENTRY
from mcaprl.recorder.columns.reader import McapReader
from tests.support.recordings import MIXED_SPACE, ScriptedEnv, record

LENGTHS = [1, 5, 2, 40, 3] * 12


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
@pytest.mark.parametrize("threads", [1, 3])
def test_joined_or_one_by_one(
    log_path: Path, monkeypatch: pytest.MonkeyPatch, compression: str, threads: int
) -> None:
    record(log_path, MIXED_SPACE, spaces.Discrete(2), LENGTHS, compression=compression)
    together = mcaprl.open(log_path, threads=threads, images="memory")
    assert [episode.length for episode in together.episodes] == LENGTHS
    monkeypatch.setattr(joined, "_MOST_BYTES", 0)
    apart = mcaprl.open(log_path, images="memory")
    assert together.fingerprint == apart.fingerprint
    # As text, where NaN equals NaN.
    assert [str(e.summary) for e in together.episodes] == [str(e.summary) for e in apart.episodes]
    for name in ("rewards", "behavior_probs"):
        assert getattr(together, name).tobytes() == getattr(apart, name).tobytes()


def test_visits_do_not_grow_with_the_episodes(
    log_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    record(log_path, spaces.Box(-1, 1, (2,), np.float32), spaces.Discrete(2), LENGTHS)
    visits, fill = [], Decoder.fill

    def count(decoder: Decoder, *arguments: object) -> None:
        visits.append(decoder)
        fill(decoder, *arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(Decoder, "fill", count)
    data = mcaprl.open(log_path)
    assert len(data.episodes) == len(LENGTHS)
    assert len(McapReader(log_path).chunks) == 2 * len(LENGTHS)
    assert len(visits) == 2, "one for /rl/step, one for /rl/episode"


def test_an_index_may_not_lead_into_the_next_chunk(log_path: Path) -> None:
    """Side by side in memory, a message of the next chunk lies behind the last one of this."""
    record(log_path, spaces.Box(-1, 1, (2,), np.float32), spaces.Discrete(2), [2, 2, 2])
    reader = McapReader(log_path)
    channel = reader.channel_of("/rl/step")
    assert channel is not None
    first, second, *_ = reader.spans(channel)
    assert first.chunk is not None
    spoilt = bytearray(log_path.read_bytes())
    entries = first.chunk.message_index_offsets[channel.id] + 15
    last = entries + INDEX_ENTRY.itemsize * (len(first.index) - 1)
    time_ns, offset = second.index[0].tolist()
    struct.pack_into("<QQ", spoilt, last, time_ns, offset + first.chunk.uncompressed_size)
    log_path.write_bytes(spoilt)
    with pytest.raises(CorruptLogError, match="not what the index says"):
        mcaprl.open(log_path)


def test_texts_of_one_length_and_another_form(log_path: Path) -> None:
    """Messages as long as each other, whose texts are not: to text, as all others."""
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
