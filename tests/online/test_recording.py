"""Tests of recorded training: SB3's transitions, action probabilities and policy versions."""

from __future__ import annotations

import os
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from numpy.typing import NDArray
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.buffers import ReplayBuffer

import mcaprl
from mcaprl.errors import LogError, OutputExistsError, UsageError
from mcaprl.offline.algorithms.config import CQLConfig
from mcaprl.offline.training.train import train as train_offline
from mcaprl.online.agent import Agent
from mcaprl.online.evaluation import FirstEpisodes
from mcaprl.online.recording import behavior_probabilities, log_paths, recorded
from mcaprl.online.task import Task
from mcaprl.online.train import train
from mcaprl.online.vec_env import BatchedVecEnv
from mcaprl.online.zip_file import read_policy
from mcaprl.progress import TrainingProgress
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.runs import read_curve
from mcaprl.sims import make_sim
from mcaprl.sims.evaluation.evaluate import Scale
from mcaprl.sims.lane.rules import ACTION_COMMANDS
from tests.support.learner_topic import read_learner

SHORT: dict[str, Any] = {
    "steps": 800,
    "hidden": (8,),
    "eval_interval": 400,
    "eval_episodes": 3,
    "final_episodes": 2,
    "learning_starts": 160,
    "target_update_interval": 80,
    "envs": 4,
}
LANE_ACTIONS = 6


def silent(_: TrainingProgress) -> None:
    """A progress callback that does nothing."""


def trained(
    folder: Path, sim_options: dict[str, Any] | None = None, **settings: Any
) -> tuple[Agent, Dataset]:
    """Train an agent for a short time; return the agent and its log."""
    folder.mkdir()
    task = Task.for_sim("lane", "dqn", sim_options, **{**SHORT, **settings})
    path = folder / "log.mcap"
    agent = Agent(task, "mcaprl/LaneKeeping-v0", folder, 0, Scale(0.0, 1.0), record=path)
    with closing(agent):
        agent.learn(silent)
    return agent, mcaprl.open(path)


@pytest.fixture(scope="module")
def usual(tmp_path_factory: pytest.TempPathFactory) -> tuple[Agent, Dataset, Path]:
    """Return an agent that was trained with `SHORT`, its log and its folder; tests change none."""
    folder = tmp_path_factory.mktemp("usual") / "run"
    return *trained(folder), folder


def buffered_episodes(buffer: ReplayBuffer) -> list[dict[str, NDArray[Any]]]:
    """Split the rows of SB3's buffer into episodes, in the order of their ends."""
    episodes = []
    for env in range(buffer.n_envs):
        columns = {
            name: getattr(buffer, name)[: buffer.size(), env]
            for name in (
                "observations",
                "actions",
                "rewards",
                "next_observations",
                "dones",
                "timeouts",
            )
        }
        ends = np.flatnonzero(columns["dones"]).tolist()
        starts = [0, *(end + 1 for end in ends)]
        for start, end in zip(starts, [*ends, buffer.size() - 1], strict=True):
            if start <= end:
                part = {name: values[start : end + 1] for name, values in columns.items()}
                # Episodes that were unfinished at the end of training come last.
                episodes.append((end if end in ends else buffer.size(), env, part))
    return [part for _, _, part in sorted(episodes, key=lambda episode: episode[:2])]


@pytest.mark.parametrize("envs", [1, 4])
def test_the_log_is_sb3s_replay_buffer_row_for_row(
    usual: tuple[Agent, Dataset, Path], tmp_path: Path, envs: int
) -> None:
    agent, log = usual[:2] if envs == SHORT["envs"] else trained(tmp_path / "run", envs=envs)
    assert isinstance(agent.model, DQN)
    assert agent.model.replay_buffer is not None
    episodes = buffered_episodes(agent.model.replay_buffer)
    assert len(log) == sum(len(part["rewards"]) for part in episodes) == 800
    assert len(log.episodes) == len(episodes) > 10
    stored = {name: np.concatenate([part[name] for part in episodes]) for name in episodes[0]}
    np.testing.assert_array_equal(log.observations, stored["observations"])
    np.testing.assert_array_equal(log.next_observations, stored["next_observations"])
    np.testing.assert_array_equal(log.actions, stored["actions"][:, 0])
    np.testing.assert_array_equal(log.rewards.astype(np.float32), stored["rewards"])
    np.testing.assert_array_equal(log.terminated, (stored["dones"] * (1 - stored["timeouts"])) == 1)
    timeouts = [episode.truncated[-1] for episode in log.episodes]
    reported = [part["timeouts"][-1] == 1 or part["dones"][-1] == 0 for part in episodes]
    assert timeouts == reported


def test_logged_commands_are_those_of_the_logged_actions(tmp_path: Path) -> None:
    _, log = trained(tmp_path / "run", sim_options={"observation": "depth-commands"})
    assert log.env_kwargs["observation"] == "depth-commands"
    for episode in log.episodes:
        commands = np.zeros((episode.length + 1, 32, 2), np.float32)
        for step, action in enumerate(episode.actions.tolist()):
            steering = commands[step, 0, 1] if action == 0 else 2 * ACTION_COMMANDS[action].steering
            commands[step + 1, 0] = -1 if action == 0 else 1, steering
            commands[step + 1, 1:] = commands[step, :-1]
        expected = commands.reshape(-1, 64)
        np.testing.assert_array_equal(episode.observations["commands"], expected[:-1])
        np.testing.assert_array_equal(episode.next_observations["commands"], expected[1:])


