"""Tests that `check` reports each contradiction in a log, its position and what to do next."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

import mcaprl
from mcaprl.errors import LISTED, LogError, Problem, Shortlist
from mcaprl.recorder.columns import chunks, summary
from mcaprl.recorder.columns import reader as mcap_reader
from mcaprl.recorder.columns.reader import McapReader
from mcaprl.recorder.columns.records import INDEX_ENTRY, MESSAGE_HEADER, contents_of
from mcaprl.recorder.columns.summary import Summary
from mcaprl.recorder.columns.writer import McapWriter
from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.format.schema import message_dtype
from mcaprl.recorder.repair.check import check_log
from mcaprl.recorder.repair.recover import recover_log
from tests.support.damage.faults import write_log
from tests.support.damage.fuzz_target import without_crcs
from tests.support.recordings import record

SPACE = spaces.Dict(
    {"x": spaces.Box(-1, 1, (2,), np.float32), "eye": spaces.Box(0, 255, (8, 8), np.uint8)}
)
Change = Callable[[np.ndarray[Any, Any]], None]


def unchanged(message: np.ndarray[Any, Any]) -> None:
    """Return a record unchanged."""


def rewritten(
    path: Path,
    change: Change = unchanged,
    *,
    strings: dict[str, str] | None = None,
    leave_out: str = "",
) -> Path:
    """Write a copy of a log with the given faults and with valid CRCs.

    Args:
        path: Path of a valid log.
        change: Function that changes each record of `/rl/step`.
        strings: Metadata that replaces the original metadata.
        leave_out: Topic whose second chunk is left out.
    """
    reader, other = McapReader(path), path.with_name("other.mcap")
    writer = McapWriter(other, overwrite=True)
    for name, own in reader.metadata.items():
        writer.add_metadata(name, strings or own)
    for schema in reader.schemas.values():
        writer.announce(schema)
    for channel in reader.channels.values():
        metadata = strings if strings and channel.metadata else channel.metadata
        writer.announce(replace(channel, metadata=metadata))
    left_out = iter(range(100))
    for chunk in reader.chunks:
        records = bytearray(reader.chunk_records(chunk))
        indexes = contents_of(memoryview(bytes(records))).indexes
        topics = {reader.channels[channel_id].topic for channel_id in indexes}
        if leave_out in topics and next(left_out) == 1:
            continue
        if topics == {"/rl/step"}:
            (index,) = indexes.values()
            _change_all(reader, records, index, change)
        writer.write_records(memoryview(bytes(records)), indexes)
    writer.close()
    return other


def _change_all(
    reader: McapReader, records: bytearray, index: np.ndarray[Any, Any], change: Change
) -> None:
    (channel,) = reader.channels_of("/rl/step")
    dtype = message_dtype(reader.schema_of(channel).data.decode())
    assert dtype is not None
    for offset in index["offset"].tolist():
        change(np.frombuffer(records, dtype, 1, offset + MESSAGE_HEADER.itemsize))


@pytest.fixture
def good(log_path: Path) -> Path:
    record(log_path, SPACE, spaces.Discrete(2), [4, 3, 5])
    assert check_log(log_path) == []
    return log_path


def at(number: int, row: int, **values: Any) -> Change:
    """Return a function that sets fields of one record of `/rl/step`."""

    def change(message: np.ndarray[Any, Any]) -> None:
        if (message["episode"][0], message["step"][0]) == (number, row):
            for name, value in values.items():
                message[name] = value

    return change


@pytest.mark.parametrize(
    ("change", "reported"),
    [
        (at(1, 1, step=2), "out of order"),
        (at(1, 1, episode=7), "out of order"),
        (at(1, 3, final=False), "out of order"),
        (at(1, 1, terminated=True), "continues after its end"),
        (at(2, 5, final=False), "6 records of an unfinished episode"),
        (at(0, 3, terminated=False), "has terminated True, but the records have False"),
        (at(1, 2, truncated=False), "has truncated True, but the records have False"),
    ],
)
def test_inconsistent_episodes_are_reported(good: Path, change: Change, reported: str) -> None:
    problems = check_log(rewritten(good, change))
    assert any(reported in problem.what for problem in problems), problems
    assert all("mcaprl recover" in problem.next for problem in problems)


def test_rewriting_changes_no_value(good: Path) -> None:
    assert check_log(rewritten(good)) == []


def test_a_wrong_return_is_reported(log_path: Path) -> None:
    write_log(log_path, 2)
    problems = check_log(rewritten(log_path, at(1, 1, reward=1e6)))
    assert ["has return" in problem.what for problem in problems] == [True]
    assert problems[0].where == "episode 1"


def resealed(data: bytearray) -> bytes:
    """Update the CRCs of data and summary of a changed file; the change is then the only fault."""
    footer = len(data) - 8 - 29
    summary_start, _ = struct.unpack_from("<QQ", data, footer + 9)
    struct.pack_into("<I", data, summary_start - 4, zlib.crc32(data[: summary_start - 13]))
    struct.pack_into("<I", data, len(data) - 12, zlib.crc32(data[summary_start : len(data) - 12]))
    return bytes(data)


def test_a_wrong_message_index_is_reported(good: Path) -> None:
    reader = McapReader(good)
    channel = reader.channel_of("/rl/step")
    assert channel is not None
    data = bytearray(good.read_bytes())
    chunk = next(c for c in reader.chunks if channel.id in c.message_index_offsets)
    entry = chunk.message_index_offsets[channel.id] + 9 + 6 + INDEX_ENTRY.itemsize
    (time_ns,) = struct.unpack_from("<Q", data, entry)
    struct.pack_into("<Q", data, entry, time_ns + 1)
    good.write_bytes(resealed(data))
    (problem,) = check_log(good)
    assert problem.what == "the message index of /rl/step is wrong"
    assert f"chunk at byte {chunk.chunk_start_offset}, /rl/step, log_time" in problem.where


def test_a_wrong_message_count_is_reported(log_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    counted = Summary.to_bytes

    def miscount(summary: Summary, start: int) -> bytes:
        # Change the count of /rl/episode, because the reader itself reports a wrong count of
        # /rl/step.
        summary.counts[2] += 1
        return counted(summary, start)

    with monkeypatch.context() as patch:
        patch.setattr(Summary, "to_bytes", miscount)
        record(log_path, SPACE, spaces.Discrete(2), [4])
    assert any("the summary counts" in problem.what for problem in check_log(log_path))


def test_metadata_with_other_spaces_is_reported(good: Path) -> None:
    other = spaces.Dict({**SPACE.spaces, "x": spaces.Box(-1, 1, (3,), np.float32)})
    strings = LogMetadata(other, spaces.Discrete(2)).to_strings()
    (problem,) = check_log(rewritten(good, strings=strings))
    assert "does not match the metadata's spaces" in problem.what


def test_missing_images_are_reported(good: Path) -> None:
    """Report missing images, and images whose size differs from the metadata."""
    (problem,) = check_log(rewritten(good, leave_out="/rl/observation/eye"))
    assert problem.what == "11 images for 15 records; 4 records have no image"
    other = spaces.Dict({**SPACE.spaces, "eye": spaces.Box(0, 255, (16, 4 + 4), np.uint8)})
    strings = LogMetadata(other, spaces.Discrete(2)).to_strings()
    (problem,) = check_log(rewritten(good, strings=strings))
    assert problem.what == "images on /rl/observation/eye do not match the metadata's space"


def test_an_image_type_without_a_field_is_reported(log_path: Path, tmp_path: Path) -> None:
    """Report a damaged schema that no CRC covers; recovery does not read images with it."""
    write_log(log_path, 2)
    data = without_crcs(log_path.read_bytes())
    assert data.count(b"string encoding") >= 2
    log_path.write_bytes(data.replace(b"string encoding", b"string encodinx"))
    (problem,) = check_log(log_path)
    assert problem.what.startswith("images on /rl/observation/")
    assert problem.what.endswith("do not match the metadata's space")
    with pytest.raises(LogError, match="cannot be recovered: images on"):
        recover_log(log_path, tmp_path / "out.mcap")


@pytest.mark.parametrize("threads", [2, 5])
def test_several_threads_find_the_same_problems(good: Path, threads: int) -> None:
    assert check_log(good, threads=threads) == []
    spoilt = bytearray(good.read_bytes())
    for chunk in list(McapReader(good).chunks)[1:3]:
        spoilt[chunk.chunk_start_offset + chunk.chunk_length - 1] ^= 1
    good.write_bytes(spoilt)
    problems = check_log(good)
    assert len(problems) >= 3
    assert check_log(good, threads=threads) == problems


def test_a_damaged_attachment_is_reported(good: Path) -> None:
    data = bytearray(good.read_bytes())
    data[data.index(b"foxglove-layout.json") + 60] ^= 1
    good.write_bytes(resealed(data))
    assert check_log(good)[0].what == "an attachment does not match its CRC"


def test_each_chunk_is_read_once(good: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Read each chunk once, except the chunks of `/rl/episode`, which are read again at the end."""
    read: list[int] = []
    once = chunks.chunk_records

    def count(file: memoryview, offset: int, scratch: Any = None) -> memoryview:
        read.append(offset)
        return once(file, offset, scratch)

    for module in (chunks, mcap_reader):
        monkeypatch.setattr(module, "chunk_records", count)
    assert check_log(good) == []
    reader = McapReader(good)
    episodes = reader.channel_of("/rl/episode")
    assert episodes is not None
    others = [c for c in reader.chunks if episodes.id not in c.message_index_offsets]
    assert {read.count(chunk.chunk_start_offset) for chunk in others} == {1}
    assert len(read) <= 2 * len(reader.chunks)


