"""Random numbers for starting states, drawn for many episodes at once."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.compiled import compiled

_AHEAD = 32


@compiled
def take(numbers: NDArray[np.float64], used: NDArray[np.int64], i: int) -> NDArray[np.float64]:
    """Return the next (size,) numbers of generator i from the arrays of a `Draws`.

    Call `draw_ahead` first.
    """
    used[i] += 1
    row: NDArray[np.float64] = numbers[i, used[i] - 1]
    return row


@compiled
def spread(share: float, most: float) -> float:
    """Map [0, 1] linearly to [-most, most]."""
    return (2.0 * share - 1.0) * most


class Draws:
    """Random numbers from 0 to 1, drawn in advance from N generators.

    Because a generator call takes a microsecond even for a few numbers, one call draws the numbers
    for many starts. The numbers of each generator are used in the order in which they were drawn.

    Attributes:
        numbers: (N, starts, size) numbers drawn in advance.
        used: (N,) number of starts whose numbers have been used.
    """

    def __init__(self, count: int, size: int) -> None:
        """Prepare draws of `size` numbers from each of `count` generators."""
        self.numbers = np.empty((count, _AHEAD, size))
        self.used = np.full(count, _AHEAD)
        self._generators: list[Any] = [None] * count

    def use_generator(self, i: int, generator: np.random.Generator) -> None:
        """Assign a generator to vehicle i.

        If this replaces another generator, discard the numbers that were drawn from that one.
        """
        if self._generators[i] is not generator:
            self._generators[i], self.used[i] = generator, _AHEAD

    def draw_ahead(self, chosen: NDArray[np.int64]) -> None:
        """Draw numbers for `take` from each `chosen` generator (K,) whose numbers are all used."""
        for i in chosen[self.used[chosen] == _AHEAD].tolist():
            self._generators[i].random(out=self.numbers[i])
            self.used[i] = 0
