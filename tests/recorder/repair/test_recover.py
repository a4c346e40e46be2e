"""Recovery: the new file has all valid records and no wrong value, and losses are reported."""

from __future__ import annotations

import json
import struct
import tracemalloc
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

import mcaprl
from mcaprl.cli import run
from mcaprl.errors import LogError, NoEpisodesError, NotMcapError, OutputExistsError, UsageError
from mcaprl.recorder.columns.reader import McapReader
from mcaprl.recorder.columns.records import RECORD_HEADER_BYTES
from mcaprl.recorder.columns.salvage import Damage, valid_records
from mcaprl.recorder.repair.check import check_log
from mcaprl.recorder.repair.recover import Recovery, recover_log
from tests.support.recordings import Truth, assert_holds, record

# Losses are reported for each chunk, so each episode has a separate chunk here.
pytestmark = pytest.mark.usefixtures("small_chunks")

SPACE = spaces.Dict(
    {
        "x": spaces.Box(-1, 1, (2,), np.float32),
        "image": spaces.Box(0, 255, (8, 9), np.uint8),
    }
)
LENGTHS = [40, 9, 60, 25]


class Recorded(tuple[bytes, Truth]):
    """A log and its recorded values, with a short repr for the names of tests."""

    def __repr__(self) -> str:
        return "Recorded"


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> tuple[bytes, Truth]:
    path = tmp_path_factory.mktemp("good") / "log.mcap"
    recorded = record(path, SPACE, spaces.Discrete(2), LENGTHS)
    return Recorded((path.read_bytes(), recorded))


@pytest.fixture
def good(truth: tuple[bytes, Truth]) -> bytes:
    return truth[0]


def episodes_of(truth: Truth, chosen: list[int]) -> Truth:
    """Select some episodes of the recorded values."""
    bounds = np.cumsum([0, *LENGTHS])
    rows = [row for k in chosen for row in range(bounds[k], bounds[k + 1])]
    return Truth(**{name: [column[row] for row in rows] for name, column in vars(truth).items()})


def recovered(path: Path, damaged: bytes, **options: Any) -> tuple[Recovery, mcaprl.Dataset]:
    path.write_bytes(damaged)
    out = path.with_name("out.mcap")
    recovery = recover_log(path, out, overwrite=True, **options)
    assert check_log(out) == []
    assert path.read_bytes() == damaged, "the damaged file is left as it is"
    assert sorted(p.name for p in path.parent.iterdir()) == sorted([path.name, "out.mcap"])
    return recovery, mcaprl.open(out)


def chunks_of(data: bytes, topic: str, path: Path) -> list[tuple[int, int]]:
    """Return the offsets and lengths of a topic's chunks."""
    path.write_bytes(data)
    reader = McapReader(path)
    channel = reader.channel_of(topic)
    assert channel is not None
    return [
        (chunk.chunk_start_offset, chunk.chunk_length)
        for chunk in reader.chunks
        if channel.id in chunk.message_index_offsets
    ]


def test_an_intact_file_loses_nothing(log_path: Path, truth: tuple[bytes, Truth]) -> None:
    recovery, data = recovered(log_path, truth[0])
    assert not recovery.has_losses
    assert recovery.episodes == 4
    assert_holds(data, truth[1])
    assert [episode.seed for episode in data.episodes] == [100, 101, 102, 103]
    old, new = McapReader(log_path), McapReader(log_path.with_name("out.mcap"))
    assert new.metadata == old.metadata
    assert {c.topic for c in new.channels.values()} == {c.topic for c in old.channels.values()}
    assert new.attachment("foxglove-layout.json") == old.attachment("foxglove-layout.json")
    assert recovery.messages == sum(
        len(part) for channel in old.channels.values() for part in old.message_ranges(channel)
    )


@settings(max_examples=60)
@given(share=st.floats(0, 1))
def test_cut_file_keeps_all_finished_episodes(
    tmp_path_factory: pytest.TempPathFactory, truth: tuple[bytes, Truth], share: float
) -> None:
    good, recorded = truth
    path = tmp_path_factory.mktemp("cut") / "log.mcap"
    cut = int(share * (len(good) - 1))
    ends = [start + length for start, length in chunks_of(good, "/rl/step", path)]
    finished = sum(end <= cut for end in ends)
    if finished == 0:
        path.write_bytes(good[:cut])
        with pytest.raises(LogError):
            recover_log(path, path.with_name("out.mcap"))
        return
    _, data = recovered(path, good[:cut])
    assert_holds(data, episodes_of(recorded, list(range(finished))))


def test_file_without_summary_loses_nothing(log_path: Path, truth: tuple[bytes, Truth]) -> None:
    log_path.write_bytes(truth[0])
    start = McapReader(log_path).summary_start
    for cut in (start - 13, start, start + 20, len(truth[0]) - 3):
        recovery, data = recovered(log_path, truth[0][:cut])
        assert_holds(data, truth[1])
        assert not recovery.has_losses or cut < start


