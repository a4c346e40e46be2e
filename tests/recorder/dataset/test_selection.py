"""Selections of columns and episodes: nothing else of a log is read."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

import mcaprl
from mcaprl.errors import CorruptLogError, SpaceError, UnknownNameError, UsageError
from mcaprl.recorder.columns.reader import McapReader
from tests.support.foreign_logs import plain_messages, steps_of, write_with_mcap
from tests.support.recordings import MIXED_SPACE, assert_same_bits, record

# Each episode has separate chunks, so that a test can damage the chunks of one episode.
pytestmark = pytest.mark.usefixtures("small_chunks")

LENGTHS = [5, 1, 120, 30, 7]


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("selection") / "log.mcap"
    record(path, MIXED_SPACE, spaces.Discrete(5), LENGTHS)
    return path


def damage(path: Path, target: Path, topic: str, number: int = 0) -> None:
    """Copy a log with one byte changed in a topic's chunk."""
    reader = McapReader(path)
    channel = reader.channel_of(topic)
    assert channel is not None
    chunk = list(reader.message_ranges(channel))[number].chunk
    assert chunk is not None
    data = bytearray(path.read_bytes())
    data[chunk.chunk_start_offset + chunk.chunk_length - 5] ^= 1
    target.write_bytes(data)


def test_columns_of_a_dict_space(log: Path) -> None:
    whole = mcaprl.open(log)
    part = mcaprl.open(log, columns=["Ünïcode key!", "joints/q", "mode"])
    assert isinstance(part.observation_space, spaces.Dict)
    assert list(part.observation_space) == ["Ünïcode key!", "joints", "mode"] or set(
        part.observation_space
    ) == {"Ünïcode key!", "joints", "mode"}
    for name in ("Ünïcode key!", "mode"):
        assert part.observation_space[name] == MIXED_SPACE[name]
        assert_same_bits(part.observations[name], whole.observations[name])
    assert_same_bits(part.observations["joints"]["q"], whole.observations["joints"]["q"])
    assert_same_bits(part.next_observations["mode"], whole.next_observations["mode"])
    assert_same_bits(part.rewards, whole.rewards)


def test_a_part_of_a_dict_space_is_saved(log: Path, tmp_path: Path) -> None:
    part = mcaprl.open(log, columns=["joints", "gray"])
    part.save(tmp_path / "part.mcap")
    again = mcaprl.open(tmp_path / "part.mcap")
    assert again.observation_space == part.observation_space
    assert again.fingerprint == part.fingerprint


def test_no_observations_at_all(log: Path, tmp_path: Path) -> None:
    none = mcaprl.open(log, columns=[])
    assert none.observations == {}
    assert_same_bits(none.rewards, mcaprl.open(log).rewards)
    assert [episode.length for episode in none.episodes] == LENGTHS
    with pytest.raises(SpaceError, match="there is nothing to record"):
        none.save(tmp_path / "none.mcap")


def test_unknown_columns(log: Path) -> None:
    with pytest.raises(UnknownNameError, match=r"unknown column 'joint'.*joints/q"):
        mcaprl.open(log, columns=["mode", "joint"])


def test_vectors_are_read_without_images(log: Path, tmp_path: Path) -> None:
    damage(log, tmp_path / "log.mcap", "/rl/observation/camera")
    with pytest.raises(CorruptLogError):
        mcaprl.open(tmp_path / "log.mcap")
    part = mcaprl.open(tmp_path / "log.mcap", columns=["joints"])
    assert_same_bits(part.observations["joints"]["q"], mcaprl.open(log).observations["joints"]["q"])


@pytest.mark.parametrize(
    ("asked", "meant"),
    [
        (2, [2]),
        (-1, [4]),
        (slice(1, 4), [1, 2, 3]),
        (slice(None, None, 2), [0, 2, 4]),
        ([3, 1, 3], [1, 3]),
        (range(2), [0, 1]),
    ],
)
def test_episodes(log: Path, asked: Any, meant: list[int]) -> None:
    whole, part = mcaprl.open(log), mcaprl.open(log, episodes=asked)
    assert part.fingerprint == whole._take(meant).fingerprint
    assert [e.seed for e in part.episodes] == [whole.episodes[k].seed for k in meant]
    assert_same_bits(part.episodes[0].log_time_ns, whole.episodes[meant[0]].log_time_ns)


@pytest.mark.parametrize("asked", [5, -6, [0, 9]])
def test_missing_episodes_are_refused(log: Path, asked: Any) -> None:
    with pytest.raises(UsageError, match="the logs have 5 episodes; indexes start at 0"):
        mcaprl.open(log, episodes=asked)
    with pytest.raises(UsageError, match="no episodes are selected"):
        mcaprl.open(log, episodes=[])


def test_an_episode_is_read_without_the_others(log: Path, tmp_path: Path) -> None:
    for topic in ("/rl/step", "/rl/observation/camera"):
        damage(log, tmp_path / "log.mcap", topic, number=0)
        part = mcaprl.open(tmp_path / "log.mcap", episodes=3)
        assert part.fingerprint == mcaprl.open(log, episodes=3).fingerprint
        with pytest.raises(CorruptLogError):
            mcaprl.open(tmp_path / "log.mcap", episodes=0)


