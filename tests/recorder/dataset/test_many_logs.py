"""More logs than descriptors: no open log keeps a descriptor."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import mcaprl
from tests.support.paths import ROOT

pytest.importorskip("resource", reason="needs limits on the number of open files")
pytest.importorskip("torch", reason="needs the extra offline")

LOGS, LIMIT = 200, 64
SCRIPT = f"""
import resource, sys
from pathlib import Path
import numpy as np
import mcaprl
import mcaprl.torch as loading
from mcaprl.cli import run
folder = Path(sys.argv[1])
# What is loaded once is loaded before the limit.
first = folder / "parts-00000.mcap"
assert run(["info", str(first), "--json"]) == run(["check", str(first)]) == 0
resource.setrlimit(resource.RLIMIT_NOFILE, ({LIMIT}, {LIMIT}))
data = mcaprl.open(folder, images="mapped")
assert len(data.episodes) == {LOGS}, len(data.episodes)
assert data.observations[::-1].shape == (len(data), 2, 2, 1)
assert len(mcaprl.open(folder, episodes=[0, {LOGS} - 1]).episodes) == 2
assert len(loading.TransitionDataset(folder)) == len(data)
stream = loading.TransitionStream(folder, batch_size=7, buffer=20, seed=1)
for epoch in range(2):
    rewards = np.concatenate([batch["reward"].numpy() for batch in stream])
    assert np.array_equal(np.sort(rewards), np.arange(len(data), dtype=np.float32)), rewards
out = folder.parent / "out.mcap"
mcaprl.merge(folder, out)
assert mcaprl.open(out).fingerprint == data.fingerprint
assert run(["info", str(folder), "--json"]) == run(["check", str(folder)]) == 0
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with logs of one episode of three steps; reward k is k."""
    place = tmp_path_factory.mktemp("many")
    count = 3 * LOGS
    frames = np.arange(4 * (count + LOGS)) % 251
    images = frames.astype(np.uint8).reshape(-1, 2, 2, 1)
    rows = np.arange(count) + np.arange(count) // 3
    mcaprl.Dataset.from_arrays(
        observations=images[rows],
        next_observations=images[rows + 1],
        actions=np.zeros(count, np.int64),
        rewards=np.arange(count, dtype=np.float64),
        terminated=np.arange(count) % 3 == 2,
        truncated=np.zeros(count, bool),
    ).save(place / "parts.mcap", compression="none")
    mcaprl.split(place / "parts.mcap", place / "logs", episodes=1)
    return place / "logs"


def test_more_logs_than_descriptors(folder: Path) -> None:
    assert len(list(folder.iterdir())) == LOGS
    command = [sys.executable, "-c", SCRIPT, str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]


def test_a_stream_closes_logs_that_it_does_not_use(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import mcaprl.torch as loading
    from mcaprl import limits

    monkeypatch.setattr(limits, "MAX_OPEN_LOGS", 5)
    stream = loading.TransitionStream(folder, batch_size=10, buffer=30, seed=2)
    rewards = np.concatenate([batch["reward"].numpy() for batch in stream])
    assert np.array_equal(np.sort(rewards), np.arange(3 * LOGS, dtype=np.float32))
    assert len(stream._source._logs) == 5
