"""A stream of shuffled batches that reads logs part by part, for data larger than the memory."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.distributed
import torch.utils.data
from numpy.typing import NDArray

from mcaprl import limits
from mcaprl.errors import LogError, UsageError
from mcaprl.offline.batches.items import Arrays, ItemOptions, Items
from mcaprl.offline.batches.loading import Tensors, joined_arrays, tensors_of
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.log_reader import LogReader, Selection
from mcaprl.recorder.dataset.open import find_logs
from mcaprl.recorder.source import Data

# Approximate number of parts in a block. With several parts, a block mixes distant episodes.
_PARTS_PER_BLOCK = 8


class _Part(NamedTuple):
    """Successive episodes of one log."""

    log: int
    first: int  # Range of episodes, with `stop`
    stop: int
    items: int


class _Share(NamedTuple):
    """Items of a part that belong to one shard: from `first` up to `stop`."""

    part: _Part
    first: int
    stop: int


class TransitionStream(torch.utils.data.IterableDataset[Tensors]):
    """Iterable dataset of shuffled batches; the arrays are those of `TransitionDataset`.

    Pass it to `DataLoader(stream, batch_size=None, num_workers=K)`, or iterate it directly. An
    epoch contains each item once over all workers and ranks. All workers of all ranks have the same
    number of batches, unless an epoch has fewer items than workers or `batch_size` is 1.
    Parts of the logs are read in random order. Several parts form a block of `buffer` items, which
    are shuffled. The order depends only on `seed`, the epoch, and the numbers of workers and ranks.

    Without workers, each complete iteration advances the epoch. With workers, call `set_epoch`
    before each epoch.
    """

    def __init__(
        self,
        data: Data,
        *,
        batch_size: int = 256,
        buffer: int = 100_000,
        seed: int = 0,
        shuffle: bool = True,
        drop_last: bool = False,
        n_steps: int = 1,
        gamma: float = 1.0,
        frame_stack: int = 1,
        length: int | None = None,
        stride: int = 1,
        rank: int | None = None,
        world_size: int | None = None,
    ) -> None:
        """Find the episodes of the logs without reading them.

        Args:
            data: Dataset, or paths of logs as in `mcaprl.open`.
            batch_size: Number of items of a batch. The last batches of an epoch have fewer.
            buffer: Number of items that are read and shuffled at a time; at least one episode.
            seed: Seed of the order.
            shuffle: Whether the order is random; otherwise, items are in the order of the logs.
            drop_last: Whether batches with fewer than `batch_size` items are left out.
            n_steps: Number of rewards in a return; returns at the end of an episode have fewer.
            gamma: Discount per step.
            frame_stack: Number of successive observations in one item.
            length: Number of transitions in a sequence; None for single transitions.
            stride: Number of steps between the starts of two sequences of an episode.
            rank: Number of this process; default: that of `torch.distributed`, or 0.
            world_size: Number of processes; default: that of `torch.distributed`, or 1.

        Raises:
            UsageError: An option is out of range, or two options exclude each other.
            LogError: A log cannot be read, or there are no episodes.
        """
        for name, value in {"batch_size": batch_size, "buffer": buffer}.items():
            if value < 1:
                raise UsageError(f"{name} is {value}, expected 1 or more")
        self._options = ItemOptions(n_steps, gamma, frame_stack, length, stride)
        self._source = _Source(data)
        self._batch_size, self._buffer, self._drop_last = batch_size, buffer, drop_last
        self._seed, self._shuffle = seed, shuffle
        self._rank, self._world_size = _rank_of(rank, world_size)
        part_items = max(buffer // _PARTS_PER_BLOCK, 1)
        self._parts = self._source.parts(self._options, part_items)
        self._count = sum(part.items for part in self._parts)
        # The epoch, and the number of batches to skip in this epoch. Both numbers are in shared
        # memory, so that workers see changes.
        self._position = torch.zeros(2, dtype=torch.int64)
        self._position.share_memory_()  # type: ignore[no-untyped-call]
        self._done = 0

    @property
    def epoch(self) -> int:
        """Number of the current epoch, from 0."""
        return int(self._position[0])

    def set_epoch(self, epoch: int) -> None:
        """Choose the epoch of the next iteration, which starts at the epoch's first batch."""
        self._position[:] = torch.tensor([epoch, 0])
        self._done = 0

    def state_dict(self, batches: int | None = None) -> dict[str, int]:
        """Return the state with which `load_state_dict` continues the epoch.

        Args:
            batches: Number of batches that the training loop has received since the start of this
                epoch; needed with workers, which read ahead. Default: the number counted by the
                current iteration in this process.
        """
        done = self._done if batches is None else batches
        return {"seed": self._seed, "epoch": self.epoch, "batches": done}

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Continue the epoch of a saved state; skip the batches that the state counts.

        The rest of the epoch is the same as in the interrupted run if the options and the numbers
        of workers and ranks are the same.

        Raises:
            UsageError: The state has another seed.
        """
        if state["seed"] != self._seed:
            raise UsageError(f"the state has seed {state['seed']}, but the stream has {self._seed}")
        self._position[:] = torch.tensor([state["epoch"], state["batches"]])
        self._done = state["batches"]

    def __iter__(self) -> Iterator[Tensors]:
        """Yield the batches of this worker's part of the epoch."""
        worker = torch.utils.data.get_worker_info()
        if worker is not None:
            yield from self._batches(worker.id, worker.num_workers)
            return
        self._done = int(self._position[1])
        for batch in self._batches(0, 1):
            self._done += 1
            yield batch
        self.set_epoch(self.epoch + 1)

    def _batches(self, worker: int, workers: int) -> Iterator[Tensors]:
        epoch, skipped = self._position.tolist()
        # Batch k comes from worker k modulo the number of workers. A resumed epoch begins with
        # worker 0 again, so worker w takes the role of worker w + skipped.
        number = (worker + skipped) % workers
        mine = len(range(number, skipped, workers))
        shard, shards = self._rank * workers + number, self._world_size * workers
        blocks = self._blocks(epoch, shard, shards)
        yield from _cut(blocks, self._sizes(shard, shards), mine)

    def _sizes(self, shard: int, shards: int) -> list[int]:
        """Return the sizes of a shard's batches; all shards have the same number of batches."""
        count = self._count * (shard + 1) // shards - self._count * shard // shards
        fewest, most = self._count // shards, -(-self._count // shards)
        if self._drop_last:
            return [self._batch_size] * (fewest // self._batch_size)
        number = -(-most // self._batch_size)
        full = [self._batch_size] * min(count // self._batch_size, number - 1)
        rest = count - sum(full)
        if rest == 0 and full and self._batch_size > 1:
            # Some shards have one item more than this shard, and that item forms one more batch.
            # Split the last batch of this shard, so that all shards have equally many batches.
            full[-1] -= 1
            rest = 1
        return [*full, rest] if rest else full

    def _blocks(self, epoch: int, shard: int, shards: int) -> Iterator[_Rows]:
        """Yield the shard's items in the order of the epoch, as blocks that are not read yet."""
        order = np.arange(len(self._parts))
        if self._shuffle:
            np.random.default_rng([self._seed, epoch]).shuffle(order)
        low, high = (self._count * number // shards for number in (shard, shard + 1))
        shares, position = list[_Share](), 0
        for part in (self._parts[k] for k in order.tolist()):
            first, stop = max(low - position, 0), min(high - position, part.items)
            if first < stop:
                shares.append(_Share(part, first, stop))
            position += part.items
        for number, block in enumerate(_grouped(shares, self._buffer)):
            yield self._rows(block, [self._seed, epoch, shard, number])

    def _rows(self, block: list[_Share], seed: list[int]) -> _Rows:
        starts = np.cumsum([0, *(share.part.items for share in block)])
        chosen = [
            np.arange(start + share.first, start + share.stop)
            for start, share in zip(starts.tolist(), block, strict=False)
        ]
        rows = np.concatenate(chosen)
        if self._shuffle:
            np.random.default_rng(seed).shuffle(rows)
        return _Rows(self._source, self._options, [share.part for share in block], rows)


class _Source:
    """Episodes of logs, or of a dataset in memory."""

    def __init__(self, data: Data) -> None:
        self._data = data if isinstance(data, Dataset) else None
        self._paths = [] if isinstance(data, Dataset) else find_logs(data)
        self._logs: dict[int, LogReader] = {}

    def parts(self, options: ItemOptions, size: int) -> list[_Part]:
        """Divide the episodes into parts of at least `size` items, except the last of a log."""
        if self._data is not None:
            every = [self._data.episode_lengths]
        else:
            every = [self._log(number).lengths for number in range(len(self._paths))]
        found = []
        for log, lengths in enumerate(every):
            counts = options.counts(lengths).tolist()
            first, items = 0, 0
            for episode, count in enumerate(counts):
                items += count
                if items >= size or episode == len(counts) - 1:
                    found.append(_Part(log, first, episode + 1, items))
                    first, items = episode + 1, 0
        if not found:
            raise LogError("no transitions to stream: there are no episodes")
        return found

    def read(self, parts: list[_Part]) -> Dataset:
        """Read the episodes of several parts, in the order of the parts."""
        if self._data is not None:
            every = [k for part in parts for k in range(part.first, part.stop)]
            return self._data._take(every)
        return Dataset.concatenate(
            [self._log(part.log).read(np.arange(part.first, part.stop)) for part in parts]
        )

    def _log(self, number: int) -> LogReader:
        log = self._logs.pop(number, None) or LogReader(self._paths[number], Selection())
        self._logs[number] = log
        if len(self._logs) > limits.MAX_OPEN_LOGS:
            # The first one was not used for the longest time.
            del self._logs[next(iter(self._logs))]
        return log

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without open files; each process opens its own."""
        return {"_data": self._data, "_paths": self._paths, "_logs": {}}


class _Rows:
    """Items of a block, in order. The block is read at the first call of `gather`."""

    def __init__(
        self, source: _Source, options: ItemOptions, parts: list[_Part], rows: NDArray[np.int64]
    ) -> None:
        self._source, self._options, self._parts, self._rows = source, options, parts, rows
        self._items: Items | None = None

    def __len__(self) -> int:
        return len(self._rows)

    def gather(self, first: int, stop: int) -> Arrays:
        if self._items is None:
            self._items = Items(self._source.read(self._parts), self._options)
        return self._items.batch(self._rows[first:stop])


def _cut(blocks: Iterator[_Rows], sizes: list[int], skipped: int) -> Iterator[Tensors]:
    """Yield batches of these sizes from successive blocks; skip the first `skipped` batches."""
    block: _Rows | None = None
    position = 0
    for number, size in enumerate(sizes):
        pieces = []
        while size:
            if block is None or position == len(block):
                block, position = next(blocks), 0
            stop = min(position + size, len(block))
            if number >= skipped:
                pieces.append(block.gather(position, stop))
            size, position = size - (stop - position), stop
        if pieces:
            yield tensors_of(joined_arrays(pieces))


def _grouped(shares: list[_Share], size: int) -> Iterator[list[_Share]]:
    """Group successive shares into blocks of at least `size` items; the last may have fewer."""
    group, items = list[_Share](), 0
    for share in shares:
        group.append(share)
        items += share.stop - share.first
        if items >= size:
            yield group
            group, items = [], 0
    if group:
        yield group


def _rank_of(rank: int | None, world_size: int | None) -> tuple[int, int]:
    """Return rank and world size; the default is `torch.distributed`'s, or 0 and 1."""
    if (rank is None) != (world_size is None):
        raise UsageError("pass both rank and world_size, or neither")
    if rank is None or world_size is None:
        running = torch.distributed.is_available() and torch.distributed.is_initialized()
        if not running:
            return 0, 1
        return torch.distributed.get_rank(), torch.distributed.get_world_size()
    if not 0 <= rank < world_size:
        raise UsageError(f"rank {rank} of world_size {world_size}: expected 0 to {world_size - 1}")
    return rank, world_size
