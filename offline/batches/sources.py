"""Datasets from several weighted logs, for the argument `DATA...` of commands."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import UsageError
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.formats.registry import other_format, read_format
from mcaprl.recorder.dataset.open import find_logs, open_logs
from mcaprl.remote import RemotePath


def open_weighted(data: Sequence[str], *, threads: int = 1) -> tuple[Dataset, NDArray[np.float64]]:
    """Read logs as one dataset, and return it with one weight per episode.

    Args:
        data: Files, folders, globs or URLs of logs, or datasets of other tools, each with an
            optional suffix `:WEIGHT`. A transition of weight 2 is drawn twice as often as one of
            weight 1, the default.
        threads: Number of threads that read chunks.

    Raises:
        UsageError: A weight is negative or infinite, or a file has two weights.
        LogError: A file is missing, damaged, not an MCAP file, or has no finished episode.
        SpaceError: The spaces of the logs differ.
    """
    weights: dict[str, float] = {}
    found: dict[str, Callable[[], Dataset]] = {}
    for part in data:
        name, weight = _split_weight(part)
        for key, read in _readers(name, threads):
            found.setdefault(key, read)
            if weights.setdefault(key, weight) != weight:
                raise UsageError(
                    f"{key} is named twice, with weights {weights[key]:g} and {weight:g}; name it"
                    " once"
                )
    parts = [read() for read in found.values()]
    pairs = zip(parts, weights.values(), strict=True)
    each = [np.full(len(part.episodes), weight) for part, weight in pairs]
    return Dataset.concatenate(parts), np.concatenate(each)


def _readers(name: str, threads: int) -> Iterator[tuple[str, Callable[[], Dataset]]]:
    """Yield a unique name and a read function for each log or dataset that `name` refers to."""
    other = other_format(name)
    if other is not None:
        yield name, partial(read_format, name, other)
        return
    for path in find_logs(name):
        key = str(path) if isinstance(path, RemotePath) else os.path.realpath(path)
        yield key, partial(open_logs, path, threads=threads)


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
