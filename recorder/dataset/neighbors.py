"""States of a dataset as vectors, and the nearest of them."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.transitions import Episode
from mcaprl.recorder.format.spaces import observation_leaves

Floats = NDArray[np.float64]
_LARGE: Final = 1_000
_PIXELS: Final = 64
_AT_ONCE: Final = 200


def states_of(dataset: Dataset, episode: Episode) -> Floats:
    """Return the numbers (T, V) of an episode's observations.

    Of parts with more than 1,000 numbers, such as images, there are at most 128, evenly spread.
    """
    found: list[NDArray[Any]] = []
    for leaf in observation_leaves(dataset.observation_space):
        rows = np.asarray(leaf.of(episode.observations)).reshape(len(episode), -1)
        stride = leaf.size // _PIXELS if leaf.size > _LARGE else 1
        found.append(rows[:, ::stride])
    return np.concatenate(found, axis=1).astype(np.float64)


def nearest_rows(
    asked: Floats, known: Floats, own: NDArray[np.int64], groups: NDArray[np.int64]
) -> tuple[NDArray[np.int64], Floats]:
    """Return the nearest known row of another group for each asked row, and its distance.

    Each column is divided by its standard deviation over the known rows, and the distance by the
    root of the number of columns.

    Args:
        asked: (M, V) rows.
        known: (N, V) rows.
        own: (M,) groups of the asked rows.
        groups: (N,) groups of the known rows.
    """
    scale = known.std(0)
    scale = np.where(scale > 0, scale, 1.0) * np.sqrt(max(known.shape[1], 1))
    center = known.mean(0)
    asked, known = (asked - center) / scale, (known - center) / scale
    squares = np.square(known).sum(1)
    rows, distances = np.zeros(len(asked), np.int64), np.full(len(asked), np.inf)
    for start in range(0, len(asked), _AT_ONCE):
        part = slice(start, start + _AT_ONCE)
        far = squares - 2 * asked[part] @ known.T
        far[own[part, None] == groups] = np.inf
        rows[part] = far.argmin(1)
        distances[part] = np.sqrt(np.square(asked[part] - known[rows[part]]).sum(1))
        distances[part][~np.isfinite(far.min(1))] = np.inf
    return rows, distances
