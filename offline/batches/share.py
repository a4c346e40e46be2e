"""The part of the training data that one process holds, and averages over all processes.

Several processes train together if each of them holds some of the episodes. In each update all of
them draw the same transitions from all data, and each computes the losses of those that it holds.
The sum of their gradients is the gradient of one process that holds everything, except for
rounding.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, distributed, nn

from mcaprl.errors import TrainingError

if TYPE_CHECKING:
    from mcaprl.offline.batches.buffer import TransitionBuffer

T = TypeVar("T")
Floats = NDArray[np.float64]


class Share:
    """Share of a process that holds all data.

    `GroupShare` is the share of one of several processes.

    Attributes:
        processes: Number of processes that train together.
        is_first: Whether this process writes the files of the run.
    """

    processes: int = 1
    is_first: bool = True

    def gather(self, value: T) -> list[T]:
        """Return the value of each process."""
        return [value]

    def average(self, values: Tensor) -> Tensor:
        """Return the mean of a tensor over the processes."""
        return values

    def from_first(self, value: T) -> T:
        """Return the value of the first process."""
        return value

    def wrap(self, module: nn.Module) -> nn.Module:
        """Return a module whose gradients are averaged over the processes."""
        return module

    def draw(
        self, buffer: TransitionBuffer, count: int, generators: Sequence[torch.Generator]
    ) -> tuple[Tensor, Tensor | None]:
        """Draw `count` transitions for each of K seeds.

        Returns:
            Rows (R,) of the buffer, and a factor (R,) for each row. The mean over the batch is
            computed in two steps: each process averages factor times value over its rows, and
            these averages are averaged over the processes. If all factors are 1, None is returned
            instead of the factors.
        """
        return torch.cat([buffer.sample_rows(count, one) for one in generators]), None

    def part(
        self, chosen: Tensor, total: int, device: torch.device
    ) -> tuple[Tensor, Tensor | None]:
        """Return rows and factors as `draw` does, but for rows that this process has chosen.

        Args:
            chosen: Rows (K, n) of the buffer, n for each of K seeds.
            total: Number of rows that all processes have chosen for each seed.
            device: Device of the results.
        """
        return chosen.flatten().to(device), None

    def moments(self, count: int, mean: Any, deviation: Any) -> tuple[Any, Any]:
        """Return mean and standard deviation over all processes, given those of this process."""
        parts = self.gather((count, mean, deviation))
        if len(parts) == 1:
            return mean, deviation
        total = sum(n for n, _, _ in parts)
        whole = sum(n * part for n, part, _ in parts) / total
        square = sum(n * (spread**2 + (part - whole) ** 2) for n, part, spread in parts) / total
        return whole, np.sqrt(square)

    def largest(self, values: Any) -> Any:
        """Return the element-wise maximum over the processes."""
        return np.max(self.gather(values), axis=0)

    def position(self, count: int) -> tuple[int, int]:
        """Return how many items the processes before this one have, and how many all have."""
        return 0, count


class GroupShare(Share):
    """Successive episodes of all data, in one process of the group of `torch.distributed`."""

    def __init__(self, lengths: NDArray[np.int64], weights: Floats, first: int, stop: int) -> None:
        """Describe the data.

        Args:
            lengths: (E,) number of transitions of each episode of all data.
            weights: (E,) relative weight of a transition of each episode.
            first: Number of the first episode of this process.
            stop: Number of the last episode of this process, plus 1.

        Raises:
            TrainingError: All weights are 0.
        """
        self.rank, self.processes = distributed.get_rank(), distributed.get_world_size()
        self.is_first = self.rank == 0
        ends = np.cumsum(lengths)
        self._first_row = int(ends[first] - lengths[first])
        self._rows = int(ends[stop - 1]) - self._first_row
        drawable = weights > 0
        if not drawable.any():
            raise TrainingError("no transitions to learn from: all weights are 0")
        self._starts = torch.from_numpy((ends - lengths)[drawable])
        self._ends = torch.from_numpy(np.cumsum(lengths[drawable]))
        self._lengths = torch.from_numpy(lengths[drawable])
        above = weights[drawable]
        self._equal = bool((above == above[0]).all())
        self._weights = torch.from_numpy(above)
        self._cumulative = torch.from_numpy(np.cumsum(above * lengths[drawable]))

    def gather(self, value: T) -> list[T]:
        """Return the values of all processes; their order is that of the processes' episodes."""
        found: list[Any] = [None] * self.processes
        distributed.all_gather_object(found, value)
        return found

    def average(self, values: Tensor) -> Tensor:
        """Return the mean of a tensor over the processes."""
        total = values.clone()
        distributed.all_reduce(total)
        return total / self.processes

    def from_first(self, value: T) -> T:
        """Return the value of the first process."""
        found: list[Any] = [value]
        distributed.broadcast_object_list(found)
        return found[0]  # type: ignore[no-any-return]

    def wrap(self, module: nn.Module) -> nn.Module:
        """Return a module whose gradients are averaged over the processes."""
        return nn.parallel.DistributedDataParallel(module)

    def draw(
        self, buffer: TransitionBuffer, count: int, generators: Sequence[torch.Generator]
    ) -> tuple[Tensor, Tensor]:
        """Draw the rows that a single process would draw. Return those that this process holds."""
        drawn = torch.stack([self.sample_rows(count, one) for one in generators]) - self._first_row
        mine = (drawn >= 0) & (drawn < self._rows)
        # All seeds need the same number of rows, at least one. Seeds with fewer rows are padded.
        most = max(int(mine.sum(1).max()), 1)
        order = mine.int().argsort(stable=True, dim=1, descending=True)[:, :most]
        held = mine.gather(1, order)
        rows = drawn.gather(1, order).masked_fill(~held, 0)
        factors = held.float() * (most * self.processes / count)
        return rows.flatten().to(buffer.device), factors.flatten().to(buffer.device)

    def part(self, chosen: Tensor, total: int, device: torch.device) -> tuple[Tensor, Tensor]:
        """Return rows and factors as `draw` does, but for rows that this process has chosen."""
        count = chosen.shape[1]
        if not count:
            chosen = torch.zeros(len(chosen), 1, dtype=torch.int64)
        factor = count * self.processes / total
        factors = torch.full((chosen.numel(),), factor, device=device)
        return chosen.flatten().to(device), factors

    def sample_rows(self, count: int, generator: torch.Generator) -> Tensor:
        """Draw rows of all data, as `TransitionBuffer.sample_rows` does for a whole buffer."""
        if self._equal:
            draws = torch.randint(int(self._ends[-1]), (count,), generator=generator)
            episodes = torch.searchsorted(self._ends, draws, right=True)
            steps = draws - self._ends[episodes] + self._lengths[episodes]
        else:
            points = torch.rand(count, generator=generator, dtype=torch.float64)
            points *= self._cumulative[-1]
            episodes = torch.searchsorted(self._cumulative, points, right=True)
            episodes.clamp_(max=len(self._cumulative) - 1)
            below = self._cumulative[episodes] - self._weights[episodes] * self._lengths[episodes]
            steps = ((points - below) / self._weights[episodes]).long().clamp_(min=0)
            steps = torch.minimum(steps, self._lengths[episodes] - 1)
        return self._starts[episodes] + steps

    def position(self, count: int) -> tuple[int, int]:
        """Return how many items the processes before this one have, and how many all have."""
        counts = self.gather(count)
        return sum(counts[: self.rank]), sum(counts)


ALONE = Share()


def divided(lengths: NDArray[np.int64], parts: int) -> list[tuple[int, int]]:
    """Divide E episodes into `parts` ranges with about equal numbers of transitions.

    No range is empty, so there must be at least `parts` episodes.

    >>> divided(np.array([4, 1, 1, 2]), 2)
    [(0, 1), (1, 4)]
    """
    ends = np.cumsum(lengths)
    wanted = ends[-1] * np.arange(1, parts) / parts
    edges = [0]
    for number, rows in enumerate(wanted, 1):
        near = int(np.abs(ends - rows).argmin()) + 1
        edges.append(min(max(near, edges[-1] + 1), len(lengths) - parts + number))
    edges.append(len(lengths))
    return list(pairwise(edges))
