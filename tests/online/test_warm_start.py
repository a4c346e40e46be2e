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

import mcaprl
from mcaprl.api.policies import load_policy
from mcaprl.chunks import Chunks
from mcaprl.cli import run
from mcaprl.errors import PolicyError, SpaceError, UsageError
from mcaprl.frames import mapped
from mcaprl.offline.algorithms.config import CQLConfig, DQNConfig
from mcaprl.offline.batches.observations import ObservationEncoder
from mcaprl.offline.training.train import train as train_offline
from mcaprl.online.config import DoubleDQNConfig
from mcaprl.online.engine import Agents
from mcaprl.online.learning import LearningAgent, fill_buffer
from mcaprl.online.sb3 import ModelAgent
from mcaprl.online.task import Task
from mcaprl.online.train import train
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
CPU = torch.device("cpu")
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


def agents_of(envs: int, rows: int, **settings: Any) -> Agents:
    """Return an agent for the transitions of `numbered`."""
    size = rows * envs
    config = DoubleDQNConfig(
        envs=envs, buffer_size=size, hidden=(4,), steps_per_update=envs, **settings
    )
    return Agents(config, ObservationEncoder(VECTOR, 3), spaces.Discrete(3), [0], CPU)


@given(
    lengths=st.lists(st.integers(1, 9), min_size=1, max_size=8),
    envs=st.integers(1, 4),
    rows=st.integers(1, 30),
)
def test_the_buffer_holds_the_last_transitions(lengths: list[int], envs: int, rows: int) -> None:
    data, agents = numbered(lengths), agents_of(envs, rows, gamma=0.5)
    buffer = agents.buffer
    if len(data) < envs:
        with pytest.raises(UsageError, match="are too few"):
            fill_buffer(agents, data)
        return
    taken = fill_buffer(agents, data)
    filled = min(len(data) // envs, rows)
    assert (taken, buffer.stored) == (filled * envs, filled)
    # Training begins with new episodes, which ends those of the log.
    buffer.begin(ObservationEncoder(VECTOR, 3).encode(np.zeros((envs, 2), np.float32)))
    batch = buffer.batch(torch.arange(filled * envs))

    def by_environment(column: torch.Tensor) -> Any:
        return column.view(filled, envs).T.flatten().numpy()

    numbers = by_environment(batch.observations.vector[:, 0])
    np.testing.assert_array_equal(numbers, np.arange(len(data) - taken, len(data)))
    rows_ = numbers.astype(int)
    following = by_environment(batch.next_observations.vector[:, 1])
    np.testing.assert_array_equal(following, numbers + 1)
    np.testing.assert_array_equal(by_environment(batch.actions), rows_ % 3)
    np.testing.assert_array_equal(by_environment(batch.rewards), numbers)
    discounts = by_environment(batch.discounts)
    np.testing.assert_array_equal(discounts, np.where(data.terminated[rows_], 0, 0.5))
    goes_on = by_environment(buffer.goes_on[:filled].flatten()).reshape(envs, filled)
    assert not goes_on[:, -1].any()
    ends = (data.terminated | data.truncated)[rows_].reshape(envs, filled)
    np.testing.assert_array_equal(goes_on[:, :-1], ~ends[:, :-1])


def test_n_step_returns_end_where_the_log_was_cut() -> None:
    agents = agents_of(2, 3, n_steps=3, gamma=0.5)
    fill_buffer(agents, numbered([6]))
    agents.buffer.begin(ObservationEncoder(VECTOR, 3).encode(np.zeros((2, 2), np.float32)))
    # Row 1 of column 0 is transition 1, whose return 1 + .5 x 2 ends with the part. Row 1 of
    # column 1 has the return 4 + .5 x 5.
    batch = agents.buffer.batch(torch.tensor([2, 3]))
    assert batch.rewards.tolist() == [2.0, 6.5]
    assert batch.discounts.tolist() == [0.25, 0.25]
    assert batch.next_observations.vector.tolist() == [[3, 3], [6, 6]]


def test_other_spaces_are_refused() -> None:
    other = numbered([4], spaces.Box(-1e6, 1e6, (2,)))
    with pytest.raises(SpaceError, match="the logs have observation_space"):
        fill_buffer(agents_of(2, 4), other)


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record a small log of the lane sim."""
    path = tmp_path_factory.mktemp("logs") / "lane.mcap"
    env = mcaprl.RecordMcap(mcaprl.sims.make_sim("lane"), path, scene=False)
    rollout(env, EpsilonGreedy(None, 1.0, env.action_space), seed=0, episodes=30)
    env.close()
    return path


def agent(folder: Path, sim_options: Any = None, **settings: Any) -> LearningAgent:
    task = Task.for_sim("lane", None, sim_options, **{**SHORT, **settings})
    return LearningAgent(task, "mcaprl/LaneKeeping-v0", folder, 0, Scale(0.0, 1.0))


def test_an_agent_starts_from_a_log(logs: Path, tmp_path: Path) -> None:
    data = mcaprl.open(logs)
    with closing(agent(tmp_path)) as begun:
        begun.start_from(data, None)
        assert begun.agents.buffer.stored == min(len(data) // 4, 51)
        begun.learn(silent)
        assert begun.updates == 50


def test_images_are_averaged_for_the_buffer(tmp_path: Path) -> None:
    path = tmp_path / "depth.mcap"
    env = mcaprl.RecordMcap(mcaprl.sims.make_sim("lane", observation="depth"), path, scene=False)
    rollout(env, EpsilonGreedy(None, 1.0, env.action_space), seed=0, steps=12)
    env.close()
    data = mcaprl.open(path)
    with closing(agent(tmp_path, {"observation": "depth"}, envs=1)) as begun:
        begun.start_from(data, None)
        frames = begun.agents.buffer.frames.images[0]
        assert frames.shape[1:] == (42, 42, 1)
        squares = data.observations.reshape(12, 42, 2, 42, 2)
        expected = np.floor(squares.mean((2, 4)) + 0.5)
        np.testing.assert_array_equal(frames[:12, ..., 0], expected)


def test_an_agent_starts_from_an_offline_policy(logs: Path, tmp_path: Path) -> None:
    config = CQLConfig(updates=30, hidden=(8,), log_interval=10, gamma=0.5, target_interval=2)
    train_offline(mcaprl.open(logs), config, tmp_path / "cql", progress=silent)
    policy = load_policy(tmp_path / "cql")
    observations = mcaprl.open(logs).observations
    with closing(agent(tmp_path, learning_starts=100)) as begun:
        begun.start_from(None, policy)
        learner, inputs = begun.agents.learner, begun._encoder.encode(observations)
        values = begun.policy.q_values(observations)
        with torch.inference_mode():
            target = learner.all_models()["q_target"](inputs).numpy()
        np.testing.assert_array_equal(values, policy.q_values(observations))
        np.testing.assert_allclose(target, values, rtol=1e-5, atol=1e-5)
        begun.learn(silent)
        assert begun.epsilon == 0.05
        # The four environments exceed 100 steps after 26 steps of the batch. Each of the 25 later
        # steps is one update.
        assert begun.updates == 25
        batch = begun.agents.buffer.batch(torch.arange(100))
        own = policy.act(batch.observations.vector.numpy())
        assert (batch.actions.numpy() == own).mean() > 0.9, "the first steps are its own"


def test_an_agent_continues_from_an_online_policy(tmp_path: Path) -> None:
    task = Task.for_sim("lane", **{**SHORT, "learning_starts": 40})
    (summary,) = train(task, tmp_path / "first", progress=silent)
    policy = load_policy(summary.folder)
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
    """The agent takes over the policy's normalization of images and vectors."""
    both: dict[str, Any] = {"hidden": (8, 8), "frame_stack": frame_stack, "layer_norm": True}
    settings = {**SHORT, **both, "dueling": True, "envs": 1}
    task = Task.for_sim("lane", None, {"observation": observation}, **settings)
    config = DQNConfig(**both, **FAST, dueling=True, normalize=True)
    data = mcaprl.open(images_of(task, tmp_path))
    train_offline(data, config, tmp_path / "offline", progress=silent)
    policy = load_policy(tmp_path / "offline")
    with closing(agent(tmp_path, {"observation": observation}, **settings)) as begun:
        begun.start_from(data, policy)
        rows = begun.agents.buffer.draw(8, [])
        observed = begun.agents.buffer.batch(rows).observations
        with torch.inference_mode():
            values = begun.agents.learner.outputs("q", observed).numpy()
        stacks = np.maximum(rows.numpy()[:, None] - np.arange(frame_stack)[::-1], 0)
        ends = data.terminated | data.truncated
        if not ends[: rows.max()].any():
            seen = mapped(
                lambda part: part[stacks] if frame_stack > 1 else part[stacks[:, 0]],
                data.observations,
            )
            # The buffer has rounded averages of the pixels.
            np.testing.assert_allclose(values, policy.q_values(seen), rtol=0.1, atol=0.02)
        assert np.isfinite(values).all()


def test_a_policy_of_another_encoder_is_refused(tmp_path: Path) -> None:
    settings = {**SHORT, "envs": 1, "dueling": False, "layer_norm": False, "frame_stack": 1}
    task = Task.for_sim("lane", None, {"observation": "depth"}, **settings)
    data = mcaprl.open(images_of(task, tmp_path))
    config = DQNConfig(**FAST, hidden=(8,), encoder="nature")
    train_offline(data, config, tmp_path / "offline", progress=silent)
    with (
        closing(agent(tmp_path, {"observation": "depth"}, **settings)) as begun,
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
        network = begun.agents.learner.network("q", 0)

        class Doubled:
            name, algo, frame_stack, encoder = "doubled", "", 1, None
            head, chunk = SimpleNamespace(networks={"q": network}), Chunks()

            def q_values(self, observations: Any) -> Any:
                return 2 * begun.policy.q_values(observations)

        with pytest.raises(PolicyError, match="a network of another architecture"):
            begun.start_from(None, Doubled())


def test_a_policy_of_sb3_initializes_an_agent(tmp_path: Path) -> None:
    task = Task.for_sim("lane", "dqn", **{**SHORT, "learning_starts": 40})
    (summary,) = train(task, tmp_path / "first", progress=silent)
    policy = load_policy(summary.folder)
    with closing(agent(tmp_path)) as begun:
        begun.start_from(None, policy)
        seen = np.random.default_rng(0).normal(size=(9, 12)).astype(np.float32)
        np.testing.assert_allclose(
            begun.policy.q_values(seen), policy.q_values(seen), rtol=1e-4, atol=1e-5
        )


def test_a_policy_without_values_is_refused(logs: Path, tmp_path: Path) -> None:
    mcaprl.train(logs, tmp_path / "bc", algo="bc", updates=1, hidden=(8,))
    with (
        closing(agent(tmp_path)) as begun,
        pytest.raises(PolicyError, match=r"seed-0 \(bc\) has no Q-values to start from"),
    ):
        begun.start_from(None, load_policy(tmp_path / "bc"))


@pytest.mark.parametrize("algo", ["dqn", "ppo"])
def test_models_of_sb3_start_from_neither_logs_nor_policies(
    logs: Path, tmp_path: Path, algo: str
) -> None:
    settings: dict[str, Any] = {"rollout_steps": 64} if algo == "ppo" else {}
    task = Task.for_sim("lane", algo, steps=64, envs=4, **settings)
    with closing(ModelAgent(task, "mcaprl/LaneKeeping-v0", tmp_path, 0, Scale(0.0, 1.0))) as begun:
        for data, policy in ((mcaprl.open(logs), None), (None, object())):
            with pytest.raises(UsageError, match=f"{algo} of Stable-Baselines3 cannot start from"):
                begun.start_from(data, policy)


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
