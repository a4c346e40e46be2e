"""Frame stacks: successive observations as one, so that it shows velocities.

A stack of k frames has the oldest first. Frames before an episode's first observation are copies of
that observation. Frames are joined along the channels of images and the last axis of other arrays.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

WHOLE = ""  # Key under which `parts_of` returns observations that are not a dict


def mapped(function: Callable[..., Any], tree: Any, *others: Any) -> Any:
    """Apply a function to each array of observations, which may be nested dicts or tuples.

    >>> mapped(lambda x, y: x + y, {"a": 1, "b": {"c": 2}}, {"a": 10, "b": {"c": 20}})
    {'a': 11, 'b': {'c': 22}}
    """
    if isinstance(tree, dict):
        return {key: mapped(function, *(one[key] for one in (tree, *others))) for key in tree}
    if isinstance(tree, tuple):
        return tuple(mapped(function, *parts) for parts in zip(tree, *others, strict=True))
    return function(tree, *others)


def rows_of(observations: Any, rows: Any) -> Any:
    """Return rows of an array, or of each array in nested dicts."""
    return mapped(lambda part: part[rows], observations)


def frame_rows(rows: Any, first: Any, ages: Any) -> Any:
    """Return the row of each frame (N, k) of the stacks that end with rows (N,).

    >>> frame_rows(np.array([5, 9]), np.array([4, 0]), np.array([2, 1, 0])).tolist()
    [[4, 4, 5], [7, 8, 9]]
    """
    # `first` (N,) are the first frames of the episodes, `ages` (k,) steps before `rows`.
    places = rows[:, None] - ages
    return places + (first[:, None] - places).clip(0)


def stacked_frames(frames: Any, count: int) -> Any:
    """Return the stacks (T, count, *shape) that end with each frame (T, *shape); no axis for 1."""
    if count == 1:
        return frames

    def stacked(part: NDArray[Any]) -> NDArray[Any]:
        rows = np.arange(len(part))
        return cast(NDArray[Any], part[frame_rows(rows, 0 * rows, np.arange(count)[::-1])])

    return mapped(stacked, frames)


class FrameStack:
    """Last k observations of each of B episodes."""

    def __init__(self, count: int) -> None:
        """Store the last `count` observations."""
        # Arrays (B, k, *shape) by key, oldest first; empty before the first observation.
        self.frames: dict[Any, NDArray[Any]] = {}
        self._count = count

    def clear(self) -> None:
        """Drop the frames. The next observations start new episodes."""
        self.frames = {}

    def see(self, parts: dict[Any, NDArray[Any]]) -> dict[Any, NDArray[Any]]:
        """Store the next observations (B, *shape) by key, and return the stacks."""
        # Without frames, or with frames of another number of episodes, they start new episodes.
        key, part = next(iter(parts.items()))
        continues = len(self.frames.get(key, ())) == len(part)
        self.frames = {
            key: np.concatenate([self.frames[key][:, 1:], part[:, None]], axis=1)
            if continues
            else np.repeat(part[:, None], self._count, axis=1)
            for key, part in parts.items()
        }
        return self.frames

    def begin_one(self, row: int) -> None:
        """Start a new episode in one row. Its first observation is the newest one of that row."""
        for part in self.frames.values():
            part[row] = part[row, -1:]

    def ending(self, row: int, last: dict[Any, NDArray[Any]]) -> dict[Any, NDArray[Any]]:
        """Return a row's stack (1, k, *shape), whose newest observation is `last` (*shape)."""
        return {
            key: np.concatenate([part[row, :-1], last[key][None]])[None]
            for key, part in self.frames.items()
        }


def parts_of_space(space: spaces.Space[Any]) -> dict[str, Any]:
    """Return the parts of a Dict space by key; any other space is a single part."""
    return dict(space.items()) if isinstance(space, spaces.Dict) else {WHOLE: space}


def parts_of(observations: Any) -> dict[str, NDArray[Any]]:
    """Return observations as a dict of arrays by key; the key of a single array is `WHOLE`."""
    return observations if isinstance(observations, dict) else {WHOLE: observations}


def whole_of(parts: dict[str, Any]) -> Any:
    """Return the observations that `parts_of` split into these parts."""
    return parts.get(WHOLE, parts)


def stack_axis(space: spaces.Space[Any]) -> int:
    """Return the (negative) axis along which frames are joined; channels first are as of SB3."""
    is_first = is_image(space) and int(np.argmin(cast(spaces.Box, space).shape)) == 0
    return -3 if is_first else -1


def is_image(space: spaces.Space[Any]) -> bool:
    """Return whether Stable-Baselines3 recognizes a space as that of images."""
    if not isinstance(space, spaces.Box) or len(space.shape) != 3 or space.dtype != np.uint8:
        return False
    return bool((space.low == 0).all() and (space.high == 255).all())


def map_space(
    function: Callable[[spaces.Box], spaces.Space[Any]], space: spaces.Space[Any]
) -> spaces.Space[Any]:
    """Apply a function to a space, or to each part of a Dict space."""
    if isinstance(space, spaces.Dict):
        return spaces.Dict({key: map_space(function, part) for key, part in space.items()})
    return function(cast(spaces.Box, space))


def stacked_space(space: spaces.Space[Any], count: int) -> spaces.Space[Any]:
    """Return the space of `count` joined observations."""
    return space if count == 1 else map_space(lambda box: _tiled(box, count), space)


def joined(frames: Any, space: spaces.Space[Any]) -> Any:
    """Join the frames (B, k, *shape) of each row, oldest first, to one of `stacked_space`."""
    found = {
        key: np.concatenate(list(np.moveaxis(parts_of(frames)[key], 1, 0)), stack_axis(part))
        for key, part in parts_of_space(space).items()
    }
    return whole_of(found)


def _tiled(box: spaces.Box, count: int) -> spaces.Box:
    low, high = (np.concatenate([end] * count, stack_axis(box)) for end in (box.low, box.high))
    return spaces.Box(low, high, dtype=cast(Any, box.dtype))
