"""Minari datasets: folders with `data/metadata.json` and the episodes in HDF5 or Arrow form."""

from __future__ import annotations

from pathlib import Path

from mcaprl.errors import LogError
from mcaprl.recorder.dataset.formats.minari.description import (
    local_path,
    options_for,
    raw_metadata,
)
from mcaprl.recorder.dataset.formats.minari.reader import read
from mcaprl.recorder.dataset.formats.minari.writer import write

__all__ = ["local_path", "matches", "options_for", "read", "write"]


def matches(path: Path) -> bool:
    """Return whether a folder is a Minari dataset, or its folder `data`."""
    try:
        raw_metadata(path)
    except LogError:
        return False
    return True
