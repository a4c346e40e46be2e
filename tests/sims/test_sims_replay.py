"""Tests that a log is sufficient to repeat its episodes bit for bit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

import mcaprl
from mcaprl.sims import make_sim
from tests.sims.test_sims import every_sim

EPISODES = 4


@every_sim
def test_a_recorded_episode_can_be_repeated(
    name: str, kwargs: dict[str, Any], log_path: Path
) -> None:
    """An episode is recorded with its scene, and repeated in another sim from seed and actions."""
    sim = make_sim(name, max_episode_steps=25, **kwargs)
    sim.action_space.seed(1)
    env = mcaprl.RecordMcap(sim, log_path)
    for seed in range(EPISODES):
        env.reset(seed=seed)
        ended = False
        while not ended:
            _, _, terminated, truncated, _ = env.step(env.action_space.sample())
            ended = terminated or truncated
    env.close()

    again = make_sim(name, max_episode_steps=25, **kwargs)
    data = mcaprl.open(log_path)
    assert len(data.episodes) == EPISODES
    for episode in data.episodes:
        observation, _ = again.reset(seed=episode.seed)
        for k in range(len(episode.actions)):
            check_equal(row(episode.observations, k), observation)
            observation, reward, terminated, truncated, _ = again.step(episode.actions[k])
            check_equal(row(episode.next_observations, k), observation)
            assert np.float64(episode.rewards[k]).tobytes() == np.float64(reward).tobytes()
            assert (episode.terminated[k], episode.truncated[k]) == (terminated, truncated)
        assert terminated or truncated


def row(observations: Any, k: int) -> Any:
    if isinstance(observations, dict):
        return {key: values[k] for key, values in observations.items()}
    return observations[k]


def check_equal(logged: Any, lived: Any) -> None:
    if isinstance(lived, dict):
        assert set(logged) == set(lived)
        for key in lived:
            check_equal(logged[key], lived[key])
    else:
        assert (logged.dtype, logged.shape) == (lived.dtype, lived.shape)
        assert logged.tobytes() == lived.tobytes()
