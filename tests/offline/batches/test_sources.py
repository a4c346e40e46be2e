"""Tests of several logs that are read with a weight for each log."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import mcaprl
from mcaprl.cli import run
from mcaprl.errors import LogError, SpaceError, UsageError
from mcaprl.offline.batches.sources import open_weighted
from mcaprl.recorder.dataset.dataset import Dataset


@pytest.fixture(autouse=True)
def logs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Record logs a, b and c with 2, 3 and 1 episodes in different environments."""
    monkeypatch.chdir(tmp_path)
    for name, episodes in (("a", 2), ("b", 3), ("c", 1)):
        save(Path(f"logs/{name}.mcap"), episodes, width=1)


def save(path: Path, episodes: int, width: int) -> None:
    path.parent.mkdir(exist_ok=True)
    observations = np.zeros((4 * episodes, width), np.float32)
    Dataset.from_arrays(
        observations=observations,
        actions=np.arange(4 * episodes) % 2,
        rewards=np.ones(4 * episodes),
        terminated=np.arange(4 * episodes) % 4 == 3,
        truncated=np.zeros(4 * episodes, bool),
        next_observations=observations,
        env_id=f"Made-{path.stem}-v0",
    ).save(path)


def test_without_weights_all_logs_count_equally() -> None:
    dataset, weights = open_weighted(["logs"])
    assert len(dataset.episodes) == 6
    assert weights.tolist() == [1] * 6


def test_each_episode_has_the_weight_of_its_log() -> None:
    dataset, weights = open_weighted(["logs/b.mcap:2.5", "logs/a.mcap", "logs/c.mcap:0"])
    assert weights.tolist() == [2.5] * 3 + [1] * 2 + [0]
    assert [path.name for path in dataset.sources] == ["b.mcap", "a.mcap", "c.mcap"]
    assert dataset.env_id == "", "the logs do not agree on it"


def test_a_folder_or_a_glob_can_have_a_weight() -> None:
    assert open_weighted(["logs:3"])[1].tolist() == [3] * 6
    assert open_weighted(["logs/[ab].mcap:3", "logs/c.mcap"])[1].tolist() == [3] * 5 + [1]


def test_a_file_given_twice_is_read_once() -> None:
    assert len(open_weighted(["logs", "logs/a.mcap"])[0].episodes) == 6
    with pytest.raises(UsageError, match=r"a\.mcap is named twice, with weights 1 and 2"):
        open_weighted(["logs", "logs/a.mcap:2"])


def test_a_colon_in_a_file_name_is_not_a_weight() -> None:
    save(Path("logs/run:2"), 1, width=1)
    assert open_weighted(["logs/run:2"])[1].tolist() == [1]


@pytest.mark.parametrize("weight", ["-1", "nan", "inf"])
def test_a_weight_is_a_number_of_at_least_zero(weight: str) -> None:
    with pytest.raises(UsageError, match="a weight must be a number of at least 0"):
        open_weighted([f"logs/a.mcap:{weight}"])


def test_a_missing_path_is_named_in_full() -> None:
    with pytest.raises(LogError, match=r"logs/d\.mcap:x: no such file"):
        open_weighted(["logs/d.mcap:x"])


def test_other_spaces_are_refused() -> None:
    save(Path("wide.mcap"), 1, width=2)
    with pytest.raises(SpaceError, match="differ in"):
        open_weighted(["logs", "wide.mcap"])


def test_the_command_accepts_weights(capsys: pytest.CaptureFixture[str]) -> None:
    small = ["--algo", "bc", "--updates", "5", "--hidden", "4", "--out", "run"]
    assert run(["train-offline", "logs/a.mcap:2", "logs/b.mcap", *small]) == 0
    assert "learns from 5 episodes, 20 transitions" in capsys.readouterr().out
    assert Path("run/curves.png").exists()
    assert run(["train-offline", "logs/a.mcap", "logs/b.mcap", "--out", "run", "--resume"]) == 1
    assert "other data" in capsys.readouterr().err
    again = ["train-offline", "logs/a.mcap", "--out", "run", "--resume", "--other-data"]
    assert run(again) == 0


def test_datasets_of_other_tools_and_urls_are_sources(tmp_path: Path) -> None:
    pytest.importorskip("fsspec", reason="needs the extra remote")
    pytest.importorskip("pyarrow", reason="needs the extra tables")
    log = tmp_path / "lane.mcap"
    mcaprl.record("lane", log, episodes=2)
    mcaprl.convert(log, tmp_path / "lane", to="parquet")
    names = [str(tmp_path / "lane"), f"file://{log}:2"]
    data, weights = open_weighted(names)
    assert len(data.episodes) == 4
    assert weights.tolist() == [1.0, 1.0, 2.0, 2.0]
    expected = mcaprl.open(log).fingerprint
    assert [open_weighted([name])[0].fingerprint for name in names] == [expected] * 2
