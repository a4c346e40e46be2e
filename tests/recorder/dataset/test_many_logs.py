"""Tests of reading more logs than a process may have open files."""

from __future__ import annotations

import gc
import os
import shutil
import subprocess
import sys
from pathlib import Path

import mcaprl
from tests.support.paths import GOLDEN

LOGS, OPEN_FILES = 120, 100
LANE_LOG = GOLDEN / "lane-1.mcap"
READ = f"""
import resource
import mcaprl

resource.setrlimit(resource.RLIMIT_NOFILE, ({OPEN_FILES}, {OPEN_FILES}))
one = len(mcaprl.open("logs/0.mcap").episodes)
assert len(mcaprl.open("logs").episodes) == {LOGS} * one
assert len(mcaprl.open("logs", episodes=[0, {LOGS} * one - 1]).episodes) == 2
assert mcaprl.check("logs").ok
"""


def open_files() -> set[str]:
    folder = Path("/proc/self/fd")
    return {os.readlink(link) for link in folder.iterdir() if link.is_symlink()}


def test_a_folder_may_have_more_logs_than_files_may_be_open(tmp_path: Path) -> None:
    (tmp_path / "logs").mkdir()
    for number in range(LOGS):
        shutil.copy(LANE_LOG, tmp_path / "logs" / f"{number}.mcap")
    done = subprocess.run(
        [sys.executable, "-c", READ], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_a_log_that_was_read_is_closed_without_the_garbage_collector() -> None:
    gc.collect()
    gc.disable()
    try:
        data = mcaprl.open(LANE_LOG)
        assert len(data)
        assert str(LANE_LOG) not in open_files()
    finally:
        gc.enable()
