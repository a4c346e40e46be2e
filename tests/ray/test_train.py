"""Tests of training on a Ray cluster.

The weights must equal those of one process, also if a worker is killed.
"""

from __future__ import annotations

import os
import shutil
import signal
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

import mcaprl
from mcaprl.api.ranges import ClusterOptions
from mcaprl.cli import run
from mcaprl.errors import ClusterError, SpaceError, TrainingError, UsageError
from mcaprl.progress import TrainingProgress
from mcaprl.recorder.format.metadata import installed_versions
from tests.ray.processes import titled
from tests.ray.seeded import SEEDED
from tests.support.paths import GOLDEN

pytest.importorskip("torch")
from safetensors.torch import load_file

from mcaprl.offline.training.metrics import OfflineSummary
from mcaprl.ray import tasks

pytestmark = pytest.mark.usefixtures("ray_cluster")
UPDATES = 1200
OPTIONS: dict[str, Any] = {
    "algo": "iql",
    "updates": UPDATES,
    "batch_size": 32,
    "hidden": (8, 8),
    "seeds": 2,
    "held_out": 0.2,
    "log_interval": 100,
    "checkpoint_interval": 100,
    "target_interval": 20,
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


@dataclass
class Trained:
    """A training by one process, and the same training by two workers, both of which were killed.

    Attributes:
        data: Arguments for the logs.
        local: Results of one process.
        found: Results of the workers.
        done: Seed and update of each report of the workers.
    """

    data: list[str]
    local: list[OfflineSummary]
    found: list[OfflineSummary]
    done: list[tuple[int, int]]


@pytest.fixture(scope="module")
def trained(logs: Path, tmp_path_factory: pytest.TempPathFactory) -> Trained:
    if not Path("/proc/self").exists():
        pytest.skip("needs /proc")
    folder = tmp_path_factory.mktemp("runs")
    data = [f"{logs / '0.mcap'}:2", str(logs / "1.mcap")]
    done: list[tuple[int, int]] = []

    def progress(now: TrainingProgress) -> None:
        if not done:
            for process in titled("ray::run_task"):
                os.kill(process, signal.SIGKILL)
        done.append((now.seed, now.done))

    found = mcaprl.train(
        data, folder / "ray", ray=ClusterOptions(workers=2), progress=progress, **OPTIONS
    )
    return Trained(data, mcaprl.train(data, folder / "local", **OPTIONS), found, done)


def test_weights_are_those_of_one_process_if_workers_are_killed(trained: Trained) -> None:
    assert [one.seed for one in trained.found] == [0, 1]
    assert any(0 < one.resumed_at < one.steps for one in trained.found), "no worker was lost"
    assert {(0, UPDATES), (1, UPDATES)} <= set(trained.done)
    for mine, theirs in zip(trained.found, trained.local, strict=True):
        assert mine.terms == theirs.terms
        for name in ("metrics.csv", "policy.safetensors", "policy.json"):
            assert (mine.folder / name).read_bytes() == (theirs.folder / name).read_bytes()
        pair = [load_file(one.folder / "checkpoint.safetensors") for one in (mine, theirs)]
        assert pair[0].keys() == pair[1].keys()
        assert all(tensor.equal(pair[1][name]) for name, tensor in pair[0].items())
    ray, local = (results[0].folder.parent for results in (trained.found, trained.local))
    assert sorted(path.name for path in ray.iterdir()) == sorted(p.name for p in local.iterdir())
    assert (ray / "config.json").read_bytes() == (local / "config.json").read_bytes()


@pytest.mark.parametrize("began_with", ["ray", "local"])
def test_a_run_is_resumed_with_and_without_ray(
    trained: Trained, tmp_path: Path, capsys: pytest.CaptureFixture[str], began_with: str
) -> None:
    out = tmp_path / "run"
    began = trained.found if began_with == "ray" else trained.local
    shutil.copytree(began[0].folder.parent, out)
    # Seed 1 continues from the beginning, and seed 0 is finished.
    (out / "seed-1" / "checkpoint.safetensors").unlink()
    ray = ["--ray", "--workers", "1"]
    resumed = ["--out", str(out), "--resume", *(ray if began_with == "local" else [])]
    assert run(["train-offline", *trained.data, *resumed]) == 0
    printed = capsys.readouterr().out
    assert f"{out / 'seed-0'}: finished before, with {UPDATES} updates" in printed
    assert f"{out / 'seed-1'}: {UPDATES} updates, " in printed
    mine, theirs = (path / "policy.safetensors" for path in (out / "seed-1", began[1].folder))
    assert mine.read_bytes() == theirs.read_bytes()
    assert run(["train-offline", trained.data[0], "--out", str(out), "--resume", *ray]) == 1
    error = capsys.readouterr().err
    assert "was trained on other data" in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("algo", ["bc", "td3-bc", "rebrac", "iql"])
def test_weights_of_learners_of_a_box_are_those_of_one_process(tmp_path: Path, algo: str) -> None:
    log, box = tmp_path / "log.mcap", {"pause_s": 0.0, "box": True}
    mcaprl.record(SEEDED, log, policy="random", episodes=8, seed=0, sim_options=box)
    sizes: dict[str, Any] = {"updates": 40, "batch_size": 16, "hidden": (8, 8), "seeds": 2}
    if algo != "bc":
        sizes["gamma"] = 0.5
    mcaprl.train(log, tmp_path / "ray", algo=algo, ray=ClusterOptions(workers=2), **sizes)
    mcaprl.train(log, tmp_path / "local", algo=algo, **sizes)
    for seed in (0, 1):
        for file in ("metrics.csv", "policy.safetensors", "policy.json"):
            mine, theirs = (tmp_path / one / f"seed-{seed}" / file for one in ("ray", "local"))
            assert mine.read_bytes() == theirs.read_bytes()


def test_options_that_cannot_be_used_with_ray(logs: Path, tmp_path: Path) -> None:
    def train(data: Any = logs, **options: Any) -> None:
        mcaprl.train(data, tmp_path / "run", algo="bc", updates=1, **options)

    with pytest.raises(UsageError, match="`workers=` requires `ray=True`"):
        train(ray=ClusterOptions(False, workers=2))
    first = mcaprl.open(logs).filter(lambda episode: episode.index == 0)
    with pytest.raises(UsageError, match="workers read logs: pass their paths"):
        train(first, ray=True)
    with pytest.raises(UsageError, match="workers read logs: pass their paths"):
        train(mcaprl.open(logs, follow=True), ray=True)
    with pytest.raises(ClusterError, match="the cluster has 2 CPUs for 3 workers"):
        train(ray=ClusterOptions(workers=3))
    with pytest.raises(ClusterError, match="the cluster has 0 GPUs for 1 worker:"):
        train(ray=True, device="cuda")
    with pytest.raises(SpaceError, match="dqn needs discrete actions"):
        mcaprl.train(GOLDEN / "multi-binary.mcap", tmp_path / "run", algo="dqn", ray=True)
    assert not (tmp_path / "run").exists()


def test_an_error_of_a_worker_ends_the_training_as_one_line(logs: Path, tmp_path: Path) -> None:
    with pytest.raises(TrainingError, match=r"update \d+ of .* Last good checkpoint") as raised:
        mcaprl.train(
            logs, tmp_path / "run", algo="bc", learning_rate=1e30, updates=9, seeds=2, ray=True
        )
    assert "\n" not in str(raised.value)


def test_a_training_whose_workers_die_is_one_line(
    logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mcaprl.ray.tasks.MOST_DEATHS", 1)

    def progress(now: TrainingProgress) -> None:
        for process in titled("ray::run_task"):
            os.kill(process, signal.SIGKILL)

    with pytest.raises(
        ClusterError, match=r"the checkpoints are kept: continue with `resume=True` \("
    ):
        mcaprl.train(
            logs,
            tmp_path / "run",
            algo="bc",
            updates=10**6,
            log_interval=10,
            ray=True,
            progress=progress,
        )


@pytest.mark.parametrize("seeds", [1, 2])
def test_an_interrupted_training_ends_its_workers(logs: Path, tmp_path: Path, seeds: int) -> None:
    options: dict[str, Any] = {"algo": "bc", "updates": 10**6, "log_interval": 10}

    def progress(now: TrainingProgress) -> None:
        raise KeyboardInterrupt

    out = tmp_path / "run"
    with pytest.raises(KeyboardInterrupt):
        mcaprl.train(logs, out, seeds=seeds, ray=True, progress=progress, **options)
    ends = time.monotonic() + 30
    while titled("ray::run_task") and time.monotonic() < ends:
        time.sleep(0.1)
    assert not titled("ray::run_task")


def test_other_versions_and_unseen_paths_are_found_before_the_workers_start(
    logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def train() -> None:
        mcaprl.train(logs, tmp_path / "run", algo="bc", updates=1, ray=ClusterOptions(workers=2))

    with monkeypatch.context() as patch:
        patch.setattr(tasks, "logs_of", lambda data: {tmp_path / "none.mcap": 1.0})
        with pytest.raises(ClusterError, match=r"127\.0\.0\.1 cannot see .*/none\.mcap: choose"):
            train()
    versions = {**installed_versions(), "numpy": "1.2.3"}
    monkeypatch.setattr(tasks, "installed_versions", lambda: versions)
    with pytest.raises(ClusterError, match=r"the worker at 127\.0\.0\.1 has numpy .* 1\.2\.3: in"):
        train()
    assert list(tmp_path.iterdir()) == []
