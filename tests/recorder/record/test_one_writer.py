"""A file has one writer and any number of readers, and a failed command leaves it unchanged."""

from __future__ import annotations

import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mcaprl
from mcaprl.cli import run
from mcaprl.errors import LogError, McaprlError, OutputExistsError
from mcaprl.files import replacing, write_atomically
from mcaprl.recorder.columns import salvage
from mcaprl.recorder.columns.reader import McapReader
from mcaprl.recorder.columns.records import MAGIC, crc32
from mcaprl.recorder.repair.check import check_log
from mcaprl.recorder.repair.recover import recover_log
from tests.support.damage.faults import KnownEpisodes, assert_is_known, play, write_log
from tests.support.paths import ROOT


@pytest.fixture
def log_path(tmp_path: Path) -> Path:
    return tmp_path / "log.mcap"


def record_to(path: Path) -> None:
    mcaprl.RecordMcap(KnownEpisodes(), path, overwrite=True).close()


def rotate_to(path: Path) -> None:
    mcaprl.RecordMcap(KnownEpisodes(), path, overwrite=True, max_file_bytes=1000).close()


def save_to(path: Path) -> None:
    source = path.parent / "source.mcap"
    write_log(source, 2)
    mcaprl.open(source).save(path, overwrite=True)


def recover_to(path: Path) -> None:
    source = path.parent / "source.mcap"
    write_log(source, 2)
    mcaprl.recover(source, path, overwrite=True)


def annotate_to(path: Path) -> None:
    source = path.parent / "lane.mcap"
    mcaprl.record("lane", source, episodes=1, scene=False)
    mcaprl.annotate(source, path, scene=True, overwrite=True)


WRITERS = [record_to, save_to, recover_to, annotate_to]


@pytest.mark.parametrize("write", WRITERS)
@pytest.mark.parametrize("kind", ["link", "fifo", "folder", "device"])
def test_only_regular_files_are_replaced(
    tmp_path: Path, write: Callable[[Path], None], kind: str
) -> None:
    target, other = tmp_path / "target.mcap", tmp_path / "other.mcap"
    other.write_bytes(b"kept")
    match kind:
        case "link":
            target.symlink_to(other)
        case "fifo":
            os.mkfifo(target)
        case "folder":
            target.mkdir()
        case "device":
            target = Path("/dev/null")
            if not os.access("/dev", os.W_OK):
                pytest.skip("/dev is not writable: the device could not be replaced anyway")
    before = target.lstat()
    if kind == "device":
        with pytest.raises(OutputExistsError, match="not a regular file"):
            write_atomically(target, b"")
    else:
        with pytest.raises(OutputExistsError, match=r"symbolic link|not a regular file"):
            write(target)
    after = target.lstat()
    assert (after.st_mode, after.st_ino) == (before.st_mode, before.st_ino)
    assert other.read_bytes() == b"kept"


@pytest.mark.parametrize("write", [*WRITERS, rotate_to])
def test_a_log_that_is_being_recorded_is_not_replaced(
    tmp_path: Path, write: Callable[[Path], None]
) -> None:
    target = tmp_path / "target.mcap"
    options: dict[str, Any] = {"max_file_bytes": 10**9} if write is rotate_to else {}
    recorded = tmp_path / "target-00000.mcap" if options else target
    with closing(mcaprl.RecordMcap(KnownEpisodes(), target, **options)) as env:
        play(env)
        inode = recorded.stat().st_ino
        with pytest.raises(LogError, match="this program has an open recorder of"):
            write(target)
        assert recorded.stat().st_ino == inode
        play(env)
    assert check_log(recorded) == []
    assert len(mcaprl.open(recorded)) > 0
    assert len(mcaprl.open(recorded).episodes) == 2


def test_a_refused_annotation_leaves_its_target(tmp_path: Path) -> None:
    plain, once, out = (tmp_path / name for name in ("plain.mcap", "once.mcap", "out.mcap"))
    mcaprl.record("lane", plain, episodes=1, scene=False)
    mcaprl.annotate(plain, once, scene=True)
    out.write_bytes(b"precious")
    wrong = tmp_path / "known.mcap"
    write_log(wrong, 1)
    for source, arguments in (
        (once, ["--scene"]),
        (plain, ["--scene", "--sim", "racer"]),
        (wrong, ["--scene", "--sim", "lane"]),
        (plain, ["--policy", str(tmp_path / "missing")]),
    ):
        command = ["annotate", str(source), *arguments, "--out", str(out), "--overwrite"]
        assert run(command) != 0
        assert out.read_bytes() == b"precious"
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "known.mcap",
        "once.mcap",
        "out.mcap",
        "plain.mcap",
    ]