def test_episodes_of_several_logs(tmp_path: Path) -> None:
    box = spaces.Box(-1, 1, (2,), np.float32)
    for number in range(3):
        record(tmp_path / f"{number}.mcap", box, spaces.Discrete(2), [2, 3, 4], seed=number)
    whole, part = mcaprl.open(tmp_path), mcaprl.open(tmp_path, episodes=[1, 2, 6, 8])
    assert part.fingerprint == whole._take([1, 2, 6, 8]).fingerprint
    assert len(part.sources) == 2, "the log in the middle has none of them"


@pytest.mark.parametrize("count", [256, 257])
def test_summaries_of_few_and_of_many_episodes(count: int, tmp_path: Path) -> None:
    """Summaries of at most 256 episodes are read at once, others when they are needed."""
    box = spaces.Box(-1, 1, (2,), np.float32)
    record(
        tmp_path / "log.mcap", box, spaces.Discrete(2), [1 + number % 3 for number in range(count)]
    )
    whole = mcaprl.open(tmp_path / "log.mcap").episodes
    for asked in ([7], [3, 200, 255], range(10, count)):
        part = mcaprl.open(tmp_path / "log.mcap", episodes=list(asked)).episodes
        assert str([one.summary for one in part]) == str([whole[k].summary for k in asked])


def test_episodes_of_a_cut_log(log: Path, tmp_path: Path) -> None:
    path = tmp_path / "cut.mcap"
    data = log.read_bytes()
    path.write_bytes(data[: len(data) * 9 // 10])
    with pytest.warns(UserWarning, match="was cut off"):
        part = mcaprl.open(path, episodes=slice(1, 3))
    assert part.fingerprint == mcaprl.open(log, episodes=[1, 2]).fingerprint


def test_episodes_of_another_writer(tmp_path: Path) -> None:
    """Find episodes by their counters if messages are unordered and `/rl/episode` is missing."""
    messages = plain_messages(steps_of([4, 9, 2, 6]))
    order = np.random.default_rng(0).permutation(len(messages)).tolist()
    write_with_mcap(tmp_path / "log.mcap", [messages[row] for row in order])
    whole = mcaprl.open(tmp_path / "log.mcap")
    part = mcaprl.open(tmp_path / "log.mcap", episodes=[1, 3])
    assert part.action_space == spaces.Discrete(5), "as far as they show"
    assert_same_bits(part.rewards, whole._take([1, 3]).rewards)


@pytest.mark.parametrize("threads", [2, 7])
def test_threads_read_the_same(log: Path, threads: int) -> None:
    assert mcaprl.open(log, threads=threads).fingerprint == mcaprl.open(log).fingerprint


def test_damage_is_reported_with_several_threads(log: Path, tmp_path: Path) -> None:
    damage(log, tmp_path / "log.mcap", "/rl/step", number=2)
    with pytest.raises(CorruptLogError):
        mcaprl.open(tmp_path / "log.mcap", threads=3)
    with pytest.raises(UsageError, match="threads is 0"):
        mcaprl.open(log, threads=0)


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record forty episodes of a thousand steps with vectors, which fill several large chunks."""
    path = tmp_path_factory.mktemp("selection") / "large.mcap"
    steps = 40_000
    frames = np.random.default_rng(0).standard_normal((steps + 1, 4), np.float32)
    mcaprl.Dataset.from_arrays(
        observations=frames[:-1],
        next_observations=frames[1:],
        actions=np.zeros(steps, np.int64),
        rewards=np.arange(float(steps)),
        terminated=np.arange(1, steps + 1) % 1000 == 0,
        truncated=np.zeros(steps, bool),
    ).save(path)
    return path


def test_indexes_of_other_chunks_are_not_read(large: Path, tmp_path: Path) -> None:
    """Read one episode without reading the indexes of all other chunks."""
    reader = McapReader(large)
    channel = reader.channel_of("/rl/step")
    assert channel is not None
    spoilt = bytearray(large.read_bytes())
    chunks = [part.chunk for part in reader.message_ranges(channel)]
    assert len(chunks) == 10
    for chunk in chunks[:-1]:
        assert chunk is not None
        start = chunk.message_index_offsets[channel.id]
        spoilt[start : start + chunk.message_index_length] = bytes(chunk.message_index_length)
    path = tmp_path / "spoilt.mcap"
    path.write_bytes(spoilt)
    assert_same_bits(
        mcaprl.open(path, episodes=39).rewards, mcaprl.open(large, episodes=39).rewards
    )
    with pytest.raises(CorruptLogError, match="no message index of channel"):
        mcaprl.open(path)


def test_an_index_with_too_few_messages_is_refused(large: Path, tmp_path: Path) -> None:
    reader = McapReader(large)
    channel = reader.channel_of("/rl/step")
    assert channel is not None
    chunk = list(reader.message_ranges(channel))[2].chunk
    assert chunk is not None
    spoilt = bytearray(large.read_bytes())
    # The opcode, the record length and the channel id precede the size of the entries.
    place = chunk.message_index_offsets[channel.id] + 11
    (reported,) = struct.unpack_from("<I", spoilt, place)
    struct.pack_into("<I", spoilt, place, reported - 16)
    path = tmp_path / "spoilt.mcap"
    path.write_bytes(spoilt)
    with pytest.raises(CorruptLogError, match="has 4095 entries, but the summary counts 4096"):
        mcaprl.open(path)
