"""Print what the benchmark's tasks are like whose packages only the environment of d3rlpy has."""

from __future__ import annotations

import json
import sys
from contextlib import closing
from typing import Any

import numpy as np

from benchmarks.suite import tasks
from mcaprl.sims import evaluate, make_sim


def describe(name: str) -> dict[str, Any]:
    """Return whether a seed determines the first steps, and the return of the best behavior."""
    task = tasks.TASKS[name]
    with closing(make_sim(task.sim, **task.options)) as env:
        # An episode in between must not matter.
        one, _, again = (_first_steps(env, seed) for seed in (3, 4, 3))
        best = tasks.behavior(name, "expert" if task.online else "pilot", env)
        score = evaluate(env, [best], name="", episodes=2, seed=tasks.EPISODE_SEED)
        return {
            "shape": env.observation_space.shape,
            "fits": all(env.observation_space.contains(each) for each in one),
            "repeats": bool(np.array_equal(one, again)),
            "differs": not np.array_equal(one[0], _first_steps(env, 4)[0]),
            "score": (score.mean_return - tasks.scale(name)[0]) / np.ptp(tasks.scale(name)),
        }


def _first_steps(env: Any, seed: int) -> list[Any]:
    """Return the first observations of an episode with the same actions each time."""
    seen = [env.reset(seed=seed)[0]]
    env.action_space.seed(0)
    return seen + [env.step(env.action_space.sample())[0] for _ in range(5)]


if __name__ == "__main__":
    json.dump({name: describe(name) for name in sys.argv[1:]}, sys.stdout)
