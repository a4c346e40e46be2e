"""Datasets from several weighted logs, for the argument `DATA...` of commands."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import UsageError
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.open import find_logs, open_logs


def open_weighted(data: Sequence[str], *, threads: int = 1) -> tuple[Dataset, NDArray[np.float64]]:
    """Read logs as one dataset, and return it with one weight per episode.

    Args:
        data: Files, folders or globs, each with an optional suffix `:WEIGHT`. A transition of
            weight 2 is drawn twice as often as one of weight 1, the default.
        threads: Number of threads that read chunks.

    Raises:
        UsageError: A weight is negative or infinite, or a file has two weights.
        LogError: A file is missing, damaged, not an MCAP file, or has no finished episode.
        SpaceError: The spaces of the logs differ.
    """
    weights: dict[Path, float] = {}
    for part in data:
        name, weight = _split_weight(part)
        for path in find_logs(name):
            if weights.setdefault(path.resolve(), weight) != weight:
                raise UsageError(
                    f"{path} is named twice, with weights {weights[path.resolve()]:g} and"
                    f" {weight:g}; name it once"
                )
    parts = [open_logs(path, threads=threads) for path in weights]
    pairs = zip(parts, weights.values(), strict=True)
    each = [np.full(len(part.episodes), weight) for part, weight in pairs]
    return Dataset.concatenate(parts), np.concatenate(each)


def _split_weight(part: str) -> tuple[str, float]:
    """Split `logs/a.mcap:2` into name and weight, unless a file with the whole name exists."""
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
