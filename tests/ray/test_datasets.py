"""Tests of logs that are read as datasets of Ray Data and written from them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import mcaprl
import mcaprl.ray
from mcaprl.errors import (
    LogError,
    NoEpisodesError,
    OutputExistsError,
    SpaceError,
    UnknownNameError,
    UsageError,
)
from mcaprl.recorder.dataset.log_reader import Selection
from mcaprl.recorder.repair.check import check_log
from tests.support.damage.faults import KnownEpisodes, write_log
from tests.support.paths import GOLDEN

pytestmark = pytest.mark.usefixtures("ray_cluster")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record two logs of 5 and 3 episodes, with Dict observations of vectors and images."""
    path = tmp_path_factory.mktemp("logs")
    write_log(path / "a.mcap", 5)
    write_log(path / "b.mcap", 3)
    return path


@pytest.fixture(scope="module")
def cartpole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("logs") / "cartpole.mcap"
    mcaprl.record("CartPole-v1", path, policy="random", episodes=20, seed=5)
    return path


def columns_of(rows: Any) -> dict[str, Any]:
    """Return all rows as arrays by column, sorted by episode and step."""
    parts = list(rows.iter_batches(batch_size=None, batch_format="numpy"))
    found = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    order = np.lexsort((found["step"], found["episode"]))
    return {name: values[order] for name, values in found.items()}


def assert_same(found: Any, expected: Any) -> None:
    assert (found.dtype, found.shape) == (expected.dtype, expected.shape)
    assert found.tobytes() == expected.tobytes()


def test_columns_are_those_of_the_dataset(folder: Path) -> None:
    data, rows = mcaprl.open(folder), mcaprl.ray.read(folder)
    assert rows.count() == len(data)
    found = columns_of(rows)
    assert set(found) == set(data.to_arrow(tensors="lists").column_names)
    for name in ("x", "picture"):
        assert_same(found[f"observation_{name}"], data.observations[name])
        assert_same(found[f"next_observation_{name}"], data.next_observations[name])
    for name, values in {
        "action": data.actions,
        "reward": data.rewards,
        "terminated": data.terminated,
        "truncated": data.truncated,
        "behavior_prob": data.behavior_probs,
        "episode": np.repeat(np.arange(8), data.episode_lengths),
        "log_time_ns": np.concatenate([e.log_time_ns[:-1] for e in data.episodes]),
    }.items():
        assert_same(found[name], values)


def test_blocks_have_whole_episodes_of_one_log(folder: Path) -> None:
    rows = mcaprl.ray.read(folder, override_num_blocks=4)
    blocks = [block["episode"] for block in rows.iter_batches(batch_size=None)]
    assert len(blocks) >= 4
    every = [set(block.tolist()) for block in blocks]
    assert sum(map(len, every)) == 8
    assert set.union(*every) == set(range(8))
    assert not any(min(one) < 5 <= max(one) for one in every)


