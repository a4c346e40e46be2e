"""Faults that are planted into a dataset, one function for each kind of finding."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, Final

import numpy as np
from gymnasium import spaces

from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.transitions import Transitions

Random = np.random.Generator


def changed(data: Dataset, **columns: Any) -> Dataset:
    """Return the dataset with other columns of its `Transitions`."""
    return Dataset(dataclasses.replace(data._transitions, **columns), data._description)


def vector(data: Dataset) -> tuple[int, Any]:
    """Return index and copy of the first leaf of the observation that is a vector."""
    for k, leaf in enumerate(data._transitions.frames):
        if np.ndim(leaf) == 2:
            return k, np.array(leaf)
    raise AssertionError("no vector")


def with_leaf(data: Dataset, k: int, leaf: Any) -> Dataset:
    """Return the dataset with another array of one leaf."""
    leaves = data._transitions.frames
    return changed(data, frames=(*leaves[:k], leaf, *leaves[k + 1 :]))


def piece(columns: Transitions, random: Random, steps: int) -> slice:
    """Return the frames of some steps within one of the longer episodes."""
    long = np.flatnonzero(columns.lengths >= min(columns.lengths.max(), 2 * steps))
    episode = int(random.choice(long))
    start = int(random.integers(1, max(2, columns.lengths[episode] - steps)))
    first = int(columns.first_frames[episode]) + start
    return slice(
        first, min(first + steps, int(columns.first_frames[episode] + columns.lengths[episode]))
    )


def frozen(data: Dataset, random: Random) -> Dataset:
    """Repeat one observation for twelve steps."""
    k, leaf = vector(data)
    where = piece(data._transitions, random, 12)
    leaf[where] = leaf[where.start]
    return with_leaf(data, k, leaf)


def dead(data: Dataset, random: Random) -> Dataset:
    """Hold the value that moves most often at its mean in one of the longest episodes."""
    k, leaf = vector(data)
    columns = data._transitions
    e = int(columns.lengths.argmax())
    part = int((np.diff(leaf, axis=0) != 0).mean(0).argmax())
    first = columns.first_frames[e]
    leaf[first : first + columns.lengths[e] + 1, part] = leaf[:, part].mean()
    return with_leaf(data, k, leaf)


def black(data: Dataset, random: Random) -> Dataset:
    """Make the frames of a camera black for five steps."""
    where = piece(data._transitions, random, 5)
    k = next(k for k, leaf in enumerate(data._transitions.frames) if np.ndim(leaf) > 2)
    leaf = np.array(data._transitions.frames[k])
    leaf[where] = 0
    return with_leaf(data, k, leaf)


def stuck_camera(data: Dataset, random: Random) -> Dataset:
    """Repeat one frame of a camera for ten steps."""
    where = piece(data._transitions, random, 10)
    k = next(k for k, leaf in enumerate(data._transitions.frames) if np.ndim(leaf) > 2)
    leaf = np.array(data._transitions.frames[k])
    leaf[where] = leaf[where.start]
    return with_leaf(data, k, leaf)


def _shifted(data: Dataset, random: Random, periods: float) -> Dataset:
    columns = data._transitions
    times = columns.log_time_ns.copy()
    where = piece(columns, random, 1)
    usual = int(np.median(np.diff(times)))
    times[where.start :] += int(periods * usual)
    return changed(data, log_time_ns=times)


def drops(data: Dataset, random: Random) -> Dataset:
    """Lose the times of three steps; the observation moves on as far."""
    return _shifted(data, random, 3)


def clock(data: Dataset, random: Random) -> Dataset:
    """Set the clock forward by five hundred periods."""
    return _shifted(data, random, 500)


def jitter(data: Dataset, random: Random) -> Dataset:
    """Vary each time by a uniform fifth of the period in both directions."""
    times = data._transitions.log_time_ns
    period = float(np.median(np.diff(times)))
    return changed(
        data, log_time_ns=times + (random.uniform(-0.2, 0.2, len(times)) * period).astype(np.int64)
    )


def clipped(data: Dataset, random: Random) -> Dataset:
    """Cut each part of the action at its 70 % quantile."""
    actions = data.actions.copy()
    return changed(data, actions=np.minimum(actions, np.quantile(actions, 0.7, axis=0)))


def leak(data: Dataset, random: Random) -> Dataset:
    """Write the first part of the action over the last observed value."""
    k, leaf = vector(data)
    leaf[data.frame_of_step, -1] = data.actions.reshape(len(data), -1)[:, 0]
    return with_leaf(data, k, leaf)


def lag(data: Dataset, random: Random) -> Dataset:
    """Log each command three steps before it has its effect."""
    actions = data.actions.copy()
    starts = np.cumsum(data.episode_lengths)[:-1]
    parts = [np.concatenate([one[3:], one[-3:]])[: len(one)] for one in np.split(actions, starts)]
    return changed(data, actions=np.concatenate(parts))


def no_effect(data: Dataset, random: Random) -> Dataset:
    """Permute the actions at random."""
    return changed(data, actions=data.actions[random.permutation(len(data))])


def duplicates(data: Dataset, random: Random) -> Dataset:
    """Append a copy of an episode."""
    copied = int(random.integers(len(data.episodes)))
    return data._take([*range(len(data.episodes)), copied])


def far_return(data: Dataset, random: Random) -> Dataset:
    """Multiply the rewards of an episode by 100, as by wrong units."""
    rewards = data.rewards.copy()
    e = int(random.integers(len(data.episodes)))
    first = int(data._transitions.first_steps[e])
    rewards[first : first + len(data.episodes[e])] *= 100
    rewards[first] += 100 * np.abs(data.statistics.returns).max()
    return data.with_rewards(rewards)


def lonely(data: Dataset, random: Random) -> Dataset:
    """Throw one observed value far out for a step."""
    k, leaf = vector(data)
    row = piece(data._transitions, random, 1).start
    part = int((np.diff(leaf, axis=0) != 0).mean(0).argmax())
    leaf[row, part] += 20 * np.ptp(leaf[:, part])
    return with_leaf(data, k, leaf)


FAULTS: Final[dict[str, Callable[[Dataset, Random], Dataset]]] = {
    "frozen": frozen,
    "dead": dead,
    "drops": drops,
    "clock": clock,
    "jitter": jitter,
    "saturated": clipped,
    "leak": leak,
    "lag": lag,
    "no effect": no_effect,
    "duplicates": duplicates,
    "return": far_return,
    "lonely": lonely,
}
"""Faults of datasets without images by the kind of the finding."""
IMAGE_FAULTS: Final = {"black": black, "frozen": stuck_camera}


def fits(kind: str, data: Dataset) -> bool:
    """Return whether a fault can be planted, and the data are enough to evaluate it."""
    if kind == "saturated":
        return isinstance(data.action_space, spaces.Box)
    return len(data.episodes) >= {"return": 20, "lonely": 5, "dead": 5}.get(kind, 1)
