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
from mcaprl.recorder import EPISODE_TOPIC, Compressors, crc32
from mcaprl.sims import make_pilot, make_sim, make_sims

ENVS, VECTOR_STEPS = 256, 400
_ALONE, _LEAST = "stepping alone", "least work of a recorder"
# Number of bytes of a Message record before its payload.
_HEAD_BYTES = 31
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


class _Least(gym.vector.VectorWrapper):
    """Wrapper that does the least work of a recorder whose file contains every finished episode.

    It keeps the arrays of each step. At the end of a step, it copies the rows of the episodes that
    ended, compresses them and as many bytes as their messages have, computes the CRCs, and writes
    both chunks. Times, indexes and summaries are missing, and small chunks are not merged.
    """

    def __init__(self, env: gym.vector.VectorEnv[Any, Any, Any], path: Path, texts: bytes) -> None:
        """Allocate rows for all steps, and create the file.

        Args:
            env: Environments that need a step to reset themselves.
            path: File to write.
            texts: Message records of one episode.
        """
        super().__init__(env)
        observation, action = env.single_observation_space, env.single_action_space
        row = np.dtype(
            [
                ("head", f"V{_HEAD_BYTES}"),
                ("reward", "f8"),
                ("action", action.dtype, action.shape),
                ("observation", observation.dtype, observation.shape),
                ("prob_to_final", "V15"),
            ]
        )
        self._rows = np.zeros((VECTOR_STEPS + 1, ENVS), row)
        self._items = self._rows.view(f"V{row.itemsize}")
        self._ended_rows = np.zeros(self._rows.size, self._items.dtype)
        self._starts, self._due = np.zeros(ENVS, np.int64), np.zeros(ENVS, np.bool_)
        self._texts, self._step = texts, 0
        self._file = path.open("wb", buffering=0)
        self._compressors = Compressors("zstd")

    def reset(self, **arguments: Any) -> tuple[Any, dict[str, Any]]:
        """Begin the episodes."""
        found = self.env.reset(**arguments)
        self._rows["observation"][0] = found[0]
        return found

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step the environments, keep the transitions, and write the episodes that ended."""
        found = self.env.step(actions)
        observations, rewards, terminated, truncated, _ = found
        step = self._step
        self._rows["action"][step], self._rows["reward"][step] = actions, rewards
        self._rows["observation"][step + 1] = observations
        self._step = step + 1
        ended = np.logical_or(terminated, truncated)
        self._starts[self._due] = self._step
        if ended.any():
            self._write(np.flatnonzero(ended).tolist())
        self._due = ended
        return found

    def close(self, **arguments: Any) -> None:
        """Write the episodes that did not end, and close the file."""
        self._write(np.flatnonzero(~self._due).tolist())
        self._file.close()
        super().close(**arguments)

    def _write(self, ended: list[int]) -> None:
        used = 0
        for number in ended:
            rows = self._items[self._starts[number] : self._step + 1, number]
            self._ended_rows[used : used + len(rows)] = rows
            used += len(rows)
        texts, records = self._texts * len(ended), self._ended_rows[:used].view(np.uint8).data
        chunks = self._compressors.few(texts) + self._compressors.short(records)
        for data in (texts, records, chunks):
            crc32(data)
        self._file.write(chunks)


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
    texts = b"".join(limits.raw_chunks(path, EPISODE_TOPIC))
    texts = texts[: len(texts) // len(episodes)]

    def do_least() -> None:
        run(_Least(make(), path, texts))

    found = compare(
        f"{table.title}: {name}",
        [
            Side(_ALONE, lambda: run(make())),
            Side(OURS, record),
            Side(_LEAST, do_least),
        ],
        ours=_ALONE,
        unit=table.unit,
        # A difference of a few percent needs many turns.
        rounds=12,
    )
    table.ratios[f"{name}, {mean:.0f} steps an episode"] = found.ratios[OURS]
    table.ratios[f"{name}, {_LEAST}"] = found.ratios[_LEAST]


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
