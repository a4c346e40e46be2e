"""Fixture that runs the code of the page about Ray on the Ray cluster of the tests."""

from __future__ import annotations

import pytest


@pytest.fixture(autouse=True)
def _cluster_of_the_page(request: pytest.FixtureRequest) -> None:
    """Connect to the cluster before the page runs."""
    callspec = getattr(request.node, "callspec", None)
    if callspec is not None and callspec.params.get("page") == "docs/ray.md":
        request.getfixturevalue("ray_cluster")
