"""Recorders that a program does not close."""

from __future__ import annotations

import gc
import subprocess
import sys
from pathlib import Path

import pytest

import mcaprl
from mcaprl.recorder.record.session import FinishesAtExit
from mcaprl.recorder.repair.check import check_log

SINGLE = """
import os, sys
import gymnasium as gym
import mcaprl

def record(seed=0):
    env = mcaprl.RecordMcap(gym.make("CartPole-v1"), "log.mcap")
    env.reset(seed=seed)
    for _ in range(2):
        while not env.step(0)[2]:
            pass
        env.reset()
    for _ in range(3):
        env.step(1)
    return env
"""
VECTOR = """
import os, sys
import gymnasium as gym
import numpy as np
import mcaprl

def record():
    env = mcaprl.RecordVecMcap(gym.make_vec("CartPole-v1", 2), "log.mcap")
    env.reset(seed=0)
    while env.episodes < 2:
        env.step(np.zeros(2, int))
    return env
"""


def run(code: str, folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True)


@pytest.mark.parametrize("recording", [SINGLE, VECTOR])
@pytest.mark.parametrize(
    "end",
    ["env = record()", "record()", "env = record()\nenv.self = env", "env = record()\nsys.exit(3)"],
)
def test_the_log_of_a_script_that_ends_without_close_is_complete(
    recording: str, end: str, tmp_path: Path
) -> None:
    done = run(recording + end, tmp_path)
    assert done.stderr == ""
    assert check_log(tmp_path / "log.mcap") == []
    episodes = mcaprl.open(tmp_path / "log.mcap").episodes
    assert [episode.reason for episode in episodes[:2]] == ["terminated"] * 2
    if recording == SINGLE:
        assert [(len(one), one.reason) for one in episodes[2:]] == [(3, "interrupted")]


def test_an_error_of_the_script_leaves_a_complete_log(tmp_path: Path) -> None:
    done = run(SINGLE + "env = record()\n1 / 0", tmp_path)
    assert "ZeroDivisionError" in done.stderr
    assert check_log(tmp_path / "log.mcap") == []
    assert len(mcaprl.open(tmp_path / "log.mcap").episodes) == 3


def test_a_forked_process_does_not_finish_the_log(tmp_path: Path) -> None:
    fork = """env = record()
if os.fork() == 0:
    sys.exit()
os.wait()
for _ in range(4):
    env.step(1)
"""
    done = run(SINGLE + fork, tmp_path)
    assert done.stderr == ""
    assert check_log(tmp_path / "log.mcap") == []
    assert len(mcaprl.open(tmp_path / "log.mcap").episodes[2]) == 7


def test_a_recorder_that_was_not_created_has_nothing_to_finish(tmp_path: Path) -> None:
    (tmp_path / "log.mcap").touch()
    done = run(SINGLE + "record()", tmp_path)
    assert done.stderr.splitlines()[-1].startswith("mcaprl.errors.OutputExistsError")
    assert "Exception ignored" not in done.stderr


def test_an_error_in_the_constructor_leaves_the_environment_open() -> None:
    deleted: list[str] = []

    class Wrapper:
        def __del__(self) -> None:
            deleted.append("environment")

    class Recorder(FinishesAtExit, Wrapper):
        def __init__(self, fails: bool) -> None:
            if fails:
                raise ValueError
            self._watch()

        def _finish(self) -> None:
            deleted.append("log")

    with pytest.raises(ValueError, match=r"^$"):
        Recorder(fails=True)
    gc.collect()
    assert deleted == []
    Recorder(fails=False)
    gc.collect()
    assert deleted == ["log", "environment"]