def killed_log(path: Path, episodes: int) -> bytes:
    """Create the log of a recorder that was killed, and return its bytes."""
    with closing(recorded(Task.for_sim("lane").batch(1), path, algo="dqn", seed=0)) as env:
        env.reset(seed=0)
        while env.episodes < episodes:
            env.step(np.zeros(1, np.int64))
        content = path.read_bytes()
    path.write_bytes(content)
    return content


@pytest.mark.parametrize("operation", ["unlink", "link", "replace"])
def test_a_log_is_in_its_place_throughout_its_recovery(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, operation: str
) -> None:
    path = tmp_path / "log.mcap"
    content = killed_log(path, 2)
    (tmp_path / "log.mcap.damaged").write_bytes(b"of an earlier kill")

    def killed(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    batch = Task.for_sim("lane").batch(1)
    with monkeypatch.context() as patch:
        patch.setattr(Path if operation == "unlink" else os, operation, killed)
        with pytest.raises(KeyboardInterrupt):
            recorded(batch, path, algo="dqn", seed=0, resume=True)
    assert path.read_bytes() == content
    with closing(recorded(batch, path, algo="dqn", seed=0, resume=True)) as env:
        assert env.episodes == 2
    assert (tmp_path / "log.mcap.damaged").read_bytes() == content


@pytest.mark.parametrize("length", [0, 5, 100, None])
def test_a_log_killed_in_its_first_episode_begins_again(tmp_path: Path, length: int | None) -> None:
    path = tmp_path / "log.mcap"
    content = killed_log(path, 0)[:length]
    path.write_bytes(content)
    batch = Task.for_sim("lane").batch(1)
    with closing(recorded(batch, path, algo="dqn", seed=0, resume=True)) as env:
        env.reset(seed=0)
        env.step(np.zeros(1, np.int64))
    assert len(mcaprl.open(path)) == 1


def test_a_file_that_is_no_log_is_not_replaced(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    path.write_text("thesis")
    with pytest.raises(LogError, match="cannot be recovered"):
        recorded(Task.for_sim("lane").batch(1), path, algo="dqn", seed=0, resume=True)
    assert path.read_text() == "thesis"


def test_the_log_can_be_trained_on_offline(
    usual: tuple[Agent, Dataset, Path], tmp_path: Path
) -> None:
    _, log, _ = usual
    config = CQLConfig(updates=20, hidden=(8,), log_interval=10, gamma=0.5, target_interval=2)
    (summary,) = train_offline(log, config, tmp_path / "offline", progress=silent)
    assert summary.steps == 20


def test_probabilities_are_those_of_the_behavior_policy(
    usual: tuple[Agent, Dataset, Path],
) -> None:
    _, log, folder = usual
    learner = read_learner(folder / "log.mcap")
    epsilon, probs = learner.epsilon, log.behavior_probs
    warm_up = learner.policy_version == 0
    # There are 160 random steps, and then four steps of the first policy decision.
    assert (epsilon == 1.0).sum() == 160
    np.testing.assert_allclose(probs[epsilon == 1.0], 1 / LANE_ACTIONS)
    low, high = epsilon / LANE_ACTIONS, 1 - epsilon + epsilon / LANE_ACTIONS
    is_greedy = np.isclose(probs, high, rtol=1e-6)
    assert (is_greedy | np.isclose(probs, low, rtol=1e-6)).all()
    settled = ~warm_up & (epsilon <= 0.05)
    assert is_greedy[settled].mean() > 0.9
    assert learner.policy_version.max() > 100


def test_probabilities_do_not_depend_on_other_predictions(tmp_path: Path) -> None:
    # The learning rate is so small that the network does not change. After each step, an evaluation
    # makes other predictions with the network.
    _, log = trained(
        tmp_path / "run",
        learning_rate=1e-30,
        exploration_initial_eps=0.5,
        exploration_final_eps=0.5,
        eval_interval=4,
        learning_starts=100,
        steps=300,
    )
    epsilon = read_learner(tmp_path / "run" / "log.mcap").epsilon
    greedy = read_policy(tmp_path / "run" / "best_model.zip").act(log.observations)
    expected = epsilon / LANE_ACTIONS + (1 - epsilon) * (log.actions == greedy)
    np.testing.assert_allclose(log.behavior_probs, expected, rtol=1e-6)
    assert 0.3 < (log.actions == greedy)[epsilon < 1].mean() < 0.9


def test_greedy_steps_follow_the_network() -> None:
    env = BatchedVecEnv(Task.for_sim("lane").batch(5))
    model = DQN("MlpPolicy", env, buffer_size=10, learning_starts=0, device="cpu", seed=0)
    observations: Any = env.reset()
    model._last_obs = observations
    model.exploration_rate = 0.4
    greedy = model.predict(observations, deterministic=True)[0]
    other = (greedy + 1) % LANE_ACTIONS
    high, low = 0.6 + 0.4 / LANE_ACTIONS, 0.4 / LANE_ACTIONS
    np.testing.assert_allclose(behavior_probabilities(model, greedy), high)
    np.testing.assert_allclose(behavior_probabilities(model, other), low)
    every = [behavior_probabilities(model, np.full(5, action)) for action in range(LANE_ACTIONS)]
    np.testing.assert_allclose(np.sum(every, axis=0), 1)
    model.learning_starts = 100
    np.testing.assert_allclose(behavior_probabilities(model, greedy), 1 / LANE_ACTIONS)
    env.close()


def test_an_actors_probabilities_sum_to_one() -> None:
    env = BatchedVecEnv(Task.for_sim("lane").batch(5))
    model = PPO("MlpPolicy", env, n_steps=8, batch_size=40, device="cpu", seed=0)
    observations: Any = env.reset()
    model._last_obs = observations
    every = [behavior_probabilities(model, np.full(5, action)) for action in range(LANE_ACTIONS)]
    np.testing.assert_allclose(np.sum(every, axis=0), 1, rtol=1e-6)
    env.close()


def test_recording_changes_nothing(usual: tuple[Agent, Dataset, Path], tmp_path: Path) -> None:
    agent, _, _ = usual
    train(Task.for_sim("lane", "dqn", **SHORT), tmp_path / "plain", progress=silent)
    plain = read_curve(tmp_path / "plain" / "seed-0" / "curve.csv")
    for name in set(plain) - {"score"}:
        assert plain[name].tolist() == [getattr(point, name) for point in agent.points]


def test_each_evaluation_has_a_separate_log(usual: tuple[Agent, Dataset, Path]) -> None:
    agent, _, folder = usual
    paths = sorted((folder / "evaluations").iterdir())
    assert [path.name for path in paths] == ["step-000000400.mcap", "step-000000800.mcap"]
    for path, point in zip(paths, agent.points, strict=True):
        log = mcaprl.open(path)
        returns = [episode.total_reward for episode in log.episodes]
        assert len(returns) == 3
        assert np.mean(returns) == pytest.approx(point.mean_return, rel=1e-5)
        assert min(returns) == pytest.approx(point.lowest_return, rel=1e-5)
        np.testing.assert_array_equal(log.behavior_probs, 1)
        assert log.env_id == "mcaprl/LaneKeeping-v0"
    assert len(mcaprl.open(folder / "evaluations").episodes) == 6


@pytest.mark.parametrize("kwargs", [{}, {"observation": "depth"}])
def test_first_episodes_are_those_of_single_environments(kwargs: dict[str, Any]) -> None:
    name, count = ("powerline", 2) if kwargs else ("lane", 4)
    envs = SyncVectorEnv(
        [lambda: make_sim(name, **kwargs)] * count, autoreset_mode=AutoresetMode.SAME_STEP
    )
    kept = FirstEpisodes(envs, "")
    kept.reset(seed=3)
    random = np.random.default_rng(1)
    actions = random.integers(6, size=(60, count))
    for row in actions:
        kept.step(row)
    episodes = kept.dataset().episodes
    assert len(episodes) == count
    for number, episode in enumerate(episodes):
        env = make_sim(name, **kwargs)
        observation: Any = env.reset(seed=3 + number)[0]
        for step in range(len(episode.rewards)):
            _check_equal(_at(episode.observations, step), observation)
            observation, reward, terminated, truncated, _ = env.step(int(actions[step, number]))
            assert (episode.actions[step], episode.rewards[step]) == (actions[step, number], reward)
        _check_equal(_at(episode.next_observations, -1), observation)
        assert step == 59 or terminated or truncated


def _at(values: Any, step: int) -> Any:
    if isinstance(values, dict):
        return {key: part[step] for key, part in values.items()}
    return values[step]


def _check_equal(one: Any, other: Any) -> None:
    if isinstance(one, dict):
        for key in one:
            _check_equal(one[key], other[key])
    else:
        np.testing.assert_array_equal(one, other)


def test_several_seeds_write_a_file_each(tmp_path: Path) -> None:
    assert log_paths(tmp_path / "a.mcap", range(3, 4), False) == {3: tmp_path / "a.mcap"}
    assert log_paths(tmp_path / "a", range(2), False) == {
        0: tmp_path / "a" / "seed-0.mcap",
        1: tmp_path / "a" / "seed-1.mcap",
    }
    with pytest.raises(UsageError, match="2 seeds write one log each"):
        log_paths(tmp_path / "a.mcap", range(2), False)


def test_an_existing_log_is_not_touched(tmp_path: Path) -> None:
    path = tmp_path / "mine.mcap"
    path.write_bytes(b"mine")
    with pytest.raises(OutputExistsError, match=r"mine\.mcap exists"):
        train(Task.for_sim("lane", **SHORT), tmp_path / "run", record=path, progress=silent)
    assert path.read_bytes() == b"mine"
    assert not (tmp_path / "run").exists()
