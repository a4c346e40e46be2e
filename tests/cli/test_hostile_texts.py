"""Texts in logs and file names cannot control the terminal, a figure or the program."""

from __future__ import annotations

import os
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

import mcaprl
from mcaprl.cli import run
from tests.support.damage.forged_logs import forged

EVIL = "\x1b[2J\x9b1m\u202e\r"


class Worded(gym.Env[Any, Any]):
    """Environment with episodes of one step and with given texts."""

    observation_space = spaces.Box(-1, 1, (2,), np.float32)
    action_space = spaces.Discrete(2)

    def __init__(self, word: str) -> None:
        self.action_meanings = (f"left {word}", f"right {word}")
        self.observation_names = (f"x {word}", f"y {word}")
        self._reason = f"crash {word}"

    def reset(self, **_: Any) -> tuple[Any, dict[str, Any]]:
        return np.zeros(2, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return np.ones(2, np.float32), 1.0, True, False, {"reason": self._reason}


def worded(path: Path, word: str) -> Path:
    with closing(mcaprl.RecordMcap(Worded(word), path, policy=f"policy {word}")) as env:
        for _ in range(3):
            env.reset(seed=1)
            env.step(1)
    return path


def is_harmless(text: str) -> bool:
    return not any(c in text for c in "\x1b\x9b\u202e\r\x07")


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_nothing_that_is_printed_controls_the_terminal(
    log_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name = f"log{EVIL}\n.mcap"
    worded(Path(name), EVIL)
    forged(Path("id.mcap"), env_id=f"Evil{EVIL}-v0")
    commands = [
        (0, ["info", name]),
        (0, ["info", name, "--json"]),
        (0, ["info", "id.mcap"]),
        (0, ["check", name]),
        (0, ["recover", name, f"out{EVIL}.mcap"]),
        (2, ["replay", name, "--verify"]),
        (2, ["replay", "id.mcap", "--verify"]),
        (1, ["info", f"missing{EVIL}"]),
        (2, [f"no such command{EVIL}"]),
    ]
    for code, command in commands:
        assert run(command) == code, command
        out, err = capsys.readouterr()
        assert is_harmless(out + err), command
        assert "[2J" in out + err or command[0] == "check", command


def test_a_file_name_cannot_forge_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    name = "log.mcap\n1 file checked, no problems"
    Path(name).write_bytes(b"no log")
    assert run(["check", name]) == 1
    assert len(capsys.readouterr().out.splitlines()) == 1


def test_reports_show_any_text(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib")
    for name in ("$\\bad$.mcap", "\udcff.mcap", "long.mcap"):
        word = "w" * 100_000 if name == "long.mcap" else r"$\bad$"
        worded(Path(name), word)
        assert run(["info", name, "--report", f"{name}-report"]) == 0, name
        capsys.readouterr()
        assert (Path(f"{name}-report") / "index.html").exists()


def test_a_loop_of_links_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    os.symlink("b.mcap", "a.mcap")
    os.symlink("a.mcap", "b.mcap")
    for command in (["info", "a.mcap"], ["check", "a.mcap"], ["replay", "a.mcap"]):
        assert run(command) == 1
        out, err = capsys.readouterr()
        assert (out + err).count("\n") == 1
        assert "symbolic links" in out + err
