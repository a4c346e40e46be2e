"""Measure updates per second of SAC and TD3 relative to Stable-Baselines3's.

    python -m benchmarks.speed.actor_critics [--rounds 5] [--turn-s 2.0] [--size 256] [--algo sac]
    python -m benchmarks.speed.actor_critics --parts

Both libraries take turns in one process, on the same random transitions (17 numbers, actions of 6)
and with networks of 256x256. The measure is CPU time on one thread, the best of several turns. The
table is printed, with the ratios, their goals, and the ratios that our update would reach if it
consisted of its matrix products alone. --parts prints the time of the parts of our update, by
PyTorch's profiler.
"""

from __future__ import annotations

import argparse
from typing import Any

import gymnasium as gym
import numpy as np
import stable_baselines3
import torch
from gymnasium import spaces
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv

from benchmarks.speed.continuous import (
    ACTION,
    HIDDEN,
    ROWS,
    WIDTH,
    parts,
    rates_and_limit,
    transitions,
)
from benchmarks.speed.learning import Turns, Update
from mcaprl.offline import SAC, TD3, TransitionBuffer

GOALS = {256: 1.3, 64: 2.0}
OURS: dict[str, Any] = {"sac": SAC, "td3": TD3}


def ours(algo: str, batch_size: int) -> Update:
    """Return a function that makes one update of this package's learner."""
    learner_type = OURS[algo]
    config = learner_type.config_type(batch_size=batch_size, hidden=HIDDEN, normalize=False)
    buffer = TransitionBuffer.from_dataset(transitions(), config.packing)
    update: Update = learner_type(config, buffer, [0]).update
    return update


class Spaces(gym.Env[Any, Any]):
    """Environment that only has spaces."""

    observation_space = spaces.Box(-np.inf, np.inf, (WIDTH,))
    action_space = spaces.Box(-1, 1, (ACTION,), np.float32)


def sb3s(algo: str, batch_size: int) -> Update:
    """Return a function that makes one update of SB3's model."""
    data = transitions()
    model: Any = getattr(stable_baselines3, algo.upper())(
        "MlpPolicy",
        DummyVecEnv([Spaces]),
        batch_size=batch_size,
        buffer_size=ROWS,
        policy_kwargs={"net_arch": list(HIDDEN)},
        device="cpu",
        seed=0,
    )
    model.set_logger(configure(None, []))
    done = data.terminated | data.truncated
    for row in range(ROWS):
        model.replay_buffer.add(
            data.observations[row : row + 1],
            data.next_observations[row : row + 1],
            data.actions[row : row + 1],
            data.rewards[row : row + 1],
            done[row : row + 1],
            [{"TimeLimit.truncated": bool(data.truncated[row])}],
        )
    return lambda: model.train(1, batch_size)


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--turn-s", type=float, default=2.0)
    parser.add_argument("--size", type=int, choices=GOALS)
    parser.add_argument("--algo", choices=OURS)
    parser.add_argument("--parts", action="store_true")
    given = parser.parse_args()
    torch.set_num_threads(1)
    if not given.parts:
        print(
            "| what | updates per CPU second | SB3's times | goal | limit |\n|---|---|---|---|---|"
        )
    for size in [given.size] if given.size else GOALS:
        for algo in [given.algo] if given.algo else OURS:
            if given.parts:
                parts(f"{algo}, batch {size}", ours(algo, size))
                continue
            turns = Turns(given.rounds, given.turn_s)
            mine, theirs, limit = rates_and_limit(ours(algo, size), sb3s(algo, size), size, turns)
            line = f"| {algo}, batch {size} | {mine:.0f} | {mine / theirs:.2f} | {GOALS[size]} |"
            print(f"{line} {limit / theirs:.2f} |", flush=True)


if __name__ == "__main__":
    main()