def test_a_damaged_header_loses_nothing_else(log_path: Path, truth: tuple[bytes, Truth]) -> None:
    good, recorded = truth
    spoilt = bytearray(good)
    # The magic bytes, the opcode and the record length precede the length of the profile.
    spoilt[8 + RECORD_HEADER_BYTES + 3] = 255
    recovery, data = recovered(log_path, bytes(spoilt))
    assert_holds(data, recorded)
    assert [damage.offset for damage in recovery.damages][:1] == [8]


def test_a_lost_channel_loses_only_its_messages(log_path: Path, truth: tuple[bytes, Truth]) -> None:
    """Remove the record of a channel whose messages share chunks with another channel."""
    good, recorded = truth
    log_path.write_bytes(good)
    reader = McapReader(log_path)
    start, size = next(
        (offset, RECORD_HEADER_BYTES + len(content))
        for offset, opcode, content in reader.records(len(MCAP0_MAGIC))
        if opcode == Opcode.CHANNEL and b"/rosout" in bytes(content)
    )
    lost, data = recovered(log_path, good[:start] + good[start + size : reader.summary_start - 13])
    assert_holds(data, recorded)
    assert lost.episodes == 4
    assert sum("2 messages of channel" in damage.what for damage in lost.damages) == 4
    topics = {c.topic for c in McapReader(log_path.with_name("out.mcap")).channels.values()}
    assert topics == {c.topic for c in reader.channels.values()} - {"/rosout"}


@pytest.mark.parametrize("topic", ["/rl/step", "/rl/observation/image"])
@pytest.mark.parametrize("number", range(4))
def test_a_damaged_chunk_loses_its_episode(
    log_path: Path, truth: tuple[bytes, Truth], topic: str, number: int
) -> None:
    good, recorded = truth
    start, length = chunks_of(good, topic, log_path)[number]
    damaged = bytearray(good)
    damaged[start + length - 20] ^= 1
    recovery, data = recovered(log_path, bytes(damaged))
    assert recovery.has_losses
    assert recovery.episodes == 3
    assert "CRC" in recovery.damages[0].what or "decompressed" in recovery.damages[0].what
    assert_holds(data, episodes_of(recorded, [k for k in range(4) if k != number]))


