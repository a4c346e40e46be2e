"""d3rlpy's files and replay buffers: written and read back here, and read by d3rlpy."""

from __future__ import annotations

import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import assume, given, settings
from numpy.typing import NDArray

import mcaprl
from mcaprl import Dataset
from mcaprl.errors import LogError, MissingExtraError, SpaceError, UsageError
from mcaprl.recorder.dataset.format_registry import FORMATS, write_format
from mcaprl.recorder.dataset.formats.columns import EpisodeArrays, dataset_of
from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.format.spaces import leaves_of
from tests.support.recordings import assert_same_bits
from tests.support.rivals import run_rivals
from tests.support.strategies import transitions
from tests.support.transitions import is_plain

h5py = pytest.importorskip("h5py", reason="needs the extra interop")

PROGRAM = Path(__file__).with_name("run_d3rlpy.py")
_SPACE = spaces.Dict(
    {
        "camera": spaces.Box(0, 255, (8, 9, 3), np.uint8),
        "gray": spaces.Box(0, 255, (9, 8), np.uint8),
        "state": spaces.Box(-np.inf, np.inf, (2, 2), np.float32),
    }
)


def _vectors() -> Dataset:
    """Return a terminated episode with observations 0 to 3 and a truncated one with 10 to 12."""
    metadata = LogMetadata(
        spaces.Box(-np.inf, np.inf, (2,), np.float32), spaces.Discrete(4), env_id="Line-v0"
    )
    first = EpisodeArrays(
        observations=np.array([[0, 0.5], [1, 0.5], [2, 0.5], [3, 0.5]], np.float32),
        actions=np.array([0, 1, 2]),
        rewards=np.array([0, 0.5, 1]),
        terminated=True,
        truncated=False,
        behavior_probs=np.array([0.25, np.nan, 1], np.float32),
        times_ns=np.array([5, 6, 7, 9]),
        infos={
            "speed": np.ma.MaskedArray([0, 1.5, 2, 0], [True, False, False, True]),
            "lap": np.ma.MaskedArray([7, 8, 9, 9]),
            "why": np.ma.MaskedArray(["", "", "", "wall"], [True, True, True, False]),
        },
        summary={"reason": "goal", "seed": 3},
    )
    second = EpisodeArrays(
        observations=np.array([[10, 0.5], [11, 0.5], [12, 0.5]], np.float32),
        actions=np.array([0, 1]),
        rewards=np.array([0, 0.5]),
        terminated=False,
        truncated=True,
        times_ns=np.array([20, 21, 23]),
        summary={"reason": "time", "options": '{"track": 2}'},
    )
    return dataset_of([first, second], metadata, "test")


def _images() -> Dataset:
    """Return a truncated episode of two transitions, with images whose pixels all differ."""

    def rows(shape: tuple[int, ...], dtype: Any) -> NDArray[Any]:
        return np.arange(3 * np.prod(shape)).reshape(3, *shape).astype(dtype)

    episode = EpisodeArrays(
        observations={
            "camera": rows((8, 9, 3), np.uint8),
            "gray": rows((9, 8), np.uint8),
            "state": rows((2, 2), np.float32),
        },
        actions=np.array([[0.25, -1], [0, 1]], np.float32),
        rewards=np.array([1, 2]),
        terminated=False,
        truncated=True,
    )
    metadata = LogMetadata(_SPACE, spaces.Box(-1, 1, (2,), np.float32))
    return dataset_of([episode], metadata, "test")


def _write(dataset: Dataset, path: Path, **options: Any) -> None:
    mcaprl.convert(_saved(dataset, path.with_suffix(".mcap")), path, to="d3rlpy", **options)


def _saved(dataset: Dataset, path: Path) -> Path:
    dataset.save(path, overwrite=True)
    return path


