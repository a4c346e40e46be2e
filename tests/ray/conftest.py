"""Marks all tests of this folder with `ray`, so that `-m 'not ray'` excludes them."""

from __future__ import annotations

from pathlib import Path

import pytest


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Add the marker `ray` to each test."""
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker("ray")
