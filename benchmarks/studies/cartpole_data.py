"""Create five CartPole-v1 logs of 50,000 transitions each, from agents of Stable-Baselines3.

random   random actions
medium   PPO in the first iteration with a mean return of 200, with sampled actions
expert   PPO after its training, with greedy actions
replay   all transitions of DQN's training
mixed    half random, half expert
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.callbacks import BaseCallback

import mcaprl

STEPS = 50_000
MEDIUM_RETURN = 200
EXPERT_STEPS = 100_000
NAMES = ("random", "medium", "expert", "replay", "mixed")
Act = Callable[[NDArray[Any]], int]


def make_logs(folder: Path) -> dict[str, mcaprl.Dataset]:
    """Read the five logs; if one of them is missing, create all five first."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = {name: folder / f"{name}.mcap" for name in NAMES}
    if not all(path.exists() for path in paths.values()):
        for path in paths.values():
            path.unlink(missing_ok=True)
        _record_all(paths)
    return {name: mcaprl.open(path) for name, path in paths.items()}


def _record_all(paths: dict[str, Path]) -> None:
    random = np.random.default_rng(0)
    record(paths["random"], lambda _: int(random.integers(2)), STEPS)
    expert = PPO("MlpPolicy", "CartPole-v1", seed=0, device="cpu")
    halfway = _StopAt(MEDIUM_RETURN)
    expert.learn(EXPERT_STEPS, callback=halfway)
    record(paths["medium"], lambda seen: int(expert.predict(seen)[0]), STEPS)
    expert.learn(EXPERT_STEPS, reset_num_timesteps=False)
    best: Act = lambda seen: int(expert.predict(seen, deterministic=True)[0])  # noqa: E731
    record(paths["expert"], best, STEPS)
    env = mcaprl.RecordMcap(gym.make("CartPole-v1"), paths["replay"], policy="dqn")
    DQN(
        "MlpPolicy",
        env,
        seed=0,
        device="cpu",
        learning_rate=2.3e-3,
        batch_size=64,
        buffer_size=100_000,
        learning_starts=1000,
        gamma=0.99,
        target_update_interval=10,
        train_freq=256,
        gradient_steps=128,
        exploration_fraction=0.16,
        exploration_final_eps=0.04,
        policy_kwargs={"net_arch": [256, 256]},
    ).learn(STEPS)
    env.close()
    half = [paths["random"].with_name(f"half-{name}.mcap") for name in ("random", "expert")]
    record(half[0], lambda _: int(random.integers(2)), STEPS // 2)
    record(half[1], best, STEPS // 2)
    mcaprl.open(half).save(paths["mixed"])
    for path in half:
        path.unlink()


def record(path: Path, act: Act, steps: int) -> None:
    """Record whole episodes until the log has at least `steps` steps."""
    env = mcaprl.RecordMcap(gym.make("CartPole-v1"), path)
    done = episode = 0
    while done < steps:
        observation, _ = env.reset(seed=episode)
        over = False
        while not over:
            observation, _, terminated, truncated, _ = env.step(act(observation))
            over = terminated or truncated
            done += 1
        episode += 1
    env.close()


class _StopAt(BaseCallback):
    """Callback that stops training when the last episodes have a high enough mean return."""

    def __init__(self, mean_return: float) -> None:
        super().__init__()
        self._mean_return = mean_return

    def _on_step(self) -> bool:
        recent = [episode["r"] for episode in self.model.ep_info_buffer or []]
        return len(recent) < 20 or float(np.mean(recent[-20:])) < self._mean_return
