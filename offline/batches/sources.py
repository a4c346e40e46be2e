"""Reading of several logs with weights, from the `DATA...` arguments of a command."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import UsageError
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.open import find_logs, open_logs


def open_weighted(data: Sequence[str], *, threads: int = 1) -> tuple[Dataset, NDArray[np.float64]]:
    """Read logs, each a file, folder or glob, optionally followed by `:WEIGHT`.

    A transition of weight 2 is sampled twice as often as one of weight 1, the default.

    Args:
        data: Logs, with or without weights.
        threads: Number of threads that read chunks.

    Returns:
        All logs as one dataset, and the weight of each of its episodes.

    Raises:
        UsageError: A weight is negative or not finite, or a file is listed with different weights.
        LogError: A file is missing, not an MCAP file, damaged, or without a finished episode.
        SpaceError: The spaces of the logs differ.
    """
    weights: dict[Path, float] = {}
    for part in data:
        name, weight = _split_weight(part)
        for path in find_logs(name):
            if weights.setdefault(path.resolve(), weight) != weight:
                raise UsageError(
                    f"{path} is meant twice, with weights {weights[path.resolve()]:g} and"
                    f" {weight:g}: name it once"
                )
    parts = [open_logs(path, threads=threads) for path in weights]
    pairs = zip(parts, weights.values(), strict=True)
    each = [np.full(len(part.episodes), weight) for part, weight in pairs]
    return Dataset.concatenate(parts), np.concatenate(each)


def _split_weight(part: str) -> tuple[str, float]:
    """Split `logs/a.mcap:2` into name and weight; the name of an existing file is not split."""
    name, colon, number = part.rpartition(":")
    if not colon or Path(part).exists():
        return part, 1.0
    try:
        weight = float(number)
    except ValueError:
        return part, 1.0
    if not 0 <= weight < np.inf:
        raise UsageError(f"{part}: a weight must be a number of at least 0")
    return name, weight
