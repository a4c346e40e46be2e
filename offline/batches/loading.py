"""A dataset of PyTorch whose items are transitions, or sequences of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.utils.data

from mcaprl.errors import UsageError
from mcaprl.offline.batches.items import Arrays, ItemOptions, Items
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.images import MappedImages
from mcaprl.recorder.dataset.transitions import STEP_COLUMNS, Origin, Transitions
from mcaprl.recorder.format.messages import EpisodeSummary
from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.source import Data, opened

_COLUMNS = ("log_time_ns", *STEP_COLUMNS)
Tensors = dict[str, Any]  # Tensors by name; observations of a Dict space are dicts of tensors


class TransitionDataset(torch.utils.data.Dataset[Tensors]):
    """Map-style dataset of the transitions of logs, or of sequences of transitions.

    An item is a dict of tensors. `dataset[rows]` with a sequence of B integers is a batch, in which
    each tensor has B rows. Without `length`, an item contains one transition:

        observation         in the space's dtype; a dict for a Dict space
        action              int64, or the space's dtype
        reward              float32, the discounted sum of up to n_steps rewards
        next_observation    observation up to n_steps later
        terminated          bool, whether next_observation is terminal
        truncated           bool, whether the episode was truncated at next_observation
        discount            float32, gamma to the power of the number of rewards; 0 if terminated
        behavior_prob       float32, NaN if unknown; for actions of floats, behavior_log_prob: the
                            natural logarithm of their probability density

    With `length` L, an item is a sequence of L transitions of one episode, with single rewards.
    Each tensor has a further axis of length L after the batch axis. Rows after the end of the
    episode are 0. An item has no `discount`, but it has these additional tensors:

        mask                bool, whether the row is a transition of the episode
        return_to_go        float32, discounted sum of the rewards from this transition on
        step                int64, number of the transition in its episode

    With `frame_stack` n, observations have a further axis of length n before the axes of their
    shape. The stack is ordered by time; the newest observation is last.
    """

    def __init__(
        self,
        data: Data,
        *,
        n_steps: int = 1,
        gamma: float = 1.0,
        frame_stack: int = 1,
        length: int | None = None,
        stride: int = 1,
    ) -> None:
        """Read the logs, and compute the returns.

        Args:
            data: Dataset, or paths of logs as in `mcaprl.open`.
            n_steps: Number of rewards in a return; returns at the end of an episode have fewer.
            gamma: Discount per step.
            frame_stack: Number of successive observations in one item; an episode's first
                observation also pads the stacks.
            length: Number of transitions in a sequence; None for single transitions.
            stride: Number of steps between the starts of two sequences of an episode.

        Raises:
            UsageError: An option is out of range, or two options exclude each other.
            LogError: A log cannot be read.
        """
        options = ItemOptions(n_steps, gamma, frame_stack, length, stride)
        self._shared: _Shared | None = None
        self._items = Items(opened(data), options)

    @property
    def data(self) -> Dataset:
        """The transitions."""
        return self._items.dataset

    def __len__(self) -> int:
        """Return the number of items."""
        return len(self._items)

    def __getitem__(self, rows: Any) -> Tensors:
        """Return one item for an integer, or a batch for a sequence or slice of integers."""
        if isinstance(rows, slice):
            rows = np.arange(len(self))[rows]
        chosen = np.asarray(rows, np.int64)
        count = len(self)
        if chosen.size and not (-count <= chosen.min() and chosen.max() < count):
            raise IndexError(f"item {rows} of {count}")
        batch = tensors_of(self._items.batch(np.atleast_1d(chosen) % max(count, 1)))
        return batch if chosen.ndim else _row(batch, 0)

    def __getitems__(self, rows: Sequence[int]) -> list[Tensors]:
        """Return several items that are gathered at once. `DataLoader` calls this method."""
        batch = self[rows]
        return [_row(batch, k) for k in range(len(rows))]

    def loader(
        self, batch_size: int, *, shuffle: bool = True, drop_last: bool = False, **options: Any
    ) -> torch.utils.data.DataLoader[Tensors]:
        """Return a DataLoader that gathers each batch at once instead of item by item.

        Args:
            batch_size: Number of items of a batch.
            shuffle: Whether each epoch has a new random order; to seed it, pass `generator` in
                `options`.
            drop_last: Whether a last batch with fewer items is left out.
            options: Further arguments of `torch.utils.data.DataLoader`; `sampler` replaces the
                order of `shuffle`.
        """
        sampler = options.pop("sampler", None)
        if sampler is None and shuffle:
            generator = options.get("generator")
            sampler = torch.utils.data.RandomSampler(range(len(self)), generator=generator)
        elif sampler is None:
            sampler = torch.utils.data.SequentialSampler(range(len(self)))
        batches = torch.utils.data.BatchSampler(sampler, batch_size, drop_last)
        return torch.utils.data.DataLoader(self, batch_size=None, sampler=batches, **options)

    def __getstate__(self) -> dict[str, Any]:
        """Return what a worker process needs: paths, or tensors in shared memory."""
        data = self._items.dataset
        columns = data._transitions
        if any(isinstance(leaf, MappedImages) for leaf in columns.frames):
            if not data.origin.logs:
                raise UsageError(
                    "images on disk cannot be sent to another process: make the TransitionDataset"
                    " from the paths of the logs, or use the start method fork"
                )
            paths = [path for path, _ in data.origin.logs]
            return {"paths": paths, "options": self._items.options}
        if self._shared is None:
            # From now on, this process uses the shared memory, too. If this process had no
            # reference to the memory, PyTorch would free it before a worker has opened it.
            self._shared = _Shared(
                frames=tuple(_shared(leaf) for leaf in columns.frames),
                columns={name: _shared(getattr(columns, name)) for name in _COLUMNS},
                episodes=columns.episodes,
                description=data._description,
                origin=data.origin.changed(),
            )
            self._items = Items(self._shared.dataset(), self._items.options)
        return {"options": self._items.options, "shared": self._shared}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore the dataset in a worker process."""
        self._shared = state.get("shared")
        if self._shared is None:
            data = opened(state["paths"], images="mapped")
        else:
            data = self._shared.dataset()
        self._items = Items(data, state["options"])


