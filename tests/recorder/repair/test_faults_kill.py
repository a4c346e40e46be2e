"""Recorders that are killed, interrupted or terminated at random times."""

from __future__ import annotations

import multiprocessing
import os
import random
import signal
import time
from multiprocessing.connection import Connection
from pathlib import Path

import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

import mcaprl
from mcaprl.errors import LogError, NoStepsError
from mcaprl.recorder.repair.check import check_log
from mcaprl.recorder.repair.recover import recover_log
from tests.support.damage.faults import KnownEpisodes, assert_is_known, count, play, tell

# The fork server has imported all modules, so that a new recorder starts immediately.
FORKS = multiprocessing.get_context("forkserver")
FORKS.set_forkserver_preload(["tests.support.damage.faults"])


def _record_for_ever(path: Path, finished: Connection, number: int) -> None:
    """Record episodes, and send a byte through the pipe after each finished episode."""
    if number != signal.SIGKILL:
        signal.signal(number, signal.default_int_handler)
    env = mcaprl.RecordMcap(KnownEpisodes(), path)
    try:
        while True:
            play(env)
            finished.send_bytes(b".")
    except KeyboardInterrupt:
        env.close()


def _stop_one(path: Path, number: signal.Signals, delay_s: float) -> int:
    """Send a signal to a recorder, and return the number of episodes that it has reported."""
    reported, telling = FORKS.Pipe(duplex=False)
    recorder = FORKS.Process(target=_record_for_ever, args=(path, telling, number))
    recorder.start()
    telling.close()
    try:
        assert reported.poll(60), "the recorder does not begin"
        time.sleep(delay_s)
        assert recorder.pid is not None
        os.kill(recorder.pid, number)
        recorder.join(60)
        assert recorder.exitcode is not None, "the recorder does not end"
    finally:
        recorder.kill()
        recorder.join()
    finished = 0
    while reported.poll():
        try:
            reported.recv_bytes()
        except (EOFError, OSError):
            break
        finished += 1
    return finished


def test_killed_recorders_lose_only_the_open_episode(tmp_path: Path) -> None:
    randoms, trials, kept, exact = random.Random(1), count(8, 200), 0, 0
    for trial in range(trials):
        path, out = tmp_path / f"{trial}.mcap", tmp_path / f"{trial}-out.mcap"
        finished = _stop_one(path, signal.SIGKILL, randoms.random() * 0.1)
        recovery = recover_log(path, out)
        data = mcaprl.open(out)
        # One more episode may have been written but not reported.
        assert finished <= len(data.episodes) <= finished + 1
        for number, episode in enumerate(data.episodes):
            assert episode.summary.episode == number
            assert_is_known(episode)
        assert check_log(out) == []
        with out.open("rb") as file:
            reader = make_reader(file, validate_crcs=True)
            assert sum(1 for _ in reader.iter_messages()) == recovery.messages
        # AnyReader takes half a second to start, so it reads only some of the logs.
        if trial % 8 == 0:
            with AnyReader([out]) as bag:
                assert sum(1 for _ in bag.messages()) == recovery.messages
        kept += len(data.episodes)
        exact += not recovery.has_losses
        path.unlink()
        out.unlink()
    tell(
        "recorders killed with SIGKILL",
        killed=trials,
        episodes_kept=kept,
        finished_episodes_lost=0,
        nothing_to_cut_off=exact,
    )


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_stopped_recorders_leave_whole_files(tmp_path: Path, number: signal.Signals) -> None:
    randoms, trials = random.Random(2), count(4, 100)
    for trial in range(trials):
        path = tmp_path / f"{trial}.mcap"
        finished = _stop_one(path, number, randoms.random() * 0.1)
        assert check_log(path) == []
        *whole, last = mcaprl.open(path).episodes
        assert len(whole) in (finished - 1, finished)
        for episode in whole:
            assert_is_known(episode)
        assert last.reason in ("terminated", "interrupted")
    tell(f"recorders stopped with {number.name}", stopped=trials, files_not_whole=0)


def test_killed_before_its_first_episode(tmp_path: Path) -> None:
    """`recover` reports that there is nothing to recover."""
    path = tmp_path / "log.mcap"
    env = mcaprl.RecordMcap(KnownEpisodes(), path)
    env.reset()
    env.step(0)
    begun = path.read_bytes()
    env.close()
    path.write_bytes(begun)
    with pytest.raises(NoStepsError):
        mcaprl.open(path)
    with pytest.raises(LogError):
        recover_log(path, tmp_path / "out.mcap")
