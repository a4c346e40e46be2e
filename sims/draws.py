"""Random numbers that are drawn ahead."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_AHEAD = 32


class Draws:
    """Numbers from 0 to 1 of N generators, each one's in the order in which it gives them.

    To ask a generator takes a microsecond, for however few numbers. So it is asked for those of
    many starts at once.
    """

    def __init__(self, count: int, size: int) -> None:
        """Take `size` numbers at a time from each of `count` generators."""
        self._size = size
        self._numbers = np.empty((count, _AHEAD, size))
        self._next = np.full(count, _AHEAD)
        self._generators: list[Any] = [None] * count

    def belong_to(self, i: int, generator: np.random.Generator) -> None:
        """Draw from a generator from now on; what was drawn ahead of another is forgotten."""
        if self._generators[i] is not generator:
            self._generators[i], self._next[i] = generator, _AHEAD

    def one(self, i: int) -> NDArray[np.float64]:
        """Give the next (size,) numbers of generator i, and draw none ahead."""
        if self._next[i] == _AHEAD:
            numbers: NDArray[np.float64] = self._generators[i].random(self._size)
            return numbers
        self._next[i] += 1
        return np.asarray(self._numbers[i, self._next[i] - 1])

    def some(self, chosen: NDArray[np.int64]) -> NDArray[np.float64]:
        """Give the next (K, size) numbers of K generators."""
        places = self._next[chosen]
        used_up = places == _AHEAD
        for i in chosen[used_up].tolist():
            self._generators[i].random(out=self._numbers[i])
        places[used_up] = 0
        self._next[chosen] = places + 1
        found: NDArray[np.float64] = self._numbers[chosen, places]
        return found