def test_a_log_can_be_annotated_in_place(tmp_path: Path) -> None:
    log = tmp_path / "log.mcap"
    mcaprl.record("lane", log, episodes=1, scene=False)
    before = mcaprl.open(log)
    mcaprl.annotate(log, log, scene=True, overwrite=True)
    assert mcaprl.open(log).fingerprint == before.fingerprint
    assert "/scene" in {channel.topic for channel in McapReader(log).channels.values()}
    assert check_log(log) == []


def _compete(path: Path, barrier: Any, results: Any) -> None:
    barrier.wait()
    try:
        with closing(mcaprl.RecordMcap(KnownEpisodes(), path, overwrite=True)) as env:
            play(env)
            # Wait until the other recorder has tried to open the file.
            barrier.wait()
            results.put(
                path.stat().st_ino == os.fstat(env._recording.log.mcap._file.fileno()).st_ino
            )
    except McaprlError as error:
        results.put(str(error))
        barrier.wait()


@pytest.mark.parametrize("exists", [False, True])
def test_one_of_two_simultaneous_recorders_is_refused(log_path: Path, exists: bool) -> None:
    context = multiprocessing.get_context("fork")
    for _ in range(6):
        log_path.unlink(missing_ok=True)
        if exists:
            log_path.write_bytes(b"old")
        barrier, results = context.Barrier(2), context.Queue()
        both = [
            context.Process(target=_compete, args=(log_path, barrier, results)) for _ in range(2)
        ]
        for process in both:
            process.start()
        found = [results.get(timeout=60) for _ in both]
        for process in both:
            process.join(60)
        recorded = [result for result in found if result is True]
        refused = [result for result in found if isinstance(result, str)]
        assert len(recorded) == len(refused) == 1, found
        assert "is being written by another" in refused[0]
        assert check_log(log_path) == []


@pytest.mark.parametrize("overwrite", [False, True])
def test_one_of_two_recoveries_to_the_same_file_is_refused(tmp_path: Path, overwrite: bool) -> None:
    source, out = tmp_path / "source.mcap", tmp_path / "out.mcap"
    write_log(source, 3)
    if overwrite:
        out.write_bytes(b"old")
    with replacing(out, LogError, overwrite=overwrite) as unfinished:
        with pytest.raises(LogError, match="is being written by another"):
            recover_log(source, out, overwrite=overwrite)
        shutil.copy(source, unfinished)
    assert check_log(out) == []


