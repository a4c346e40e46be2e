"""Compaction at close: small chunks are merged, and no message is lost if a write fails."""

from __future__ import annotations

import os
import random
import stat
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

import pytest
from gymnasium import spaces
from mcap.reader import make_reader
from mcap.records import ChunkIndex

import mcaprl
from mcaprl.errors import LogError
from mcaprl.files import is_at, try_lock
from mcaprl.recorder.columns import output
from mcaprl.recorder.columns.reader import McapReader
from mcaprl.recorder.repair.check import check_log
from tests.recorder.repair.test_faults_writes import FailingFile, failing
from tests.support.damage.faults import KnownEpisodes, assert_is_known, play, write_log
from tests.support.paths import ROOT
from tests.support.recordings import MIXED_SPACE, record

LENGTHS = [1, 5, 2, 40, 3] * 12


def messages_of(path: Path) -> dict[str, list[tuple[int, int, int, bytes]]]:
    """Return sequence numbers, times and bytes of all messages by topic, in file order."""
    found: dict[str, list[tuple[int, int, int, bytes]]] = {}
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        for _, channel, message in reader.iter_messages(log_time_order=False):
            row = (message.sequence, message.log_time, message.publish_time, message.data)
            found.setdefault(channel.topic, []).append(row)
    return found


def attachments_of(path: Path) -> list[Any]:
    """Return the attachments and metadata records that the summary lists."""
    with path.open("rb") as file:
        reader = make_reader(file)
        return [*reader.iter_attachments(), *reader.iter_metadata()]


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_all_messages_stay(
    log_path: Path, monkeypatch: pytest.MonkeyPatch, compression: str
) -> None:
    def write(path: Path) -> None:
        record(path, MIXED_SPACE, spaces.Discrete(2), LENGTHS, compression=compression)

    other = log_path.with_name("small.mcap")
    write(log_path)
    monkeypatch.setattr(output, "_MIN_CHUNKS_SAVED", 10**9)
    write(other)
    assert messages_of(log_path) == messages_of(other)
    assert attachments_of(log_path) == attachments_of(other)
    assert check_log(log_path) == []
    sizes = [len(McapReader(path).chunks) for path in (log_path, other)]
    assert sizes == [4, 4 * len(LENGTHS)]
    assert set(os.listdir(log_path.parent)) == {log_path.name, other.name}


def chunk(number: int, size: int, *channels: int) -> ChunkIndex:
    return ChunkIndex(1, number, "", 1, 1, 1, dict.fromkeys(channels, 1), 1, size)


def groups(*chunks: ChunkIndex) -> list[list[int]]:
    return [[c.chunk_start_offset for c in group] for group in output.groups_of(chunks)]


def test_only_small_chunks_of_one_kind_are_merged() -> None:
    small, large = 2**15, 2**16
    # Channels 2 and 3 share a chunk, so they are of the same kind.
    assert groups(
        chunk(0, small, 1),
        chunk(1, small, 2, 3),
        chunk(2, small, 1),
        chunk(3, small, 3),
        chunk(4, large, 1),
        chunk(5, small, 1),
        chunk(6, small, 2),
        chunk(7, small),
    ) == [[0, 2], [4], [5], [1, 3, 6], [7]]
    # A merged chunk has at most 1 MiB.
    assert [len(group) for group in groups(*(chunk(k, small, 1) for k in range(70)))] == [32, 32, 6]


def test_channels_are_of_one_kind_if_chunks_connect_them() -> None:
    chunks = [
        chunk(0, 9, 1, 2),
        chunk(1, 9, 3, 4),
        chunk(2, 9, 2, 3),
        chunk(3, 9, 5),
        chunk(4, 9, 4),
    ]
    assert groups(*chunks) == [[3], [0, 1, 2, 4]]


