"""Tests of training that starts from logs and trained policies."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3 import DQN

import mcaprl
from mcaprl.api.policies import load_policy
from mcaprl.cli import run
from mcaprl.errors import PolicyError, SpaceError, UsageError
from mcaprl.offline.algorithms.config import CQLConfig, DQNConfig
from mcaprl.offline.training.train import train as train_offline
from mcaprl.online.agent import Agent
from mcaprl.online.task import Task
from mcaprl.online.train import train
from mcaprl.online.warm_start import fill_buffer
from mcaprl.progress import TrainingProgress
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.sims.evaluation.evaluate import Scale
from mcaprl.sims.evaluation.rollout import EpsilonGreedy, rollout

SHORT: dict[str, Any] = {
    "steps": 200,
    "hidden": (8,),
    "eval_interval": 200,
    "eval_episodes": 2,
    "final_episodes": 2,
    "target_update_interval": 80,
    "envs": 4,
}
FAST: dict[str, Any] = {"updates": 10, "log_interval": 10, "gamma": 0.5, "target_interval": 2}
VECTOR = spaces.Box(-np.inf, np.inf, (2,))


def silent(_: TrainingProgress) -> None:
    """A progress callback that does nothing."""


def numbered(lengths: list[int], space: spaces.Space[Any] = VECTOR) -> Dataset:
    """Return episodes in which observations, actions and rewards number the transitions."""
    count = sum(lengths)
    ends = np.cumsum(lengths) - 1
    numbers = np.arange(count, dtype=np.float32)
    truncated = np.zeros(count, dtype=bool)
    truncated[ends[::2]] = True
    terminated = np.zeros(count, dtype=bool)
    terminated[ends[1::2]] = True
    return Dataset.from_arrays(
        observations=np.stack([numbers, numbers], 1),
        actions=np.arange(count) % 3,
        rewards=numbers,
        terminated=terminated,
        truncated=truncated,
        next_observations=np.stack([numbers + 1, numbers + 1], 1),
        observation_space=space,
        action_space=spaces.Discrete(3),
    )


class Model(DQN):
    """DQN for the transitions of `numbered`, without an environment."""

    def __init__(self, envs: int, rows: int, **kwargs: Any) -> None:
        super().__init__(
            "MlpPolicy",
            None,  # type: ignore[arg-type]
            buffer_size=rows * envs,
            device="cpu",
            policy_kwargs={"net_arch": [4]},
            _init_setup_model=False,
            **kwargs,
        )
        self.observation_space, self.action_space, self.n_envs = VECTOR, spaces.Discrete(3), envs
        self._setup_model()


@given(
    lengths=st.lists(st.integers(1, 9), min_size=1, max_size=8),
    envs=st.integers(1, 4),
    rows=st.integers(1, 30),
)
def test_the_buffer_holds_the_last_transitions(lengths: list[int], envs: int, rows: int) -> None:
    data, model = numbered(lengths), Model(envs, rows)
    buffer = model.replay_buffer
    assert buffer is not None
    if len(data) < envs:
        with pytest.raises(UsageError, match="are too few"):
            fill_buffer(model, data)
        return
    taken = fill_buffer(model, data)
    filled = min(len(data) // envs, rows)
    assert (taken, buffer.size()) == (filled * envs, filled)
    numbers = buffer.observations[:filled, :, 0].T.ravel()
    np.testing.assert_array_equal(numbers, np.arange(len(data) - taken, len(data)))
    np.testing.assert_array_equal(buffer.next_observations[:filled, :, 1].T.ravel(), numbers + 1)
    np.testing.assert_array_equal(buffer.actions[:filled, :, 0].T.ravel(), numbers % 3)
    np.testing.assert_array_equal(buffer.rewards[:filled].T.ravel(), numbers)
    for env in range(envs):
        column = numbers[env * filled : (env + 1) * filled].astype(int)
        dones, timeouts = buffer.dones[:filled, env], buffer.timeouts[:filled, env]
        terminated = dones * (1 - timeouts)
        np.testing.assert_array_equal(terminated, data.terminated[column])
        assert dones[-1] == 1
        np.testing.assert_array_equal(dones[:-1], (data.terminated | data.truncated)[column[:-1]])


def test_n_step_returns_end_where_the_log_was_cut() -> None:
    model = Model(2, 3, n_steps=3, gamma=0.5)
    fill_buffer(model, numbered([6]))
    buffer: Any = model.replay_buffer
    batch = buffer._get_samples(np.array([1] * 50))
    # Row 1 of column 0 is transition 1, whose return 1 + .5 x 2 ends with the episode. Row 1 of
    # column 1 has the return 4 + .5 x 5.
    assert set(batch.rewards[:, 0].tolist()) == {2.0, 6.5}
    assert set(batch.discounts[:, 0].tolist()) == {0.25}
    assert set(batch.dones[:, 0].tolist()) == {0.0}


def test_other_spaces_are_refused() -> None:
    other = numbered([4], spaces.Box(-1e6, 1e6, (2,)))
    with pytest.raises(SpaceError, match="the logs have observation_space"):
        fill_buffer(Model(2, 4), other)


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record a small log of the lane sim."""
    path = tmp_path_factory.mktemp("logs") / "lane.mcap"
    env = mcaprl.RecordMcap(mcaprl.sims.make_sim("lane"), path, scene=False)
    rollout(env, EpsilonGreedy(None, 1.0, env.action_space), seed=0, episodes=30)
    env.close()
    return path


