"""Full disks and failing writes: one clear error, and no finished episode is lost."""

from __future__ import annotations

import contextlib
import errno
import os
import random
import resource
import warnings
from collections.abc import Iterator
from io import FileIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import mcaprl
from mcaprl.errors import LogError
from mcaprl.recorder.repair.check import check_log
from mcaprl.recorder.repair.recover import recover_log
from tests.support.damage.faults import KnownEpisodes, assert_is_known, count, play, tell, write_log

ERRORS = (errno.ENOSPC, errno.EIO, errno.EDQUOT)


class FailingFile(FileIO):
    """File whose writes fail after `writes_left` writes; the first failing write is partial."""

    writes_left = 0
    error = errno.ENOSPC
    part = 0.0
    truncates = True

    def write(self, data: Any) -> int:
        kind = type(self)
        if kind.writes_left > 0:
            kind.writes_left -= 1
            return super().write(data)
        if kind.part > 0:
            written = super().write(bytes(data)[: int(kind.part * len(data))])
            kind.part = 0.0
            return written
        raise OSError(kind.error, os.strerror(kind.error))

    def truncate(self, size: int | None = None) -> int:
        if not type(self).truncates:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return super().truncate(size)


@contextlib.contextmanager
def failing(writes: int, chance: random.Random) -> Iterator[None]:
    """Let this number of writes succeed; make later writes fail in one of several ways."""
    FailingFile.writes_left, FailingFile.error = writes, chance.choice(ERRORS)
    FailingFile.part = chance.choice([0.0, 0.5, 0.99])
    FailingFile.truncates = chance.random() < 0.5
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mcaprl.recorder.columns.output.FileIO", FailingFile)
        yield


def record_until_it_fails(path: Path, episodes: int, **options: Any) -> int:
    """Record until a write fails, and return the number of finished episodes."""
    env = None
    try:
        env = mcaprl.RecordMcap(KnownEpisodes(), path, **options)
        for _ in range(episodes):
            play(env)
        env.close()
    except LogError as error:
        message = str(error)
        assert "\n" not in message
        assert str(path) in message
        assert any(os.strerror(number) in message for number in (*ERRORS, errno.EFBIG))
    finally:
        finished = env.episodes if env is not None else 0
        if env is not None:
            # Closing neither repeats the failed write nor reports it again.
            env.close()
    return finished


def assert_all_there(path: Path, finished: int) -> None:
    """Check that all finished episodes can be read.

    One more episode may be read if its chunk was written before the failure.
    """
    out = path.with_name("out.mcap")
    try:
        recover_log(path, out, overwrite=True)
    except LogError:
        assert finished == 0
        return
    assert check_log(out) == []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        logs = [mcaprl.open(out), mcaprl.open(path)]
    for data in logs:
        assert len(data.episodes) >= finished
        for episode in data.episodes:
            assert_is_known(episode)


def test_every_write_fails_once(log_path: Path) -> None:
    tried = 0
    for trial in range(count(1, 10)):
        for writes in range(10_000):
            with failing(writes, random.Random(f"{trial} {writes}")):
                finished = record_until_it_fails(log_path, 4, overwrite=True)
            if FailingFile.writes_left > 0:
                break
            tried += 1
            assert_all_there(log_path, finished)
    tell("writes that fail", failed=tried, finished_episodes_lost=0)
    assert tried > 20


class Later(KnownEpisodes):
    """Environment of known episodes that starts with the fourth episode."""

    def __init__(self) -> None:
        super().__init__()
        self.episode = 2


def test_disk_is_full_while_appending(log_path: Path) -> None:
    for writes in range(0, 30, 3):
        write_log(log_path, 3, overwrite=True)
        with failing(writes, random.Random(writes)):
            FailingFile.truncates = True
            env = mcaprl.RecordMcap(Later(), log_path, append=True)
            with pytest.raises(LogError, match=str(log_path)):  # noqa: PT012
                for _ in range(20):
                    play(env)
            env.close()
        assert env.episodes >= 3
        assert_all_there(log_path, env.episodes)


def test_vector_recording_on_a_full_disk(log_path: Path) -> None:
    for writes in range(14, 60, 5):
        envs = SyncVectorEnv([KnownEpisodes, KnownEpisodes], autoreset_mode=AutoresetMode.SAME_STEP)
        with failing(writes, random.Random(writes)):
            env = mcaprl.RecordVecMcap(envs, log_path, overwrite=True)
            env.reset()
            with pytest.raises(LogError, match="everything written before"):  # noqa: PT012
                while True:
                    env.step(np.zeros(2, np.int64))
            env.close()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if env.episodes:
                assert len(mcaprl.open(log_path).episodes) >= env.episodes


def test_a_file_size_limit_is_one_error(log_path: Path) -> None:
    """Simulate a full disk by the system's limit for the size of a file."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    for limit in (3_000, 5_000, 20_000, 60_000):
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
        try:
            finished = record_until_it_fails(log_path, 1_000, overwrite=True)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
        assert log_path.stat().st_size <= limit
        assert_all_there(log_path, finished)


def test_recovering_onto_a_full_disk(log_path: Path) -> None:
    """If the disk is full, the damaged file is unchanged, and no partial file remains."""
    write_log(log_path, 3)
    before = log_path.read_bytes()
    with failing(6, random.Random(0)), pytest.raises(LogError, match="cannot write"):
        recover_log(log_path, log_path.with_name("out.mcap"))
    assert [path.name for path in log_path.parent.iterdir()] == [log_path.name]
    assert log_path.read_bytes() == before


def test_the_environment_is_closed_after_a_failed_write(log_path: Path) -> None:
    closed = []

    class Closes(KnownEpisodes):
        def close(self) -> None:
            closed.append(True)

    with failing(15, random.Random(0)):
        env = mcaprl.RecordMcap(Closes(), log_path)
        env.reset()
        env.step(0)
        with pytest.raises(LogError):
            env.close()
        env.close()
    assert closed == [True, True]