def records_of(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Return offset, opcode and length of all records."""
    offset = 8
    while offset < len(data) - 8:
        opcode, length = struct.unpack_from("<BQ", data, offset)
        yield offset, opcode, length
        offset += 9 + length


@pytest.mark.parametrize("claimed", [0, 7, 10_000, 2**62, 2**64 - 1])
@pytest.mark.parametrize("opcode", [Opcode.CHUNK, Opcode.MESSAGE_INDEX, Opcode.METADATA])
def test_a_wrong_length_loses_only_its_record(
    log_path: Path, truth: tuple[bytes, Truth], opcode: Opcode, claimed: int
) -> None:
    """Find the records that follow a record with a wrong length."""
    good, recorded = truth
    places = [offset for offset, found, _ in records_of(good) if found == opcode]
    step_chunks = [start for start, _ in chunks_of(good, "/rl/step", log_path)]
    place = step_chunks[1] if opcode == Opcode.CHUNK else places[len(places) // 2]
    damaged = bytearray(good)
    struct.pack_into("<Q", damaged, place + 1, claimed)
    recovery, data = recovered(log_path, bytes(damaged))
    assert recovery.damages
    lost = [1] if opcode == Opcode.CHUNK else []
    assert_holds(data, episodes_of(recorded, [k for k in range(4) if k not in lost]))
    assert data.env_id == ""


def test_records_in_any_order(log_path: Path, truth: tuple[bytes, Truth]) -> None:
    good, recorded = truth
    places = list(records_of(good))
    chunk_places = [
        (offset, 9 + length) for offset, opcode, length in places if opcode == Opcode.CHUNK
    ]
    parts = [good[start : start + length] for start, length in chunk_places]
    first, last = chunk_places[0][0], chunk_places[-1][0] + chunk_places[-1][1]
    others = b"".join(
        good[offset : offset + 9 + length]
        for offset, opcode, length in places
        if opcode in (Opcode.ATTACHMENT, Opcode.SCHEMA, Opcode.CHANNEL) and first < offset < last
    )
    damaged = good[:first] + others + b"".join(reversed(parts)) + good[last:]
    _, data = recovered(log_path, damaged)
    assert_holds(data, recorded)


def test_duplicate_chunks_are_read_once(log_path: Path, truth: tuple[bytes, Truth]) -> None:
    good, recorded = truth
    start, length = chunks_of(good, "/rl/step", log_path)[2]
    chunk = good[start : start + length]
    recovery, data = recovered(log_path, good[:start] + chunk + good[start:])
    assert any("repeated chunk" in damage.what for damage in recovery.damages)
    assert_holds(data, recorded)


def killed(path: Path, steps: int) -> tuple[bytes, Truth]:
    """Record a log that is killed in its second episode, with some of its chunks on disk."""
    space, whole = spaces.Box(0, 255, (20, 20), np.uint8), path.with_name("whole.mcap")
    truth = record(whole, space, spaces.Discrete(2), [3, steps + 50])
    images = chunks_of(whole.read_bytes(), "/rl/observation/image", path)
    data = whole.read_bytes()
    whole.unlink()
    # Images are written in chunks of 100 images, and records of /rl/step in chunks of 4096.
    later = [offset for offset, _ in images if offset > 0]
    return data[: later[-1]], truth


def test_an_unfinished_episode_can_be_kept(log_path: Path) -> None:
    damaged, truth = killed(log_path, 8200)
    recovery, data = recovered(log_path, damaged)
    assert [episode.length for episode in data.episodes] == [3]
    (dropped,) = recovery.dropped
    assert (dropped.number, dropped.can_end) == (1, True)
    recovery, data = recovered(log_path, damaged, keep_unfinished=True)
    assert (recovery.ended, recovery.episodes, recovery.has_losses) == (1, 2, True)
    kept = data.episodes[1]
    assert 8000 < kept.length == dropped.records - 1
    rows = slice(3, 3 + kept.length)
    assert kept.observations.tobytes() == np.stack(truth.observations[rows]).tobytes()
    assert kept.next_observations.tobytes() == np.stack(truth.next_observations[rows]).tobytes()
    assert kept.actions.tolist() == truth.actions[rows]
    assert kept.rewards.tobytes() == np.array(truth.rewards[rows]).tobytes()
    assert kept.truncated.tolist() == [False] * (kept.length - 1) + [True]
    assert not kept.terminated.any()
    assert kept.reason == "interrupted"


def test_only_an_unfinished_episode(log_path: Path) -> None:
    damaged, _ = killed(log_path, 8200)
    start = chunks_of(damaged, "/rl/step", log_path)[0]
    damaged = damaged[: start[0]] + damaged[start[0] + start[1] :]
    log_path.write_bytes(damaged)
    out = log_path.with_name("out.mcap")
    with pytest.raises(NoEpisodesError, match="no whole episode; pass `keep_unfinished=True`"):
        recover_log(log_path, out)
    assert not out.exists()
    recovery, data = recovered(log_path, damaged, keep_unfinished=True)
    assert recovery.episodes == len(data.episodes) == 1


def test_unrecoverable_files(log_path: Path, good: bytes) -> None:
    out = log_path.with_name("out.mcap")
    for data, kind in (
        (b"", NotMcapError),
        (b"hello", LogError),
        (bytes(100_000), LogError),
        (good[: good.index(b"zstd") - 50], LogError),
    ):
        log_path.write_bytes(data)
        with pytest.raises(kind):
            recover_log(log_path, out)
        assert [path.name for path in log_path.parent.iterdir()] == [log_path.name]


def test_paths_that_are_refused(log_path: Path, good: bytes) -> None:
    log_path.write_bytes(good)
    out = log_path.with_name("out.mcap")
    with pytest.raises(UsageError, match="is the damaged file"):
        recover_log(log_path, log_path, overwrite=True)
    out.write_text("precious")
    with pytest.raises(OutputExistsError):
        recover_log(log_path, out)
    assert out.read_text() == "precious"
    with (
        closing(mcaprl.RecordMcap(gym.make("CartPole-v1"), log_path, overwrite=True)),
        pytest.raises(LogError, match="has an open recorder"),
    ):
        recover_log(log_path, out, overwrite=True)
    assert out.read_text() == "precious"


@pytest.mark.parametrize("use_chunking", [True, False])
def test_files_of_other_writers_keep_their_topics(log_path: Path, use_chunking: bool) -> None:
    """Recover any MCAP file, with its JSON topics, profile, metadata and attachments."""
    writer = Writer(
        str(log_path), use_chunking=use_chunking, chunk_size=500, compression=CompressionType.LZ4
    )
    writer.start("myprofile", "mylibrary")
    schema = writer.register_schema("Thing", "jsonschema", b'{"type": "object"}')
    with_schema = writer.register_channel("/thing", "json", schema)
    without = writer.register_channel("/raw", "application/x-raw", 0, {"robot": "7"})
    for time_ns in range(100):
        channel = with_schema if time_ns % 3 else without
        writer.add_message(channel, time_ns, b'{"n": %d}' % time_ns, 2 * time_ns, time_ns % 7)
    writer.add_metadata("notes", {"where": "lab"})
    writer.add_attachment(5, 6, "map.bin", "application/octet-stream", b"\x01\x02")
    writer.finish()
    data = log_path.read_bytes()
    log_path.write_bytes(data[: data.rindex(b"map.bin") - 40])
    out = log_path.with_name("out.mcap")
    recover_log(log_path, out)
    with out.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        messages = [
            (channel.topic, message.log_time, message.publish_time, message.sequence, message.data)
            for _, channel, message in reader.iter_messages()
        ]
        assert reader.get_header().profile == "myprofile"
        assert [record.metadata for record in reader.iter_metadata()] == [{"where": "lab"}]
        assert [attachment.data for attachment in reader.iter_attachments()] == [b"\x01\x02"]
    assert messages == [
        ("/thing" if t % 3 else "/raw", t, 2 * t, t % 7, b'{"n": %d}' % t) for t in range(100)
    ]


def test_command_output_and_exit_codes(
    log_path: Path, good: bytes, capsys: pytest.CaptureFixture[str]
) -> None:
    log_path.write_bytes(good)
    out = log_path.with_name("out.mcap")
    assert run(["recover", str(log_path), str(out)]) == 0
    assert "4 episodes" in capsys.readouterr().out
    log_path.write_bytes(good[: 2 * len(good) // 3])
    assert run(["recover", str(log_path), str(out)]) == 2, "there is a file"
    capsys.readouterr()
    assert run(["recover", str(log_path), str(out), "--overwrite"]) == 3
    assert "lost: " in capsys.readouterr().out
    assert run(["recover", str(log_path), str(out), "--overwrite", "--json"]) == 3
    reported = json.loads(capsys.readouterr().out)
    assert reported["ok"] is False
    assert {"episodes", "messages", "damages", "dropped", "ended", "not_listed"} <= set(reported)
    log_path.write_bytes(b"nonsense")
    assert run(["recover", str(log_path), str(out), "--overwrite"]) == 1
    assert "cannot be recovered" in capsys.readouterr().err


@pytest.mark.parametrize("other", [b"/rl/step", b"/rl/episode", b"mcaprl_msgs/msg/Episode"])
def test_a_log_without_the_step_topic(log_path: Path, tmp_path: Path, other: bytes) -> None:
    """Recover nothing from a log whose episodes cannot be found."""
    record(log_path, SPACE, spaces.Discrete(2), [4, 5])
    data = log_path.read_bytes()
    for name in {b"mcaprl.dataset", b"/rl/step", other}:
        assert data.count(name) >= 2
        data = data.replace(name, name[:-1] + b"x")
    log_path.write_bytes(data)
    with pytest.raises(NoEpisodesError, match="no whole episode"):
        recover_log(log_path, tmp_path / "out.mcap")
    assert not (tmp_path / "out.mcap").exists()


def test_scanning_for_records_does_not_copy_the_file(log_path: Path) -> None:
    """Scan without a copy of the rest of the file at each record; copies take quadratic time."""
    steps = 20_000
    frames = np.random.default_rng(0).standard_normal((steps + 1, 20))
    mcaprl.Dataset.from_arrays(
        observations=frames[:-1],
        next_observations=frames[1:],
        actions=np.zeros(steps, np.int64),
        rewards=np.zeros(steps),
        terminated=np.zeros(steps, bool),
        truncated=np.arange(steps) == steps - 1,
    ).save(log_path, compression="none")
    view = memoryview(log_path.read_bytes())
    assert len(view) > 2_000_000
    tracemalloc.start()
    try:
        damages: list[Damage] = []
        found = sum(1 for _ in valid_records(view, damages))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert found > 5
    assert damages == []
    assert peak < 300_000


def test_an_episode_without_any_record_is_named(log_path: Path) -> None:
    """Report an episode whose chunk is damaged.

    It is only known from `/rl/episode` and from the gap in the episode numbers.
    """
    with closing(mcaprl.RecordMcap(gym.make("CartPole-v1"), log_path)) as recorder:
        for seed in range(30):
            recorder.reset(seed=seed)
            while not any(recorder.step(seed % 2)[2:4]):
                pass
        # Each episode is one chunk of `/rl/step` while the log is open.
        content = bytearray(log_path.read_bytes())
    start, length = chunks_of(bytes(content), "/rl/step", log_path)[12]
    content[start + length - 5] ^= 1
    log_path.write_bytes(content)
    recovery = recover_log(log_path, log_path.with_name("out.mcap"))
    assert recovery.episodes == 29
    (lost,) = recovery.dropped
    assert (lost.number, lost.records) == (12, 0)
    assert any("lost: episode 12" in str(problem) for problem in recovery.problems)
