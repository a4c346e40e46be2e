"""What all tests need: one thread for torch, no display, and no silent skips in CI."""

from __future__ import annotations

import importlib.util
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
os.environ.setdefault("OMP_NUM_THREADS", "1")

# Disks and JIT compilers make the first example slow; that is no fault of the code under test.
settings.register_profile(
    "mcaprl", deadline=None, suppress_health_check=[HealthCheck.too_slow], derandomize=True
)
settings.load_profile("mcaprl")


@pytest.fixture(autouse=True, scope="session")
def _one_thread() -> None:
    """Two threads on a busy machine run many times slower than one."""
    if importlib.util.find_spec("torch"):
        import torch

        torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def _same_weights() -> None:
    """Networks of a test are the same in each run: chance may leave one with dead units."""
    if "torch" in sys.modules:
        sys.modules["torch"].manual_seed(0)


@pytest.fixture
def log_path(tmp_path: Path) -> Path:
    """Where a test may write its log."""
    return tmp_path / "log.mcap"


def need(available: bool, reason: str) -> None:
    """Skip the test where a counterpart is missing; in CI nothing may be missing."""
    if not available and os.environ.get("CI") == "true":
        pytest.fail(f"CI must have it: {reason}")
    if not available:
        pytest.skip(reason)


@pytest.fixture(scope="module")
def small_chunks() -> Iterator[None]:
    """Let the writers of a module leave their small chunks, as one that is killed does."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mcaprl.recorder.columns.compact._MIN_CHUNKS_SAVED", 10**9)
        yield
