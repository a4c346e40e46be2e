"""Provide the workloads: transitions of known size, and an environment without cost."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

import mcaprl

OBSERVATION = spaces.Box(-np.inf, np.inf, (19,), np.float32)
ACTION = spaces.Discrete(9)
EPISODE_STEPS = 1000
IMAGE_STEPS, IMAGE_SHAPE = 20_000, (84, 84)


class Constant(gym.Env[Any, Any]):
    """Environment with a constant observation, so that only the recorder takes time."""

    observation_space, action_space = OBSERVATION, ACTION

    def __init__(self, episode_steps: int = EPISODE_STEPS) -> None:
        """Prepare the observation."""
        self.observation = np.arange(19, dtype=np.float32)
        self.step_number, self.episode_steps = 0, episode_steps

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        self.step_number = 0
        return self.observation, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Return the same observation at every step."""
        self.step_number += 1
        return self.observation, 1.0, False, self.step_number == self.episode_steps, {}


def run_env(env: gym.Env[Any, Any], episodes: int, steps: int = EPISODE_STEPS) -> None:
    """Run episodes with a constant action, and close the environment."""
    for _ in range(episodes):
        env.reset()
        for _ in range(steps):
            env.step(3)
    env.close()


def vectors(transitions: int) -> mcaprl.Dataset:
    """Return transitions of random numbers, which hardly compress.

    An observation has 19 float32 values. There are 9 actions.
    """
    random = np.random.default_rng(0)
    episodes = transitions // EPISODE_STEPS
    frames = random.standard_normal((episodes, EPISODE_STEPS + 1, 19), np.float32)
    return mcaprl.Dataset.from_arrays(
        observations=frames[:, :-1].reshape(transitions, 19),
        next_observations=frames[:, 1:].reshape(transitions, 19),
        action_space=ACTION,
        **_rest(random, transitions),
    )


def images(transitions: int) -> mcaprl.Dataset:
    """Return transitions with two observations: a vector, and a depth image of a noisy plane."""
    random = np.random.default_rng(0)
    frames = transitions + transitions // EPISODE_STEPS
    plane = np.add.outer(np.arange(84), np.arange(84) // 2).astype(np.uint8)
    noise = random.integers(0, 8, (frames, *IMAGE_SHAPE), np.uint8)
    depth = plane + random.integers(0, 60, (frames, 1, 1), np.uint8) + noise
    states = random.standard_normal((frames, 19), np.float32)
    here = np.arange(transitions) + np.arange(transitions) // EPISODE_STEPS
    return mcaprl.Dataset.from_arrays(
        observations={"depth": depth[here], "state": states[here]},
        next_observations={"depth": depth[here + 1], "state": states[here + 1]},
        observation_space=spaces.Dict(
            {"depth": spaces.Box(0, 255, IMAGE_SHAPE, np.uint8), "state": OBSERVATION}
        ),
        action_space=ACTION,
        **_rest(random, transitions),
    )


def _rest(random: np.random.Generator, transitions: int) -> dict[str, Any]:
    return {
        "actions": random.integers(9, size=transitions),
        "rewards": random.standard_normal(transitions),
        "terminated": np.zeros(transitions, bool),
        "truncated": np.arange(1, transitions + 1) % EPISODE_STEPS == 0,
        "env_id": "CartPole-v1",
    }
