"""Tests that a replaced file has its old or its new content, and that no other file remains."""

from __future__ import annotations

import json
import math
import os
import signal
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

from mcaprl.errors import LogError, Problem, ReportError, UsageError
from mcaprl.files import (
    TemporaryFolder,
    locked_folder,
    replacing,
    replacing_folder,
    temporary_folder,
    work_folder,
    write_atomically,
    write_json,
)
from mcaprl.storage import work_folders


def fail_halfway(path: Path) -> None:
    with replacing(path) as unfinished:
        unfinished.write_bytes(b"half")
        raise KeyError


def test_an_error_leaves_the_old_content(tmp_path: Path) -> None:
    path = tmp_path / "new" / "file.txt"
    write_atomically(path, b"old")
    with pytest.raises(KeyError):
        fail_halfway(path)
    assert path.read_bytes() == b"old"
    with replacing(path, concurrent=True) as unfinished:
        unfinished.write_bytes(b"new")
        assert path.read_bytes() == b"old"
    assert path.read_bytes() == b"new"
    assert list(path.parent.iterdir()) == [path]


def test_an_os_error_becomes_the_given_type(tmp_path: Path) -> None:
    taken = tmp_path / "taken"
    taken.touch()
    with pytest.raises(ReportError, match=r"cannot write .*taken/x"):
        write_json(taken / "x", {}, ReportError)
    with pytest.raises(OSError, match="taken"):
        write_json(taken / "x", {})


def test_json_has_null_where_a_number_is_not_finite(tmp_path: Path) -> None:
    write_json(tmp_path / "a.json", {"a": [math.nan, -math.inf, 1.5], 2: (True, None)})
    found = json.loads((tmp_path / "a.json").read_text(), parse_constant=pytest.fail)
    assert found == {"a": [None, None, 1.5], "2": [True, None]}


@pytest.mark.parametrize("write", [work_folder, locked_folder, replacing, replacing_folder])
def test_outputs_are_local(write: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with (
        pytest.raises(UsageError, match=r"s3://bucket/log.mcap is a URL, but outputs are local"),
        write(Path("s3://bucket/log.mcap")),
    ):
        pass
    assert not list(tmp_path.iterdir())


def test_a_problem_is_one_line() -> None:
    assert str(Problem("no end", "byte 3")) == "no end (byte 3)"
    whole = Problem("no end", "byte 3", "steps are lost", "recover it", "a.mcap")
    assert str(whole) == "a.mcap: no end (byte 3): steps are lost; recover it"
    assert set(whole.to_json()) == {"file", "what", "where", "next"}


needs_fork = pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")


@contextmanager
def forked(body: Callable[[], object]) -> Iterator[Callable[[], None]]:
    """Run a function in a forked process, which then waits; yield a function that kills it."""
    receiver, sender = os.pipe()
    pid = os.fork()
    if pid == 0:
        body()
        os.write(sender, b".")
        signal.pause()
    killed = []

    def kill() -> None:
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        killed.append(True)

    try:
        assert os.read(receiver, 1) == b"."
        yield kill
    finally:
        if not killed:
            kill()


@needs_fork
def test_leftovers_of_killed_writers_are_removed_by_other_writers(tmp_path: Path) -> None:
    """The work folders of living writers, and what other programs wrote, are kept."""
    left, other = tmp_path / ".left.json.part", tmp_path / ".other.json.part"
    other.mkdir()
    (other / "thesis.tex").touch()
    (tmp_path / ".link.part").symlink_to(other)
    opened = ExitStack()
    with forked(lambda: opened.enter_context(work_folder(tmp_path / "left.json"))) as kill:
        write_json(tmp_path / "a.json", {})
        assert left.exists()
        with pytest.raises(LogError, match=r"left.json is being written by another process"):
            write_json(tmp_path / "left.json", {})
        kill()
        # A process looks for leftovers once.
        write_json(tmp_path / "b.json", {})
        assert left.exists()
        work_folders._searched.clear()
        write_json(tmp_path / "c.json", {})
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        ".link.part",
        ".other.json.part",
        "a.json",
        "b.json",
        "c.json",
    ]
    assert [path.name for path in other.iterdir()] == ["thesis.tex"]


@needs_fork
def test_leftovers_of_killed_readers_are_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    (tmp_path / "mcaprl-other").mkdir()
    (tmp_path / "mcaprl-other" / "thesis.tex").touch()
    kept: list[Any] = []
    with forked(lambda: kept.append(TemporaryFolder())) as kill:
        (left,) = (path for path in tmp_path.iterdir() if path.name != "mcaprl-other")
        with temporary_folder() as folder:
            assert list(folder.iterdir()) == []
            assert left.exists()
        kill()
        work_folders._searched.clear()
        with temporary_folder():
            assert not left.exists()
    assert [path.name for path in tmp_path.iterdir()] == ["mcaprl-other"]


@needs_fork
def test_a_folder_that_was_being_replaced_is_restored(tmp_path: Path) -> None:
    """A process that is killed between the two moves of a replacement loses nothing."""
    path = tmp_path / "logs"
    path.mkdir()
    (path / "1.txt").write_text("old")

    def replace() -> None:
        rename = os.rename

        def rename_once(*names: Any) -> None:
            rename(*names)
            os.kill(os.getpid(), signal.SIGKILL)

        os.rename = rename_once  # type: ignore[assignment]
        with replacing_folder(path, overwrite=True) as folder:
            (folder / "1.txt").write_text("new")

    pid = os.fork()
    if pid == 0:
        replace()
    os.waitpid(pid, 0)
    assert not path.exists()
    write_json(tmp_path / "other.json", {})
    assert (path / "1.txt").read_text() == "old"
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["logs", "other.json"]


@needs_fork
def test_a_forked_process_keeps_no_lock_and_removes_nothing(tmp_path: Path) -> None:
    kept = ExitStack()
    folder = kept.enter_context(work_folder(tmp_path / "a.json"))
    kept.enter_context(locked_folder(tmp_path / "run"))

    def leave() -> None:
        kept.close()

    with forked(leave):
        assert folder.exists()
        assert (tmp_path / "run").exists()
        kept.close()
        # The child still runs, but has closed its copies of the locked folders.
        write_json(tmp_path / "a.json", {})
        with locked_folder(tmp_path / "run"):
            pass
