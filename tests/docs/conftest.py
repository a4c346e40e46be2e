"""Fixture that runs the code of the page about Ray on the Ray cluster of the tests."""

from __future__ import annotations

import pytest

# The other tests with this page only read it.
USING_RAY = {f"test_a_page_runs_{how}[docs/ray.md]" for how in ("with_small_numbers", "as_written")}


@pytest.fixture(autouse=True)
def _cluster_of_the_page(request: pytest.FixtureRequest) -> None:
    """Connect to the cluster before the page runs."""
    if request.node.name in USING_RAY:
        request.getfixturevalue("ray_cluster")
