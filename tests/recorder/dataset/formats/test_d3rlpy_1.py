"""Files of d3rlpy 1: flat arrays, in which `episode_terminals` marks the ends of episodes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

import mcaprl
from mcaprl.errors import SpaceError
from tests.recorder.dataset.formats.test_d3rlpy import PROGRAM
from tests.support.rivals import run_rivals

h5py = pytest.importorskip("h5py", reason="needs the extra interop")


def _write(
    path: Path, lengths: list[int], terminal: list[bool], *, is_discrete: bool, **changes: Any
) -> Path:
    """Write the arrays of `MDPDataset.dump` of d3rlpy 1; row k has observation k and reward k."""
    rows = np.arange(sum(lengths), dtype=np.float32)
    ends = np.zeros((2, len(rows)), np.float32)
    ends[0, np.cumsum(lengths) - 1] = terminal
    ends[1, np.cumsum(lengths) - 1] = 1
    arrays = {
        "observations": np.stack([rows, rows], axis=1),
        "actions": (rows % 2).astype(np.int32) if is_discrete else rows[:, None] / 4,
        "rewards": rows,
        "terminals": ends[0],
        "episode_terminals": ends[1],
        "discrete_action": is_discrete,
        "create_mask": False,
        "mask_size": 1,
        "version": "1.0",
    } | changes
    with h5py.File(path, "w") as file:
        for name, values in arrays.items():
            file[name] = values
    return path


@pytest.mark.parametrize("format", [None, "d3rlpy", "hdf5"])
def test_the_last_row_of_an_episode_without_terminal_is_an_observation(
    tmp_path: Path, format: str | None
) -> None:
    path = _write(tmp_path / "cartpole.h5", [3, 4, 2], [True, False, True], is_discrete=True)
    message = "last observation of 2 terminated .*last steps of 1 episode"
    with pytest.warns(UserWarning, match=message):
        found = mcaprl.open(path, format=format)
    assert found.episode_lengths.tolist() == [3, 3, 2]
    assert found.frames[:, 0].tolist() == [0, 1, 2, 2, 3, 4, 5, 6, 7, 8, 8]
    assert found.rewards.tolist() == [0, 1, 2, 3, 4, 5, 7, 8]
    assert found.actions.tolist() == [0, 1, 0, 1, 0, 1, 1, 0]
    assert np.flatnonzero(found.terminated).tolist() == [2, 7]
    assert np.flatnonzero(found.truncated).tolist() == [5]
    assert found.action_space == spaces.Discrete(2)


def test_a_file_of_truncated_episodes_has_all_of_them(tmp_path: Path) -> None:
    path = _write(tmp_path / "pendulum.h5", [199] * 500, [False] * 500, is_discrete=False)
    with pytest.warns(UserWarning, match="last steps of 500 episodes"):
        found = mcaprl.open(path)
    assert found.episode_lengths.tolist() == [198] * 500
    assert found.action_space == spaces.Box(-np.inf, np.inf, (1,), np.float32)


def test_actions_are_discrete_if_the_file_says_so(tmp_path: Path) -> None:
    actions = np.array([[0.0], [3.0]])
    arguments: Any = tmp_path / "a.h5", [2], [True]
    _write(*arguments, is_discrete=True, actions=actions)
    with pytest.warns(UserWarning, match="no next_observations"):
        assert mcaprl.open(tmp_path / "a.h5").action_space == spaces.Discrete(4)
    _write(*arguments, is_discrete=False, actions=np.array([0, 3]))
    with pytest.warns(UserWarning, match="no next_observations"):
        assert mcaprl.open(tmp_path / "a.h5").actions.shape == (2, 1)
    _write(*arguments, is_discrete=True, actions=actions + 0.5)
    with pytest.raises(SpaceError, match=r"a\.h5: actions is float64 and cannot be .*row 0 is 0.5"):
        mcaprl.open(tmp_path / "a.h5")


def test_images_get_their_channels_last(tmp_path: Path) -> None:
    images = np.arange(2 * 3 * 9 * 8).reshape(2, 3, 9, 8).astype(np.uint8)
    _write(tmp_path / "a.h5", [2], [True], is_discrete=True, observations=images)
    with pytest.warns(UserWarning, match="no next_observations"):
        found = mcaprl.open(tmp_path / "a.h5")
    np.testing.assert_array_equal(found.observations, np.moveaxis(images, 1, -1))


def test_d3rlpy_reads_the_same_transitions(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    lengths = rng.integers(2, 30, 40).tolist()
    terminal = (rng.random(40) < 0.7).tolist()
    for is_discrete in (False, True):
        path = _write(tmp_path / "a.h5", lengths, terminal, is_discrete=is_discrete)
        run_rivals(PROGRAM, "load_v1", path, tmp_path / "theirs.npz")
        with pytest.warns(UserWarning, match="no next_observations"):
            found = mcaprl.open(path)
        with np.load(tmp_path / "theirs.npz") as theirs:
            assert theirs["lengths"].tolist() == found.episode_lengths.tolist()
            np.testing.assert_array_equal(theirs["observation"], found.observations)
            np.testing.assert_array_equal(theirs["action"].ravel(), found.actions.ravel())
            np.testing.assert_array_equal(theirs["reward"].ravel(), found.rewards)
            np.testing.assert_array_equal(theirs["terminal"], found.terminated)
            # d3rlpy's next observation after a terminal state is zero.
            kept = ~found.terminated
            ours = found.next_observations[kept]
            np.testing.assert_array_equal(theirs["next_observation"][kept], ours)
