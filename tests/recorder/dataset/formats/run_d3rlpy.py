"""Commands that use d3rlpy; the tests run them in an environment in which d3rlpy is installed.

python run_d3rlpy.py COMMAND ARGUMENT... [-- COMMAND ARGUMENT...]

transitions LOG OUT.npz   write the transitions of `Dataset.to_d3rlpy`
load FILE OUT.npz         write the transitions that d3rlpy loads from a file
load_v1 FILE OUT.npz      write the transitions that d3rlpy loads from a file of d3rlpy 1
dump LOG FILE             convert a log with `to_d3rlpy`, and write it with d3rlpy's `dump`
back LOG OUT              convert a log with `to_d3rlpy`, and back with `from_d3rlpy`
collect FILE              write steps that d3rlpy's replay buffer collects
train LOG                 run three updates of one of d3rlpy's algorithms
"""

from __future__ import annotations

import itertools
import sys
from importlib import import_module
from typing import Any

import numpy as np

import mcaprl
from mcaprl import Dataset


def main(*arguments: str) -> None:
    """Run commands."""
    commands: dict[str, Any] = {
        "transitions": lambda log, out: save(mcaprl.open(log).to_d3rlpy(), out),
        "load": load,
        "load_v1": load_v1,
        "dump": dump,
        "back": lambda log, out: Dataset.from_d3rlpy(mcaprl.open(log).to_d3rlpy()).save(out),
        "collect": collect,
        "train": train,
    }
    for is_separator, words in itertools.groupby(arguments, "--".__eq__):
        if not is_separator:
            name, *rest = words
            commands[name](*rest)


def save(buffer: Any, out: str) -> None:
    """Write all transitions that d3rlpy's picker returns, and d3rlpy's action space and size."""
    picked = [
        buffer.transition_picker(episode, index)
        for episode in buffer.episodes
        for index in range(episode.transition_count)
    ]
    assert len(picked) == buffer.transition_count
    first = picked[0].observation
    parts = range(len(first)) if isinstance(first, list | tuple) else [None]
    found: dict[str, Any] = {}
    for part in parts:
        for name in ("observation", "next_observation"):
            rows = [getattr(transition, name) for transition in picked]
            key = name if part is None else f"{name}_{part}"
            found[key] = np.stack(rows if part is None else [row[part] for row in rows])
    for name in ("action", "reward", "terminal"):
        found[name] = np.array([getattr(transition, name) for transition in picked])
    # The algorithms need batches with float32 rewards.
    assert buffer.sample_transition_batch(4).rewards.dtype == np.float32
    info = buffer.dataset_info
    found["lengths"] = np.array([episode.transition_count for episode in buffer.episodes])
    found |= {"space": np.array(info.action_space.name), "size": np.array(info.action_size)}
    np.savez(out, allow_pickle=False, **found)


def load(file: str, out: str) -> None:
    """Load a file with d3rlpy's own reader."""
    d3rlpy = _d3rlpy()
    with open(file, "rb") as opened:
        save(d3rlpy.dataset.ReplayBuffer.load(opened, d3rlpy.dataset.InfiniteBuffer()), out)


def load_v1(file: str, out: str) -> None:
    """Load a file of d3rlpy 1 with d3rlpy's own reader."""
    dataset = _d3rlpy().dataset
    with open(file, "rb") as opened:
        episodes = dataset.load_v1(opened)
    save(dataset.ReplayBuffer(dataset.InfiniteBuffer(), episodes=episodes), out)


def dump(log: str, file: str) -> None:
    """Write a log with d3rlpy's own writer."""
    with open(file, "w+b") as opened:
        mcaprl.open(log).to_d3rlpy().dump(opened)


def collect(file: str) -> None:
    """Write two episodes of three steps with d3rlpy's buffer: one terminated and one truncated."""
    d3rlpy = _d3rlpy()
    sample = d3rlpy.dataset.Episode(
        np.zeros((1, 2), np.float32), np.zeros((1, 1), np.int64), np.zeros((1, 1)), True
    )
    buffer = d3rlpy.dataset.ReplayBuffer(
        d3rlpy.dataset.InfiniteBuffer(),
        observation_signature=sample.observation_signature,
        action_signature=sample.action_signature,
        reward_signature=sample.reward_signature,
        action_space=d3rlpy.ActionSpace.DISCRETE,
        action_size=4,
    )
    for first, terminated in ((0, True), (10, False)):
        for step in range(3):
            buffer.append(np.array([first + step, 0.5], np.float32), step, step / 2)
        buffer.clip_episode(terminated)
    with open(file, "w+b") as opened:
        buffer.dump(opened)


def train(log: str) -> None:
    """Train on a log with d3rlpy's CQL."""
    learner = _d3rlpy().algos.DiscreteCQLConfig(batch_size=4).create("cpu")
    buffer = mcaprl.open(log).to_d3rlpy()
    learner.build_with_dataset(buffer)
    for _ in range(3):
        losses = learner.update(buffer.sample_transition_batch(4))
        assert np.isfinite(losses["loss"])


def _d3rlpy() -> Any:
    return import_module("d3rlpy")


if __name__ == "__main__":
    main(*sys.argv[1:])
