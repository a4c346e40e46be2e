"""Tests of training on a Ray cluster.

The weights must equal those of one process, also if a worker is killed.
"""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import pytest

import mcaprl
from mcaprl.cli import run
from mcaprl.errors import ClusterError, SpaceError, UsageError
from mcaprl.progress import TrainingProgress
from mcaprl.recorder.format.metadata import installed_versions
from mcaprl.runs import read_curve
from tests.ray.seeded import SEEDED
from tests.support.paths import GOLDEN

pytest.importorskip("torch")
from safetensors.torch import load_file

pytestmark = pytest.mark.usefixtures("ray_cluster")
EARLY, LATE = 1e-5, 1e-3
"""Relative differences of the loss terms after 50 and 1,500 updates, as docs/ray.md says."""
OPTIONS: dict[str, Any] = {
    "algo": "iql",
    "updates": 1500,
    "batch_size": 32,
    "hidden": (8, 8),
    "seeds": 2,
    "held_out": 0.2,
    "log_interval": 50,
    "checkpoint_interval": 50,
    "target_interval": 100,
    "normalize": True,
    "scale_rewards": True,
    "normalize_advantages": True,
}


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with two logs."""
    folder = tmp_path_factory.mktemp("logs")
    for seed in (0, 1):
        mcaprl.record(
            SEEDED,
            folder / f"{seed}.mcap",
            policy="random",
            episodes=7 + seed,
            seed=seed,
            sim_options={"pause_s": 0.0},
        )
    return folder


def train_workers() -> list[int]:
    """Return the processes of Ray Train's workers."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            title = path.read_bytes()
        except OSError:
            continue
        if b"RayTrainWorker" in title:
            found.append(int(path.parent.name))
    return sorted(found)


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs /proc")
def test_weights_are_those_of_one_process_if_a_worker_is_killed(logs: Path, tmp_path: Path) -> None:
    data = [f"{logs / '0.mcap'}:2", str(logs / "1.mcap")]
    local = mcaprl.train(data, tmp_path / "local", **OPTIONS)
    killed: list[int] = []
    done: list[tuple[int, int]] = []

    def progress(now: TrainingProgress) -> None:
        done.append((now.seed, now.done))
        if not killed:
            killed.append(train_workers()[-1])
            os.kill(killed[0], signal.SIGKILL)

    found = mcaprl.train(data, tmp_path / "ray", ray=True, workers=2, progress=progress, **OPTIONS)
    assert [one.seed for one in found] == [0, 1]
    assert all(0 < one.resumed_at < one.steps for one in found), "no worker was lost"
    assert {(0, 1500), (1, 1500)} <= set(done)
    for mine, theirs in zip(found, local, strict=True):
        assert mine.terms == pytest.approx(theirs.terms, abs=LATE, rel=LATE)
        curves = [read_curve(one.folder / "metrics.csv") for one in (mine, theirs)]
        assert curves[0].keys() == curves[1].keys()
        for name, values in curves[0].items():
            assert len(values) == len(curves[1][name]) == 30
            assert values[0] == pytest.approx(curves[1][name][0], abs=EARLY, rel=EARLY)
        pair = [load_file(one.folder / "checkpoint.safetensors") for one in (mine, theirs)]
        assert pair[0].keys() == pair[1].keys()
        assert pair[0]["generator.sampler"].equal(pair[1]["generator.sampler"])
        for name, tensor in pair[0].items():
            if name.endswith(".weights"):
                assert (tensor - pair[1][name]).abs().max() < 0.02
    names = sorted(path.name for path in (tmp_path / "ray").iterdir())
    assert names == sorted(path.name for path in (tmp_path / "local").iterdir())


def test_a_finished_run_is_resumed_without_updates_and_needs_the_same_data(
    logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    small = ["--updates", "3", "--hidden", "4", "--algo", "bc", "--ray", "--workers", "2"]
    assert run(["train-offline", str(logs), "--out", str(out), *small]) == 0
    assert f"{out / 'seed-0'}: 3 updates" in capsys.readouterr().out
    resumed = ["train-offline", str(logs / "0.mcap"), "--out", str(out), "--resume", "--ray"]
    assert run(resumed) == 1
    assert capsys.readouterr().err.count("\n") == 1


def test_options_that_cannot_be_used_with_ray(logs: Path, tmp_path: Path) -> None:
    def train(data: Any = logs, **options: Any) -> None:
        mcaprl.train(data, tmp_path / "run", algo="bc", updates=1, **options)

    with pytest.raises(UsageError, match="--workers requires --ray"):
        train(workers=2)
    with pytest.raises(UsageError, match="--ray trains one algorithm on the paths of logs"):
        train(mcaprl.open(logs), ray=True)
    with pytest.raises(UsageError, match="--ray trains one algorithm on the paths of logs"):
        train(ray=True, follow=True)
    with pytest.raises(ClusterError, match="the cluster has 2 CPUs for 3 workers"):
        train(ray=True, workers=3)
    with pytest.raises(ClusterError, match="the cluster has 0 GPUs for 1 workers"):
        train(ray=True, device="cuda")
    with pytest.raises(SpaceError, match="needs discrete actions, got Box"):
        train(GOLDEN / "multi-binary.mcap", ray=True)
    assert not (tmp_path / "run").exists()


def test_an_error_of_a_worker_ends_the_training_as_one_line(
    logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    versions = {**installed_versions(), "numpy": "1.2.3"}
    monkeypatch.setattr("mcaprl.ray.training.installed_versions", lambda: versions)
    with pytest.raises(ClusterError, match=r"the worker at 127\.0\.0\.1 has numpy .* 1\.2\.3: in"):
        mcaprl.train(logs, tmp_path / "run", algo="bc", updates=1, ray=True, workers=2)
