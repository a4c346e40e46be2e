"""Dataset and Episode: views, selection, statistics, tables."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

import mcaprl
from mcaprl.errors import LogError, SpaceError, UsageError
from mcaprl.recorder.dataset.format_registry import target_format, write_format
from mcaprl.recorder.dataset.formats.columns import EpisodeArrays, dataset_of
from mcaprl.recorder.dataset.save import save_log
from mcaprl.recorder.format.metadata import LogMetadata
from tests.support.recordings import MIXED_SPACE, record


def small() -> mcaprl.Dataset:
    """Return three episodes: one terminated, one truncated, and one that is not finished."""
    return mcaprl.Dataset.from_arrays(
        observations=np.array([[0.0], [1.0], [5.0], [7.0], [8.0]], np.float32),
        next_observations=np.array([[1.0], [2.0], [6.0], [8.0], [9.0]], np.float32),
        actions=np.array([0, 1, 1, 0, 2]),
        rewards=np.array([1.0, 2.0, -4.0, 0.5, 0.25]),
        terminated=np.array([False, True, False, False, False]),
        truncated=np.array([False, False, True, False, False]),
        behavior_probs=np.array([0.5, 0.5, 1.0, np.nan, 0.1], np.float32),
        env_id="Toy-v0",
    )


def test_episodes_are_found_by_their_ends() -> None:
    data = small()
    assert [episode.length for episode in data.episodes] == [2, 1, 2]
    assert [episode.total_reward for episode in data.episodes] == [3.0, -4.0, 0.75]
    assert data.episodes[2].observations.tolist() == [[7], [8]]
    assert data.episodes[2].next_observations.tolist() == [[8], [9]]
    assert data.action_space == spaces.Discrete(3)


def test_a_gap_between_observations_ends_an_episode() -> None:
    data = mcaprl.Dataset.from_arrays(
        observations=np.array([[0.0], [3.0]]),
        next_observations=np.array([[1.0], [4.0]]),
        actions=np.array([0, 0]),
        rewards=np.zeros(2),
        terminated=np.zeros(2, bool),
        truncated=np.zeros(2, bool),
    )
    assert [episode.length for episode in data.episodes] == [1, 1]
    assert not data.truncated.any(), "flags stay as they were given"
    assert data.observation_space == spaces.Box(-np.inf, np.inf, (1,), np.float64)


def test_wrong_arrays_are_refused() -> None:
    data = small()
    arrays = {
        "observations": data.observations,
        "next_observations": data.next_observations,
        "actions": data.actions,
        "rewards": data.rewards,
        "terminated": data.terminated,
        "truncated": data.truncated,
    }
    with pytest.raises(SpaceError, match=r"actions has shape \(4,\), expected \(5,\)"):
        mcaprl.Dataset.from_arrays(**{**arrays, "actions": data.actions[:4]})
    halves = data.actions + 0.5
    with pytest.raises(SpaceError, match="cannot be converted exactly to int64"):
        mcaprl.Dataset.from_arrays(**{**arrays, "actions": halves}, action_space=spaces.Discrete(3))
    with pytest.raises(SpaceError, match="no transitions"):
        mcaprl.Dataset.from_arrays(**{name: array[:0] for name, array in arrays.items()})


def test_filter_and_split_take_whole_episodes() -> None:
    data = small()
    good = data.filter(lambda episode: episode.total_reward > 0)
    assert good.rewards.tolist() == [1.0, 2.0, 0.5, 0.25]
    assert good.next_observations.ravel().tolist() == [1, 2, 8, 9]
    assert [episode.index for episode in good.episodes] == [0, 1]
    first, second = data.split(0.6, seed=1)
    assert len(first.episodes) == 2
    assert len(second.episodes) == 1
    assert sorted([*first.rewards, *second.rewards]) == sorted(data.rewards)
    with pytest.raises(UsageError, match=r"fraction 1\.5: give a number between 0 and 1"):
        data.split(1.5)


@given(st.floats(0.01, 0.99), st.integers(0, 1000))
def test_split_is_a_partition(fraction: float, seed: int) -> None:
    data = small()
    first, second = data.split(fraction, seed=seed)
    again, _ = data.split(fraction, seed=seed)
    assert again.fingerprint == first.fingerprint
    assert len(first.episodes) + len(second.episodes) == 3
    assert min(len(first.episodes), len(second.episodes)) >= 1


def test_other_rewards_change_the_returns_alone(tmp_path: Path) -> None:
    data = mcaprl.Dataset.from_arrays(
        observations=np.arange(4.0)[:, None],
        actions=[0, 1, 1, 0],
        rewards=[1.0, 2.0, 3.0, 4.0],
        terminated=[False, True, False, True],
        truncated=[False] * 4,
        next_observations=np.arange(1.0, 5.0)[:, None],
    )
    other = data.with_rewards(data.rewards - 10 * (data.actions == 1))
    assert other.rewards.tolist() == [1, -8, -7, 4]
    assert [episode.total_reward for episode in other.episodes] == [-7, -3]
    assert other.statistics.returns.tolist() == [-7, -3]
    assert [episode.total_reward for episode in data.episodes] == [3, 7]
    assert other.fingerprint != data.fingerprint
    assert data.with_rewards([1, 2, 3, 4]).fingerprint == data.fingerprint
    other.save(tmp_path / "other.mcap")
    saved = mcaprl.open(tmp_path / "other.mcap")
    assert saved.rewards.tolist() == [1, -8, -7, 4]
    assert [episode.total_reward for episode in saved.episodes] == [-7, -3]
    np.testing.assert_array_equal(saved.actions, data.actions)


@pytest.mark.parametrize(
    ("rewards", "says"),
    [
        ([1.0], r"rewards has shape \(1,\), expected \(2,\)"),
        ([[1.0], [2.0]], r"rewards has shape \(2, 1\), expected \(2,\)"),
        ([1.0, np.nan], "rewards has nan in row 1, expected finite numbers"),
        ([np.inf, 1.0], "rewards has inf in row 0, expected finite numbers"),
        (["a", "b"], "rewards has dtype <U1, expected numbers"),
        ([1j, 2j], "rewards has dtype complex128, expected numbers"),
    ],
)
def test_wrong_rewards_are_refused(rewards: Any, says: str) -> None:
    data = mcaprl.Dataset.from_arrays(
        observations=np.zeros((2, 1)),
        actions=[0, 1],
        rewards=[1.0, 2.0],
        terminated=[False, True],
        truncated=[False, False],
        next_observations=np.zeros((2, 1)),
    )
    with pytest.raises(SpaceError, match=says):
        data.with_rewards(rewards)


def test_statistics_by_hand() -> None:
    statistics = small().statistics
    assert (statistics.episodes, statistics.steps) == (3, 5)
    assert statistics.returns.tolist() == [3.0, -4.0, 0.75]
    assert statistics.mean_return == pytest.approx(-0.25 / 3)
    assert statistics.action_counts == {0: 2, 1: 2, 2: 1}
    column = statistics.observations["observation"]
    assert (column.low[0], column.high[0], column.not_finite) == (0.0, 9.0, 0)
    assert column.mean[0] == pytest.approx((0 + 1 + 2 + 5 + 6 + 7 + 8 + 9) / 8)


def test_statistics_of_images_and_nan(log_path: Path) -> None:
    record(log_path, MIXED_SPACE, spaces.Discrete(2), [4])
    data = mcaprl.open(log_path)
    pixels = np.concatenate([data.observations["gray"], data.next_observations["gray"][-1:]])
    column = data.statistics.observations["gray"]
    assert column.mean[0] == pytest.approx(pixels.mean())
    assert column.std[0] == pytest.approx(pixels.std())
    assert (column.low[0], column.high[0]) == (pixels.min(), pixels.max())


def test_repr_prints_shapes() -> None:
    data = small()
    assert repr(data) == (
        "Dataset(Toy-v0: 3 episodes, 5 transitions, observation=8x1 float32, actions=Discrete(3))"
    )
    assert "observations=<2x1 float32>" in repr(data.episodes[0])


def test_episode_arrays_are_views(log_path: Path) -> None:
    record(log_path, MIXED_SPACE, spaces.Discrete(2), [30, 30])
    episode = mcaprl.open(log_path).episodes[1]
    assert episode.observations["camera"].base is not None
    assert episode.observations["camera"].shape == (30, 12, 9, 3)


def test_several_logs_are_one_dataset(tmp_path: Path) -> None:
    box = spaces.Box(-1, 1, (2,), np.float32)
    for number in range(3):
        record(tmp_path / f"{number}.mcap", box, spaces.Discrete(2), [2, 3], seed=number)
    whole = mcaprl.open(tmp_path)
    assert len(whole.episodes) == 6
    assert whole.fingerprint == mcaprl.open(str(tmp_path / "*.mcap")).fingerprint
    last = mcaprl.open(tmp_path / "2.mcap")
    assert whole.episodes[5].observations.tolist() == last.episodes[1].observations.tolist()
    assert len(mcaprl.open([tmp_path / "0.mcap", tmp_path / "2.mcap"]).episodes) == 4


def test_logs_of_other_spaces_are_refused(tmp_path: Path) -> None:
    box = spaces.Box(-1, 1, (2,), np.float32)
    record(tmp_path / "a.mcap", box, spaces.Discrete(2), [2])
    record(tmp_path / "b.mcap", box, spaces.Discrete(3), [2])
    with pytest.raises(SpaceError, match=r"a\.mcap and .*b\.mcap differ in action_space"):
        mcaprl.open(tmp_path)


def test_a_mixture_has_no_policy_metadata(tmp_path: Path) -> None:
    box = spaces.Box(-1, 1, (2,), np.float32)
    for name in ("a", "b"):
        record(tmp_path / f"{name}.mcap", box, spaces.Discrete(2), [2], policy=name, epsilon=0.5)
    mixed = mcaprl.open([tmp_path / "a.mcap", tmp_path / "b.mcap"])
    mixed.save(tmp_path / "mixed.mcap")
    again = mcaprl.open(tmp_path / "mixed.mcap")
    for data in (mixed, again):
        assert (data.metadata["policy"], data.metadata["epsilon"]) == ("", "0.5")
    assert again.metadata == mixed.metadata
    assert [episode.policy for episode in again.episodes] == ["a", "b"]


def test_a_file_given_twice_is_read_once(tmp_path: Path) -> None:
    record(tmp_path / "a.mcap", spaces.Box(-1, 1, (2,), np.float32), spaces.Discrete(2), [3])
    path = tmp_path / "a.mcap"
    assert len(mcaprl.open([path, str(path), tmp_path, str(tmp_path / "*.mcap")])) == 3


def test_a_dataset_can_be_saved_over_its_source(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    record(path, MIXED_SPACE, spaces.Discrete(2), [3, 4])
    data = mcaprl.open(path)
    data.filter(lambda episode: episode.length == 4).save(path, overwrite=True)
    assert len(mcaprl.open(path)) == 4
    assert [found.name for found in tmp_path.iterdir()] == ["a.mcap"]
    with pytest.raises(mcaprl.McaprlError, match="exists"):
        data.save(path)


def test_an_empty_selection(tmp_path: Path) -> None:
    none = small().filter(lambda episode: False)
    assert (len(none), none.episodes) == (0, ())
    assert none.observations.shape == (0, 1)
    assert np.isnan(none.statistics.mean_return)
    with pytest.raises(LogError, match="no episodes"):
        none.save(tmp_path / "none.mcap")
    with pytest.raises(LogError, match="no data"):
        mcaprl.open([])


def test_unknown_table() -> None:
    with pytest.raises(mcaprl.McaprlError, match="did you mean episodes"):
        small().to_arrow("episode")  # type: ignore[arg-type]


def test_missing_data(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="no such file, folder or match"):
        mcaprl.open(tmp_path / "nothing.mcap")
    with pytest.raises(LogError, match=r"no \.mcap files"):
        mcaprl.open(tmp_path)


def test_transition_table() -> None:
    pyarrow = pytest.importorskip("pyarrow")
    table = small().to_arrow()
    assert isinstance(table, pyarrow.Table)
    assert table.column("observation.0").to_pylist() == [0, 1, 5, 7, 8]
    assert table.column("next_observation.0").to_pylist() == [1, 2, 6, 8, 9]
    assert table.column("episode").to_pylist() == [0, 0, 1, 2, 2]
    assert table.column("step").to_pylist() == [0, 1, 0, 0, 1]
    assert table.column("reward").to_pylist() == [1.0, 2.0, -4.0, 0.5, 0.25]
    assert table.schema.field("observation.0").type == pyarrow.float32()


def test_episode_table() -> None:
    pytest.importorskip("pyarrow")
    assert small().filter(lambda episode: False).to_arrow().num_rows == 0
    pytest.importorskip("pandas")
    frame = small().to_pandas("episodes")
    assert frame["total_reward"].tolist() == [3.0, -4.0, 0.75]
    assert frame["length"].tolist() == [2, 1, 2]
    assert frame["terminated"].tolist() == [True, False, False]


def test_image_table(log_path: Path) -> None:
    pytest.importorskip("pyarrow")
    record(log_path, MIXED_SPACE, spaces.Box(-1, 1, (2,), np.float32), [3])
    data = mcaprl.open(log_path)
    table = data.to_arrow()
    assert table.column("action.1").to_pylist() == data.actions[:, 1].tolist()
    flat = table.column("observation_camera").to_pylist()
    assert flat == data.observations["camera"].reshape(3, -1).tolist()


def test_arrays_of_a_registered_environment_have_its_spaces() -> None:
    env = gym.make("CartPole-v1")
    arrays: dict[str, Any] = {
        "observations": np.zeros((3, 4)),
        "next_observations": np.zeros((3, 4)),
        "actions": np.zeros(3, np.int64),
        "rewards": np.ones(3),
        "terminated": np.array([False, False, True]),
        "truncated": np.zeros(3, bool),
    }
    data = mcaprl.Dataset.from_arrays(**arrays, env_id="CartPole-v1")
    assert data.observation_space == env.observation_space
    assert data.action_space == env.action_space
    for chosen in (
        {"observation_space": spaces.Box(-9, 9, (4,))},
        {"action_space": spaces.Discrete(5)},
    ):
        mixed = mcaprl.Dataset.from_arrays(**arrays, env_id="CartPole-v1", **chosen)
        expected = {name: getattr(env, name) for name in ("observation_space", "action_space")}
        assert {name: getattr(mixed, name) for name in expected} == expected | chosen
    other = mcaprl.Dataset.from_arrays(**arrays, env_id="Pendulum-v1")
    assert other.observation_space == spaces.Box(-np.inf, np.inf, (4,), np.float64)
    assert other.action_space == spaces.Discrete(1)


def with_times(times: list[list[int]]) -> mcaprl.Dataset:
    """Return a dataset with one episode for each list of times."""
    episodes = [
        EpisodeArrays(
            observations=np.zeros((len(each), 1), np.float32),
            actions=np.zeros(len(each) - 1, np.int64),
            rewards=np.zeros(len(each) - 1),
            terminated=True,
            truncated=False,
            times_ns=np.array(each),
        )
        for each in times
    ]
    space = spaces.Box(-1, 1, (1,), np.float32)
    return dataset_of(episodes, LogMetadata(space, spaces.Discrete(2)), "test")


def test_times_from_0_are_kept(tmp_path: Path) -> None:
    times = [[0, 1, 5], [3_900_000_000, 3_900_000_007]]
    data = with_times(times)
    for name in ("first.mcap", "second.mcap"):
        data.save(tmp_path / name)
        found = mcaprl.open(tmp_path / name)
        assert [each.log_time_ns.tolist() for each in found.episodes] == times
        assert [each.summary.start_time_ns for each in found.episodes] == [0, 3_900_000_000]
    assert (tmp_path / "first.mcap").read_bytes() == (tmp_path / "second.mcap").read_bytes()
    # A copy of the log keeps the times, too.
    found.save(tmp_path / "third.mcap")
    assert mcaprl.open(tmp_path / "third.mcap").episodes[1].log_time_ns.tolist() == times[1]
    with pytest.raises(SpaceError, match="episode 0: log_time_ns are not times"):
        with_times([[-1, 0]])
    # The times of a mapping may be before 1970.
    early = dataclasses.replace(data._transitions, log_time_ns=data._transitions.log_time_ns - 1)
    with pytest.raises(LogError, match="the first time is -1 ns; a log cannot have times before"):
        save_log(tmp_path / "fourth.mcap", early, data._description)


@pytest.mark.parametrize("suffix", ["", ".npz", ".hdf5", "parquet", "minari-v0"])
def test_arrays_have_the_times_of_their_log(tmp_path: Path, suffix: str) -> None:
    data = small()
    if suffix:
        for package in ("h5py", "pyarrow"):
            pytest.importorskip(package, reason="needs the extras interop and tables")
        form = {"parquet": "parquet", "minari-v0": "minari"}.get(suffix)
        write_format(data, tmp_path / f"data{suffix}", target_format(tmp_path / f"a{suffix}", form))
        data = mcaprl.open(tmp_path / f"data{suffix}")
    log = tmp_path / "log.mcap"
    for part in (data, data.filter(lambda episode: episode.index > 0)):
        before_ns = time.time_ns()
        part.save(log, overwrite=True)
        saved = mcaprl.open(log)
        assert before_ns <= saved.episodes[0].log_time_ns[0] <= time.time_ns()
        assert "times" not in saved.metadata
    # A log and arrays together have no common clock.
    both = mcaprl.Dataset.concatenate([saved, small()])
    both.save(log, overwrite=True)
    assert mcaprl.open(log).episodes[0].log_time_ns[0] > before_ns