@pytest.mark.parametrize("compression", ["none", "zstd"])
def test_array_checks_find_the_same_problems_as_a_scan(
    log_path: Path, monkeypatch: pytest.MonkeyPatch, compression: str
) -> None:
    """Find the same problems as a scan of single records, for any wrong byte that no CRC covers."""
    record(
        log_path, SPACE, spaces.Discrete(2), [1 + k % 3 for k in range(12)], compression=compression
    )
    sound = without_crcs(log_path.read_bytes())
    numbers = np.random.default_rng(5)
    start, found = McapReader(log_path).chunks[0].chunk_start_offset, set()
    for _ in range(200):
        spoilt = bytearray(sound)
        spoilt[int(numbers.integers(start, len(sound)))] ^= 1 << int(numbers.integers(8))
        log_path.write_bytes(spoilt)
        together = check_log(log_path)
        with monkeypatch.context() as patch:
            patch.setattr(summary, "_has_only", lambda *_: False)
            assert check_log(log_path) == together
        found |= {problem.what for problem in together}
    assert len(found) > 10, found


def test_many_problems_of_one_kind_are_counted() -> None:
    found = Shortlist(Problem(f"chunk {number} is damaged", "") for number in range(1000))
    assert (len(found), found.total) == (LISTED, 1000)
    assert [str(problem) for problem in found.rest()] == [
        "990 more findings of the kind: chunk # is damaged (not listed)"
    ]
    many = Shortlist(Problem(f"kind {chr(k) * 3}", "") for k in range(1000, 3000))
    assert many.total == 2000
    assert len(many) < 200
    assert len(many.rest()) == 1