def test_nothing_worth_rewriting_is_left(log_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    copies: list[Path] = []
    monkeypatch.setattr(output._CompactedFile, "copy", lambda out, *_: copies.append(out.path))
    write_log(log_path, 3)
    assert not copies
    monkeypatch.setattr(output, "_MAX_BYTES_PER_CHUNK", 1)
    write_log(log_path, 20, overwrite=True)
    assert not copies


def test_each_write_of_the_compaction_fails(log_path: Path) -> None:
    """If a write fails, the log with small chunks is complete, and no temporary file remains."""
    write_log(log_path, 6)
    after = len(McapReader(log_path).chunks)
    failed, finished = 0, 10**9
    for writes in range(10_000):
        with failing(writes, random.Random(writes)):
            try:
                write_log(log_path, 6, overwrite=True)
            except LogError:
                continue
            done = FailingFile.writes_left > 0
        assert os.listdir(log_path.parent) == [log_path.name]
        assert check_log(log_path) == []
        episodes = mcaprl.open(log_path).episodes
        assert len(episodes) == 6
        for episode in episodes:
            assert_is_known(episode)
        if done:
            finished = writes
            break
        failed += len(McapReader(log_path).chunks) > after
    assert failed > 5
    assert finished < 10_000


@pytest.mark.parametrize("name", ["fsync", "replace", "chmod"])
@pytest.mark.parametrize("error", [OSError(5, "Input/output error"), KeyboardInterrupt()])
def test_the_last_steps_fail(
    log_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, error: BaseException
) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(os, name, fail)
    try:
        write_log(log_path, 6)
    except KeyboardInterrupt:
        assert isinstance(error, KeyboardInterrupt)
    assert os.listdir(log_path.parent) == [log_path.name]
    assert check_log(log_path) == []
    assert len(mcaprl.open(log_path).episodes) == 6
    monkeypatch.undo()
    # Afterwards, the log is not locked.
    output.release(output.reopen(log_path))


@pytest.mark.parametrize("writes", [0, 1, 2, 4, 6])
def test_killed_while_compacting(log_path: Path, writes: int) -> None:
    """The log is complete, and the next writer that appends removes the temporary files."""
    code = """
        import os, signal, sys
        from pathlib import Path
        from mcaprl.recorder.columns.output import _CompactedFile
        from tests.support.damage.faults import write_log
        write, left = _CompactedFile._write, int(sys.argv[2])
        def dying(out, *parts):
            global left
            if left == 0:
                os.kill(os.getpid(), signal.SIGKILL)
            left -= 1
            write(out, *parts)
        _CompactedFile._write = dying
        write_log(Path(sys.argv[1]), 6)
    """
    command = [sys.executable, "-c", textwrap.dedent(code), str(log_path), str(writes)]
    assert subprocess.run(command, cwd=ROOT, check=False).returncode == -9
    leftover = log_path.with_name(f".{log_path.name}.part")
    assert leftover.exists()
    assert check_log(log_path) == []
    assert len(mcaprl.open(log_path.parent).episodes) == 6
    append(log_path, 1, first=6)
    assert not leftover.exists()
    assert check_log(log_path) == []
    episodes = mcaprl.open(log_path).episodes
    assert [episode.summary.episode for episode in episodes] == list(range(7))
    for episode in episodes:
        assert_is_known(episode)


def append(path: Path, episodes: int, *, first: int) -> None:
    """Append episodes whose numbers start at `first`."""
    reported = KnownEpisodes()
    reported.episode = first - 1
    env = mcaprl.RecordMcap(reported, path, append=True)
    for _ in range(episodes):
        play(env)
    env.close()


def test_readers_keep_the_old_file(log_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Readers keep the old file during compaction, and no second writer can lock the log."""
    opened: list[McapReader] = []
    replace = os.replace

    def look(*paths: Any) -> None:
        opened.append(McapReader(log_path))
        with pytest.raises(LogError, match="has an open recorder"):
            output.reopen(log_path)
        replace(*paths)
        with pytest.raises(LogError, match="has an open recorder"):
            output.reopen(log_path)

    monkeypatch.setattr(os, "replace", look)
    write_log(log_path, 6)
    (old,) = opened
    assert old.complete
    channel = old.channel_of("/rl/step")
    assert channel is not None
    new = McapReader(log_path)
    new_channel = new.channel_of("/rl/step")
    assert new_channel is not None
    assert list(old.messages(channel)) == list(new.messages(new_channel))
    assert len(new.chunks) < len(old.chunks)


def test_a_writer_that_opened_the_old_file_gets_the_new_one(
    log_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Replace the file after the writer has opened it and before the writer locks it."""
    write_log(log_path, 2)
    locked = try_lock
    copy = log_path.read_bytes()
    once = [True]

    def replaced(descriptor: int) -> bool:
        if once:
            once.clear()
            other = log_path.with_name("other")
            other.write_bytes(copy)
            os.replace(other, log_path)
        return locked(descriptor)

    monkeypatch.setattr(output, "try_lock", replaced)
    file = output.reopen(log_path)
    assert is_at(file.fileno(), log_path)
    output.release(file)


def test_links_and_modes_stay(tmp_path: Path) -> None:
    target, link = tmp_path / "target.mcap", tmp_path / "link.mcap"
    write_log(target, 1)
    target.chmod(0o600)
    link.symlink_to(target)
    append(link, 8, first=1)
    assert link.is_symlink()
    assert stat.S_IMODE(target.stat().st_mode) == 0o600
    assert len(McapReader(link).chunks) < 10
    assert check_log(link) == []


def test_a_file_that_was_moved_away_is_left_alone(tmp_path: Path) -> None:
    """Do not compact a moved file, because its path may belong to another recording."""
    env = mcaprl.RecordMcap(KnownEpisodes(), tmp_path / "a.mcap")
    for _ in range(6):
        play(env)
    os.replace(tmp_path / "a.mcap", tmp_path / "b.mcap")
    write_log(tmp_path / "a.mcap", 1)
    before = (tmp_path / "a.mcap").read_bytes()
    with pytest.raises(LogError, match="was removed or replaced"):
        env.close()
    assert (tmp_path / "a.mcap").read_bytes() == before
    assert len(mcaprl.open(tmp_path / "b.mcap").episodes) == 6


def test_parts_of_a_rotated_log_are_compacted(tmp_path: Path) -> None:
    write_log(tmp_path / "log.mcap", 60, max_file_bytes=40_000)
    parts = sorted(tmp_path.iterdir())
    assert len(parts) > 1
    assert all(len(McapReader(part).chunks) <= 6 for part in parts)
    for number, episode in enumerate(mcaprl.open(tmp_path).episodes):
        assert episode.summary.episode == number
        assert_is_known(episode)
