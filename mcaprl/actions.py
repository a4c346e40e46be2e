"""Finite action spaces as one list of actions, which are numbered from 0, and masks of them.

A Discrete space of n actions has the indexes 0 to n - 1. A value of a MultiDiscrete or MultiBinary
space is one joint action; the last element changes fastest, as in `numpy.ravel_multi_index`:

>>> joint = JointActions.of(spaces.MultiDiscrete([2, 3]))
>>> joint.count, joint.values(np.array([0, 1, 3])).tolist()
(6, [[0, 0], [0, 1], [1, 0]])
>>> joint.indexes(np.array([[1, 2]])).tolist()
[5]

An action mask has the flags of the allowed actions, as a part of a Dict observation. Some
environments return the flags as an info, or as another part. The setting `mask_from` names this
source. A policy with such a source receives the Dict observation
`{"observation": ..., "action_mask": ...}`, where `observation` is that of the environment.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import PolicyError

MASK_KEY = "action_mask"
"""Key of the mask, as in PettingZoo; the value has one flag per action."""
OBSERVATION_KEY = "observation"
"""Key of the environment's observation beside a mask from `mask_from`."""
_INFO = "info:"


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
        """Return the numbering of a space."""
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


def joint_actions(space: spaces.Space[Any] | None) -> JointActions | None:
    """Return the numbering of a finite space; None for other spaces."""
    if not isinstance(space, spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary):
        return None
    return JointActions.of(space)


def allowed_actions(observations: Any) -> NDArray[np.bool_] | None:
    """Return the mask (..., A) of one or more observations; None if they have no mask.

    After an episode's end, a mask may allow no action. Then all actions are allowed, because the
    values and actions of that state are never used.
    """
    if not isinstance(observations, dict) or MASK_KEY not in observations:
        return None
    allowed = np.asarray(observations[MASK_KEY]).astype(bool)
    found: NDArray[np.bool_] = allowed | ~allowed.any(-1, keepdims=True)
    return found


def info_name(source: str) -> str | None:
    """Return the dotted name of an info; None if the source is a part of the observation.

    >>> info_name("info:legal.moves"), info_name("robot/legal")
    ('legal.moves', None)
    """
    return source.removeprefix(_INFO) if source.startswith(_INFO) else None


def has_source(space: spaces.Space[Any] | None) -> bool:
    """Return whether an observation space is that of observations with a mask from a source."""
    return isinstance(space, spaces.Dict) and set(space.spaces) == {OBSERVATION_KEY, MASK_KEY}


def masked(observation: Any, info: Mapping[str, Any], source: str) -> dict[str, Any]:
    """Return one observation of an environment with its mask from a source."""
    name = info_name(source)
    found: Any = observation if name is None else info
    for key in source.split("/") if name is None else name.split("."):
        try:
            found = found[key]
        except (KeyError, TypeError, IndexError) as error:
            what = f"observation has no part {source}" if name is None else f"info has no {name}"
            raise PolicyError(
                f"the environment's {what}, which the policy needs as mask"
            ) from error
    return {OBSERVATION_KEY: observation, MASK_KEY: np.asarray(found, np.int8)}
