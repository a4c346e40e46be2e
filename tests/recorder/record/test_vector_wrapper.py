"""RecordVecMcap: the log of a vector environment contains the episodes of all sub-environments."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
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
from mcaprl.errors import LogError, NoStepsError, SpaceError, UsageError
from mcaprl.recorder.columns.reader import McapReader
from mcaprl.recorder.dataset.transitions import Episode
from mcaprl.recorder.record import step_rows
from mcaprl.recorder.record.step_rows import OpenSteps
from mcaprl.recorder.record.vector_wrapper import VectorWrapper
from mcaprl.recorder.repair.check import check_log
from tests.support.learner_topic import read_learner
from tests.support.recordings import MIXED_SPACE, KnownCommands, assert_same_bits, leaves_of

MODES = list(AutoresetMode)


class Wanderer(gym.Env[Any, Any]):
    """Environment with random observations, given episode lengths, and distinct rewards."""

    metadata: dict[str, Any] = {"render_fps": 10}  # noqa: RUF012 (as Gymnasium declares it)

    def __init__(self, space: spaces.Space[Any], lengths: list[int], seed: int) -> None:
        self.observation_space, self.action_space = space, spaces.Discrete(5, start=-2)
        space.seed(seed)
        self._samples = [space.sample() for _ in range(40)]
        self._lengths, self._episode, self._drawn, self._step = lengths, -1, 0, 0
        self._seed = seed

    def _draw(self) -> Any:
        self._drawn += 1
        return self._samples[self._drawn % 40]

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self._episode, self._step = self._episode + 1, 0
        return self._draw(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self._step += 1
        over = self._step == self._lengths[self._episode % len(self._lengths)]
        ends = (over and self._episode % 2 == 0, over and self._episode % 2 == 1)
        infos = {"reason": f"end {self._episode}"} if over else {}
        return self._draw(), 1000.0 * self._seed + 0.1 * self._drawn, *ends, infos


@pytest.fixture(scope="module", autouse=True)
def small_buffers() -> Iterator[None]:
    """Begin with buffers of four rows, so that they are used several times and must grow."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(step_rows, "_FIRST_CAPACITY", 4)
        yield


def members(
    folder: Path, space: spaces.Space[Any], lengths: list[list[int]]
) -> list[Callable[[], gym.Env[Any, Any]]]:
    """Create sub-environments that are recorded individually, for comparison."""

    def make(number: int) -> gym.Env[Any, Any]:
        env = Wanderer(space, lengths[number], seed=number)
        return mcaprl.RecordMcap(env, folder / f"member-{number}.mcap", start_time_ns=0)

    return [lambda number=number: make(number) for number in range(len(lengths))]  # type: ignore[misc]


def act_for(env: mcaprl.RecordVecMcap, steps: int, *, seed: int = 0) -> None:
    """Take random actions with probabilities that depend on the action; reset if required."""
    env.reset(seed=seed)
    random = np.random.default_rng(seed)
    for _ in range(steps):
        actions = random.integers(-2, 3, env.num_envs)
        env.behavior_probs = 0.5 + actions / 10
        _, _, terminated, truncated, _ = env.step(actions)
        over = terminated | truncated
        if env.metadata["autoreset_mode"] is AutoresetMode.DISABLED and over.any():
            env.reset(options={"reset_mask": over})


def assert_same_episode(found: Episode, expected: Episode) -> None:
    for name in ("observations", "next_observations"):
        pairs = zip(
            leaves_of(getattr(found, name)), leaves_of(getattr(expected, name)), strict=True
        )
        for here, there in pairs:
            assert_same_bits(here, there)
    for name in ("actions", "rewards", "terminated", "truncated"):
        assert_same_bits(getattr(found, name), getattr(expected, name))
    assert (found.reason, found.total_reward) == (expected.reason, expected.total_reward)


