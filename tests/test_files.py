"""Tests that a replaced file has its old or its new content, and that no other file remains."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest

from mcaprl.errors import ReportError, UsageError
from mcaprl.files import (
    locked_folder,
    replacing,
    replacing_folder,
    work_folder,
    write_atomically,
    write_json,
)
from mcaprl.problem import Problem


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
