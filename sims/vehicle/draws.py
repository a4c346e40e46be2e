"""Random numbers that are drawn ahead."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.sims.geometry.compiled import compiled

_AHEAD = 32


@compiled
def take(numbers: NDArray[np.float64], used: NDArray[np.int64], i: int) -> NDArray[np.float64]:
    """Give the next (size,) numbers of generator i, by the arrays of a `Draws` that has some."""
    used[i] += 1
    row: NDArray[np.float64] = numbers[i, used[i] - 1]
    return row


class Draws:
    """Numbers from 0 to 1 of N generators, each one's in the order in which it gives them.

    To ask a generator takes a microsecond, for however few numbers. So it is asked for those of
    many starts at once.

    Attributes:
        numbers: (N, ahead, size) drawn ahead.
        used: (N,) how many of them are used up.
    """

    def __init__(self, count: int, size: int) -> None:
        """Take `size` numbers at a time from each of `count` generators."""
        self.numbers = np.empty((count, _AHEAD, size))
        self.used = np.full(count, _AHEAD)
        self._generators: list[Any] = [None] * count

    def belong_to(self, i: int, generator: np.random.Generator) -> None:
        """Draw from a generator from now on; what was drawn ahead of another is forgotten."""
        if self._generators[i] is not generator:
            self._generators[i], self.used[i] = generator, _AHEAD

    def one(self, i: int, numbers: NDArray[np.float64]) -> None:
        """Write the next numbers of generator i into a (size,) array, and draw none ahead."""
        if self.used.item(i) == _AHEAD:
            self._generators[i].random(out=numbers)
        else:
            numbers[:] = take(self.numbers, self.used, i)

    def draw_ahead(self, chosen: NDArray[np.int64]) -> None:
        """Make sure that `take` has numbers of K generators."""
        for i in chosen[self.used[chosen] == _AHEAD].tolist():
            self._generators[i].random(out=self.numbers[i])
            self.used[i] = 0
