"""Shared fixtures: one torch thread, no display, and no silent skips in CI."""

from __future__ import annotations

import importlib.util
import logging
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

from mcaprl.ray.cluster import LOCAL, connect, local_settings
from tests.support.paths import CORE

os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
os.environ.setdefault("OMP_NUM_THREADS", "1")
# Ray reads these variables when it is imported. Its clusters in tests listen only on 127.0.0.1.
os.environ.update(local_settings())

# Disk access and JIT compilation make the first example slow, so there is no deadline.
settings.register_profile(
    "mcaprl", deadline=None, suppress_health_check=[HealthCheck.too_slow], derandomize=True
)
settings.load_profile("mcaprl")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """With `-m core`, import no other modules, which may need packages that are missing."""
    is_core = collection_path.is_dir() or collection_path in CORE
    return True if config.option.markexpr == "core" and not is_core else None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the core tests, and start with the examples, which take long, not to end with them."""
    for item in items:
        if item.path in CORE:
            item.add_marker("core")
    items.sort(key=lambda item: item.path.name != "test_examples.py")


@pytest.fixture(autouse=True, scope="session")
def _one_thread() -> None:
    """Limit torch to one thread, because two threads are many times slower on a busy machine."""
    if importlib.util.find_spec("torch"):
        import torch

        torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def _same_weights() -> None:
    """Seed torch, because some random initializations have dead units."""
    if "torch" in sys.modules:
        sys.modules["torch"].manual_seed(0)


@pytest.fixture
def log_path(tmp_path: Path) -> Path:
    """Return the path of a test's log."""
    return tmp_path / "log.mcap"


@pytest.fixture
def python_signals() -> Iterator[None]:
    """Handle SIGINT and SIGTERM as Python does by default.

    A process that a shell starts in the background ignores SIGINT, and libraries that other tests
    use replace the handlers.
    """
    defaults: dict[signal.Signals, Any] = {
        signal.SIGINT: signal.default_int_handler,
        signal.SIGTERM: signal.SIG_DFL,
    }
    before = {number: signal.signal(number, handler) for number, handler in defaults.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Run the tests of a file in one worker, and all tests with the Ray cluster in one worker."""
    from xdist.scheduler import LoadFileScheduling

    scheduling = LoadFileScheduling(config, log)
    file_of = scheduling._split_scope

    def group_of(test: str) -> str:
        needs_ray = test.startswith("tests/ray/") or test.endswith("[docs/ray.md]")
        return "ray" if needs_ray else file_of(test)

    scheduling._split_scope = group_of
    return scheduling


def need(available: bool, reason: str) -> None:
    """Skip the test if something that it needs is missing. In CI, fail instead."""
    if not available and os.environ.get("CI") == "true":
        pytest.fail(f"CI must have it: {reason}")
    if not available:
        pytest.skip(reason)


@pytest.fixture(scope="session")
def ray_cluster() -> Iterator[None]:
    """Start a Ray cluster of two workers on 127.0.0.1; this process stays connected to it."""
    ray = pytest.importorskip("ray")
    with pytest.MonkeyPatch.context() as patch:
        # The workers must be able to import environments of the tests.
        paths = [str(Path(__file__).parent.parent), os.environ.get("PYTHONPATH", "")]
        patch.setenv("PYTHONPATH", os.pathsep.join(filter(None, paths)))
        # The default of 15 makes the workers wait for all other processes of the tests.
        patch.setenv("RAY_worker_niceness", "0")
        assert connect(LOCAL, workers=2, store_bytes=200 << 20)
    logging.getLogger("ray.data").setLevel(logging.ERROR)
    yield
    # Ray's thread for errors sometimes waits for the server forever: end the server after 10 s.
    command = ["pkill", "-P", str(os.getpid()), "gcs_server"]
    timer = threading.Timer(10, subprocess.run, [command])
    timer.daemon = True
    timer.start()
    ray.shutdown()
    timer.cancel()


@pytest.fixture(scope="module")
def small_chunks() -> Iterator[None]:
    """Prevent writers from merging small chunks on close, as if they had been killed."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mcaprl.recorder.columns.output._MIN_CHUNKS_SAVED", 10**9)
        yield
