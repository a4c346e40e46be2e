"""Action spaces as networks use them: numbered actions, or numbers in [-1, 1]; and action masks.

A finite action space is one list of actions, which are numbered from 0.

A Discrete space of n actions has the indexes 0 to n - 1. A value of a MultiDiscrete or MultiBinary
space is one joint action; the last element changes fastest, as in `numpy.ravel_multi_index`:

>>> joint = JointActions.of(spaces.MultiDiscrete([2, 3]))
>>> joint.count, joint.values(np.array([0, 1, 3])).tolist()
(6, [[0, 0], [0, 1], [1, 0]])
>>> joint.indexes(np.array([[1, 2]])).tolist()
[5]

A value of a Box is a vector of numbers, each of which is scaled from its bounds to [-1, 1]:

>>> box = BoxActions.of(spaces.Box(0, 10, (2,)))
>>> box.scaled(np.array([[0, 7.5]])).tolist()
[[-1.0, 0.5]]

An action mask has the flags of the allowed actions, as a part of a Dict observation. Some
environments return the flags as an info, or as another part. The setting `mask_from` names this
source. A policy with such a source receives the Dict observation
`{"observation": ..., "action_mask": ...}`, where `observation` is that of the environment.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import PolicyError, SpaceError

MASK_KEY = "action_mask"  # Key of the mask, as in PettingZoo; the value has one flag per action
OBSERVATION_KEY = "observation"
"""Key of the environment's observation beside a mask from `mask_from`."""
_INFO = "info:"


@dataclass(frozen=True, eq=False)
class JointActions:
    """Numbering of the actions of a finite space."""

    space: spaces.Space[Any]  # Discrete, MultiDiscrete or MultiBinary space
    sizes: tuple[int, ...]  # Number of values of each element
    starts: NDArray[np.int64]  # (K,) int64, smallest value of each element

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


@dataclass(frozen=True, eq=False)
class BoxActions:
    """Scaling of the actions of a Box to numbers in [-1, 1]."""

    space: spaces.Box
    low: NDArray[np.float64]  # (n,) float64, numbers of an action that are scaled to -1
    high: NDArray[np.float64]  # (n,) float64, numbers of an action that are scaled to 1

    @classmethod
    def of(
        cls, space: spaces.Box, actions: NDArray[Any] | None = None, names: Sequence[str] = ()
    ) -> BoxActions:
        """Return the scaling of a space; the range of `actions` replaces infinite bounds."""
        if np.dtype(space.dtype).kind != "f":
            raise SpaceError(
                f"{space} has integers: learning needs numbers or numbered actions; declare a Box"
                " of floats that the environment rounds, or a MultiDiscrete space"
            )
        low, high = (bound.ravel().astype(np.float64) for bound in (space.low, space.high))
        if actions is not None and len(actions):
            flat = np.asarray(actions, np.float64).reshape(len(actions), -1)
            least, most = flat.min(0), flat.max(0)
            constant = (least == most) & (len(flat) > 1)
            if constant.any():
                part = int(constant.argmax())
                raise SpaceError(
                    f"{part_name(part, names)} is {least[part]:g} in all {len(flat)} rows: an"
                    " action that never changes cannot be learned; remove it from the action"
                )
            low, high = np.where(np.isinf(low), least, low), np.where(np.isinf(high), most, high)
        elif not np.isfinite([low, high]).all():
            raise SpaceError(f"{space} has infinite bounds: its scale needs logged actions")
        empty = low >= high
        if empty.any():
            part = int(empty.argmax())
            raise SpaceError(
                f"{part_name(part, names)} has the bounds {low[part]:g} and {high[part]:g}: an"
                " action that cannot change cannot be learned; remove it from the action"
            )
        return cls(space, low, high)

    @property
    def size(self) -> int:
        """Number of numbers of an action, n."""
        return len(self.low)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of one value."""
        return tuple(self.space.shape)

    @property
    def log_scale(self) -> float:
        """Log density of an action in its units, minus the log density of the scaled action."""
        return -float(np.log((self.high - self.low) / 2).sum())

    def scaled(self, actions: NDArray[Any]) -> NDArray[np.float32]:
        """Return actions (N, *shape) as numbers (N, n), within [-1, 1] if they are in the Box."""
        flat = np.asarray(actions, np.float64).reshape(len(actions), -1)
        return (2 * (flat - self.low) / (self.high - self.low) - 1).astype(np.float32)

    def unscaled(self, numbers: NDArray[Any]) -> NDArray[Any]:
        """Return the actions (N, *shape) of numbers (N, n), in the units and dtype of the space."""
        flat = self.low + (np.asarray(numbers, np.float64) + 1) / 2 * (self.high - self.low)
        # The Box contains its bounds, also where they are rounded to its dtype.
        values = np.clip(flat.astype(self.space.dtype), *self._bounds)
        return values.reshape(len(numbers), *self.shape)

    def contain(self, values: NDArray[Any]) -> NDArray[np.bool_]:
        """Return whether each of the values (N, *shape) is in the space; NaN is not."""
        flat = np.asarray(values).reshape(len(values), -1)
        low, high = self._bounds
        inside = (flat >= low) & (flat <= high)
        return cast("NDArray[np.bool_]", inside.all(1))

    @property
    def _bounds(self) -> tuple[NDArray[Any], NDArray[Any]]:
        return self.space.low.ravel(), self.space.high.ravel()


def part_name(part: int, names: Sequence[str] = ()) -> str:
    """Return how messages name a number of an action.

    >>> part_name(1), part_name(1, ["pedal", "steering"])
    ('action[1]', 'action[1] (steering)')
    """
    return f"action[{part}]" + (f" ({names[part]})" if part < len(names) else "")


def short_name(space: spaces.Space[Any]) -> str:
    """Return a space in messages: that of a Box without its bounds.

    >>> short_name(spaces.Box(-1, 1, (2,))), short_name(spaces.Discrete(5))
    ('Box(2,)', 'Discrete(5)')
    """
    return f"Box{space.shape}" if isinstance(space, spaces.Box) else f"{space}"


def joint_actions(space: spaces.Space[Any] | None) -> JointActions | None:
    """Return the numbering of a finite space; None for other spaces."""
    if not isinstance(space, spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary):
        return None
    return JointActions.of(space)


def allowed_actions(observations: Any) -> NDArray[np.bool_] | None:
    """Return the mask (..., A) of one or more observations; None if they have no mask."""
    # After an episode's end, a mask may allow no action. Then all actions are allowed, because the
    # values and actions of that state are never used.
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
