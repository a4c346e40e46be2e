"""Placeholder until the module is written."""

from __future__ import annotations

from pathlib import Path


def matches(path: Path) -> bool:
    """Return False."""
    return False