def test_a_valid_file_of_another_kind_is_not_to_be_recovered(tmp_path: Path) -> None:
    other = tmp_path / "other.mcap"
    writer = McapWriter(other)
    channel = writer.add_channel("/chatter", "std_msgs/msg/String", "string data")
    writer.write_messages([(channel, 5, b"\0\1\0\0" + b"\1\0\0\0\0")])
    writer.close()
    (note,) = check_log(other)
    assert (note.severity, note.where) == ("note", "no topic /rl/step")
    assert "another robot's bag" in note.what
    with pytest.raises(LogError, match="there is nothing to recover"):
        recover_log(other, tmp_path / "out.mcap")
    assert not (tmp_path / "out.mcap").exists()
    # A damaged chunk is found, and the file can be recovered.
    content = bytearray(other.read_bytes())
    content[McapReader(other).chunks[0].chunk_start_offset + 60] ^= 1
    other.write_bytes(content)
    assert "recover" in check_log(other)[-1].next


def test_actions_outside_their_space_are_found(log_path: Path) -> None:
    class Careless(gym.Env[Any, Any]):
        observation_space = spaces.Box(-1, 1, (1,))
        action_space = spaces.Discrete(3)

        def reset(self, **_: Any) -> Any:
            return np.zeros(1, np.float32), {}

        def step(self, action: Any) -> Any:
            return np.zeros(1, np.float32), 1.0, bool(action == 0), False, {}

    with closing(mcaprl.RecordMcap(Careless(), log_path)) as env:
        env.reset()
        for action in (1, 7, 2, 0):
            env.step(action)
    (problem,) = check_log(log_path)
    assert str(problem.what) == "action 7 is outside of Discrete(3)"
    assert problem.where == "episode 0 step 1"
    found = [one for one in mcaprl.info(log_path).findings if one.severity == "problem"]
    assert [one.what for one in found] == ["1 action outside of Discrete(3)"]
    assert found[0].where == "episode 0 step 1"


def test_a_cut_log_says_that_viewers_need_a_recovered_copy(good: Path, tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap"
    reader = McapReader(good)
    # The writer was killed after the chunks of all episodes.
    cut.write_bytes(good.read_bytes()[: reader.data_end])
    problem = check_log(cut)[0]
    assert "viewers cannot open it" in problem.what
    assert problem.next == f"run `mcaprl recover {cut} OUT`"
    with pytest.warns(UserWarning, match=f"to open it in a viewer, run `mcaprl recover {cut} OUT`"):
        assert len(mcaprl.open(cut).episodes) == 3
