"""Items for training, gathered from a dataset as NumPy arrays: transitions or sequences of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import UsageError
from mcaprl.recorder.dataset.images import Frames
from mcaprl.recorder.format.spaces import leaves_of, nest

if TYPE_CHECKING:
    from mcaprl.recorder.dataset.dataset import Dataset

Arrays = dict[str, Any]  # Arrays by name; observations of a Dict space are dicts of arrays
_BLOCK_ROWS = 1 << 18


@dataclass(frozen=True)
class ItemOptions:
    """Settings that define the items of a dataset."""

    n_steps: int = 1  # Number of rewards in a return; returns at the end of an episode have fewer
    gamma: float = 1.0  # Discount per step
    # Number of successive observations in one item; an episode's first observation also pads the
    # stacks.
    frame_stack: int = 1
    length: int | None = None  # Number of transitions in a sequence; None for single transitions
    stride: int = 1  # Number of steps between the starts of two sequences of an episode

    def __post_init__(self) -> None:
        """Check the values."""
        counts = {
            "n_steps": self.n_steps,
            "frame_stack": self.frame_stack,
            "length": 1 if self.length is None else self.length,
            "stride": self.stride,
        }
        for name, count in counts.items():
            if count < 1:
                raise UsageError(f"{name} is {count}, expected 1 or more")
        if not 0 <= self.gamma <= 1:
            raise UsageError(f"gamma is {self.gamma}, expected a number from 0 to 1")
        if self.length is None and self.stride > 1:
            raise UsageError("stride is for sequences: pass length, too")
        if self.length is not None and self.n_steps > 1:
            raise UsageError("n_steps and length exclude each other")

    def counts(self, lengths: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return how many items (E,) each episode has, given how many transitions each has."""
        return -(-lengths // self.stride)


class Items:
    """Training items from all episodes, in the order of the dataset."""

    def __init__(self, dataset: Dataset, options: ItemOptions) -> None:
        """Compute the returns of all transitions."""
        self.dataset, self.options = dataset, options
        lengths = dataset.episode_lengths
        self._ends = np.repeat(np.cumsum(lengths), lengths)
        self._firsts = self._ends - np.repeat(lengths, lengths)
        steps = np.arange(len(dataset)) - self._firsts
        self._starts = np.flatnonzero(steps % options.stride == 0)
        self._steps = steps
        self._leaves = leaves_of(dataset.observation_space)
        if options.length is None:
            places, returns = n_step_returns(dataset, options.n_steps, options.gamma)
            self._ahead = places[1] - places[0]
            self._rewards, self._discounts = returns
        else:
            self._to_go = returns_to_go(dataset.rewards, lengths, options.gamma)

    def __len__(self) -> int:
        """Return the number of items."""
        return len(self._starts)

    def batch(self, items: NDArray[np.int64]) -> Arrays:
        """Return items (B,) as the arrays that `mcaprl.torch.TransitionDataset` lists."""
        rows = self._starts[items]
        return self._transitions(rows) if self.options.length is None else self._sequences(rows)

    def _transitions(self, rows: NDArray[np.int64]) -> Arrays:
        data, ahead = self.dataset, self._ahead[rows]
        frames, lasts = data.frame_of_step[rows], rows + ahead - 1
        firsts = frames - self._steps[rows]
        return {
            "observation": self._observed(frames, firsts),
            "action": data.actions[rows],
            "reward": self._rewards[rows],
            "next_observation": self._observed(frames + ahead, firsts),
            "terminated": data.terminated[lasts],
            "truncated": data.truncated[lasts],
            "discount": self._discounts[rows],
            data.behavior_field.name: data.behavior[rows],
        }

    def _sequences(self, rows: NDArray[np.int64]) -> Arrays:
        data = self.dataset
        assert self.options.length is not None
        wanted = rows[:, np.newaxis] + np.arange(self.options.length)
        mask = wanted < self._ends[rows][:, np.newaxis]
        # Rows after the end of the episode are gathered from its last row, and then cleared.
        every = np.minimum(wanted, self._ends[rows][:, np.newaxis] - 1)
        frames = data.frame_of_step[every]
        firsts = frames - self._steps[every]
        found = {
            "observation": self._observed(frames, firsts),
            "action": data.actions[every],
            "reward": data.rewards[every].astype(np.float32),
            "next_observation": self._observed(frames + 1, firsts),
            "terminated": data.terminated[every],
            "truncated": data.truncated[every],
            data.behavior_field.name: data.behavior[every],
            "return_to_go": self._to_go[every],
            "step": self._steps[every],
        }
        _clear(found, ~mask)
        return {**found, "mask": mask}

    def _observed(self, frames: NDArray[np.int64], firsts: NDArray[np.int64]) -> Any:
        """Gather observations; if configured, stack successive observations along a new axis."""
        count = self.options.frame_stack
        if count > 1:
            ages = np.arange(count - 1, -1, -1)
            frames = np.maximum(frames[..., np.newaxis] - ages, firsts[..., np.newaxis])
        columns = self.dataset._transitions.frames
        return nest(self._leaves, [_gathered(column, frames) for column in columns])


def n_step_returns(
    dataset: Dataset, n_steps: int, gamma: float
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Return (2, N) frames now and n steps later, and (2, N) sums of rewards and discounts."""
    # Returns stop at the end of an episode: a truncation bootstraps from the last observation, a
    # termination has no bootstrap value.
    count, lengths = len(dataset), dataset.episode_lengths
    ends = np.repeat(np.cumsum(lengths), lengths)
    here = dataset.frame_of_step
    places, returns = np.empty((2, count), np.int64), np.empty((2, count), np.float32)
    places[0] = here
    # In blocks, so that the intermediate arrays need little memory.
    for first in range(0, count, _BLOCK_ROWS):
        block = slice(first, first + _BLOCK_ROWS)
        rows = np.arange(first, min(first + _BLOCK_ROWS, count))
        ahead = np.minimum(n_steps, ends[block] - rows)
        rewards = np.zeros(len(rows))
        for k in range(n_steps):
            counts = ahead > k
            rewards[counts] += gamma**k * dataset.rewards[rows[counts] + k]
        discounts = gamma ** ahead.astype(float)
        discounts[dataset.terminated[rows + ahead - 1]] = 0
        places[1, block] = here[block] + ahead
        with np.errstate(over="ignore"):
            returns[0, block], returns[1, block] = rewards, discounts
    return places, returns


def returns_to_go(
    rewards: NDArray[np.float64], lengths: NDArray[np.int64], gamma: float
) -> NDArray[np.float32]:
    """Return the discounted sums (N,) of the rewards from each transition to its episode's end."""
    found = rewards.astype(np.float64)
    ends = np.cumsum(lengths)
    for age in range(1, int(lengths.max(initial=0))):
        rows = ends[lengths > age] - 1 - age
        found[rows] += gamma * found[rows + 1]
    return found.astype(np.float32)


def _gathered(column: Frames, frames: NDArray[np.int64]) -> NDArray[Any]:
    values: NDArray[Any] = column[frames.ravel()]
    return values.reshape(*frames.shape, *column.shape[1:])


def _clear(arrays: Arrays, where: NDArray[np.bool_]) -> None:
    """Set all arrays to zero in the rows that the mask `where` selects."""
    for array in arrays.values():
        if isinstance(array, dict):
            _clear(array, where)
        else:
            array[where] = 0
