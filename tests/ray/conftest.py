"""Marks all tests of this folder with `ray`, and checks that signal handlers are kept."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path

import pytest


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Add the marker `ray` to each test, so that `-m 'not ray'` excludes them."""
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker("ray")


@pytest.fixture(autouse=True, scope="module")
def _kept_handlers() -> Iterator[None]:
    """Check that Ctrl-C and SIGUSR1 have the same handlers after a file's tests as before."""
    numbers = [getattr(signal, name) for name in ("SIGINT", "SIGUSR1") if hasattr(signal, name)]
    before = [signal.getsignal(number) for number in numbers]
    yield
    assert [signal.getsignal(number) for number in numbers] == before
