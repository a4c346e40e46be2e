"""LeRobot datasets, version 3.0: folders of Parquet files, images and videos."""

from __future__ import annotations

from pathlib import Path

from mcaprl.files import parse_json, read_file
from mcaprl.recorder.dataset.formats.lerobot.reader import read
from mcaprl.recorder.dataset.formats.lerobot.writer import write

__all__ = ["matches", "read", "write"]


def matches(path: Path) -> bool:
    """Return whether a folder is a LeRobot dataset of any version."""
    try:
        info = parse_json(read_file(path / "meta/info.json"))
    except (OSError, ValueError):
        return False
    return isinstance(info, dict) and "codebase_version" in info
