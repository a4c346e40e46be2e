"""Measure recording: one environment, and 256 environments that are stepped together."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

import mcaprl
from benchmarks.measure import OURS, Side, Table, compare
from benchmarks.speed import limits, rivals
from benchmarks.speed.workloads import EPISODE_STEPS, OBSERVATION, Constant, run_env
from mcaprl.recorder import STEP_TOPIC
from mcaprl.sims import make_pilot, make_sim, make_sims

ENVS, VECTOR_STEPS = 256, 400
_ALONE, _LIMIT = "stepping alone", "plain zstd 1 of the same chunks alone"
_Actions = list[NDArray[Any]]
_Make = Callable[[], gym.vector.VectorEnv[Any, Any, Any]]


class _Arrays(gym.Wrapper[Any, Any, Any, Any]):
    """Wrapper that keeps the last episode in arrays: the least that a recorder can do per step."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        """Allocate the arrays."""
        super().__init__(env)
        self._observations = np.zeros((EPISODE_STEPS, *OBSERVATION.shape), np.float32)
        self._rewards = np.zeros(EPISODE_STEPS)
        self._actions = np.zeros(EPISODE_STEPS, np.int64)
        self._step = 0

    def reset(self, **arguments: Any) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        self._step = 0
        return self.env.reset(**arguments)

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Step the environment, and keep the transition."""
        found = self.env.step(action)
        step = self._step
        self._observations[step], self._rewards[step], self._actions[step] = *found[:2], action
        self._step = step + 1
        return found


def one(folder: Path, encoded: list[bytes], minari: rivals.MinariFolder) -> Table:
    """Measure the time that recording adds to each step of one environment."""
    episodes, unrecorded = 100, "the environment alone"
    messages = (encoded * (1 + episodes * EPISODE_STEPS // len(encoded)))[
        : episodes * EPISODE_STEPS
    ]
    scratch = folder / "recorded.mcap"

    def record() -> None:
        run_env(mcaprl.RecordMcap(Constant(), scratch, overwrite=True), episodes)

    table = compare(
        "Recording: CPU time added to each environment step",
        [
            Side(unrecorded, lambda: rivals.record_nothing(episodes)),
            Side(OURS, record, floor=unrecorded),
            Side(
                "a wrapper that assigns the values to NumPy arrays",
                lambda: run_env(_Arrays(Constant()), episodes),
                floor=unrecorded,
            ),
            Side("mcap's Writer, prebuilt messages", lambda: rivals.write_mcap(messages, scratch)),
            Side(
                "foxglove-sdk, prebuilt messages",
                lambda: rivals.write_foxglove(messages, scratch),
            ),
            Side(
                "rosbags' Writer, prebuilt messages",
                lambda: rivals.write_rosbags(messages, folder / "bag"),
            ),
            Side(
                "Minari's DataCollector, HDF5",
                lambda: minari.record(10, "hdf5"),
                share=10 / episodes,
                floor=unrecorded,
            ),
            Side(
                "Minari's DataCollector, Arrow",
                lambda: minari.record(10, "arrow"),
                share=10 / episodes,
                floor=unrecorded,
            ),
        ],
        goal="4 times less than mcap's Writer, 2 times less than foxglove-sdk,"
        " 15 times less than Minari",
        rounds=12,
    )
    table.ratios.pop(unrecorded)
    return table


def many(folder: Path) -> Table:
    """Measure recording 256 environments beside stepping them.

    Creating and closing the environments and the log is included.
    """
    table = Table(
        f"Recording {ENVS} environments at once",
        goal="at most 5 % more than stepping",
        unit=f"CPU time, {_ALONE} = 1",
    )
    sync = {"vectorization_mode": "sync"}
    for name in ("Pendulum-v1", "CartPole-v1"):
        make = partial(gym.make_vec, name, ENVS, **sync)
        _add_kind(table, folder / "many.mcap", f"{name}, one by one", make, _random(make()))
    for sim, steady, choose in (("powerline", "no change", _unchanged), ("lane", "pilot", _pilot)):
        make = partial(make_sims, sim, ENVS)
        for what, actions in ((steady, choose()), ("random", _random(make()))):
            _add_kind(table, folder / "many.mcap", f"{sim} in a batch, {what}", make, actions)
    return table


def _add_kind(table: Table, path: Path, name: str, make: _Make, actions: _Actions) -> None:
    """Measure one kind of environments, and add it to the table."""

    def run(env: gym.vector.VectorEnv[Any, Any, Any]) -> None:
        env.reset(seed=[0] * ENVS)
        for each in actions:
            env.step(each)
        env.close()

    def record() -> None:
        run(mcaprl.RecordVecMcap(make(), path, overwrite=True))

    record()
    episodes = mcaprl.open(path, columns=[]).episodes
    mean = sum(episode.length for episode in episodes) / len(episodes)
    chunks = limits.raw_chunks(path, STEP_TOPIC)
    found = compare(
        f"{table.title}: {name}",
        [
            Side(_ALONE, lambda: run(make())),
            Side(OURS, record),
            Side(_LIMIT, lambda: limits.level_1_chunks(chunks)),
        ],
        ours=_ALONE,
        unit=table.unit,
        # A difference of a few percent needs many turns.
        rounds=12,
    )
    table.ratios[f"{name}, {mean:.0f} steps an episode"] = found.ratios[OURS]
    table.ratios[f"{name}, {_LIMIT}"] = found.ratios[_LIMIT]


def _random(env: gym.vector.VectorEnv[Any, Any, Any]) -> _Actions:
    """Return random actions; most sims end an episode after a few of them."""
    env.action_space.seed(0)
    return [env.action_space.sample() for _ in range(VECTOR_STEPS)]


def _unchanged() -> _Actions:
    """Return the last action of powerline, with which an episode lasts longer."""
    last = make_sim("powerline").action_space.n - 1  # type: ignore[attr-defined]
    return [np.full(ENVS, last)] * VECTOR_STEPS


def _pilot() -> _Actions:
    """Return the pilot's actions in one lane, for environments that all begin like this one."""
    env = make_sim("lane")
    pilot, found = make_pilot(env), []
    observation, _ = env.reset(seed=0)
    for _ in range(VECTOR_STEPS):
        (action,) = pilot.act(observation[None])
        found.append(np.full(ENVS, action))
        observation, *_ = env.step(action)
    return found
