"""Replay buffers of Stable-Baselines3: filled as SB3 fills them, and read back."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import hypothesis.strategies as st
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import assume, given, settings
from numpy.typing import NDArray

import mcaprl
from mcaprl import Dataset, RecordMcap
from mcaprl.errors import LogError, SpaceError, UsageError
from mcaprl.recorder.dataset.formats import sb3
from tests.support.strategies import transitions

sb3_package = pytest.importorskip("stable_baselines3", reason="needs the extra online")
buffers = pytest.importorskip("stable_baselines3.common.buffers")
torch = pytest.importorskip("torch")

_ARRAYS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


class Counter(gym.Env[Any, Any]):
    """Environment in which all elements of observation k are k; episodes have 4 or 6 steps."""

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012

    def __init__(
        self, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]
    ) -> None:
        self.observation_space, self.action_space = observation_space, action_space
        self._episode = self._step = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self._episode, self._step = self._episode + 1, 0
        return self._observation(self.observation_space), {}

    def step(self, action: Any) -> Any:
        self._step += 1
        is_odd = self._episode % 2 == 1
        terminated, truncated = is_odd and self._step == 4, not is_odd and self._step == 6
        reward = self._step + float(np.sum(action)) / 8
        return self._observation(self.observation_space), reward, terminated, truncated, {}

    def _observation(self, space: spaces.Space[Any]) -> Any:
        if isinstance(space, spaces.Dict):
            return {key: self._observation(part) for key, part in space.items()}
        if isinstance(space, spaces.Box) and len(space.shape) == 3:
            # The channels differ, so that their order matters.
            return (np.indices(space.shape)[2] + self._step).astype(np.uint8)
        return np.full(space.shape or (), self._step, space.dtype)


_VECTOR = spaces.Box(-np.inf, np.inf, (2,), np.float32)
_CAMERA = spaces.Box(0, 255, (36, 40, 3), np.uint8)


def _learned(
    path: Path, space: spaces.Space[Any], policy: str, steps: int, **options: Any
) -> tuple[Any, Dataset]:
    """Run DQN on a recorded environment; return the algorithm and its log."""
    env = RecordMcap(Counter(space, spaces.Discrete(3)), path)
    model = sb3_package.DQN(
        policy, env, buffer_size=steps, learning_starts=steps, seed=0, device="cpu", **options
    )
    model.learn(steps)
    env.close()
    return model, mcaprl.open(path)


def _seed() -> None:
    """Seed NumPy's global generator, from which SB3's buffers sample."""
    np.random.seed(0)  # noqa: NPY002


def _sample(buffer: Any, size: int) -> Any:
    _seed()
    return buffer.sample(size)


def _same_buffers(ours: Any, theirs: Any) -> None:
    assert type(ours) is type(theirs)
    assert (ours.pos, ours.full) == (theirs.pos, theirs.full)
    assert ours.observation_space == theirs.observation_space
    for name in _ARRAYS:
        mine, other = getattr(ours, name), getattr(theirs, name)
        for key in mine if isinstance(mine, dict) else [...]:
            assert mine[key].dtype == other[key].dtype, name
            np.testing.assert_array_equal(mine[key], other[key], name)


@pytest.mark.parametrize(
    ("space", "policy"),
    [
        (_VECTOR, "MlpPolicy"),
        (spaces.Discrete(7), "MlpPolicy"),
        (_CAMERA, "CnnPolicy"),
        (spaces.Dict({"camera": _CAMERA, "speed": _VECTOR}), "MultiInputPolicy"),
    ],
)
def test_the_buffer_is_equal_to_the_one_that_sb3_filled(
    tmp_path: Path, space: spaces.Space[Any], policy: str
) -> None:
    # 40 steps are eight whole episodes: four terminate and four are truncated.
    model, dataset = _learned(tmp_path / "log.mcap", space, policy, 40)
    ours = dataset.to_sb3()
    assert (ours.dones.sum(), ours.timeouts.sum()) == (8, 4)
    _same_buffers(ours, model.replay_buffer)
    mine, theirs = (_sample(buffer, 16) for buffer in (ours, model.replay_buffer))
    for one, other in zip(mine, theirs, strict=True):
        for key in one if isinstance(one, dict) else [...]:
            assert one is None or torch.equal(one[key], other[key])


def test_training_on_the_buffer_gives_the_same_weights(tmp_path: Path) -> None:
    model, dataset = _learned(tmp_path / "log.mcap", _VECTOR, "MlpPolicy", 40)
    weights = []
    for buffer in (model.replay_buffer, dataset.to_sb3(buffer_size=40)):
        env = Counter(_VECTOR, spaces.Discrete(3))
        learner = sb3_package.DQN("MlpPolicy", env, buffer_size=40, seed=1, device="cpu")
        learner.replay_buffer = buffer
        learner._setup_learn(0, None)
        _seed()
        learner.train(20, batch_size=8)
        weights.append(learner.policy.state_dict())
    for name, tensor in weights[0].items():
        assert torch.equal(tensor, weights[1][name])


def test_n_step_returns_are_those_of_sb3(tmp_path: Path) -> None:
    # The last episode of the log was interrupted. N-step returns must not extend beyond its end.
    model, dataset = _learned(tmp_path / "log.mcap", _VECTOR, "MlpPolicy", 44, n_steps=3)
    ours = dataset.to_sb3(buffer_class=buffers.NStepReplayBuffer, n_steps=3, gamma=0.99)
    found = [_sample(buffer, 64) for buffer in (ours, model.replay_buffer)]
    assert len({tuple(row) for row in found[0].observations.tolist()}) > 4
    for one, other in zip(*found, strict=True):
        assert torch.equal(one, other)


def test_bounded_actions_are_scaled_as_sb3_scales_them(tmp_path: Path) -> None:
    space = spaces.Box(np.array([-2, 0], np.float32), np.array([2, 10], np.float32))
    env = RecordMcap(Counter(_VECTOR, space), tmp_path / "log.mcap")
    model = sb3_package.SAC("MlpPolicy", env, buffer_size=40, learning_starts=40, seed=0)
    model.learn(40)
    env.close()
    dataset = mcaprl.open(tmp_path / "log.mcap")
    ours = dataset.to_sb3()
    assert np.abs(dataset.actions).max() > 5 > 1 >= np.abs(ours.actions).max()
    np.testing.assert_allclose(ours.actions, model.replay_buffer.actions, atol=1e-6)
    back = Dataset.from_sb3(model.replay_buffer)
    np.testing.assert_allclose(back.actions, dataset.actions, atol=1e-5)
    np.testing.assert_array_equal(back.rewards.astype(np.float32), ours.rewards[:, 0])
    assert [e.truncated[-1] for e in back.episodes] == [False, True] * 4
    raw = Dataset.from_sb3(model.replay_buffer, scaled_actions=False)
    np.testing.assert_array_equal(raw.actions, model.replay_buffer.actions[:, 0])


def test_unscaled_actions_are_scaled_by_hand() -> None:
    space = spaces.Box(np.array([-2, 0], np.float32), np.array([2, 10], np.float32))
    buffer = _steps(actions=[[-2, 10], [1, 2.5]], action_space=space).to_sb3()
    np.testing.assert_array_equal(buffer.actions[:, 0], [[-1, 1], [0.5, -0.5]])
    buffer.actions[0, 0, 1] = 4
    with pytest.raises(SpaceError, match="scaled_actions=False"):
        Dataset.from_sb3(buffer)
    unbounded = spaces.Box(-np.inf, np.inf, (2,), np.float32)
    buffer = _steps(actions=[[-2, 10], [1, 2.5]], action_space=unbounded).to_sb3()
    np.testing.assert_array_equal(buffer.actions[:, 0], [[-2, 10], [1, 2.5]])
    fixed = spaces.Box(np.array([-2, 1], np.float32), np.array([2, 1], np.float32))
    with pytest.raises(SpaceError, match="cannot be scaled"):
        _steps(actions=[[-2, 1], [1, 1]], action_space=fixed).to_sb3()


def test_several_environments_follow_each_other(tmp_path: Path) -> None:
    logs = [tmp_path / f"{name}.mcap" for name in "ab"]
    envs = [RecordMcap(Counter(_VECTOR, spaces.Discrete(3)), path) for path in logs]
    vector = sb3_package.common.vec_env.DummyVecEnv([lambda env=env: env for env in envs])
    model = sb3_package.DQN("MlpPolicy", vector, buffer_size=40, learning_starts=40, seed=0)
    model.learn(40)
    vector.close()
    found, recorded = Dataset.from_sb3(model.replay_buffer), mcaprl.open(logs)
    assert found.fingerprint == recorded.fingerprint
    assert found.episode_lengths.tolist() == [4, 6] * 4
    assert (np.diff(np.concatenate([e.log_time_ns for e in found.episodes])) > 0).all()


def test_an_overwritten_buffer_returns_the_remaining_transitions(tmp_path: Path) -> None:
    env = RecordMcap(Counter(_VECTOR, spaces.Discrete(3)), tmp_path / "log.mcap")
    model = sb3_package.DQN("MlpPolicy", env, buffer_size=15, learning_starts=99, seed=0)
    model.learn(40)
    env.close()
    assert (model.replay_buffer.full, model.replay_buffer.pos) == (True, 10)
    found, recorded = Dataset.from_sb3(model.replay_buffer), mcaprl.open(tmp_path / "log.mcap")
    for name in ("observations", "next_observations", "actions", "terminated", "truncated"):
        np.testing.assert_array_equal(getattr(found, name), getattr(recorded, name)[25:])
    assert found.episode_lengths.tolist() == [5, 4, 6]


def test_shared_observations_are_stored_as_sb3_stores_them(tmp_path: Path) -> None:
    options: dict[str, Any] = {"handle_timeout_termination": False}
    model, dataset = _learned(
        tmp_path / "log.mcap",
        _VECTOR,
        "MlpPolicy",
        40,
        optimize_memory_usage=True,
        replay_buffer_kwargs=options,
    )
    theirs, ours = model.replay_buffer, dataset.to_sb3(optimize_memory_usage=True, **options)
    assert (ours.buffer_size, ours.pos, ours.full) == (41, 40, False)
    for name in ("observations", "actions", "rewards", "dones", "timeouts"):
        # SB3's buffer has one row less, so the last next observation is in its first row.
        np.testing.assert_array_equal(getattr(ours, name)[1:40], getattr(theirs, name)[1:])
    np.testing.assert_array_equal(ours.observations[40], theirs.observations[0])
    with pytest.raises(LogError, match="lossy=True"):
        Dataset.from_sb3(ours)
    for buffer, first in ((ours, 0), (theirs, 1)):
        found = Dataset.from_sb3(buffer, lossy=True)
        np.testing.assert_array_equal(found.observations, dataset.observations[first:])
        # All final observations are lost, except the newest one.
        assert [e.next_observations[-1, 0] for e in found.episodes] == [3, 5, 3, 5, 3, 5, 3, 6]
        assert all(e.terminated[-1] and not e.truncated[-1] for e in found.episodes)


def test_a_buffer_without_timeouts_needs_lossy(tmp_path: Path) -> None:
    buffer = _steps().to_sb3(handle_timeout_termination=False)
    with pytest.raises(LogError, match="handle_timeout_termination=False"):
        Dataset.from_sb3(buffer)
    assert Dataset.from_sb3(buffer, lossy=True).terminated.tolist() == [False, True]


def test_an_end_without_a_flag_is_no_termination() -> None:
    # The second episode was interrupted, so the learner must bootstrap from its last observation.
    columns: dict[str, Any] = {
        "observations": np.array([[0], [1], [5], [6]], np.float32),
        "next_observations": np.array([[1], [2], [6], [7]], np.float32),
        "actions": np.array([0, 1, 0, 1]),
        "rewards": np.ones(4),
        "terminated": [False, True, False, False],
        "truncated": [False] * 4,
    }
    buffer = Dataset.from_arrays(**columns).to_sb3(buffer_size=6)
    assert (buffer.pos, buffer.full, buffer.size()) == (4, False, 4)
    assert buffer.dones[:, 0].tolist() == [0, 1, 0, 1, 0, 0]
    assert buffer.timeouts[:, 0].tolist() == [0, 0, 0, 1, 0, 0]
    found = Dataset.from_sb3(buffer)
    assert found.truncated.tolist() == [False, False, False, True]
    # SB3 sets no flag at the end of a training run. The observations then show the end of an
    # episode.
    buffer.dones[1] = buffer.dones[3] = 0
    assert Dataset.from_sb3(buffer).episode_lengths.tolist() == [2, 2]


def test_environments_of_equal_observations_are_not_one_episode() -> None:
    space = spaces.Box(0, 1, (1,), np.float32)
    buffer = buffers.ReplayBuffer(6, space, spaces.Discrete(2), "cpu", n_envs=2)
    zeros = np.zeros((2, 1), np.float32)
    for action in range(2):
        buffer.add(zeros, zeros, np.full(2, action), np.zeros(2), np.zeros(2), [{}, {}])
    found = Dataset.from_sb3(buffer)
    assert found.episode_lengths.tolist() == [2, 2]
    assert found.actions.tolist() == [0, 1, 0, 1]


def test_channels_can_keep_their_order(tmp_path: Path) -> None:
    model, dataset = _learned(tmp_path / "log.mcap", _CAMERA, "CnnPolicy", 40)
    found = Dataset.from_sb3(model.replay_buffer)
    assert found.observation_space == _CAMERA
    np.testing.assert_array_equal(found.frames, dataset.frames)
    first = Dataset.from_sb3(model.replay_buffer, channels_last=False)
    assert first.observation_space == spaces.Box(0, 255, (3, 36, 40), np.uint8)
    np.testing.assert_array_equal(first.frames, dataset.frames.transpose(0, 3, 1, 2))


@settings(max_examples=60)
@given(transitions(), st.integers(0, 3))
def test_all_spaces_come_back_or_are_refused(arguments: dict[str, Any], spare: int) -> None:
    with np.errstate(all="ignore"):
        arguments["rewards"] = arguments["rewards"].astype(np.float32)
    dataset = Dataset.from_arrays(**arguments)
    assume(not isinstance(dataset.action_space, spaces.Box))
    try:
        buffer = dataset.to_sb3(buffer_size=len(dataset) + spare)
    except SpaceError:
        assert not _is_supported(dataset)
        return
    found = Dataset.from_sb3(buffer)
    assert found.observation_space == dataset.observation_space
    assert found.episode_lengths.tolist() == dataset.episode_lengths.tolist()
    for name in ("actions", "rewards", "terminated"):
        np.testing.assert_array_equal(getattr(found, name), getattr(dataset, name))
    for mine, other in zip(_leaves(dataset.frames), _leaves(found.frames), strict=True):
        assert mine.tobytes() == other.tobytes()


def test_spaces_that_sb3_does_not_support_are_refused_by_name() -> None:
    floats, integers = (spaces.Box(0, 1, (2,), kind) for kind in (np.float32, np.int64))
    grid = spaces.MultiDiscrete(np.array([[2, 2]]))
    cases: list[tuple[spaces.Space[Any], spaces.Space[Any], str]] = [
        (floats, spaces.Discrete(3, start=1), r"action is Discrete\(3, start=1\)"),
        (floats, integers, "action is a Box of int64"),
        (floats, grid, "action is .*one dimension"),
        (floats, spaces.MultiBinary((2, 2)), "action is .*one dimension"),
        (spaces.Discrete(3, start=-1), spaces.Discrete(2), "observation is .*that starts at 0"),
        (
            spaces.Box(0, 1, (), np.float32),
            spaces.Discrete(2),
            r"observation is a Box of shape \(\)",
        ),
        (
            spaces.Dict({"arm": spaces.Dict({"q": floats})}),
            spaces.Discrete(2),
            r"observation\['arm'\] is a Dict",
        ),
    ]
    for observation_space, action_space, message in cases:
        with pytest.raises(SpaceError, match=message):
            sb3._check_spaces(observation_space, action_space)


def test_numbers_that_float32_cannot_hold_are_refused() -> None:
    with pytest.raises(SpaceError, match=r"reward 1e\+300 is too large"):
        _steps(rewards=[1, 1e300]).to_sb3()
    assert _steps(rewards=[1, np.inf]).to_sb3().rewards[1, 0] == np.inf
    # Other rewards are rounded to float32, as in SB3.
    assert _steps(rewards=[1, 0.1]).to_sb3().rewards[1, 0] == np.float32(0.1)
    space = spaces.Box(-np.inf, np.inf, (1,), np.float64)
    with pytest.raises(SpaceError, match=r"action -1e\+300 is too large"):
        _steps(actions=[[1], [-1e300]], action_space=space).to_sb3()


def test_wrong_arguments_and_empty_buffers() -> None:
    with pytest.raises(UsageError, match="buffer_size is 1, but the dataset needs 2 rows"):
        _steps().to_sb3(buffer_size=1)
    with pytest.raises(UsageError, match="n_envs must be 1"):
        _steps().to_sb3(n_envs=2)
    with pytest.raises(UsageError, match="ReplayBuffer does not support optimize_memory_usage"):
        _steps().to_sb3(optimize_memory_usage=True)
    with pytest.raises(UsageError, match="unexpected keyword argument 'gama'"):
        _steps().to_sb3(gama=0.9)
    with pytest.raises(UsageError, match="expected a ReplayBuffer of SB3, but this is a list"):
        Dataset.from_sb3([])
    empty = buffers.ReplayBuffer(3, _VECTOR, spaces.Discrete(2), "cpu")
    with pytest.raises(LogError, match="has no transitions"):
        Dataset.from_sb3(empty)


def _steps(
    actions: Any = (0, 1),
    action_space: spaces.Space[Any] | None = None,
    rewards: Any = (0.5, -1),
) -> Dataset:
    """Return an episode of two transitions that is truncated."""
    return Dataset.from_arrays(
        observations=np.array([[0], [1]], np.float32),
        next_observations=np.array([[1], [2]], np.float32),
        actions=np.asarray(actions, None if action_space is None else action_space.dtype),
        rewards=np.array(rewards, float),
        terminated=[False, False],
        truncated=[False, True],
        action_space=action_space,
        observation_space=spaces.Box(-np.inf, np.inf, (1,), np.float32),
    )


def _leaves(frames: Any) -> list[NDArray[Any]]:
    return list(frames.values()) if isinstance(frames, dict) else [frames]


def _is_supported(dataset: Dataset) -> bool:
    """Return whether the spaces of a dataset start at 0 and have no Box of a single number."""
    space = dataset.observation_space
    parts = [*space.values()] if isinstance(space, spaces.Dict) else [space]
    return not any(
        (isinstance(part, spaces.Discrete) and part.start != 0)
        or (isinstance(part, spaces.Box) and part.shape == ())
        for part in (*parts, dataset.action_space)
    )