def check_against_members(folder: Path) -> None:
    """Check that the vector log has exactly the episodes of the sub-environments."""
    data = mcaprl.open(folder / "vector.mcap")
    assert check_log(folder / "vector.mcap") == []
    waiting: list[Episode] = []
    for path in sorted(folder.glob("member-*.mcap")):
        try:
            waiting += mcaprl.open(path).episodes
        except NoStepsError:
            continue
    for episode in data.episodes:
        expected = next(e for e in waiting if e.rewards[0] == episode.rewards[0])
        assert_same_episode(episode, expected)
        waiting = [e for e in waiting if e is not expected]
        np.testing.assert_allclose(episode.behavior_probs, 0.5 + episode.actions / 10)
    assert waiting == []
    times = np.concatenate([episode.log_time_ns for episode in data.episodes])
    assert (np.diff(times) == 10**8).all(), "as if recorded one after the other"


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(
    "space",
    [
        spaces.Box(-np.inf, np.inf, (3,), np.float32),
        spaces.Box(-1, 1, (), np.float64),
        spaces.Discrete(7, start=-3),
        spaces.MultiDiscrete([3, 5]),
        spaces.MultiBinary(4),
        spaces.Box(0, 255, (9, 8, 3), np.uint8),
        MIXED_SPACE,
    ],
    ids=["vector", "scalar", "discrete", "multi-discrete", "multi-binary", "image", "dict"],
)
def test_every_sub_environment_is_recorded(
    tmp_path: Path, space: spaces.Space[Any], mode: AutoresetMode
) -> None:
    """Record a vector environment that overwrites the returned buffers in the next step."""
    makers = members(tmp_path, space, [[3, 1, 70], [5], [1, 2]])
    envs = SyncVectorEnv(makers, copy=False, autoreset_mode=mode)
    with closing(mcaprl.RecordVecMcap(envs, tmp_path / "vector.mcap", start_time_ns=5)) as env:
        act_for(env, 90)
    check_against_members(tmp_path)


@settings(max_examples=25)
@given(
    lengths=st.lists(st.lists(st.integers(1, 9), min_size=1, max_size=3), min_size=1, max_size=4),
    mode=st.sampled_from(MODES),
    steps=st.integers(1, 30),
)
def test_episodes_of_any_lengths(
    tmp_path_factory: pytest.TempPathFactory,
    lengths: list[list[int]],
    mode: AutoresetMode,
    steps: int,
) -> None:
    folder = tmp_path_factory.mktemp("vector")
    space = spaces.Box(-1, 1, (2,), np.float32)
    envs = SyncVectorEnv(members(folder, space, lengths), autoreset_mode=mode)
    with closing(mcaprl.RecordVecMcap(envs, folder / "vector.mcap")) as env:
        act_for(env, steps)
    check_against_members(folder)


def test_episodes_are_in_the_order_of_their_ends(tmp_path: Path) -> None:
    space = spaces.Box(-1, 1, (2,), np.float32)
    makers = members(tmp_path, space, [[4], [2], [4]])
    envs = SyncVectorEnv(makers, autoreset_mode=AutoresetMode.SAME_STEP)
    env = mcaprl.RecordVecMcap(envs, tmp_path / "vector.mcap", policy="a", epsilon=0.5)
    env.reset(seed=10)
    for step in range(5):
        env.policy, env.epsilon = ("a", 0.5) if step < 2 else ("b", 0.25)
        env.step(np.zeros(3, np.int64))
    env.close()
    reported = [
        (e.length, e.seed, e.policy, e.epsilon, e.reason)
        for e in mcaprl.open(tmp_path / "vector.mcap").episodes
    ]
    assert reported == [
        (2, 11, "a", 0.5, "end 0"),
        (4, 10, "a", 0.5, "end 0"),
        (2, None, "a", 0.5, "end 1"),
        (4, 12, "a", 0.5, "end 0"),
        (1, None, "b", 0.25, "interrupted"),
        (1, None, "b", 0.25, "interrupted"),
        (1, None, "b", 0.25, "interrupted"),
    ]