class _Shared(NamedTuple):
    """Contents of a dataset, with arrays as tensors in memory shared between processes."""

    frames: tuple[torch.Tensor, ...]
    columns: dict[str, torch.Tensor]
    episodes: tuple[EpisodeSummary, ...]
    description: LogMetadata
    origin: Origin

    def dataset(self) -> Dataset:
        columns = Transitions(
            frames=tuple(leaf.numpy() for leaf in self.frames),
            episodes=self.episodes,
            infos={},
            packets={},
            **{name: column.numpy() for name, column in self.columns.items()},
        )
        return Dataset(columns, self.description, origin=self.origin)


def _shared(array: Any) -> torch.Tensor:
    """Copy an array to a tensor in memory shared between processes."""
    tensor = torch.from_numpy(np.array(array))
    tensor.share_memory_()  # type: ignore[no-untyped-call]
    return tensor


def tensors_of(arrays: Arrays) -> Tensors:
    """Return arrays as tensors that share their memory."""
    return {
        name: tensors_of(part) if isinstance(part, dict) else torch.from_numpy(part)
        for name, part in arrays.items()
    }


def _row(batch: Tensors, k: int) -> Tensors:
    return {
        name: _row(part, k) if isinstance(part, dict) else part[k] for name, part in batch.items()
    }


def joined_arrays(parts: Sequence[Arrays]) -> Arrays:
    """Concatenate the rows of several batches."""
    if len(parts) == 1:
        return parts[0]
    return {
        name: joined_arrays([part[name] for part in parts])
        if isinstance(first, dict)
        else np.concatenate([part[name] for part in parts])
        for name, first in parts[0].items()
    }
