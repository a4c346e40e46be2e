"""Statistics of the features of a LeRobot dataset: for each episode, and for all data.

A statistic of an array has one number for each element of the last dimension. A statistic of images
has one number for each channel, in shape (channels, 1, 1); for color images, the numbers are in
[0, 1]. Image statistics are computed from at most `_MAX_IMAGES` evenly spaced images per episode.
"""

from __future__ import annotations

import math
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
"""Statistics as arrays, by the names in `NAMES`."""


def sampled(feature: Feature, count: int) -> NDArray[np.int64]:
    """Return evenly spaced indexes of an episode's images, from which statistics are computed."""
    limit = _MAX_ELEMENTS // math.prod(feature.shape) if feature.is_depth else _MAX_IMAGES
    return _spread(count, min(max(limit, 1), _MAX_IMAGES))


def describe(feature: Feature, values: NDArray[Any]) -> Stats:
    """Return the statistics of the values (T, *shape)."""
    channels = values.shape[3] if values.ndim == 4 else 1
    rows = values.reshape(-1, channels if feature.is_image else feature.shape[-1])
    if feature.is_image and values.dtype == np.uint8:
        found = _of_levels(_histogram(values.reshape(len(values), -1, channels)))
    else:
        found = _of_numbers(rows.astype(np.float64))
    if feature.is_image:
        shape = (feature.shape[-1], 1, 1)
        found = {n: np.broadcast_to(a.reshape(-1, 1, 1), shape) for n, a in found.items()}
    elif rows.dtype.kind in "biu":
        found |= {"min": rows.min(0), "max": rows.max(0)}
    return found | {"count": np.array([len(values)], np.int64)}


def pooled(episodes: Sequence[Stats]) -> Stats:
    """Combine the statistics of the episodes into the statistics of all data.

    Each quantile is the mean of the episodes' quantiles, weighted by the number of values of each
    episode.
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


def _spread(count: int, limit: int) -> NDArray[np.int64]:
    return np.unique(np.linspace(0, count - 1, min(count, limit)).round().astype(np.int64))


def _of_numbers(numbers: NDArray[np.float64]) -> Stats:
    """Return the statistics (D,) of rows (N, D)."""
    limit = max(_MAX_ELEMENTS // numbers.shape[1], 1)
    few = numbers if len(numbers) <= limit else numbers[_spread(len(numbers), limit)]
    # NumPy warns about NaN and infinite values, which have no finite mean.
    with np.errstate(all="ignore"):
        quantiles = np.quantile(few, list(QUANTILES.values()), axis=0)
        return {
            "min": numbers.min(0),
            "max": numbers.max(0),
            "mean": numbers.mean(0),
            "std": numbers.std(0),
            **dict(zip(QUANTILES, quantiles, strict=True)),
        }


def _histogram(images: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Return a histogram (C, 256) of the values in each channel of images (T, pixels, C)."""
    counts = np.zeros((images.shape[2], 256), np.int64)
    for image in images:
        for channel, row in enumerate(counts):
            row += np.bincount(image[:, channel], minlength=256)
    return counts


def _of_levels(counts: NDArray[np.int64]) -> Stats:
    """Return the statistics (C,) of pixel values k / 255, given their histograms (C, 256)."""
    levels = np.arange(256) / 255
    total = int(counts[0].sum())
    mean = counts @ levels / total
    variance = (counts * (levels - mean[:, None]) ** 2).sum(1) / total
    found = {"mean": mean, "std": np.sqrt(variance)}
    ends = np.cumsum(counts, axis=1)

    def at(rank: int) -> NDArray[np.float64]:
        return levels[[int(np.searchsorted(row, rank, side="right")) for row in ends]]

    for name, share in QUANTILES.items():
        # Like `np.quantile`, interpolate linearly between the two values next to the quantile.
        place = share * (total - 1)
        low, high = at(math.floor(place)), at(math.ceil(place))
        found[name] = low + (place - math.floor(place)) * (high - low)
    return found | {"min": at(0), "max": at(total - 1)}
