"""NumPy archives: ours are read back unchanged, and others are read by the usual array names."""

from __future__ import annotations

import zipfile
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
from tests.recorder.dataset.formats.minari_sets import Cameras
from tests.support.transitions import same_transitions


def _two_episodes() -> Dataset:
    """Return an episode of two steps with action probabilities, and one step without them."""
    space = spaces.Dict(
        {"pose": spaces.Dict({"x": spaces.Box(-9, 9, (2,), np.float32)}), "a b": spaces.Discrete(5)}
    )
    metadata = LogMetadata(space, spaces.Discrete(4), env_id="Toy-v0", policy="pid", seed="4")
    first = EpisodeArrays(
        observations={
            "pose": {"x": np.array([[0, 1], [2, 3], [4, 5]], np.float32)},
            "a b": np.array([0, 1, 4]),
        },
        actions=np.array([2, 0]),
        rewards=np.array([0.1, -1]),
        terminated=True,
        truncated=True,
        behavior_probs=np.array([0.5, np.nan], np.float32),
        times_ns=np.array([10, 20, 35]),
        infos={"lap": np.ma.MaskedArray([7, 8, 9])},
        summary={"reason": "crash", "seed": 2**63 - 1, "policy": "pid", "options": "{}"},
    )
    second = EpisodeArrays(
        observations={"pose": {"x": np.ones((2, 2), np.float32)}, "a b": np.array([3, 3])},
        actions=np.array([1]),
        rewards=np.array([-0.0]),
        terminated=False,
        truncated=False,
        times_ns=np.array([40, 41]),
        infos={"lap": np.ma.MaskedArray([0, 1])},
    )
    return dataset_of([first, second], metadata, "test")


def test_what_an_archive_has_no_place_for_is_said(tmp_path: Path) -> None:
    data = _two_episodes()
    assert data.to_npz(tmp_path / "toy.npz") == [
        "npz has no place for spaces, environment, policy names, seeds and reset options,"
        " end reasons, other metadata: a log keeps them"
    ]
    found = Dataset.from_npz(tmp_path / "toy.npz")
    same_transitions(found, data)
    assert found.action_space == spaces.Discrete(3)
    assert found.infos["lap"].tolist() == [7, 8, 9, 0, 1]
    times = [episode.log_time_ns.tolist() for episode in found.episodes]
    assert times == [[10, 20, 35], [40, 41]]
    assert mcaprl.open(tmp_path / "toy.npz").sources == (tmp_path / "toy.npz",)


def test_numpy_reads_the_arrays_by_their_usual_names(tmp_path: Path) -> None:
    _two_episodes().to_npz(tmp_path / "toy.npz")
    with np.load(tmp_path / "toy.npz", allow_pickle=False) as arrays:
        assert arrays["observations/pose/x"].tolist() == [[0, 1], [2, 3], [1, 1]]
        assert arrays["final_observations/pose/x"].tolist() == [[4, 5], [1, 1]]
        assert arrays["observations/a b"].tolist() == [0, 1, 3]
        assert arrays["actions"].tolist() == [2, 0, 1]
        assert arrays["terminations"].tolist() == [False, True, False]
        assert arrays["episode_lengths"].tolist() == [2, 1]
        assert arrays["infos/lap"].tolist() == [7, 8, 9, 0, 1]


def test_images_are_read_from_disk_block_by_block(tmp_path: Path) -> None:
    env = mcaprl.RecordMcap(Cameras(), tmp_path / "log.mcap", compression="none")
    for seed in range(2):
        env.reset(seed=seed)
        for _ in range(5):
            env.step(np.array([0, 1]))
    env.close()
    log = mcaprl.open(tmp_path / "log.mcap", images="mapped")
    assert "on disk" in log.storage
    log.to_npz(tmp_path / "log.npz")
    same_transitions(mcaprl.open(tmp_path / "log.npz"), log)
    # Writing the same data again creates a file with the same bytes.
    log.to_npz(tmp_path / "again.npz")
    assert (tmp_path / "again.npz").read_bytes() == (tmp_path / "log.npz").read_bytes()


@pytest.mark.parametrize("terminated", ["terminals", "terminations", "terminated"])
@pytest.mark.parametrize("truncated", ["timeouts", "truncations", "truncated", None])
def test_archives_of_others_are_read(
    tmp_path: Path, terminated: str, truncated: str | None
) -> None:
    observations = np.array([[0.0], [1], [5], [6]], np.float32)
    arrays: dict[str, Any] = {
        "observations": observations,
        "next_observations": observations + 1,
        "actions": np.array([1, 0, 2, 1]),
        "rewards": np.array([[1], [2], [3], [4]], np.float32),
        terminated: np.array([0, 0, 0, 1], np.uint8),
    }
    if truncated is not None:
        arrays[truncated] = np.array([[0], [1], [0], [0]], bool)
    np.savez(tmp_path / "their.npz", **arrays)
    found = mcaprl.open(tmp_path / "their.npz")
    # The first episode ends where the next observation differs from the following observation, even
    # if there is no flag.
    assert found.episode_lengths.tolist() == [2, 2]
    assert found.truncated.tolist() == [False, truncated is not None, False, False]
    assert found.terminated.tolist() == [False, False, False, True]
    assert found.frames.tolist() == [[0], [1], [2], [5], [6], [7]]
    assert (found.action_space, found.rewards.tolist()) == (spaces.Discrete(3), [1, 2, 3, 4])


