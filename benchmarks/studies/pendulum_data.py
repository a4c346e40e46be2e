"""Logs of Pendulum-v1 by a scripted pilot: energy control below, and a PD controller at the top.

The rewards are the negative squares of angle, speed and torque.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

import mcaprl

STEPS = 200
TORQUE = 2.0
PILOT, RANDOM = -170.0, -1_230.0
"""Mean returns of the pilot, and of random torques."""
BLENDS = {"expert": (0.0, 0.0), "noisy": (0.3, 0.3), "random": (1.0, 0.0), "mixed": (-1.0, 0.3)}
"""Probability of a random torque, and deviation of the noise on others, by the kind of a log.

A probability of -1 is drawn for each episode, from 0 to 1.
"""


def pilot(observation: NDArray[Any]) -> float:
    """Return the torque that swings the pendulum up and holds it, before noise."""
    cosine, sine, speed = (float(number) for number in observation)
    angle = np.arctan2(sine, cosine)
    if cosine > 0.9:
        return float(np.clip(-12 * angle - 3 * speed, -TORQUE, TORQUE))
    energy = speed**2 / 6 + 5 * (cosine - 1)
    return TORQUE if energy * speed <= 0 else -TORQUE


def pendulum(
    kind: str | tuple[float, float] = "mixed", episodes: int = 100, seed: int = 0
) -> mcaprl.Dataset:
    """Record episodes of 200 steps; `kind` is a key of `BLENDS`, or a value such as those."""
    chance, deviation = BLENDS[kind] if isinstance(kind, str) else kind
    env, random = gym.make("Pendulum-v1"), np.random.default_rng(seed)
    rows: list[tuple[Any, ...]] = []
    for episode in range(episodes):
        observation, _ = env.reset(seed=10_000 * seed + episode)
        share = random.random() if chance < 0 else chance
        for step in range(STEPS):
            torque = pilot(observation) + deviation * TORQUE * random.standard_normal()
            if random.random() < share:
                torque = random.uniform(-TORQUE, TORQUE)
            action = np.clip([torque], -TORQUE, TORQUE).astype(np.float32)
            following, reward, *_ = env.step(action)
            rows.append((observation, action, reward, step == STEPS - 1, following))
            observation = following
    observations, actions, rewards, ends, next_observations = map(np.array, zip(*rows, strict=True))
    return mcaprl.Dataset.from_arrays(
        observations=observations,
        actions=actions,
        rewards=rewards,
        terminated=np.zeros(len(ends), bool),
        truncated=ends,
        next_observations=next_observations,
        env_id="Pendulum-v1",
    )


def returns_of(policy: Any, episodes: int = 20, seed: int = 1_000) -> list[float]:
    """Return the returns of episodes of a policy, which all start at once."""
    envs = gym.make_vec("Pendulum-v1", num_envs=episodes, vectorization_mode="sync")
    observations, _ = envs.reset(seed=seed)
    totals = np.zeros(episodes)
    for _ in range(STEPS):
        observations, rewards, *_ = envs.step(policy.act(observations))
        totals += rewards
    envs.close()
    return [float(total) for total in totals]