def test_selected_columns_and_episodes_alone_are_read(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from mcaprl.ray import blocks

    data = mcaprl.open(folder)
    rows = mcaprl.ray.read(folder, columns=["reward", "step", "episode"], episodes=[6, 1, -1])
    found = columns_of(rows)
    assert set(found) == {"reward", "step", "episode"}
    assert sorted(set(found["episode"].tolist())) == [1, 6, 7]
    assert_same(found["reward"], np.concatenate([data.episodes[k].rewards for k in (1, 6, 7)]))
    seen: list[Any] = []

    def select(**given: Any) -> Selection:
        seen.append(given)
        return Selection(**given)

    monkeypatch.setattr(blocks, "Selection", select)
    blocks._reader.cache_clear()
    every = blocks.LogSource([folder / "a.mcap"])
    for names in (["action"], ["next_observation_x", "step"]):
        (task,) = every.apply_projection({name: name for name in names}).get_read_tasks(1)
        (block,) = task()
        assert block.column_names == names
    assert seen == [{"columns": ()}, {"columns": ("x",)}]


def test_columns_selected_later_are_pushed_down(folder: Path) -> None:
    rows = mcaprl.ray.read(folder).select_columns(["action"])
    assert next(iter(rows.iter_batches(batch_size=None))).keys() == {"action"}
    assert "Project" not in str(rows.materialize().stats())


def test_sizes_come_from_the_summaries(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from mcaprl.ray.blocks import LogSource

    data = mcaprl.open(folder)
    monkeypatch.setattr("mcaprl.recorder.dataset.log_reader.LogReader.read", None)
    source = LogSource([folder / "a.mcap", folder / "b.mcap"])
    # A row has 46 bytes without observations: 8 each for `episode`, `step`, `log_time_ns` and
    # `reward`, 1 for each flag, 4 for `behavior_prob`, and 8 for the action. Each of its two
    # observations has a vector of 12 bytes and an image of 64 bytes.
    assert source.estimate_inmemory_data_size() == (46 + 2 * 76) * len(data)
    tasks = source.get_read_tasks(-1)
    assert sum(task.metadata.num_rows for task in tasks) == len(data)
    assert sum(task.metadata.size_bytes for task in tasks) == (46 + 2 * 76) * len(data)
    assert {file for task in tasks for file in task.metadata.input_files} == {
        str(folder / "a.mcap"),
        str(folder / "b.mcap"),
    }


def test_only_blocks_of_one_episode_exceed_the_maximum(folder: Path) -> None:
    from mcaprl.ray.blocks import LogSource

    # The episodes of the log have 5, 12, 19, 26 and 33 transitions of 198 bytes.
    source = LogSource([folder / "a.mcap"], most_bytes=198 * 32)
    assert [group.rows for group in source.groups] == [17, 19, 26, 33]
    blocks = [block for task in source.get_read_tasks(1) for block in task()]
    assert [len(block) for block in blocks] == [17, 19, 26, 33]
    assert [len(group.episodes) for group in LogSource([folder / "a.mcap"]).groups] == [5]
    some = LogSource([folder / "a.mcap"], episodes=slice(1, 4), blocks=2)
    assert [group.rows for group in some.groups] == [12, 19, 26]


def test_tensors_reach_torch_batches(cartpole: Path) -> None:
    torch = pytest.importorskip("torch")
    rows = mcaprl.ray.read(cartpole, columns=["observation", "action"])
    batch = next(iter(rows.iter_torch_batches(batch_size=8)))
    assert (batch["observation"].shape, batch["observation"].dtype) == ((8, 4), torch.float32)


def test_logs_at_urls_are_read(cartpole: Path) -> None:
    pytest.importorskip("fsspec")
    found = columns_of(mcaprl.ray.read(f"file://{cartpole}"))
    assert_same(found["observation"], mcaprl.open(cartpole).observations)


def test_written_logs_have_the_same_transitions(cartpole: Path, tmp_path: Path) -> None:
    data = mcaprl.open(cartpole)
    rows = mcaprl.ray.read(cartpole, override_num_blocks=3)
    manifest = mcaprl.ray.write(rows, tmp_path / "out")
    assert manifest == tmp_path / "out" / "manifest.json"
    again = mcaprl.open(manifest)
    assert len(again.sources) == rows.materialize().num_blocks() >= 3
    assert again.fingerprint == data.fingerprint
    assert again.env_id == "CartPole-v1"
    assert again.behavior_probs.tobytes() == data.behavior_probs.tobytes()
    for path in again.sources:
        assert check_log(path) == []
    files = {path.name for path in again.sources} | {"manifest.json"}
    assert {path.name for path in (tmp_path / "out").iterdir()} == files


def test_logs_of_commands_keep_their_densities(tmp_path: Path) -> None:
    data = mcaprl.open(GOLDEN / "densities.mcap")
    rows = mcaprl.ray.read(GOLDEN / "densities.mcap")
    assert_same(columns_of(rows)["behavior_log_prob"], data.behavior_log_probs)
    mcaprl.ray.write(rows, tmp_path / "out")
    again = mcaprl.open(tmp_path / "out")
    assert again.fingerprint == data.fingerprint
    assert again.action_labels == data.action_labels


def test_changed_and_filtered_rows_are_written(folder: Path, tmp_path: Path) -> None:
    data = mcaprl.open(folder)

    def double(batch: dict[str, Any]) -> dict[str, Any]:
        keep = batch["episode"] % 2 == 0
        batch = {name: values[keep] for name, values in batch.items()}
        return {**batch, "reward": 2 * batch["reward"]}

    rows = mcaprl.ray.read(folder).map_batches(double, batch_size=None)
    mcaprl.ray.write(rows, tmp_path / "out", like=folder)
    again = mcaprl.open(tmp_path / "out")
    kept = data.filter(lambda episode: episode.index % 2 == 0)
    assert again.rewards.tobytes() == (2 * kept.rewards).tobytes()
    assert again.frames["picture"].tobytes() == kept.frames["picture"].tobytes()


def test_rows_are_written_to_urls(cartpole: Path, tmp_path: Path) -> None:
    pytest.importorskip("fsspec")
    url = f"file://{tmp_path}/out"
    assert mcaprl.ray.write(mcaprl.ray.read(cartpole), url) == f"{url}/manifest.json"
    again = mcaprl.open(f"{url}/manifest.json")
    assert again.fingerprint == mcaprl.open(cartpole).fingerprint


def test_episodes_in_parts_are_refused_and_can_be_joined(cartpole: Path, tmp_path: Path) -> None:
    rows = mcaprl.ray.read(cartpole, override_num_blocks=1).repartition(7)
    with pytest.raises(SpaceError, match=r"episode \d+ is not whole .* keys=\[\"episode\"\]"):
        mcaprl.ray.write(rows, tmp_path / "out", like=cartpole)
    assert list((tmp_path / "out").glob("*")) == []
    joined = rows.repartition(2, keys=["episode"])
    mcaprl.ray.write(joined, tmp_path / "out", like=cartpole)
    again, data = mcaprl.open(tmp_path / "out"), mcaprl.open(cartpole)
    lengths = sorted(again.episode_lengths.tolist())
    assert lengths == sorted(data.episode_lengths.tolist())


def test_rows_that_are_no_episodes_are_one_error(cartpole: Path, tmp_path: Path) -> None:
    rows = mcaprl.ray.read(cartpole)
    with pytest.raises(SpaceError, match="no column next_observation"):
        mcaprl.ray.write(rows.drop_columns(["next_observation"]), tmp_path / "a", like=cartpole)

    def shift(batch: dict[str, Any]) -> dict[str, Any]:
        return {**batch, "observation": batch["observation"] + 1}

    changed = rows.map_batches(shift, batch_size=None)
    with pytest.raises(SpaceError, match="change both columns in the same way"):
        mcaprl.ray.write(changed, tmp_path / "b", like=cartpole)
    (tmp_path / "c").mkdir()
    (tmp_path / "c" / "x.mcap").touch()
    with pytest.raises(OutputExistsError, match="new folder"):
        mcaprl.ray.write(rows, tmp_path / "c")


def test_names_and_numbers_that_do_not_exist(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="did you mean reward"):
        mcaprl.ray.read(folder, columns=["rewards"])
    with pytest.raises(UsageError, match="no episode 8"):
        mcaprl.ray.read(folder, episodes=[8])
    with pytest.raises(LogError, match="no such file"):
        mcaprl.ray.read(tmp_path / "none.mcap")
    env = mcaprl.RecordMcap(gym.make("CartPole-v1"), tmp_path / "empty.mcap")
    env.close()
    with pytest.raises(NoEpisodesError):
        mcaprl.ray.read(tmp_path / "empty.mcap")
    with pytest.warns(UserWarning, match=r"empty\.mcap has no finished episode: skipped"):
        rows = mcaprl.ray.read([tmp_path / "empty.mcap", folder / "a.mcap"])
    assert rows.count() == 95
    env = mcaprl.RecordMcap(gym.make("CartPole-v1"), tmp_path / "other.mcap")
    env.reset(seed=0)
    env.step(0)
    env.close()
    with pytest.raises(SpaceError, match=r"other\.mcap differs in observation_space"):
        mcaprl.ray.read([folder / "a.mcap", tmp_path / "other.mcap"])
    assert KnownEpisodes().observation_space != gym.make("CartPole-v1").observation_space
