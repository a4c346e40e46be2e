"""Statistics of the features of a LeRobot dataset: for each episode, and for all data.

Arrays have one number for each element of the last dimension. Images have one for each channel, of
shape (channels, 1, 1), and those of color images are in [0, 1]. They are taken from at most
`_MAX_IMAGES` images of an episode, spread evenly.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.recorder.dataset.formats.lerobot.features import Feature

QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
NAMES = ("min", "max", "mean", "std", "count", *QUANTILES)
"""Names of the statistics."""
_MAX_IMAGES = 100
_MAX_ELEMENTS = 1 << 22

Stats = dict[str, NDArray[Any]]
"""Arrays by the names of `NAMES`."""


def sampled(count: int, limit: int = _MAX_IMAGES) -> NDArray[np.int64]:
    """Return at most `limit` of `count` rows, spread evenly."""
    return np.unique(np.linspace(0, count - 1, min(count, limit)).round().astype(np.int64))


def describe(feature: Feature, values: NDArray[Any]) -> Stats:
    """Return the statistics of the values (T, *shape).

    Args:
        feature: Feature of the values.
        values: Values; of images, those that `sampled` selects.
    """
    if feature.is_image:
        rows = values.reshape(-1, 1 if values.ndim == 3 else values.shape[-1])
        scale = 255.0 if values.dtype == np.uint8 else 1.0
        if feature.dtype == "video":
            rows = np.broadcast_to(rows, (len(rows), feature.shape[-1]))
    else:
        rows, scale = values.reshape(-1, feature.shape[-1]), 1.0
    # Unknown and infinite values have no mean; NumPy warns about them.
    with np.errstate(all="ignore"):
        numbers = rows.astype(np.float64) / scale
        found = dict(zip(QUANTILES, _quantiles(numbers), strict=True))
        found |= {"mean": numbers.mean(0), "std": numbers.std(0)}
        found |= {"min": numbers.min(0), "max": numbers.max(0)}
    if feature.is_image:
        found = {name: array.reshape(-1, 1, 1) for name, array in found.items()}
    elif rows.dtype.kind in "biu":
        found |= {"min": rows.min(0), "max": rows.max(0)}
    return found | {"count": np.array([len(values)], np.int64)}


def pooled(episodes: Sequence[Stats]) -> Stats:
    """Return the statistics of all data from those of the episodes.

    The quantiles are the means of the episodes' quantiles, weighted by their numbers of values.
    """
    counts = np.array([episode["count"][0] for episode in episodes], np.float64)
    column = {name: np.stack([e[name] for e in episodes]) for name in NAMES}
    shares = (counts / counts.sum()).reshape(-1, *[1] * (column["mean"].ndim - 1))
    with np.errstate(all="ignore"):
        mean = (shares * column["mean"]).sum(0)
        variance = (shares * (column["std"] ** 2 + (column["mean"] - mean) ** 2)).sum(0)
        found = {name: (shares * column[name]).sum(0) for name in QUANTILES}
        found |= {"min": column["min"].min(0), "max": column["max"].max(0)}
        found |= {"mean": mean, "std": np.sqrt(variance)}
    return found | {"count": column["count"].sum(0)}


def _quantiles(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    limit = max(_MAX_ELEMENTS // rows.shape[1], 1)
    few = rows if len(rows) <= limit else rows[sampled(len(rows), limit)]
    found: NDArray[np.float64] = np.quantile(few, list(QUANTILES.values()), axis=0)
    return found
