"""Print what the benchmark's tasks are like whose packages only the environment of d3rlpy has."""

from __future__ import annotations

import json
import sys
from contextlib import closing, redirect_stdout
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import mcaprl
from benchmarks.suite import learners, tasks
from mcaprl.sims import evaluate, make_sim


def describe(name: str) -> dict[str, Any]:
    """Return whether a seed determines the first steps, and the return of the best behavior."""
    task = tasks.TASKS[name]
    with closing(make_sim(task.sim, **task.options)) as env:
        # An episode in between must not matter.
        one, *others, again = (_first_steps(env, seed) for seed in (3, *range(4, 10), 3))
        best = tasks.behavior(name, "expert" if task.online else "pilot", env)
        score = evaluate(env, [best], name="", episodes=2, seed=tasks.EPISODE_SEED)
        return {
            "shape": env.observation_space.shape,
            "fits": all(env.observation_space.contains(each) for each in one),
            "repeats": bool(np.array_equal(one, again)),
            "differs": any(not np.array_equal(one[0], other[0]) for other in others),
            "score": (score.mean_return - tasks.scale(name)[0]) / np.ptp(tasks.scale(name)),
        }


def _first_steps(env: Any, seed: int) -> list[Any]:
    """Return the first observations of an episode with the same actions each time."""
    seen = [env.reset(seed=seed)[0]]
    env.action_space.seed(0)
    return seen + [env.step(env.action_space.sample())[0] for _ in range(5)]


def clone(name: str) -> list[int]:
    """Return actions of d3rlpy's clone after a few updates on a task's pilot."""
    task = tasks.TASKS[name]
    with TemporaryDirectory() as folder, closing(make_sim(task.sim, **task.options)) as env:
        pilot = tasks.behavior(name, "pilot", env)
        mcaprl.record(env, f"{folder}/a.mcap", policy=pilot, steps=100, seed=0, scene=False)
        data = mcaprl.open(f"{folder}/a.mcap")
    learners.SHARED["updates"] = 5
    (policy,), _ = learners.train_d3rlpy(task, data, "bc", 1)
    actions: list[int] = policy.act(data.observations[:50]).tolist()
    return actions


if __name__ == "__main__":
    found: dict[str, Any] = {name: describe(name) for name in sys.argv[1:]}
    with redirect_stdout(sys.stderr):
        found["clone"] = clone("Breakout")
    json.dump(found, sys.stdout)