def test_what_d3rlpy_has_no_place_for_is_said(tmp_path: Path) -> None:
    assert write_format(_vectors(), tmp_path / "out.h5", FORMATS["d3rlpy"]) == [
        "d3rlpy has no place for spaces, times, environment, behavior_prob, seeds and reset"
        " options, end reasons, infos, final observations after a termination: a log keeps them"
    ]


def test_negative_integers_are_a_box(tmp_path: Path) -> None:
    dataset = Dataset.from_arrays(
        observations=np.zeros((2, 1), np.float32),
        next_observations=np.zeros((2, 1), np.float32),
        actions=np.array([[-128], [5]], np.int8),
        rewards=np.array([0.0, 1.0]),
        terminated=np.array([False, True]),
        truncated=np.array([False, False]),
        action_space=spaces.Box(-128, 127, (1,), np.int8),
    )
    _write(dataset, tmp_path / "out.h5", lossy=True)
    found = mcaprl.open(tmp_path / "out.h5")
    assert isinstance(found.action_space, spaces.Box)
    assert found.actions.tolist() == [[-128], [5]]


@settings(max_examples=40)
@given(transitions())
def test_all_transitions_come_back(arguments: dict[str, Any]) -> None:
    dataset = Dataset.from_arrays(**arguments)
    assume(is_plain(dataset))
    with TemporaryDirectory() as folder:
        log = _saved(dataset, Path(folder) / "log.mcap")
        mcaprl.convert(log, Path(folder) / "out.h5", to="d3rlpy", lossy=True)
        found = mcaprl.open(Path(folder) / "out.h5")
    assert found.episode_lengths.tolist() == dataset.episode_lengths.tolist()
    np.testing.assert_array_equal(found.rewards, dataset.rewards)
    assert found.terminated.tolist() == dataset.terminated.tolist()
    assert_same_bits(
        found.actions.reshape(-1), dataset.actions.astype(found.actions.dtype).reshape(-1)
    )
    mine, theirs = leaves_of(found.observation_space), leaves_of(dataset.observation_space)
    for leaf, other in zip(mine, theirs, strict=True):
        steps, rows = leaf.of(found.frames)[found.frame_of_step], other.of(dataset.frames)
        assert_same_bits(np.sort(steps.ravel()), np.sort(rows[dataset.frame_of_step].ravel()))


def test_the_layout_of_the_file(tmp_path: Path) -> None:
    _write(_vectors(), tmp_path / "out.h5")
    with h5py.File(tmp_path / "out.h5") as file:
        assert file["version"][()] == b"2.1"
        assert file["num_episodes"][()] == 2
        assert file["columns"][()].tolist() == [
            b"observations",
            b"actions",
            b"rewards",
            b"terminated",
        ]
        # The terminated episode has one step per transition. The truncated episode also has a step
        # for its final observation.
        assert file["observations_0"][:, 0].tolist() == [0, 1, 2]
        assert file["observations_1"][:, 0].tolist() == [10, 11, 12]
        assert file["actions_1"][()].tolist() == [[0], [1], [0]]
        assert file["rewards_1"][()].tolist() == [[0], [0.5], [0]]
        assert [bool(file[f"terminated_{k}"][()]) for k in range(2)] == [True, False]


def test_a_terminal_observation_is_repeated(tmp_path: Path) -> None:
    _write(_vectors(), tmp_path / "out.h5")
    found = mcaprl.open(tmp_path / "out.h5")
    assert found.frames[:, 0].tolist() == [0, 1, 2, 2, 10, 11, 12]
    assert found.actions.tolist() == [0, 1, 2, 0, 1]
    assert found.action_space == spaces.Discrete(3)
    assert found.terminated.tolist() == [False, False, True, False, False]
    assert found.truncated.tolist() == [False, False, False, False, True]


