"""Tests of opening: weights of logs, and options for other data."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mcaprl
from mcaprl.cli import run
from mcaprl.errors import LogError, SpaceError, UsageError
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.source import logs_of, opened


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


def read(names: list[str]) -> Dataset:
    return opened(names, weighted=True)


def test_without_weights_all_logs_count_equally() -> None:
    dataset = read(["logs"])
    assert len(dataset.episodes) == 6
    assert dataset.weights.tolist() == [1] * 6


def test_each_episode_has_the_weight_of_its_log() -> None:
    dataset = read(["logs/b.mcap:2.5", "logs/a.mcap", "logs/c.mcap:0"])
    assert dataset.weights.tolist() == [2.5] * 3 + [1] * 2 + [0]
    assert [path.name for path in dataset.sources] == ["b.mcap", "a.mcap", "c.mcap"]
    assert dataset.env_id == "", "the logs do not agree on it"


def test_a_folder_or_a_glob_can_have_a_weight() -> None:
    assert read(["logs:3"]).weights.tolist() == [3] * 6
    assert read(["logs/[ab].mcap:3", "logs/c.mcap"]).weights.tolist() == [3] * 5 + [1]


def test_a_file_given_twice_is_read_once() -> None:
    assert len(read(["logs", "logs/a.mcap"]).episodes) == 6
    with pytest.raises(UsageError, match=r"a\.mcap is named twice, with weights 1 and 2"):
        read(["logs", "logs/a.mcap:2"])


def test_a_colon_in_a_file_name_is_not_a_weight() -> None:
    save(Path("logs/run:2"), 1, width=1)
    assert read(["logs/run:2"]).weights.tolist() == [1]


@pytest.mark.parametrize("weight", ["-1", "nan", "inf"])
def test_a_weight_is_a_number_of_at_least_zero(weight: str) -> None:
    with pytest.raises(UsageError, match="a weight must be a number of at least 0"):
        read([f"logs/a.mcap:{weight}"])


def test_a_missing_path_is_named_in_full() -> None:
    with pytest.raises(LogError, match=r"logs/d\.mcap:x: no such file"):
        read(["logs/d.mcap:x"])


def test_other_spaces_are_refused() -> None:
    save(Path("wide.mcap"), 1, width=2)
    with pytest.raises(SpaceError, match="differ in"):
        read(["logs", "wide.mcap"])


def test_the_command_accepts_weights(capsys: pytest.CaptureFixture[str]) -> None:
    small = ["--algo", "bc", "--updates", "5", "--hidden", "4", "--out", "run"]
    assert run(["train-offline", "logs/a.mcap:2", "logs/b.mcap", *small]) == 0
    assert "learning from 5 episodes, 20 transitions" in capsys.readouterr().out
    assert Path("run/curves.png").exists()
    assert run(["train-offline", "logs/a.mcap", "logs/b.mcap", "--out", "run", "--resume"]) == 1
    assert "other data" in capsys.readouterr().err
    again = ["train-offline", "logs/a.mcap", "--out", "run", "--resume", "--other-data"]
    assert run(again) == 0


def test_arguments_are_checked_before_the_data_are_read(
    capsys: pytest.CaptureFixture[str],
) -> None:
    bad = ["--follow", "--algo", "bc", "--alpha", "1", "--out", "run"]
    assert run(["train-offline", "none.mcap", *bad]) == 2
    assert "bc has no setting --alpha" in capsys.readouterr().err


def test_datasets_of_other_tools_and_urls_are_sources(tmp_path: Path) -> None:
    pytest.importorskip("fsspec", reason="needs the extra remote")
    log = tmp_path / "lane.mcap"
    mcaprl.record("lane", log, episodes=2)
    pytest.importorskip("pyarrow", reason="needs the extra tables")
    mcaprl.convert(log, tmp_path / "lane", to="parquet")
    names = [str(tmp_path / "lane"), f"file://{log}:2"]
    data = read(names)
    assert len(data.episodes) == 4
    # Logs come first.
    assert data.weights.tolist() == [2.0, 2.0, 1.0, 1.0]
    expected = mcaprl.open(log).fingerprint
    assert [read([name]).fingerprint for name in names] == [expected] * 2


def test_weights_belong_to_paths_and_stay_with_episodes() -> None:
    data = mcaprl.open(["logs/a.mcap", "logs/b.mcap"], weights=[2, 0.5])
    assert data.weights.tolist() == [2, 2, 0.5, 0.5, 0.5]
    assert data.grow() is data
    assert data.filter(lambda episode: episode.index in (1, 4)).weights.tolist() == [2, 0.5]
    first, second = data.split(0.4, seed=1)
    assert sorted([*first.weights, *second.weights]) == [0.5, 0.5, 0.5, 2, 2]
    chosen = mcaprl.open(["logs/a.mcap", "logs/b.mcap"], weights=[2, 0.5], episodes=[0, 2])
    assert chosen.weights.tolist() == [2, 0.5]
    assert data.fingerprint != mcaprl.open("logs/[ab].mcap").fingerprint
    with pytest.raises(UsageError, match="weights must be 2 numbers of at least 0, one for each"):
        mcaprl.open(["logs/a.mcap", "logs/b.mcap"], weights=[1])
    with pytest.raises(LogError, match=r"logs/a\.mcap:2: no such file"):
        mcaprl.open("logs/a.mcap:2")


def test_only_unchanged_logs_can_be_read_again_by_other_processes(tmp_path: Path) -> None:
    data = mcaprl.open(["logs/a.mcap", "logs/b.mcap"], weights=[2, 1])
    paths = [tmp_path / "logs" / name for name in ("a.mcap", "b.mcap")]
    assert logs_of(data) == dict(zip(paths, (2, 1), strict=True))
    assert logs_of(["logs/a.mcap:2", "logs/b.mcap"], weighted=True) == logs_of(data)
    parts = [mcaprl.open("logs/a.mcap"), mcaprl.open("logs/b.mcap")]
    assert list(logs_of(Dataset.concatenate(parts))) == paths
    for changed in (
        data.with_rewards(np.zeros(len(data))),
        data.with_weights(np.ones(5)),
        Dataset.concatenate([data, data.split(0.5)[0]]),
        mcaprl.open("logs", columns=[]),
        mcaprl.open("logs", episodes=0),
        mcaprl.open("logs", follow=True),
    ):
        with pytest.raises(UsageError, match="workers read logs: pass their paths"):
            logs_of(changed)


def test_info_and_check_of_datasets() -> None:
    data = mcaprl.open("logs")
    found = mcaprl.info(data)
    assert found.to_json() == mcaprl.info("logs").to_json()
    part = data.filter(lambda episode: episode.index < 2)
    assert (mcaprl.info(part).episodes, mcaprl.info(part).title) == (2, "logs/a.mcap and 2 more")
    with pytest.raises(UsageError, match="check reads files: pass the paths of the logs"):
        mcaprl.check(data)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"follow": True, "weights": [1]}, "finished logs, not for growing ones: weights"),
        ({"follow": True, "columns": []}, "finished logs, not for growing ones: columns"),
        ({"dones": "truncated"}, "datasets of other tools, not for logs: dones"),
        ({"format": "npz", "episodes": 1}, "logs, not for the format npz: episodes"),
        ({"format": "npz", "follow": True}, "logs, not for the format npz: follow"),
        ({"format": "npz", "images": "mapped"}, "logs and bags, not for the format npz: images"),
        ({"mapping": {}, "weights": [1], "columns": []}, "not for a mapping: columns, weights"),
    ],
)
def test_options_for_other_data_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError, match=f"these options are for .*{message}"):
        mcaprl.open("logs", **options)


def test_train_names_the_arguments_of_open(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"`mapping=` is an argument of mcaprl\.open"):
        mcaprl.train("logs/a.mcap", tmp_path / "run", mapping="map.yaml")
    assert not (tmp_path / "run").exists()