def test_episodes_that_end_in_one_step_share_chunks(
    log_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    space = spaces.Box(-1, 1, (2,), np.float32)
    makers = members(log_path.parent, space, [[3], [3], [2], [3]])
    env = mcaprl.RecordVecMcap(SyncVectorEnv(makers), log_path)
    env.reset(seed=0)
    act = np.zeros(4, np.int64)
    for ended in (0, 1, 4):
        env.step(act)
        assert env.episodes == ended
    # Read the growing file: closing it would merge its small chunks.
    reader = McapReader(log_path)
    counts = [len(part) for part in reader.message_ranges(reader.channels_of("/rl/step")[0])]
    assert counts == [3, 12]
    monkeypatch.setattr(OpenSteps, "end", failing_end)
    with pytest.raises(LogError, match="no room"):  # noqa: PT012
        for _ in range(4):
            env.step(act)
    assert env.episodes == 4, "episodes that were not written are not counted"


@pytest.mark.parametrize(("limit", "lengths"), [(1, [1, 1, 1]), (500, [2, 1]), (10**6, [3])])
def test_a_limited_file_gets_few_of_the_episodes_that_end_in_one_step(
    tmp_path: Path, limit: int, lengths: list[int]
) -> None:
    space = spaces.Box(-1, 1, (2,), np.float32)
    envs = SyncVectorEnv(members(tmp_path, space, [[2], [2], [2]]))
    # Each episode has three records of 74 bytes.
    with closing(
        mcaprl.RecordVecMcap(envs, tmp_path / "limited.mcap", max_file_bytes=limit)
    ) as env:
        env.reset(seed=0)
        for _ in range(2):
            env.step(np.zeros(3, np.int64))
    files = sorted(tmp_path.glob("limited-*.mcap"))
    assert [len(mcaprl.open(file).episodes) for file in files] == lengths


def test_environments_have_to_be_reset_after_an_error_in_reset(
    log_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with closing(mcaprl.RecordVecMcap(cartpoles(2), log_path)) as env:
        env.reset(seed=0)
        env.step(np.zeros(2, np.int64))
        with monkeypatch.context() as patch:
            patch.setattr(OpenSteps, "end", failing_end)
            with pytest.raises(LogError, match="no room"):
                env.reset(seed=0)
        with pytest.raises(gym.error.ResetNeeded, match="no open episode"):
            env.step(np.zeros(2, np.int64))


def failing_end(*_: Any) -> None:
    """Take the place of `OpenSteps.end`, as if the disk were full."""
    raise LogError("no room")


def cartpoles(count: int, mode: AutoresetMode = AutoresetMode.NEXT_STEP) -> Any:
    return gym.make_vec(
        "CartPole-v1", count, "sync", {"autoreset_mode": mode}, sutton_barto_reward=True
    )


def test_metadata_describes_one_sub_environment(log_path: Path) -> None:
    mcaprl.RecordVecMcap(cartpoles(2), log_path, seed=3, policy="random", epsilon=1.0).close()
    single = log_path.with_name("single.mcap")
    env = gym.make("CartPole-v1", sutton_barto_reward=True)
    mcaprl.RecordMcap(env, single, seed=3, policy="random", epsilon=1.0).close()
    name = "mcaprl.dataset"
    assert McapReader(log_path).metadata[name] == McapReader(single).metadata[name]


def test_natively_batched_environment(log_path: Path) -> None:
    envs: Any = gym.make_vec("CartPole-v1", 4, "vector_entry_point")
    with closing(mcaprl.RecordVecMcap(envs, log_path)) as env:
        env.reset(seed=1)
        for _ in range(60):
            env.step(np.ones(4, np.int64))
    data = mcaprl.open(log_path)
    assert data.env_id == "CartPole-v1"
    # The carts are always pushed to the same side, so every pole falls within a dozen steps.
    assert {episode.reason for episode in data.episodes[:-4]} == {"terminated"}
    assert all(8 <= episode.length <= 11 for episode in data.episodes[:-4])


def test_learner_topic(log_path: Path) -> None:
    with closing(mcaprl.RecordVecMcap(cartpoles(3), log_path, policy_version=0)) as env:
        env.reset(seed=0)
        for step in range(40):
            env.epsilon, env.policy_version = 1 - step / 40, step // 4
            env.step(np.ones(3, np.int64))
    data, learner = mcaprl.open(log_path), read_learner(log_path)
    times = np.concatenate([episode.log_time_ns[:-1] for episode in data.episodes])
    assert learner.log_time_ns.tolist() == times.tolist(), "one message for each transition"
    firsts = [episode.epsilon for episode in data.episodes]
    # `epsilon` is set after the first reset, so it is unknown at the start of the first three
    # episodes.
    assert all(math.isnan(epsilon) for epsilon in firsts[:3])
    start = 0
    for episode in data.episodes[:3]:
        steps = np.arange(episode.length)
        np.testing.assert_allclose(learner.epsilon[start : start + episode.length], 1 - steps / 40)
        assert (
            learner.policy_version[start : start + episode.length].tolist() == (steps // 4).tolist()
        )
        start += episode.length
    assert check_log(log_path) == []


def test_log_without_learner(log_path: Path) -> None:
    mcaprl.RecordVecMcap(cartpoles(2), log_path).close()
    with pytest.raises(LogError, match="no topic /rl/learner"):
        read_learner(log_path)


def test_an_error_ends_all_episodes_before_the_step(log_path: Path) -> None:
    envs = cartpoles(2)
    env = mcaprl.RecordVecMcap(envs, log_path)
    env.reset(seed=0)
    env.step(np.zeros(2, np.int64))
    with pytest.raises(SpaceError, match=r"action has shape \(3,\); its space declares \(2,\)"):
        env.step(np.zeros(3, np.int64))
    env.step(np.zeros(2, np.int64))
    envs.envs[1].unwrapped.gravity = None
    with pytest.raises(TypeError):
        env.step(np.zeros(2, np.int64))
    with pytest.raises(gym.error.ResetNeeded, match=r"environments \[0, 1\]"):
        env.step(np.zeros(2, np.int64))
    env.close()
    env.close()
    reported = [(e.length, e.reason) for e in mcaprl.open(log_path).episodes]
    assert reported == [(2, "interrupted"), (2, "interrupted")]


def test_an_ended_environment_has_to_be_reset(log_path: Path) -> None:
    with closing(mcaprl.RecordVecMcap(cartpoles(2, AutoresetMode.DISABLED), log_path)) as env:
        env.reset(seed=0)
        with pytest.raises(gym.error.ResetNeeded):  # noqa: PT012
            while True:
                env.step(np.ones(2, np.int64))


def test_densities_of_several_environments(log_path: Path) -> None:
    envs = SyncVectorEnv([KnownCommands, KnownCommands])
    with closing(mcaprl.RecordVecMcap(envs, log_path)) as recorder:
        recorder.reset()
        with pytest.raises(SpaceError, match="use behavior_log_probs"):
            recorder.behavior_probs = (0.5, 0.5)
        for wrong in ((0.0, math.inf), (1e39, 0.0), (-math.inf, 0.0)):
            recorder.behavior_log_probs = wrong
            with pytest.raises(UsageError, match=r"behavior_log_probs\[[01]\] .* log density"):
                recorder.step(np.zeros((2, 2), np.float32))
        for step in range(3):
            if step != 1:
                recorder.behavior_log_probs = np.array([step - 7.5, 40.0])
            recorder.step(np.full((2, 2), step / 2, np.float32))
    data = mcaprl.open(log_path)
    assert data.action_labels == ("steering (-1 right, 1 left)", "speed (0 to 2.5 m/s)")
    np.testing.assert_array_equal(data.behavior_log_probs, [-7.5, np.nan, -5.5, 40, np.nan, 40])


def test_invalid_arguments_are_refused(log_path: Path) -> None:
    with pytest.raises(UsageError, match="RecordMcap wraps single"):
        mcaprl.RecordVecMcap(gym.make("CartPole-v1"), log_path)  # type: ignore[arg-type]
    silent = cartpoles(2)
    silent.metadata = {}
    with pytest.raises(UsageError, match="expected one of"):
        mcaprl.RecordVecMcap(silent, log_path)
    assert not log_path.exists()
    env = mcaprl.RecordVecMcap(cartpoles(2), log_path)
    with pytest.raises(UsageError, match=r"2\*\*64 - 2"):
        env.reset(seed=2**64)
    env.reset(seed=0)
    env.behavior_probs = np.ones(3)
    with pytest.raises(SpaceError, match=r"behavior_probs has shape \(3,\), expected \(2,\)"):
        env.step(np.zeros(2, np.int64))
    for probs, name in (((0.5, -0.5), "behavior_probs[1] -0.5"), (2, "behavior_probs[0] 2")):
        env.behavior_probs = probs
        with pytest.raises(UsageError, match=re.escape(f"{name} is not the probability")):
            env.step(np.zeros(2, np.int64))
    env.behavior_probs = (math.nan, 1.0)
    env.step(np.zeros(2, np.int64))
    env.close()
    with pytest.raises(UsageError, match="closed"):
        env.reset()


def test_the_final_observation_is_required(log_path: Path) -> None:
    class Forgetful(VectorWrapper):
        def step(self, actions: Any) -> Any:
            return *self.env.step(actions)[:4], {}

    env = mcaprl.RecordVecMcap(Forgetful(cartpoles(2, AutoresetMode.SAME_STEP)), log_path)
    env.reset(seed=0)
    with pytest.raises(SpaceError, match="final_obs"):  # noqa: PT012
        while True:
            env.step(np.ones(2, np.int64))
    env.close()
    assert {e.reason for e in mcaprl.open(log_path).episodes} == {"interrupted"}


def test_large_images_preallocate_little_memory(log_path: Path) -> None:
    class ImageEnv(gym.Env[Any, Any]):
        observation_space = spaces.Box(0, 255, (480, 640, 3), np.uint8)
        action_space = spaces.Discrete(2)

        def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, Any]:
            self.count = 0
            return np.zeros((480, 640, 3), np.uint8), {}

        def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
            self.count += 1
            return np.full((480, 640, 3), self.count, np.uint8), 0.0, self.count == 12, False, {}

    envs = SyncVectorEnv([ImageEnv, ImageEnv], autoreset_mode=AutoresetMode.SAME_STEP)
    with closing(mcaprl.RecordVecMcap(envs, log_path)) as env:
        env.reset()
        for _ in range(12):
            env.step(np.zeros(2, np.int64))
    data = mcaprl.open(log_path)
    assert data.next_observations[:, 7, 7, 1].tolist() == list(range(1, 13)) * 2
    assert max(chunk.uncompressed_size for chunk in McapReader(log_path).chunks) < 16 * 2**20
