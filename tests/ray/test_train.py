"""Tests of training on a Ray cluster.

The weights must equal those of one process, also if a worker is killed.
"""

from __future__ import annotations

import io
import os
import shutil
import signal
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

import mcaprl
from mcaprl.cli import run
from mcaprl.errors import ClusterError, LogError, SpaceError, UsageError
from mcaprl.progress import TrainingProgress
from mcaprl.recorder.format.metadata import installed_versions
from mcaprl.runs import read_curve
from tests.ray.processes import titled
from tests.ray.seeded import SEEDED
from tests.support.paths import GOLDEN

pytest.importorskip("torch")
from safetensors.torch import load_file

from mcaprl.offline.training.metrics import OfflineSummary
from mcaprl.ray import training, workers

pytestmark = pytest.mark.usefixtures("ray_cluster")
EARLY, LATE, UPDATES = 1e-5, 1e-4, 300
"""Relative differences of the loss terms after 50 and 300 updates, as docs/ray.md says."""
OPTIONS: dict[str, Any] = {
    "algo": "iql",
    "updates": UPDATES,
    "batch_size": 32,
    "hidden": (8, 8),
    "seeds": 2,
    "held_out": 0.2,
    "log_interval": 50,
    "checkpoint_interval": 50,
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
    """A training by one process, and the same training by two workers, one of which was killed.

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
            os.kill(titled("RayTrainWorker")[-1], signal.SIGKILL)
        done.append((now.seed, now.done))

    found = mcaprl.train(data, folder / "ray", ray=True, workers=2, progress=progress, **OPTIONS)
    return Trained(data, mcaprl.train(data, folder / "local", **OPTIONS), found, done)


@pytest.mark.long
def test_weights_are_those_of_one_process_if_a_worker_is_killed(trained: Trained) -> None:
    assert [one.seed for one in trained.found] == [0, 1]
    assert all(0 < one.resumed_at < one.steps for one in trained.found), "no worker was lost"
    assert {(0, UPDATES), (1, UPDATES)} <= set(trained.done)
    for mine, theirs in zip(trained.found, trained.local, strict=True):
        assert mine.terms == pytest.approx(theirs.terms, abs=LATE, rel=LATE)
        curves = [read_curve(one.folder / "metrics.csv") for one in (mine, theirs)]
        assert curves[0].keys() == curves[1].keys()
        for name, values in curves[0].items():
            assert len(values) == len(curves[1][name]) == UPDATES / 50
            assert values[0] == pytest.approx(curves[1][name][0], abs=EARLY, rel=EARLY)
        pair = [load_file(one.folder / "checkpoint.safetensors") for one in (mine, theirs)]
        assert pair[0].keys() == pair[1].keys()
        assert pair[0]["generator.sampler"].equal(pair[1]["generator.sampler"])
        for name, tensor in pair[0].items():
            if name.endswith(".weights"):
                assert (tensor - pair[1][name]).abs().max() < 0.02
    ray, local = (results[0].folder.parent for results in (trained.found, trained.local))
    assert sorted(path.name for path in ray.iterdir()) == sorted(p.name for p in local.iterdir())


@pytest.mark.long
def test_a_run_is_resumed_by_another_number_of_workers_with_the_same_data(
    trained: Trained, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    shutil.copytree(trained.found[0].folder.parent, out)
    # Seed 1 continues from the beginning, and seed 0 is finished.
    (out / "seed-1" / "checkpoint.safetensors").unlink()
    resumed = ["--out", str(out), "--resume", "--ray", "--workers", "1"]
    assert run(["train-offline", *trained.data, *resumed]) == 0
    printed = capsys.readouterr().out
    assert f"{out / 'seed-0'}: finished before, with {UPDATES} updates" in printed
    assert f"{out / 'seed-1'}: {UPDATES} updates, " in printed
    mine, theirs = (
        read_curve(path / "metrics.csv") for path in (out / "seed-1", trained.local[1].folder)
    )
    for name, values in mine.items():
        assert values[-1] == pytest.approx(theirs[name][-1], abs=LATE, rel=LATE)
    assert run(["train-offline", trained.data[0], *resumed]) == 1
    error = capsys.readouterr().err
    assert "was trained on other data" in error
    assert error.count("\n") == 1


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
    with pytest.raises(ClusterError, match="the cluster has 0 GPUs for 1 worker:"):
        train(ray=True, device="cuda")
    with pytest.raises(SpaceError, match="needs discrete actions, got Box"):
        train(GOLDEN / "multi-binary.mcap", ray=True)
    assert not (tmp_path / "run").exists()


@pytest.mark.long
def test_an_error_of_a_worker_ends_the_training_as_one_line(
    logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Damage the last log, which only one of the workers reads. No worker is started again."""
    from ray.train.torch import TorchTrainer

    fit, ended = TorchTrainer.fit, []
    monkeypatch.setattr(TorchTrainer, "fit", lambda trainer: ended.append(fit(trainer)))
    monkeypatch.setattr(training, "MOST_DEATHS", 0)
    shutil.copytree(logs, tmp_path / "logs")
    content = bytearray((logs / "1.mcap").read_bytes())
    summary = make_reader(io.BytesIO(content)).get_summary()
    assert summary is not None
    chunk = summary.chunk_indexes[-1]
    content[chunk.chunk_start_offset + chunk.chunk_length // 2] ^= 1
    (tmp_path / "logs" / "1.mcap").write_bytes(content)
    with pytest.raises(
        LogError, match=r"1\.mcap: the chunk at byte .* does not match its CRC"
    ) as raised:
        mcaprl.train(tmp_path / "logs", tmp_path / "run", algo="bc", updates=1, ray=True, workers=2)
    assert "\n" not in str(raised.value)
    assert len(ended) == 1


def test_other_versions_and_unseen_paths_are_found_before_the_workers_start(
    logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def train() -> None:
        mcaprl.train(logs, tmp_path / "run", algo="bc", updates=1, ray=True, workers=2)

    monkeypatch.setattr(training, "_fit", None)
    summaries = training._read_summaries([str(logs)])
    unseen = replace(summaries, paths=[summaries.paths[0], tmp_path / "none.mcap"])
    with monkeypatch.context() as patch:
        patch.setattr(training, "_read_summaries", lambda data: unseen)
        with pytest.raises(ClusterError, match=r"127\.0\.0\.1 cannot see .*/none\.mcap: choose"):
            train()
    versions = {**installed_versions(), "numpy": "1.2.3"}
    monkeypatch.setattr(workers, "installed_versions", lambda: versions)
    with pytest.raises(ClusterError, match=r"the worker at 127\.0\.0\.1 has numpy .* 1\.2\.3: in"):
        train()
    assert list(tmp_path.iterdir()) == []
