"""Recording in several processes that are stopped or killed, or that meet another recording."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import gymnasium as gym
import pytest
from gymnasium import spaces

import mcaprl
from mcaprl.api import record_files
from mcaprl.errors import LogError, SpaceError
from mcaprl.recorder.repair.check import check_log
from tests.support.recordings import ScriptedEnv

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="signals are those of POSIX")
# On a busy machine, lines of progress would be printed between the errors.
COMMAND = [sys.executable, "-m", "mcaprl.cli", "record", "CartPole-v1", "--quiet"]
COMMAND += ["--policy", "random"]


@contextmanager
def recording(folder: Path) -> Iterator[tuple[subprocess.Popen[str], list[int]]]:
    """Record shards until stopped; yield the command's process and the ids of its workers."""
    command = [*COMMAND, "--steps", "100000000", "--envs", "2", "--out", str(folder)]
    shards = [folder / f"shard-0{number}.mcap" for number in range(2)]
    with subprocess.Popen(
        command,
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # Shells let background processes ignore SIGINT.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    ) as process:
        try:
            while not all(path.exists() and path.stat().st_size > 40_000 for path in shards):
                assert process.poll() is None, process.communicate()
                time.sleep(0.05)
            children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text()
            yield process, [int(child) for child in children.split() if is_worker(int(child))]
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)


def is_worker(process: int) -> bool:
    """Return whether a process is a worker, and not Python's resource tracker."""
    return b"spawn_main" in Path(f"/proc/{process}/cmdline").read_bytes()


def wait_for_end(process: int) -> None:
    """Wait until a process has ended; it does not have to be a child of this process."""
    until = time.monotonic() + 20
    while Path(f"/proc/{process}").exists():
        state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
        if state == "Z":
            return
        assert time.monotonic() < until, "the process still runs"
        time.sleep(0.05)


needs_proc = pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs /proc")


@needs_proc
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
@pytest.mark.parametrize("to_group", [False, True])
def test_a_signal_ends_all_processes_with_whole_files(
    tmp_path: Path, number: signal.Signals, to_group: bool
) -> None:
    with recording(tmp_path / "shards") as (process, workers):
        (os.killpg if to_group else os.kill)(process.pid, number)
        _, errors = process.communicate(timeout=30)
        assert process.returncode == 130
        # Lines of progress come first on a slow machine.
        assert errors.splitlines()[-1] == "mcaprl: interrupted; finished episodes are kept"
        for worker in workers:
            wait_for_end(worker)
    for path in (tmp_path / "shards").iterdir():
        assert check_log(path) == []
        assert len(mcaprl.open(path).episodes) > 0


@needs_proc
def test_workers_end_with_whole_files_if_their_parent_is_killed(tmp_path: Path) -> None:
    with recording(tmp_path / "shards") as (process, workers):
        process.kill()
        assert len(workers) == 2
        for worker in workers:
            wait_for_end(worker)
    for path in (tmp_path / "shards").iterdir():
        assert check_log(path) == []


@needs_proc
def test_a_killed_worker_is_one_line_and_the_other_shard_is_whole(tmp_path: Path) -> None:
    with recording(tmp_path / "shards") as (process, workers):
        os.kill(workers[0], signal.SIGKILL)
        _, errors = process.communicate(timeout=30)
        assert process.returncode == 1
    (line,) = errors.strip().splitlines()
    killed = [path for path in (tmp_path / "shards").iterdir() if check_log(path)]
    assert line.startswith(f"mcaprl: {killed[0]}: its process was killed by SIGKILL; the ")
    assert len(killed) == 1
    with pytest.warns(UserWarning, match="not finished|cut off|still being written"):
        episodes = len(mcaprl.open(killed[0]).episodes)
    reported = int(line.partition("; the ")[2].split()[0])
    assert 10 < reported <= episodes


@needs_proc
def test_shards_that_are_being_recorded_are_not_replaced(tmp_path: Path) -> None:
    folder = tmp_path / "shards"
    with recording(folder):
        before = sorted(path.stat().st_ino for path in folder.glob("*.mcap"))
        with pytest.raises(LogError, match="in use by another recording"):
            mcaprl.record("CartPole-v1", folder, episodes=2, envs=2, overwrite=True)
        assert sorted(path.stat().st_ino for path in folder.glob("*.mcap")) == before


def test_a_shard_that_another_recorder_writes_is_not_replaced(tmp_path: Path) -> None:
    for name in ("shard-00.mcap", "shard-01.mcap"):
        mcaprl.record("CartPole-v1", tmp_path / name, policy="random", episodes=1)
    env = mcaprl.RecordMcap(gym.make("CartPole-v1"), tmp_path / "shard-01.mcap", append=True)
    with closing(env), pytest.raises(LogError, match="has an open recorder of"):
        mcaprl.record("CartPole-v1", tmp_path, policy="random", episodes=2, envs=2, overwrite=True)
    assert len(mcaprl.open(tmp_path).episodes) == 2


def test_a_request_that_cannot_be_logged_leaves_old_shards(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mcaprl.record("CartPole-v1", tmp_path / "shard-00.mcap", policy="random", episodes=1)
    before = (tmp_path / "shard-00.mcap").read_bytes()
    text = spaces.Text(3)
    env = ScriptedEnv(text, spaces.Discrete(2), [])
    monkeypatch.setattr(record_files, "make_limited", lambda sim, limit: env)
    with pytest.raises(SpaceError):
        mcaprl.record("Text-v0", tmp_path, policy="random", episodes=2, envs=2, overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == ["shard-00.mcap"]
    assert (tmp_path / "shard-00.mcap").read_bytes() == before
