"""Growing logs: appending, rotation, locks, and reading during recording."""

from __future__ import annotations

import multiprocessing
import threading
import time
import warnings
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from hypothesis import given, settings
from hypothesis import strategies as st

import mcaprl
from mcaprl.errors import LogError, NoStepsError, OutputExistsError, UsageError
from mcaprl.recorder.columns.reader import McapReader
from mcaprl.recorder.repair.check import check_log
from tests.support.recordings import MIXED_SPACE, Truth, assert_holds, record

BOX = spaces.Box(-1, 1, (2,), np.float32)
ONES = np.ones(2, np.int64)


def joined(*parts: Truth) -> Truth:
    """Concatenate the recorded values of several recordings."""
    whole = Truth()
    for part in parts:
        for name, rows in vars(part).items():
            getattr(whole, name).extend(rows)
    return whole


@pytest.mark.parametrize("space", [BOX, MIXED_SPACE], ids=["vector", "dict"])
def test_appended_recordings_read_as_one(log_path: Path, space: Any) -> None:
    actions = spaces.Discrete(3)
    parts = [
        record(log_path, space, actions, [3, 1], seed=1),
        record(log_path, space, actions, [9000, 2], seed=2, start_time_ns=None, append=True),
        record(log_path, space, actions, [4], seed=3, start_time_ns=None, append=True,
               compression="lz4"),
    ]  # fmt: skip
    assert check_log(log_path) == []
    data = mcaprl.open(log_path)
    assert_holds(data, joined(*parts))
    assert [episode.summary.episode for episode in data.episodes] == [0, 1, 2, 3, 4]
    times = np.concatenate([episode.log_time_ns for episode in data.episodes])
    assert (np.diff(times) > 0).all()


def cartpole_log(path: Path, episodes: int, first: int = 0, **options: Any) -> None:
    with closing(mcaprl.RecordMcap(gym.make("CartPole-v1"), path, **options)) as env:
        for number in range(first, first + episodes):
            env.reset(seed=number)
            while not any(env.step(number % 2)[2:4]):
                pass


def test_appending_equals_one_recording(log_path: Path) -> None:
    """Compare byte for byte, except the versions and the creation times."""
    whole = log_path.with_name("whole.mcap")
    start = 10**18
    cartpole_log(whole, 6, start_time_ns=start)
    cartpole_log(log_path, 2, start_time_ns=start)
    cartpole_log(log_path, 1, 2, start_time_ns=_end_of(log_path) + 20_000_000, append=True)
    cartpole_log(log_path, 3, 3, start_time_ns=_end_of(log_path) + 20_000_000, append=True)
    assert log_path.read_bytes() == whole.read_bytes()


def _end_of(path: Path) -> int:
    return int(mcaprl.open(path).episodes[-1].log_time_ns[-1])


def test_appending_creates_a_missing_file(log_path: Path) -> None:
    cartpole_log(log_path, 2, append=True)
    assert len(mcaprl.open(log_path).episodes) == 2


def test_appending_nothing_changes_nothing(log_path: Path) -> None:
    cartpole_log(log_path, 2)
    before = log_path.read_bytes()
    cartpole_log(log_path, 0, append=True)
    assert log_path.read_bytes() == before


def test_vector_environment_appends_to_a_log_of_one_environment(log_path: Path) -> None:
    cartpole_log(log_path, 2)
    envs = SyncVectorEnv([lambda: gym.make("CartPole-v1")] * 2)
    with closing(mcaprl.RecordVecMcap(envs, log_path, append=True)) as env:
        env.reset(seed=0)
        for _ in range(30):
            env.step(ONES)
        assert env.episodes > 2
    data = mcaprl.open(log_path)
    assert [e.summary.episode for e in data.episodes] == list(range(len(data.episodes)))
    assert check_log(log_path) == []


