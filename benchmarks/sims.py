"""The sims beside highway-env's own environments: steps a second, on one core."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from mcaprl.sims import make_sim, make_sims

CARS, DRONES = 1024, 64
QUADROTOR_STEPS = 5
"""A drone's decision of 0.5 s is five steps of 0.1 s, each of 50 steps of its equations."""


@dataclass(frozen=True)
class Side:
    """What is timed, and how many steps it takes."""

    run: Callable[[], None]
    steps: int


def sides() -> dict[str, Side]:
    """Make all environments; each is to be driven at random, resets included."""
    return {
        "racetrack": _single(_highway("highway_env:racetrack-v1"), 100),
        "lane-keeping": _single(_highway("highway_env:lane-keeping-v0"), 2_000),
        "car": _single(make_sim("lane"), 50_000),
        "cars": _batch(make_sims("lane", CARS), 200),
        "rays": _single(make_sim("lane", observation="rays"), 5_000),
        "image": _single(make_sim("lane", observation="depth"), 1_000),
        "quadrotor": _batch(make_sims("powerline", DRONES), 50, QUADROTOR_STEPS),
        "racer": _single(make_sim("racer"), 20_000),
    }


def ratios(seconds: dict[str, float], timed: dict[str, Side]) -> dict[str, float]:
    """Compare steps a second, from the seconds that each side took."""
    rate = {name: timed[name].steps / seconds[name] for name in timed}
    rows = {
        "car, one environment": "car",
        f"car, {CARS} environments in a batch": "cars",
        "car with 16 rays": "rays",
        "car with a depth image": "image",
        f"quadrotor, 0.1 s of flight, {DRONES} in a batch": "quadrotor",
        "racer with 18 rays": "racer",
    }
    found = {
        f"{label}, steps/s / those of highway-env's racetrack-v1": rate[name] / rate["racetrack"]
        for label, name in rows.items()
    }
    label = "car, one environment, steps/s / those of highway-env's lane-keeping-v0"
    return found | {label: rate["car"] / rate["lane-keeping"]}


def _highway(env_id: str) -> gym.Env[Any, Any]:
    with warnings.catch_warnings():
        # Its spaces are float64 here and there; Gymnasium says so when they are made.
        warnings.simplefilter("ignore")
        return gym.make(env_id, disable_env_checker=True)


def _single(env: gym.Env[Any, Any], steps: int) -> Side:
    sim = env.unwrapped
    sim.action_space.seed(0)
    actions = [sim.action_space.sample() for _ in range(steps)]

    def run() -> None:
        sim.reset(seed=0)
        for action in actions:
            _, _, terminated, truncated, _ = sim.step(action)
            if terminated or truncated:
                sim.reset()

    return Side(run, steps)


def _batch(env: gym.vector.VectorEnv[Any, Any, Any], steps: int, each: int = 1) -> Side:
    random = np.random.default_rng(0)
    count = len(env.unwrapped.action_meanings)
    actions = random.integers(count, size=(steps, env.num_envs))

    def run() -> None:
        env.reset(seed=0)
        for action in actions:
            env.step(action)

    return Side(run, steps * env.num_envs * each)