def test_without_next_observations_the_last_step_is_left_out_unless_terminal(
    tmp_path: Path,
) -> None:
    arrays: dict[str, Any] = {
        "observations/x": np.arange(7.0)[:, None],
        "observations/arm/y": np.arange(7),
        "actions": np.arange(14, dtype=np.float32).reshape(7, 2),
        "rewards": np.arange(7.0),
        "terminals": np.array([0, 0, 1, 0, 0, 0, 0], bool),
        "timeouts": np.array([0, 0, 0, 0, 1, 0, 0], bool),
    }
    np.savez_compressed(tmp_path / "their.npz", **arrays)
    message = "observation of 1 terminated episode is repeated .*, and the last steps of 2 episodes"
    with pytest.warns(UserWarning, match=message):
        found = mcaprl.open(tmp_path / "their.npz")
    assert found.episode_lengths.tolist() == [3, 1, 1]
    assert found.frames["x"].ravel().tolist() == [0, 1, 2, 2, 3, 4, 5, 6]
    assert found.frames["arm"]["y"].tolist() == [0, 1, 2, 2, 3, 4, 5, 6]
    assert found.rewards.tolist() == [0, 1, 2, 3, 5]
    assert found.actions.tolist() == [[0, 1], [2, 3], [4, 5], [6, 7], [10, 11]]
    assert np.flatnonzero(found.terminated).tolist() == [2]
    assert np.flatnonzero(found.truncated).tolist() == [3]


@pytest.mark.filterwarnings("ignore:Implicitly cleaning up")
def _usual(**changes: Any) -> dict[str, Any]:
    arrays = {
        "observations": np.zeros((2, 3)),
        "next_observations": np.zeros((2, 3)),
        "actions": np.zeros(2, np.int64),
        "rewards": np.zeros(2),
        "terminals": np.zeros(2, bool),
        **changes,
    }
    return {name: values for name, values in arrays.items() if values is not None}


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"rewards": None, "terminals": None}, LogError, "no rewards, terminals or terminations"),
        ({"terminations": np.zeros(2)}, LogError, "both terminals and terminations"),
        ({"actions": np.zeros(3, np.int64)}, SpaceError, r"actions has shape \(3,\)"),
        ({"actions": np.zeros(3, int), "next_observations": None}, SpaceError, "3 actions"),
        (
            {"observations": np.array([["a"], ["b"]])},
            SpaceError,
            "observations has dtype <U1.*row 0 is 'a'",
        ),
        ({"rewards": np.array([object(), None])}, LogError, "not a readable .npz"),
        ({"terminals": np.array([0.5, 0])}, SpaceError, "terminals are not flags: row 0 is 0.5"),
    ],
)
def test_other_arrays_are_refused_by_name(
    tmp_path: Path, changes: dict[str, Any], error: type[Exception], message: str
) -> None:
    np.savez(tmp_path / "odd.npz", **_usual(**changes))
    with pytest.raises(error, match=message) as caught:
        mcaprl.open(tmp_path / "odd.npz")
    assert "odd.npz" in str(caught.value)


def test_damaged_archives_give_one_clear_line(tmp_path: Path) -> None:
    path = tmp_path / "toy.npz"
    _two_episodes().to_npz(path)
    whole = path.read_bytes()
    with np.load(path) as archive:
        arrays = dict(archive)

    def fails(message: str) -> None:
        with pytest.raises(LogError, match=message) as caught:
            mcaprl.open(path)
        assert "\n" not in str(caught.value)

    path.write_bytes(whole[:-30])
    fails("not a readable .npz file")
    path.write_bytes(b"")
    fails("not a readable .npz file")
    with path.open("wb") as file:
        np.save(file, np.zeros(3))
    fails("not a readable .npz file: File is not a zip file")
    np.savez(path, **{**arrays, "episode_lengths": arrays["episode_lengths"][:1]})
    fails("episode_lengths")
    with zipfile.ZipFile(path, "w") as archive_file:
        # The header declares an array of 8 PB, but the file has only a few bytes.
        header = "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000000,), }"
        data = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode()
        archive_file.writestr("rewards.npy", data)
    fails("not a readable .npz file")
