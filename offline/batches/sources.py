"""Datasets from several weighted logs, for the argument `DATA...` of commands."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import UsageError
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.format_registry import other_format, read_format
from mcaprl.recorder.dataset.open import file_key, find_logs, open_logs

Item = TypeVar("Item")


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
    found = _weighted(data, lambda name: _readers(name, threads))
    parts = [read() for read, _ in found]
    pairs = zip(parts, found, strict=True)
    each = [np.full(len(part.episodes), weight) for part, (_, weight) in pairs]
    return Dataset.concatenate(parts), np.concatenate(each)


def weighted_logs(data: Sequence[str]) -> list[tuple[Path, float]]:
    """Return the absolute path of each log in `data` (see `open_weighted`) and its weight.

    Raises:
        UsageError: A weight is negative or infinite, a file has two weights, or it is a dataset of
            another tool.
        LogError: A file is missing.
    """
    return _weighted(data, _logs)


def _weighted(
    data: Sequence[str], expand: Callable[[str], Iterator[tuple[str, Item]]]
) -> list[tuple[Item, float]]:
    """Return the items to which `data` refers, with their weights. Each item occurs once."""
    found: dict[str, tuple[Item, float]] = {}
    for part in data:
        name, weight = _split_weight(part)
        for key, item in expand(name):
            _, earlier = found.setdefault(key, (item, weight))
            if earlier != weight:
                raise UsageError(
                    f"{key} is named twice, with weights {earlier:g} and {weight:g}; name it once"
                )
    return list(found.values())


def _logs(name: str) -> Iterator[tuple[str, Path]]:
    if other_format(name) is not None:
        raise UsageError(f"{name} is not a log: convert it first (mcaprl convert)")
    for path in find_logs(name):
        yield file_key(path), path if path.is_absolute() else path.absolute()


def _readers(name: str, threads: int) -> Iterator[tuple[str, Callable[[], Dataset]]]:
    """Yield a unique name and a read function for each log or dataset that `name` refers to."""
    other = other_format(name)
    if other is not None:
        yield name, partial(read_format, name, other)
        return
    for path in find_logs(name):
        yield file_key(path), partial(open_logs, path, threads=threads)


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
