"""All tests of this folder have the marker `ray`, so that `-m 'not ray'` leaves them out."""

from __future__ import annotations

from pathlib import Path

import pytest


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Add the marker."""
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker("ray")