def test_a_file_that_appears_meanwhile_is_not_replaced(tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    with pytest.raises(OutputExistsError):
        _write_beside(out, lambda: out.write_bytes(b"other"), overwrite=False)
    assert out.read_bytes() == b"other"
    recorders = []
    with pytest.raises(LogError, match="this program has an open recorder of"):
        _write_beside(out, lambda: recorders.append(_recorder_of(out)), overwrite=True)
    recorders[0].close()
    assert check_log(out) == []


def _write_beside(out: Path, other: Callable[[], Any], *, overwrite: bool) -> None:
    with replacing(out, LogError, overwrite=overwrite) as unfinished:
        unfinished.write_bytes(b"new")
        other()


def _recorder_of(path: Path) -> mcaprl.RecordMcap:
    path.unlink()
    env = mcaprl.RecordMcap(KnownEpisodes(), path)
    play(env)
    return env


def test_leftovers_of_killed_writers_are_removed(tmp_path: Path) -> None:
    out = tmp_path / ("x" * 245 + ".mcap")
    for overwrite in (False, True):
        pid = os.fork()
        if pid == 0:
            with replacing(out, LogError, overwrite=overwrite) as unfinished:
                unfinished.write_bytes(b"half")
                (unfinished.parent / "more").mkdir()
                os._exit(0)
        os.waitpid(pid, 0)
        assert [path.suffix for path in tmp_path.iterdir() if path != out] == [".part"]
        with replacing(out, LogError, overwrite=overwrite) as unfinished:
            assert list(unfinished.parent.iterdir()) == []
            unfinished.write_bytes(b"whole")
        assert [path.name for path in tmp_path.iterdir()] == [out.name]
    assert out.read_bytes() == b"whole"


_RECORD_AND_DIE = """
import os, signal, sys
from pathlib import Path
import mcaprl
from mcaprl.errors import McaprlError
from tests.support.damage.faults import KnownEpisodes, play
env = mcaprl.RecordMcap(KnownEpisodes(), Path(sys.argv[1]))
play(env)
play(env)
pid = os.fork()
if pid == 0:
    print(os.getpid(), flush=True)
    try:
        play(env)
    except McaprlError as error:
        print(error, flush=True)
    signal.pause()
os.read(0, 1)
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_killed_recorder_whose_child_lives_locks_nothing(log_path: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-c", _RECORD_AND_DIE, str(log_path)]
    with subprocess.Popen(
        command, cwd=ROOT, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        child, refusal = int(process.stdout.readline()), process.stdout.readline()
        try:
            with pytest.raises(LogError, match="is being written by another"):
                mcaprl.RecordMcap(KnownEpisodes(), log_path, append=True)
            process.stdin.write(".")
            process.stdin.flush()
            process.wait(60)
            assert "is closed; record to another file" in refusal
            assert recover_log(log_path, tmp_path / "out.mcap").episodes == 2
            with pytest.warns(UserWarning, match="cut off|still being written"):
                assert len(mcaprl.open(log_path).episodes) == 2
            mcaprl.RecordMcap(KnownEpisodes(), tmp_path / "out.mcap", append=True).close()
            mcaprl.RecordMcap(KnownEpisodes(), log_path, overwrite=True).close()
        finally:
            os.kill(child, signal.SIGKILL)


def test_appending_keeps_what_readers_have_mapped(log_path: Path) -> None:
    write_log(log_path, 3)
    reader = McapReader(log_path)
    before = bytes(reader.view)
    with closing(mcaprl.RecordMcap(KnownEpisodes(), log_path, append=True)) as env:
        env.reset()
        assert len(mcaprl.open(log_path).episodes) == 3
    assert bytes(reader.view) == before
    channel = reader.channel_of("/rl/step")
    assert channel is not None
    assert len(list(reader.messages(channel))) > 0
    assert check_log(log_path) == []


@pytest.mark.filterwarnings("ignore:.*is still being written")
def test_readers_beside_a_recorder_that_appends(log_path: Path) -> None:
    """A reader that opens the log reads whole episodes; no error or signal interrupts it."""
    write_log(log_path, 1)
    stop, errors, seen = threading.Event(), [], []

    def read() -> None:
        while not stop.is_set():
            try:
                episodes = mcaprl.open(log_path).episodes
                assert_is_known(episodes[0])
                seen.append(len(episodes))
            except Exception as error:
                errors.append(error)
                return

    reader = threading.Thread(target=read)
    reader.start()
    known = KnownEpisodes()
    for number in range(1, 30):
        known.episode = number - 1
        with closing(mcaprl.RecordMcap(known, log_path, append=True)) as env:
            play(env)
    stop.set()
    reader.join()
    assert errors == []
    assert seen == sorted(seen)
    assert seen


@pytest.mark.parametrize("images", ["memory", "mapped"])
@pytest.mark.parametrize("change", ["truncate", "copy"])
def test_a_log_that_is_changed_in_place_is_one_error(
    tmp_path: Path, images: Any, change: str
) -> None:
    path, other = tmp_path / "a.mcap", tmp_path / "b.mcap"
    write_log(path, 3, compression="none")
    write_log(other, 3, compression="none")
    data = mcaprl.open(path, images=images)
    reader = McapReader(path)
    first = np.asarray(data.observations["picture"][:4])
    os.utime(path, ns=(0, 0))
    if change == "truncate":
        os.truncate(path, 5000)
    else:
        with path.open("r+b") as file:
            file.write(other.read_bytes())
    channel = reader.channel_of("/rl/step")
    assert channel is not None
    with pytest.raises(LogError, match="changed by another program"):
        list(reader.messages(channel))
    if images == "memory":
        assert np.array_equal(data.observations["picture"][:4], first)
    else:
        with pytest.raises(LogError, match="changed by another program"):
            data.observations["picture"][:4]


def test_reading_a_fifo_is_refused(tmp_path: Path) -> None:
    fifo = tmp_path / "fifo.mcap"
    os.mkfifo(fifo)
    for command in (
        ["info", str(fifo)],
        ["check", str(fifo)],
        ["recover", str(fifo), str(tmp_path / "out.mcap")],
        ["layout", str(fifo), "--out", str(tmp_path / "layout.json")],
        ["train-offline", str(fifo), "--out", str(tmp_path / "run")],
    ):
        assert run(command) == 1


def test_chunks_with_equal_crcs_are_different_chunks(
    log_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a long log, some chunks have equal lengths and CRCs by chance."""
    write_log(log_path, 60)
    # The CRC of the data section, which begins with the file, stays as it is.
    monkeypatch.setattr(
        salvage, "crc32", lambda data: crc32(data) if bytes(data[:8]) == MAGIC else 0
    )
    recovery = recover_log(log_path, log_path.with_name("out.mcap"))
    assert recovery.problems == []
    assert recovery.episodes == 60
