"""Damaged logs are neither copied nor appended to, so that no copy gives damage a valid CRC."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import gymnasium as gym
import pytest
from mcap.writer import Writer

import mcaprl
from mcaprl.errors import LogError
from mcaprl.recorder.record.wrapper import RecordMcap


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """Write a log with metadata of another program, an attachment, and uncompressed chunks."""
    plain, extra, path = tmp_path / "plain.mcap", tmp_path / "extra.mcap", tmp_path / "log.mcap"
    mcaprl.record("CartPole-v1", plain, policy="random", episodes=3, compression="none")
    with extra.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        writer.add_metadata("calibration", {"focal_px": "612.5"})
        writer.finish()
    mcaprl.merge([plain, extra], path)
    return path


EDITS: dict[str, Callable[[Path, Path], object]] = {
    "filter": lambda log, out: mcaprl.filter("length > 0", log, out / "log.mcap"),
    "split": lambda log, out: mcaprl.split(log, out / "parts", episodes=2),
    "slice": lambda log, out: mcaprl.slice(log, out / "log.mcap", steps=(0, 8)),
    "merge": lambda log, out: mcaprl.merge([log], out / "log.mcap"),
    "append": lambda log, out: RecordMcap(
        gym.make("CartPole-v1", max_episode_steps=5), log, append=True
    ),
}


@pytest.mark.parametrize("edit", EDITS)
@pytest.mark.parametrize("part", [b"612.5", b'"configById"', b"episode 1 begins"])
def test_damage_is_refused(log: Path, tmp_path: Path, edit: str, part: bytes) -> None:
    """The parts are in a metadata record, an attachment and a chunk."""
    content = bytearray(log.read_bytes())
    assert content.count(part) == 1, part
    content[content.find(part) + 1] ^= 1
    log.write_bytes(content)
    assert mcaprl.check(log).problems
    (tmp_path / "out").mkdir()
    with pytest.raises(LogError, match=r"does not match its CRC; run `mcaprl recover "):
        EDITS[edit](log, tmp_path / "out")
    assert log.read_bytes() == content
    assert not list((tmp_path / "out").iterdir())
