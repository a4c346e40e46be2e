"""Tests of `load_policy` with every kind of run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import DQN

import mcaprl
from mcaprl.api.policies import is_policy, load_policies
from mcaprl.errors import PolicyError
from mcaprl.offline.algorithms.config import CQLConfig
from mcaprl.offline.training.train import train as train_offline
from mcaprl.online.task import Task
from mcaprl.online.train import train as train_online
from mcaprl.sims.evaluation.rollout import EpsilonGreedy, rollout

ONLINE: dict[str, Any] = {
    "steps": 400,
    "envs": 2,
    "hidden": (8,),
    "eval_interval": 200,
    "eval_episodes": 2,
}


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make an online run, an offline run (two seeds each) and a file of plain SB3, in CartPole."""
    folder = tmp_path_factory.mktemp("runs")
    task = Task.for_sim("CartPole-v1", **ONLINE, final_episodes=2)
    log = folder / "logs"
    train_online(task, folder / "online", seeds=2, record=log, progress=lambda _: None)
    config = CQLConfig(updates=4, hidden=(8,), target_interval=1, gamma=0.5)
    train_offline(mcaprl.open(log), config, folder / "offline", seeds=2, progress=lambda _: None)
    DQN("MlpPolicy", "CartPole-v1", buffer_size=10).save(folder / "sb3.zip")
    return folder


@pytest.mark.parametrize(
    ("path", "algo", "name"),
    [
        ("online", "double-dqn", "online/seed-0"),
        ("online/seed-1", "double-dqn", "online/seed-1"),
        ("online/seed-1/policy.json", "double-dqn", "online/seed-1"),
        ("offline", "cql", "offline/seed-0"),
        ("offline/seed-1", "cql", "offline/seed-1"),
        ("sb3.zip", "dqn", "sb3"),
    ],
)
def test_every_kind_of_run_loads_as_the_same_kind_of_object(
    runs: Path, path: str, algo: str, name: str
) -> None:
    env, policy = gym.make("CartPole-v1"), mcaprl.load_policy(runs / path)
    assert (policy.algo, policy.name, policy.frame_stack) == (algo, name, 1)
    assert policy.action_space == env.action_space
    observations = np.zeros((3, 4), np.float32)
    policy.begin()
    actions = policy.act(observations)
    assert actions.shape == (3,)
    assert policy.q_values(observations).argmax(1).tolist() == actions.tolist()
    probabilities = policy.action_probabilities(observations)
    np.testing.assert_array_equal(probabilities[np.arange(3), actions], 1)
    (episode,) = rollout(env, EpsilonGreedy(policy, 0.0, env.action_space), seed=0, episodes=1)
    assert episode.length > 0


@pytest.mark.parametrize("path", ["online", "offline"])
def test_all_seeds_of_a_run_load_in_order(runs: Path, path: str) -> None:
    names = [policy.name for policy in load_policies(runs / path)]
    assert names == [f"{path}/seed-0", f"{path}/seed-1"]


def test_logs_are_no_policies(runs: Path) -> None:
    found = {path.name: is_policy(path) for path in runs.iterdir()}
    assert found == {"online": True, "offline": True, "sb3.zip": True, "logs": False}
    with pytest.raises(PolicyError, match="logs has no policy"):
        mcaprl.load_policy(runs / "logs")
