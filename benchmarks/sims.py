"""The sims beside highway-env's own environments, on one core."""

from __future__ import annotations

import warnings
from typing import Any

import gymnasium as gym
import numpy as np

from benchmarks.measure import Side, Table, compare
from mcaprl.sims import make_sim, make_sims

CARS, DRONES = 1024, 64
QUADROTOR_STEPS = 5
"""A drone's decision of 0.5 s is five steps of 0.1 s, each of 50 steps of its equations."""


STEPS = 1_000_000
"""So many steps are the task; each side takes a share of them."""


def tables() -> list[Table]:
    """Time a step of each sim."""
    one_car = "car"
    sides = [
        _single(one_car, make_sim("lane"), 50_000),
        _batch(f"car, {CARS} in a batch", make_sims("lane", CARS), 200),
        _single("car with 16 rays", make_sim("lane", observation="rays"), 5_000),
        _single("car with a depth image", make_sim("lane", observation="depth"), 1_000),
        _batch(
            f"quadrotor, 0.1 s of flight, {DRONES} in a batch",
            make_sims("powerline", DRONES),
            50,
            QUADROTOR_STEPS,
        ),
        _single("racer with 18 rays", make_sim("racer"), 20_000),
        _single("highway-env, lane-keeping-v0", _highway("highway_env:lane-keeping-v0"), 2_000),
        _single("highway-env, racetrack-v1", _highway("highway_env:racetrack-v1"), 100),
    ]
    table = compare(
        "A step of a sim, actions at random, resets included",
        sides,
        goal="a thousand steps of the car in the time of one of highway-env's racetrack",
        rounds=3,
        ours=one_car,
    )
    table.unit = "CPU time, one car = 1"
    return [table]


def _highway(env_id: str) -> gym.Env[Any, Any]:
    with warnings.catch_warnings():
        # Its spaces are float64 here and there; Gymnasium says so when they are made.
        warnings.simplefilter("ignore")
        return gym.make(env_id, disable_env_checker=True)


def _single(name: str, env: gym.Env[Any, Any], steps: int) -> Side:
    sim = env.unwrapped
    sim.action_space.seed(0)
    actions = [sim.action_space.sample() for _ in range(steps)]

    def run() -> None:
        sim.reset(seed=0)
        for action in actions:
            _, _, terminated, truncated, _ = sim.step(action)
            if terminated or truncated:
                sim.reset()

    return Side(name, run, share=steps / STEPS)


def _batch(name: str, env: gym.vector.VectorEnv[Any, Any, Any], steps: int, each: int = 1) -> Side:
    random = np.random.default_rng(0)
    count = len(env.unwrapped.action_meanings)
    actions = random.integers(count, size=(steps, env.num_envs))

    def run() -> None:
        env.reset(seed=0)
        for action in actions:
            env.step(action)

    return Side(name, run, share=steps * env.num_envs * each / STEPS)