def test_images_and_several_arrays_are_read(tmp_path: Path) -> None:
    dataset = _images()
    lost = write_format(dataset, tmp_path / "out.h5", FORMATS["d3rlpy"])
    assert lost[:2] == [
        "the keys camera, gray, state of the observations become numbers",
        "observation_state of shape (2, 2) becomes a vector",
    ]
    with h5py.File(tmp_path / "out.h5", "r+") as file:
        assert file["observations_0_0"].shape == (3, 3, 8, 9)
        assert file["observations_0_1"].shape == (3, 1, 9, 8)
    found = mcaprl.open(tmp_path / "out.h5")
    np.testing.assert_array_equal(found.frames["0"], dataset.frames["camera"])
    np.testing.assert_array_equal(found.frames["1"][..., 0], dataset.frames["gray"])
    assert found.frames["2"].tolist() == [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9, 10, 11]]
    np.testing.assert_array_equal(found.actions, dataset.actions)


def test_episodes_that_are_not_counted_are_named(tmp_path: Path) -> None:
    _write(_vectors(), tmp_path / "out.h5")
    with h5py.File(tmp_path / "out.h5", "r+") as file:
        file["num_episodes"][()] = 1
    with pytest.warns(UserWarning, match="not read: actions_1, observations_1, rewards_1$"):
        found = mcaprl.open(tmp_path / "out.h5")
    assert found.frames[:, 0].tolist() == [0, 1, 2, 2]


def test_actions_that_d3rlpy_does_not_have_are_refused(tmp_path: Path) -> None:
    for space, values, message in (
        (spaces.Discrete(3, start=1), [1, 3], r"actions are Discrete\(3, start=1\)"),
        (spaces.MultiDiscrete([2, 3]), [[1, 2], [0, 0]], "actions are MultiDiscrete"),
    ):
        dataset = Dataset.from_arrays(
            observations=np.zeros((2, 1)),
            next_observations=np.zeros((2, 1)),
            actions=np.array(values),
            rewards=np.zeros(2),
            terminated=[False, True],
            truncated=[False, False],
            action_space=space,
            observation_space=spaces.Box(-1, 1, (1,), np.float64),
        )
        with pytest.raises(SpaceError, match=message):
            dataset.to_d3rlpy()
        with pytest.raises(SpaceError, match="pass `lossy=True`"):
            _write(dataset, tmp_path / "out.h5")
        assert not (tmp_path / "out.h5").exists()


def test_damaged_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "out.h5"
    for name, value, message in (
        ("version", "2.0", "has version 2.0 of d3rlpy's file format"),
        ("num_episodes", 3, "observations_2"),
        ("num_episodes", [1, 2], "num_episodes is not a whole number"),
        ("num_episodes", 0, "has no episodes"),
        ("rewards_1", np.zeros((2, 1)), "episode 1 has arrays of shapes"),
        ("rewards_0", np.zeros((3, 2)), "several rewards for each step"),
        ("actions_0", [["a"], ["b"], ["c"]], "not numbers"),
    ):
        _write(_vectors(), path, overwrite=True)
        with h5py.File(path, "r+") as file:
            del file[name]
            file[name] = value
        with pytest.raises(LogError, match=message):
            mcaprl.open(path)


def test_a_buffer_of_episodes_is_copied() -> None:
    """Drop the last step of truncated episodes, which d3rlpy also does not use as a transition."""
    episodes = [
        SimpleNamespace(
            observations=np.array([[first], [first + 1]], np.float32),
            actions=np.array([[0], [1]]),
            rewards=np.array([[1], [2]], np.float32),
            terminated=first == 0,
        )
        for first in (0, 5)
    ]
    info = SimpleNamespace(action_space=SimpleNamespace(name="DISCRETE"), action_size=6)
    found = Dataset.from_d3rlpy(SimpleNamespace(episodes=episodes, dataset_info=info))
    assert found.action_space == spaces.Discrete(6)
    assert found.frames[:, 0].tolist() == [0, 1, 1, 5, 6]
    assert found.rewards.tolist() == [1, 2, 1]
    assert found.truncated.tolist() == [False, False, True]


