"""Finite action spaces as one list of actions, which are numbered from 0.

A Discrete space of n actions has the indexes 0 to n - 1. A value of a MultiDiscrete or MultiBinary
space is one joint action; the last element changes fastest, as in `numpy.ravel_multi_index`:

>>> joint = JointActions.of(spaces.MultiDiscrete([2, 3]))
>>> joint.count, joint.values(np.array([0, 1, 3])).tolist()
(6, [[0, 0], [0, 1], [1, 0]])
>>> joint.indexes(np.array([[1, 2]])).tolist()
[5]
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class JointActions:
    """Numbering of the actions of a finite space.

    Attributes:
        space: Discrete, MultiDiscrete or MultiBinary space.
        sizes: Number of values of each element.
        starts: (K,) int64, smallest value of each element.
    """

    space: spaces.Space[Any]
    sizes: tuple[int, ...]
    starts: NDArray[np.int64]

    @classmethod
    def of(cls, space: spaces.Space[Any]) -> JointActions:
        """Return the numbering of a space.

        Raises:
            TypeError: The space is not Discrete, MultiDiscrete or MultiBinary.
        """
        match space:
            case spaces.Discrete():
                sizes, starts = np.array([space.n]), np.array([space.start])
            case spaces.MultiDiscrete():
                sizes, starts = space.nvec.ravel(), space.start.ravel()
            case spaces.MultiBinary():
                starts = np.zeros(math.prod(space.shape), np.int64)
                sizes = starts + 2
            case _:
                raise TypeError(f"{space} is not a finite space")
        return cls(space, tuple(map(int, sizes)), starts.astype(np.int64))

    @property
    def count(self) -> int:
        """Number of actions, A."""
        return math.prod(self.sizes)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of one value; () for a Discrete space alone."""
        return tuple(self.space.shape or ())

    @property
    def first(self) -> int:
        """Smallest action as one integer: the start of a Discrete space, otherwise 0."""
        return 0 if self.shape else int(self.starts[0])

    @property
    def strides(self) -> tuple[int, ...]:
        """Distance (K,) between the indexes of two values that differ by 1 in one element."""
        return tuple(math.prod(self.sizes[k + 1 :]) for k in range(len(self.sizes)))

    def indexes(self, values: NDArray[Any]) -> NDArray[np.int64]:
        """Return the indexes (N,) of values (N, *shape), which must be in the space."""
        digits = np.subtract(self._rows(values), self.starts, dtype=np.int64)
        found: NDArray[np.int64] = digits @ np.array(self.strides, np.int64)
        return found

    def values(self, indexes: NDArray[np.int64]) -> NDArray[Any]:
        """Return the values (N, *shape) of indexes (N,): int64, or the dtype of the space."""
        digits = np.stack(np.unravel_index(indexes, self.sizes), 1) + self.starts
        found = digits.reshape(len(indexes), *self.shape)
        return found.astype(self.space.dtype) if self.shape else found

    def contain(self, values: NDArray[Any]) -> NDArray[np.bool_]:
        """Return whether each of the values (N, *shape) is in the space."""
        rows = self._rows(values)
        inside = (rows >= self.starts) & (rows <= self.starts + np.array(self.sizes) - 1)
        found: NDArray[np.bool_] = inside.all(1)
        return found

    def _rows(self, values: NDArray[Any]) -> NDArray[Any]:
        return np.asarray(values).reshape(len(values), len(self.sizes))


def joint_actions(space: spaces.Space[Any]) -> JointActions | None:
    """Return the numbering of a finite space; None for other spaces."""
    if not isinstance(space, spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary):
        return None
    return JointActions.of(space)
