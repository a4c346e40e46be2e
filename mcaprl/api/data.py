"""Types of the log arguments of the public API."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.open import open_logs

Paths = str | Path | Sequence[str | Path]
"""A file, a folder or a glob of logs, or several of them."""
Data = Dataset | Paths
"""A dataset, or paths of logs."""


def opened(data: Data, *, threads: int = 1) -> Dataset:
    """Return a dataset unchanged, or read it from paths."""
    return data if isinstance(data, Dataset) else open_logs(data, threads=threads)


def named(data: Data) -> str:
    """Return the name of data for tables.

    >>> named("lane.mcap"), named(["a.mcap", "b.mcap"])
    ('lane.mcap', 'a.mcap, b.mcap')
    """
    paths = data.sources if isinstance(data, Dataset) else data
    return str(paths) if isinstance(paths, str | Path) else ", ".join(map(str, paths))