def test_something_else_than_a_buffer_is_refused() -> None:
    with pytest.raises(UsageError, match="expected a replay buffer of d3rlpy, but this is a list"):
        Dataset.from_d3rlpy([])


def test_a_missing_d3rlpy_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "d3rlpy", None)
    with pytest.raises(MissingExtraError, match="pip install --no-deps d3rlpy"):
        _vectors().to_d3rlpy()


def test_d3rlpys_picker_gives_every_transition(tmp_path: Path) -> None:
    log = _saved(_vectors(), tmp_path / "log.mcap")
    mcaprl.convert(log, tmp_path / "out.h5", to="d3rlpy")
    direct = ["transitions", log, tmp_path / "direct.npz"]
    run_rivals(PROGRAM, *direct, "--", "load", tmp_path / "out.h5", tmp_path / "loaded.npz")
    for name in ("direct", "loaded"):
        with np.load(tmp_path / f"{name}.npz") as found:
            assert found["observation"][:, 0].tolist() == [0, 1, 2, 10, 11]
            # d3rlpy's next observation after a terminal state is zero.
            assert found["next_observation"].tolist() == [
                [1, 0.5],
                [2, 0.5],
                [0, 0],
                [11, 0.5],
                [12, 0.5],
            ]
            assert found["action"][:, 0].tolist() == [0, 1, 2, 0, 1]
            assert found["reward"][:, 0].tolist() == [0, 0.5, 1, 0, 0.5]
            assert found["terminal"].tolist() == [0, 0, 1, 0, 0]
            assert found["lengths"].tolist() == [3, 2]
            assert found["space"] == "DISCRETE"
            # A file does not contain the number of actions, so d3rlpy infers it from the largest
            # action.
            assert found["size"] == {"direct": 4, "loaded": 3}[name]


def test_d3rlpy_has_images_with_the_channels_first_and_trains(tmp_path: Path) -> None:
    dataset = _images()
    log = _saved(dataset, tmp_path / "log.mcap")
    vectors = _saved(_vectors(), tmp_path / "vectors.mcap")
    run_rivals(PROGRAM, "transitions", log, tmp_path / "out.npz", "--", "train", vectors)
    with np.load(tmp_path / "out.npz") as found:
        camera, gray = (dataset.frames[key] for key in ("camera", "gray"))
        np.testing.assert_array_equal(found["observation_0"], np.moveaxis(camera[:2], -1, 1))
        np.testing.assert_array_equal(found["next_observation_1"][:, 0], gray[1:])
        assert found["next_observation_2"].tolist() == [[4, 5, 6, 7], [8, 9, 10, 11]]
        assert (str(found["space"]), int(found["size"])) == ("CONTINUOUS", 2)
        assert found["terminal"].tolist() == [0, 0]


def test_d3rlpys_own_files_are_read(tmp_path: Path) -> None:
    log = _saved(_vectors(), tmp_path / "log.mcap")
    dump, back = ["dump", log, tmp_path / "dumped.h5"], ["back", log, tmp_path / "back.mcap"]
    run_rivals(PROGRAM, *dump, "--", *back, "--", "collect", tmp_path / "collected.h5")
    for path in (tmp_path / "dumped.h5", tmp_path / "back.mcap"):
        found = mcaprl.open(path)
        assert found.frames[:, 0].tolist() == [0, 1, 2, 2, 10, 11, 12]
        assert found.rewards.tolist() == [0, 0.5, 1, 0, 0.5]
        assert found.terminated.tolist() == [False, False, True, False, False]
    assert mcaprl.open(tmp_path / "back.mcap").action_space == spaces.Discrete(4)
    # The third step of the truncated episode has no next observation, so it is not a transition.
    found = mcaprl.open(tmp_path / "collected.h5")
    assert found.observations[:, 0].tolist() == [0, 1, 2, 10, 11]
    assert found.next_observations[:, 0].tolist() == [1, 2, 2, 11, 12]
    assert found.truncated.tolist() == [False, False, False, False, True]