def agent(folder: Path, algo: str = "double-dqn", **settings: Any) -> Agent:
    task = Task.for_sim("lane", algo, **{**SHORT, **settings})
    return Agent(task, "mcaprl/LaneKeeping-v0", folder, 0, Scale(0.0, 1.0))


def test_an_agent_starts_from_a_log(logs: Path, tmp_path: Path) -> None:
    data = mcaprl.open(logs)
    with closing(agent(tmp_path)) as begun:
        begun.start_from(data, None)
        model: Any = begun.model
        assert model.replay_buffer.size() == min(len(data) // 4, 51)
        begun.learn(silent)
        assert model._n_updates == 50


def test_images_are_transposed_for_the_buffer(tmp_path: Path) -> None:
    path = tmp_path / "depth.mcap"
    env = mcaprl.RecordMcap(mcaprl.sims.make_sim("lane", observation="depth"), path, scene=False)
    rollout(env, EpsilonGreedy(None, 1.0, env.action_space), seed=0, steps=12)
    env.close()
    data = mcaprl.open(path)
    task = Task.for_sim("lane", "dqn", {"observation": "depth"}, **{**SHORT, "envs": 1})
    begun = Agent(task, "mcaprl/LaneKeeping-v0", tmp_path, 0, Scale(0.0, 1.0))
    with closing(begun):
        begun.start_from(data, None)
        buffer: Any = begun.model.replay_buffer  # type: ignore[attr-defined]
        frames = buffer.frames[""]
        assert frames.shape[1:] == (1, 1, 42, 42)
        squares = data.observations.reshape(12, 42, 2, 42, 2)
        expected = np.floor(squares.mean((2, 4)) + 0.5)
        np.testing.assert_array_equal(frames[:12, 0, 0], expected)


def test_an_agent_starts_from_an_offline_policy(logs: Path, tmp_path: Path) -> None:
    config = CQLConfig(updates=30, hidden=(8,), log_interval=10, gamma=0.5, target_interval=2)
    train_offline(mcaprl.open(logs), config, tmp_path / "cql", progress=silent)
    policy = load_policy(tmp_path / "cql")
    observations = mcaprl.open(logs).observations
    with closing(agent(tmp_path, learning_starts=100)) as begun:
        begun.start_from(None, policy)
        model: Any = begun.model
        with torch.inference_mode():
            values = model.q_net(torch.from_numpy(observations)).numpy()
            target = model.q_net_target(torch.from_numpy(observations)).numpy()
        np.testing.assert_allclose(values, policy.q_values(observations), rtol=1e-5, atol=1e-5)
        np.testing.assert_array_equal(values, target)
        begun.learn(silent)
        assert model.exploration_rate == pytest.approx(0.05)
        # The four environments exceed 100 steps after 26 steps of the batch. Each of the 25 later
        # steps is one update.
        assert model._n_updates == 25
        acted = model.replay_buffer.actions[:25, :, 0]
        seen = model.replay_buffer.observations[:25]
        own = policy.act(seen.reshape(-1, 12)).reshape(acted.shape)
        assert (acted == own).mean() > 0.9, "the first steps are its own"


def test_an_agent_continues_from_an_online_policy(tmp_path: Path) -> None:
    task = Task.for_sim("lane", **{**SHORT, "learning_starts": 40})
    (summary,) = train(task, tmp_path / "first", progress=silent)
    policy = load_policy(summary.folder / "best_model.zip")
    again = Task.for_sim("lane", **{**SHORT, "steps": 8, "eval_interval": 4})
    (second,) = train(again, tmp_path / "second", policy=policy, progress=silent)
    assert second.steps == 8


def images_of(task: Task, folder: Path, count: int = 60) -> Path:
    """Record random steps of a task's sim."""
    env = mcaprl.make_sim(task.sim, **task.sim_options)
    with closing(mcaprl.RecordMcap(env, folder / "images.mcap", scene=False)) as recorded:
        rollout(recorded, EpsilonGreedy(None, 1.0, env.action_space), seed=0, steps=count)
    return folder / "images.mcap"


@pytest.mark.parametrize("frame_stack", [1, 2])
@pytest.mark.parametrize("observation", ["depth", "dashboard", "depth-commands"])
def test_a_policy_from_images_keeps_its_values(
    tmp_path: Path, observation: str, frame_stack: int
) -> None:
    """The agent's network includes the policy's normalization of images and vectors."""
    both: dict[str, Any] = {"hidden": (8, 8), "frame_stack": frame_stack, "layer_norm": True}
    settings = {**SHORT, **both, "dueling": True, "envs": 1}
    task = Task.for_sim("lane", None, {"observation": observation}, **settings)
    config = DQNConfig(**both, **FAST, dueling=True, normalize=True)
    data = mcaprl.open(images_of(task, tmp_path))
    train_offline(data, config, tmp_path / "offline", progress=silent)
    policy = load_policy(tmp_path / "offline")
    with closing(Agent(task, "mcaprl/LaneKeeping-v0", tmp_path, 0, Scale(0.0, 1.0))) as begun:
        begun.start_from(data, policy)
        batch: Any = begun.model.replay_buffer.sample(8)  # type: ignore[attr-defined]
        model: Any = begun.model
        with torch.inference_mode():
            values = model.q_net(batch.observations).numpy()
        assert np.isfinite(values).all()


def test_a_policy_of_another_encoder_is_refused(tmp_path: Path) -> None:
    settings = {**SHORT, "envs": 1, "dueling": False, "layer_norm": False, "frame_stack": 1}
    task = Task.for_sim("lane", None, {"observation": "depth"}, **settings)
    data = mcaprl.open(images_of(task, tmp_path))
    config = DQNConfig(**FAST, hidden=(8,), encoder="nature")
    train_offline(data, config, tmp_path / "offline", progress=silent)
    with (
        closing(Agent(task, "mcaprl/LaneKeeping-v0", tmp_path, 0, Scale(0.0, 1.0))) as begun,
        pytest.raises(PolicyError, match=r"1-32-64-64-8-6, but .* 1-16-32-8-6: .*encoder"),
    ):
        begun.start_from(None, load_policy(tmp_path / "offline"))


def test_a_policy_of_another_width_is_refused(logs: Path, tmp_path: Path) -> None:
    config = CQLConfig(updates=10, hidden=(8,), log_interval=10, gamma=0.5, target_interval=2)
    train_offline(mcaprl.open(logs), config, tmp_path / "cql", progress=silent)
    with (
        closing(agent(tmp_path, hidden=(16, 8))) as begun,
        pytest.raises(PolicyError, match="has layers 12-8-6, but the agent has 12-16-8-6"),
    ):
        begun.start_from(None, load_policy(tmp_path / "cql"))


def test_weights_of_other_outputs_are_refused(tmp_path: Path) -> None:
    with closing(agent(tmp_path)) as begun:
        model: Any = begun.model

        class Doubled:
            name, frame_stack = "doubled", 1
            head = SimpleNamespace(networks={"q": model.q_net})
            encoder = SimpleNamespace(width=0)

            def q_values(self, observations: Any) -> Any:
                return 2 * model.q_net(torch.from_numpy(observations)).detach().numpy()

        with pytest.raises(PolicyError, match="a network of another architecture"):
            begun.start_from(None, Doubled())


def test_ppo_accepts_neither_logs_nor_policies(logs: Path, tmp_path: Path) -> None:
    task = Task.for_sim("lane", "ppo", steps=64, envs=4, rollout_steps=64)
    begun = Agent(task, "mcaprl/LaneKeeping-v0", tmp_path, 0, Scale(0.0, 1.0))
    with closing(begun):
        with pytest.raises(UsageError, match="PPO cannot learn from logs"):
            begun.start_from(mcaprl.open(logs), None)
        with pytest.raises(UsageError, match="PPO has no Q-values"):
            begun.start_from(None, object())


def test_the_command_accepts_logs_and_a_policy(
    logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    offline = ["--updates", "20", "--hidden", "8", "--algo", "cql"]
    offline += ["--gamma", "0.5", "--target-interval", "2"]
    assert run(["train-offline", str(logs), "--out", str(tmp_path / "cql"), *offline]) == 0
    sizes = ["--steps", "80", "--hidden", "8", "--eval-interval", "40"]
    sizes += ["--eval-episodes", "2", "--final-episodes", "2"]
    command = ["train-online", "lane", "--out", str(tmp_path / "run"), *sizes]
    assert run([*command, "--from", str(logs), "--from", str(tmp_path / "cql")]) == 0
    twice = [*command, "--from", str(tmp_path / "cql"), "--from", str(tmp_path / "run")]
    assert run(twice) == 2
    assert "pass at most one policy" in capsys.readouterr().err