@pytest.mark.parametrize(
    ("env_id", "env_kwargs", "options", "reported"),
    [
        ("CartPole-v1", {"sutton_barto_reward": True}, {}, "its env_kwargs is"),
        ("CartPole-v0", {}, {}, "env_id is CartPole-v1, but the recording has CartPole-v0"),
        ("CartPole-v1", {}, {"step_duration_s": 0.5}, "its step_duration_ns is 20000000"),
        ("MountainCar-v0", {}, {}, "cannot be appended to"),
        ("CartPole-v1", {}, {"start_time_ns": 1_000}, "must be later"),
        ("CartPole-v1", {}, {"start_time_ns": 2**63}, "between the years 1970 and 2262"),
        ("CartPole-v1", {}, {"start_time_ns": 1.5e18}, "must be an integer"),
        ("CartPole-v1", {}, {"step_duration_s": float("nan")}, "step_duration_s is nan"),
        ("CartPole-v1", {}, {"overwrite": True}, "mutually exclusive"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*CartPole-v0 is out of date:DeprecationWarning")
def test_incompatible_recordings_are_not_appended(
    log_path: Path, env_id: str, env_kwargs: dict[str, Any], options: dict[str, Any], reported: str
) -> None:
    cartpole_log(log_path, 2)
    before = log_path.read_bytes()
    env = gym.make(env_id, **env_kwargs)
    with pytest.raises((LogError, UsageError), match=reported):
        mcaprl.RecordMcap(env, log_path, append=True, **options)
    assert log_path.read_bytes() == before
    cartpole_log(log_path, 1, append=True)


def test_a_damaged_file_is_not_appended_to(log_path: Path) -> None:
    cartpole_log(log_path, 2)
    whole = log_path.read_bytes()
    for damaged in (whole[:-9], whole[: len(whole) // 2], whole[:-40] + b"x" + whole[-39:]):
        log_path.write_bytes(damaged)
        with pytest.raises(LogError, match=f"run `mcaprl recover {log_path} OUT` and append to"):
            mcaprl.RecordMcap(gym.make("CartPole-v1"), log_path, append=True)
        assert log_path.read_bytes() == damaged


def test_killed_while_appending(log_path: Path) -> None:
    """If appending is interrupted, read the file like a file that is being written."""
    cartpole_log(log_path, 2)
    env = mcaprl.RecordMcap(gym.make("CartPole-v1"), log_path, append=True)
    env.reset(seed=5)
    while not any(env.step(0)[2:4]):
        pass
    copy = log_path.with_name("copy.mcap")
    copy.write_bytes(log_path.read_bytes())
    with pytest.warns(UserWarning, match="finished episodes read: 3"):
        assert len(mcaprl.open(copy).episodes) == 3
    env.close()
    assert check_log(log_path) == []


@settings(max_examples=12)
@given(st.lists(st.integers(1, 30), min_size=1, max_size=12), st.integers(1, 20_000))
def test_rotated_files_equal_one_file(
    tmp_path_factory: pytest.TempPathFactory, lengths: list[int], max_file_bytes: int
) -> None:
    folder = tmp_path_factory.mktemp("rotated")
    truth = record(folder / "one.mcap", BOX, spaces.Discrete(2), lengths)
    record(
        folder / "parts" / "p.mcap", BOX, spaces.Discrete(2), lengths, max_file_bytes=max_file_bytes
    )
    parts = sorted((folder / "parts").iterdir())
    assert parts[0].name == "p-00000.mcap"
    data = mcaprl.open(folder / "parts")
    assert_holds(data, truth)
    times = [np.concatenate([e.log_time_ns for e in d.episodes])
             for d in (data, mcaprl.open(folder / "one.mcap"))]  # fmt: skip
    assert (times[0] == times[1]).all()
    for path in parts:
        assert check_log(path) == []
        assert len(mcaprl.open(path).episodes) >= 1, "a file of whole episodes"
    # Each file except the last one has reached the maximum size.
    assert all(path.stat().st_size >= max_file_bytes for path in parts[:-1])


def test_rotation_and_appending(tmp_path: Path) -> None:
    path = tmp_path / "lane.mcap"
    cartpole_log(path, 5, max_file_bytes=6_000)
    before = sorted(tmp_path.iterdir())
    assert len(before) > 1
    with pytest.raises(OutputExistsError, match="lane-00000"):
        cartpole_log(path, 1, max_file_bytes=6_000)
    cartpole_log(path, 5, 5, max_file_bytes=6_000, append=True)
    after = sorted(tmp_path.iterdir())
    assert len(after) > len(before)
    data = mcaprl.open(tmp_path)
    assert [episode.summary.episode for episode in data.episodes] == list(range(10))
    assert (np.diff(np.concatenate([e.log_time_ns for e in data.episodes])) > 0).all()
    layouts = [McapReader(part).attachment("foxglove-layout.json") for part in after]
    assert len(set(layouts)) == 1, "each file has the layout"
    assert layouts[0] is not None
    cartpole_log(path, 1, max_file_bytes=6_000, overwrite=True)
    assert [part.name for part in tmp_path.iterdir()] == ["lane-00000.mcap"]
    with pytest.raises(UsageError, match="expected at least 1"):
        cartpole_log(path, 1, max_file_bytes=0, overwrite=True)


def test_a_file_without_episodes_is_removed(tmp_path: Path) -> None:
    env = mcaprl.RecordMcap(gym.make("CartPole-v1"), tmp_path / "a.mcap", max_file_bytes=1)
    for _ in range(2):
        env.reset(seed=0)
        while not any(env.step(0)[2:4]):
            pass
    env.reset()
    assert len(list(tmp_path.iterdir())) == 3
    env.close()
    assert len(list(tmp_path.iterdir())) == 2


def test_a_file_without_a_finished_episode_is_skipped(tmp_path: Path) -> None:
    """Skip a file without a finished episode, as a killed recorder leaves it; read the others."""
    cartpole_log(tmp_path / "a.mcap", 2)
    cartpole_log(tmp_path / "b.mcap", 0)
    with pytest.warns(UserWarning, match=r"b\.mcap has no finished episode: skipped"):
        assert len(mcaprl.open(tmp_path).episodes) == 2
    (tmp_path / "a.mcap").unlink()
    with pytest.raises(NoStepsError, match="no finished episode"):
        mcaprl.open(tmp_path)


@pytest.mark.parametrize("options", [{}, {"overwrite": True}, {"append": True}])
def test_second_writer_is_refused(log_path: Path, options: dict[str, Any]) -> None:
    env = mcaprl.RecordMcap(gym.make("CartPole-v1"), log_path)
    env.reset(seed=0)
    message = f"this program has an open recorder of {log_path}: call close\\(\\) on it"
    with pytest.raises(LogError, match=message):
        mcaprl.RecordMcap(gym.make("CartPole-v1"), log_path, **options)
    while not any(env.step(0)[2:4]):
        pass
    with pytest.raises(LogError, match=message):
        cartpole_data().save(log_path, overwrite=True)
    env.close()
    assert check_log(log_path) == []
    cartpole_log(log_path, 1, append=True)


def cartpole_data() -> mcaprl.Dataset:
    observations = np.zeros((2, 4), np.float32)
    return mcaprl.Dataset.from_arrays(
        observations=observations,
        next_observations=observations,
        actions=np.zeros(2, np.int64),
        rewards=np.zeros(2),
        terminated=np.array([False, True]),
        truncated=np.zeros(2, bool),
    )


def _hold(path: Path) -> None:
    with closing(mcaprl.RecordMcap(gym.make("CartPole-v1"), path)):
        time.sleep(600)


def test_the_lock_is_released_when_its_process_ends(log_path: Path) -> None:
    process = multiprocessing.get_context("spawn").Process(target=_hold, args=(log_path,))
    process.start()
    try:
        deadline = time.monotonic() + 60
        while not (log_path.exists() and log_path.stat().st_size > 1_000):
            assert time.monotonic() < deadline
            time.sleep(0.02)
        with pytest.raises(LogError, match="being written by another"):
            mcaprl.RecordMcap(gym.make("CartPole-v1"), log_path, overwrite=True)
    finally:
        process.kill()
        process.join()
    cartpole_log(log_path, 1, overwrite=True)


def test_overwriting_keeps_the_old_file_for_its_readers(log_path: Path) -> None:
    cartpole_log(log_path, 3)
    reader = McapReader(log_path)
    before = bytes(reader.view)
    cartpole_log(log_path, 1, overwrite=True)
    assert bytes(reader.view) == before


def test_readers_see_finished_episodes_during_recording(log_path: Path) -> None:
    """At any time, a reader finds all finished episodes, with the recorded values."""
    reported: list[int] = []
    space = spaces.Dict({"x": BOX, "image": spaces.Box(0, 255, (8, 8), np.uint8)})

    def write() -> None:
        env = mcaprl.RecordMcap(Counting(space), log_path)
        for _ in range(150):
            env.reset()
            while not env.step(0)[2]:
                pass
            reported.append(env.episodes)
        env.close()

    writer = threading.Thread(target=write)
    writer.start()
    seen = 0
    while writer.is_alive():
        finished = reported[-1] if reported else 0
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                data = mcaprl.open(log_path)
        except LogError:
            assert finished == 0
            continue
        assert len(data.episodes) >= max(finished, seen)
        seen = len(data.episodes)
        numbers = np.concatenate([np.arange(episode.length) for episode in data.episodes])
        assert (data.observations["x"][:, 0] == numbers.astype(np.float32)).all()
        assert (data.observations["image"][:, 3, 3] == numbers % 256).all()
    writer.join()
    assert len(mcaprl.open(log_path).episodes) == 150


class Counting(gym.Env[Any, Any]):
    """Environment whose observations count steps, with episodes of increasing length."""

    action_space = spaces.Discrete(2)

    def __init__(self, space: spaces.Space[Any]) -> None:
        self.observation_space = space
        self.episode, self.count = 0, 0

    def _observation(self) -> dict[str, Any]:
        image = np.full((8, 8), self.count % 256, np.uint8)
        return {"x": np.full(2, self.count, np.float32), "image": image}

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self.episode, self.count = self.episode + 1, 0
        return self._observation(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.count += 1
        return self._observation(), 1.0, self.count == 2 * self.episode, False, {}


def test_vector_recording_rotates(tmp_path: Path) -> None:
    envs = SyncVectorEnv(
        [lambda: gym.make("CartPole-v1")] * 3, autoreset_mode=AutoresetMode.SAME_STEP
    )
    env = mcaprl.RecordVecMcap(envs, tmp_path / "v.mcap", max_file_bytes=5_000, policy_version=1)
    with closing(env):
        env.reset(seed=0)
        for _ in range(60):
            env.step(np.ones(3, np.int64))
    assert len(list(tmp_path.iterdir())) > 2
    assert all(check_log(path) == [] for path in tmp_path.iterdir())
    assert len(mcaprl.open(tmp_path)) == 180
