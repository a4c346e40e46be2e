"""Helpers of the fault tests: recordings whose episodes can be recomputed, and counters."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

import mcaprl
from mcaprl.recorder.dataset.transitions import Episode

LARGE = os.environ.get("MCAPRL_FAULTS") == "large"
# File to which results are appended; see `fault_table`.
FIGURES = os.environ.get("MCAPRL_FAULT_FIGURES")


def count(small: int, large: int) -> int:
    """Return the number of trials of a fault: `large` in `make faults`, otherwise `small`."""
    return large if LARGE else small


def tell(fault: str, **figures: Any) -> None:
    """Print the result of a fault test in one line; `make faults` writes it into the docs."""
    line = ", ".join(f"{name.replace('_', ' ')} {value}" for name, value in figures.items())
    print(f"\n{fault}: {line}")
    if FIGURES is not None:
        with Path(FIGURES).open("a") as file:
            file.write(f"{fault}: {line}\n")


class KnownEpisodes(gym.Env[Any, Any]):
    """Environment in which all values depend only on the episode k and the step.

    Episode k has 5 + 7k % 40 steps.
    """

    observation_space = spaces.Dict(
        {
            "x": spaces.Box(-np.inf, np.inf, (3,), np.float32),
            "picture": spaces.Box(0, 255, (8, 8), np.uint8),
        }
    )
    action_space = spaces.Discrete(4)

    def __init__(self) -> None:
        self.episode, self.count = -1, 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self.episode, self.count = self.episode + 1, 0
        return observation_of(self.episode, 0), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.count += 1
        over = self.count == length_of(self.episode)
        observation = observation_of(self.episode, self.count)
        return observation, reward_of(self.episode, self.count), over, False, {}


def length_of(episode: int) -> int:
    """Return the number of steps of an episode."""
    return 5 + 7 * episode % 40


def observation_of(episode: int, step: int) -> dict[str, Any]:
    """Return the observation after `step` steps."""
    return {
        "x": np.array([episode, step, np.sin(episode + step)], np.float32),
        "picture": np.full((8, 8), (31 * episode + step) % 256, np.uint8),
    }


def reward_of(episode: int, step: int) -> float:
    """Return the reward of the transition to `step`."""
    return float(np.cos(episode * 100 + step))


def play(env: Any) -> None:
    """Run one episode."""
    env.reset()
    step = 0
    while not env.step(step % 4)[2]:
        step += 1


def write_log(path: Path, episodes: int, **options: Any) -> None:
    """Record episodes, starting with the first."""
    env = mcaprl.RecordMcap(KnownEpisodes(), path, start_time_ns=10**18, **options)
    for _ in range(episodes):
        play(env)
    env.close()


def assert_is_known(episode: Episode) -> None:
    """Check that an episode equals the recorded one bit for bit."""
    number = episode.summary.episode
    length = length_of(number)
    assert episode.length == length
    for shift, name in ((0, "observations"), (1, "next_observations")):
        rows = [observation_of(number, step + shift) for step in range(length)]
        for key, column in getattr(episode, name).items():
            assert column.tobytes() == np.stack([row[key] for row in rows]).tobytes()
    rewards = [reward_of(number, step + 1) for step in range(length)]
    assert episode.rewards.tobytes() == np.array(rewards).tobytes()
    assert episode.actions.tolist() == [step % 4 for step in range(length)]
    assert episode.terminated.tolist() == [False] * (length - 1) + [True]
    assert not episode.truncated.any()
    assert np.isnan(episode.behavior_probs).all()
