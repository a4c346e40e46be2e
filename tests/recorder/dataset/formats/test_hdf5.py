"""HDF5 files: written and read in D4RL's form, and read in robomimic's form."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

import mcaprl
from mcaprl import Dataset
from mcaprl.errors import LogError, SpaceError
from mcaprl.recorder.dataset.formats.columns import EpisodeArrays, dataset_of
from mcaprl.recorder.format.metadata import LogMetadata

h5py = pytest.importorskip("h5py", reason="needs the extra interop")


def _two_episodes() -> Dataset:
    """Return a terminated episode of two steps, and an episode of one step without an end flag."""
    metadata = LogMetadata(
        spaces.Box(-9, 9, (2,), np.float32), spaces.Box(-1, 1, (1,), np.float32), env_id="Toy-v0"
    )
    first = EpisodeArrays(
        observations=np.array([[0, 1], [2, 3], [4, 5]], np.float32),
        actions=np.array([[0.5], [-1]], np.float32),
        rewards=np.array([0.1, 2]),
        terminated=True,
        truncated=False,
        behavior_log_probs=np.array([2.5, np.nan], np.float32),
        times_ns=np.array([10, 20, 35]),
        summary={"reason": "goal", "seed": 3, "policy": "pid", "options": '{"x": 1}'},
    )
    second = EpisodeArrays(
        observations=np.array([[6, 7], [8, 9]], np.float32),
        actions=np.zeros((1, 1), np.float32),
        rewards=np.array([3]),
        terminated=False,
        truncated=False,
        times_ns=np.array([40, 41]),
    )
    return dataset_of([first, second], metadata, "test")


def _write(path: Path, arrays: dict[str, Any]) -> Path:
    with h5py.File(path, "w") as file:
        for name, values in arrays.items():
            file[name] = values
    return path


def test_what_d4rl_has_no_place_for_is_said(tmp_path: Path) -> None:
    data = _two_episodes()
    assert data.to_hdf5(tmp_path / "toy.hdf5") == [
        "1 episode without an end flag: a timeout is written at the end",
        "hdf5 has no place for spaces, times, environment, policy names, seeds and reset options,"
        " end reasons: a log keeps them",
    ]
    found = Dataset.from_hdf5(tmp_path / "toy.hdf5")
    assert found.episode_lengths.tolist() == [2, 1]
    assert found.frames.tolist() == data.frames.tolist()
    assert found.terminated.tolist() == [False, True, False]
    assert found.truncated.tolist() == [False, False, True]
    np.testing.assert_array_equal(found.behavior_log_probs, [2.5, np.nan, np.nan])
    assert found.actions.tolist() == [[0.5], [-1], [0]]


def test_the_arrays_are_those_of_d4rl(tmp_path: Path) -> None:
    _two_episodes().to_hdf5(tmp_path / "toy.hdf5")
    with h5py.File(tmp_path / "toy.hdf5") as file:
        assert file["observations"][()].tolist() == [[0, 1], [2, 3], [6, 7]]
        assert file["next_observations"][()].tolist() == [[2, 3], [4, 5], [8, 9]]
        assert file["actions"].shape == (3, 1)
        assert file["rewards"][()].tolist() == [0.1, 2, 3]
        assert file["terminals"][()].tolist() == [False, True, False]
        assert file["timeouts"][()].tolist() == [False, False, True]
        assert set(file) == {
            *("observations", "next_observations", "actions", "rewards", "terminals", "timeouts"),
            "behavior_log_probs",
        }


def test_dict_observations_are_refused_or_written_by_key(tmp_path: Path) -> None:
    arrays: dict[str, Any] = {"a/b": np.arange(2.0), "c": np.arange(2)}
    data = Dataset.from_arrays(
        observations=arrays,
        next_observations=arrays,
        actions=np.array([0, 1]),
        rewards=np.zeros(2),
        terminated=[True, True],
        truncated=[False, False],
    )
    with pytest.raises(SpaceError, match=r"a Dict observation.*`lossy=True`"):
        data.to_hdf5(tmp_path / "toy.hdf5")
    assert not (tmp_path / "toy.hdf5").exists()
    sentence, _ = data.to_hdf5(tmp_path / "toy.hdf5", lossy=True)
    assert "one array for each key" in sentence
    with h5py.File(tmp_path / "toy.hdf5") as file:
        assert file["observations/a_b"][()].tolist() == [0, 1]
    found = mcaprl.open(tmp_path / "toy.hdf5")
    assert found.frames["a_b"].tolist() == data.frames["a/b"].tolist()


def test_a_file_of_d4rl_without_next_observations(tmp_path: Path) -> None:
    path = _write(
        tmp_path / "maze.hdf5",
        {
            "observations": np.arange(6, dtype=np.float32)[:, None],
            "actions": np.zeros((6, 2), np.float32),
            "rewards": np.arange(6, dtype=np.float32),
            "terminals": np.array([0, 1, 0, 0, 0, 0], bool),
            "timeouts": np.array([0, 0, 0, 1, 0, 1], bool),
            "infos/qpos": np.zeros((6, 3)),
            "metadata/algorithm": "SAC",
        },
    )
    message = "no next_observations: the last observation of 1 term.*last steps of 2"
    with pytest.warns(UserWarning, match=message):
        found = mcaprl.open(path)
    assert found.episode_lengths.tolist() == [2, 1, 1]
    assert found.frames.ravel().tolist() == [0, 1, 1, 2, 3, 4, 5]
    assert found.rewards.tolist() == [0, 1, 2, 4]
    assert found.truncated.tolist() == [False, False, True, True]


def _demos(path: Path, *, next_obs: bool = True) -> Path:
    """Write three demonstrations; the demonstration with number 10 is the last."""
    with h5py.File(path, "w") as file:
        for number, count, done in ((10, 2, 0), (0, 3, 1), (2, 1, 1)):
            rows = np.arange(count + 1, dtype=np.float64)[:, None] + 100 * number
            images = np.broadcast_to(rows[:, :, None, None], (count + 1, 9, 8, 3)).astype(np.uint8)
            demo = file.create_group(f"data/demo_{number}")
            demo.attrs["num_samples"] = count
            demo["obs/eef"], demo["obs/front"] = rows[:-1], images[:-1]
            if next_obs:
                demo["next_obs/eef"], demo["next_obs/front"] = rows[1:], images[1:]
            demo["actions"] = np.full((count, 7), number, np.float64)
            demo["rewards"] = np.arange(count, dtype=np.float64)
            demo["dones"] = np.array([0] * (count - 1) + [done])
        file["data"].attrs["env_args"] = '{"env_name": "Lift"}'
        file["mask/train"] = np.array([b"demo_0"])
    return path


def test_demonstrations_of_robomimic_are_read_in_order(tmp_path: Path) -> None:
    found = mcaprl.open(_demos(tmp_path / "lift.hdf5"))
    assert found.episode_lengths.tolist() == [3, 1, 2]
    assert found.frames["eef"].ravel().tolist() == [0, 1, 2, 3, 200, 201, 1000, 1001, 1002]
    assert found.frames["front"].shape == (9, 9, 8, 3)
    assert found.frames["front"][3].max() == 3
    assert found.actions[:, 0].tolist() == [0, 0, 0, 2, 10, 10]
    assert np.flatnonzero(found.terminated).tolist() == [2, 3]
    assert np.flatnonzero(found.truncated).tolist() == [5]


def test_demonstrations_without_next_obs(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match=r"also used as next observation, and .*is left out"):
        found = mcaprl.open(_demos(tmp_path / "lift.hdf5", next_obs=False))
    assert found.episode_lengths.tolist() == [3, 1, 1]
    assert found.frames["eef"].ravel().tolist() == [0, 1, 2, 2, 200, 200, 1000, 1001]
    assert np.flatnonzero(found.truncated).tolist() == [4]


def test_demonstrations_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    path = _demos(tmp_path / "lift.hdf5")
    with h5py.File(path, "a") as file:
        file["data/demo_0/dones"][0] = 1
    with pytest.warns(UserWarning, match="dones before the last step"):
        mcaprl.open(path)
    with h5py.File(path, "a") as file:
        file["data/demo_10/next_obs/eef"][0] = 7
    with pytest.raises(LogError, match="demo_10/eef: next_obs is not the observation of"):
        mcaprl.open(path)
    with h5py.File(path, "a") as file:
        del file["data/demo_0/obs"]
    with pytest.raises(LogError, match="demo_0 has no observations: extract them"):
        mcaprl.open(path)


def test_other_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "odd.hdf5"
    with pytest.raises(LogError, match="no observations, actions, rewards, terminals or"):
        mcaprl.open(_write(path, {"x": np.zeros(3)}))
    with pytest.raises(LogError, match="the group data has no demo_0"):
        mcaprl.open(_write(path, {"data/x": np.zeros(3)}))
    with pytest.raises(LogError, match="part of a Minari dataset"):
        mcaprl.open(_write(path, {"episode_0/rewards": np.zeros(3)}))
    arrays = {"observations": np.zeros((2, 1)), "actions": np.zeros((3, 1))}
    ends = {"rewards": np.zeros(2), "terminals": np.zeros(2, bool)}
    with pytest.raises(SpaceError, match="3 actions, but 2 rewards"):
        mcaprl.open(_write(path, {**arrays, **ends}))
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(LogError, match="not a readable HDF5 file"):
        mcaprl.open(path)
