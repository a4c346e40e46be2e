"""Tests of runs that are stopped or killed and then resumed: restored state and continuation."""

from __future__ import annotations

import csv
import hashlib
import json
import shutil
import signal
import subprocess
import sys
import textwrap
from collections.abc import Callable
from contextlib import closing
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from stable_baselines3 import DQN

import mcaprl
from mcaprl.cli import run
from mcaprl.errors import TrainingError, UsageError
from mcaprl.frames import mapped
from mcaprl.online.config import CONFIGS, FINITE_ALGOS
from mcaprl.online.learning import LearningAgent
from mcaprl.online.task import Task, choose_task
from mcaprl.online.train import OnlineSummary, make_agent, train
from mcaprl.progress import TrainingProgress
from mcaprl.recorder.dataset.open import GrowingLogs
from mcaprl.runs import read_curve
from mcaprl.sims.evaluation.evaluate import Scale
from mcaprl.storage.tensor_files import read_tensors, write_tensors
from tests.support.offline_tasks import corridor

SHORT: dict[str, Any] = {
    "steps": 2_000,
    "hidden": (8,),
    "eval_interval": 400,
    "eval_episodes": 2,
    "final_episodes": 2,
    "learning_starts": 300,
    "target_update_interval": 200,
    "checkpoint_interval": 400,
}
SHORTER: dict[str, Any] = {**SHORT, "steps": 200, "eval_interval": 200}


class Stopped(Exception):
    """Exception that stops a training."""


def silent(_: TrainingProgress) -> None:
    """A progress callback that does nothing."""


def stop_at(step: int) -> Callable[[TrainingProgress], None]:
    """Return a progress callback that stops the training."""

    def report(now: TrainingProgress) -> None:
        if now.done >= step:
            raise Stopped

    return report


@pytest.mark.parametrize(
    ("algo", "settings"),
    [
        ("double-dqn", {}),
        ("double-dqn", {"n_steps": 3, "buffer_size": 1_000, "alpha": 0.5}),
        ("double-dqn", {"target_update_episodes": 5, "exploration_decay": 0.999, "dueling": True}),
        ("dqn", {}),
        ("dqn", {"n_steps": 3}),
        ("ppo", {"rollout_steps": 400, "batch_size": 50}),
        ("sac", {"n_steps": 3}),
        ("td3", {}),
        ("sac of sb3", {}),
        ("tqc", {}),
    ],
)
def test_a_checkpoint_restores_everything(
    tmp_path: Path, algo: str, settings: dict[str, Any]
) -> None:
    """A finished run that is resumed writes the same checkpoint, which has all state."""
    if algo == "tqc":
        pytest.importorskip("sb3_contrib")
    algo, _, engine = algo.partition(" of ")
    known = {field.name for field in fields(CONFIGS[algo])}
    given = {name: value for name, value in {**SHORT, **settings}.items() if name in known}
    sim_options = {} if algo in FINITE_ALGOS else {"actions": "continuous"}
    task = choose_task("lane", algo, sim_options, given, engine=engine or None)
    path = tmp_path / "checkpoint.safetensors"
    scale = Scale(0.0, 1.0)
    with closing(make_agent(task, "Lane-v0", tmp_path, 0, scale)) as first:
        first.learn(silent)
    before = path.read_bytes()
    torch.manual_seed(7)
    with closing(make_agent(task, "Lane-v0", tmp_path, 0, scale, resume=True)) as second:
        second.learn(silent)
        assert second.resumed_at == 2_000
        assert second.points == first.points
        path.unlink()
        second._save()
    assert path.read_bytes() == before


def sha(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.mark.parametrize(
    ("sim_options", "settings"),
    [
        ({}, {"n_steps": 3}),
        ({"observation": "dashboard"}, {"frame_stack": 2, "image_shift": 2, "batch_size": 8}),
    ],
)
def test_a_stopped_run_ends_with_the_bits_of_an_uninterrupted_one(
    tmp_path: Path, sim_options: dict[str, Any], settings: dict[str, Any]
) -> None:
    short = {**SHORT, "steps": 1_200, "checkpoint_interval": 350, **settings}
    task = Task.for_sim("lane", None, sim_options, **short)
    train(task, tmp_path / "a", record=tmp_path / "a.mcap", progress=silent)
    with pytest.raises(Stopped):
        train(task, tmp_path / "b", record=tmp_path / "b.mcap", progress=stop_at(1_000))
    (summary,) = train(
        task, tmp_path / "b", record=tmp_path / "b.mcap", resume=True, progress=silent
    )
    assert summary.resumed_at == 704
    for name in (*LearningAgent.best_files, "curve.csv", "checkpoint.safetensors"):
        whole, resumed = (tmp_path / run / "seed-0" / name for run in ("a", "b"))
        assert sha(whole) == sha(resumed), name
    check_same_logs(tmp_path / "a.mcap", tmp_path / "b.mcap")


def check_same_logs(path: Path, other: Path) -> None:
    """Check that two logs have the same episodes."""
    one, two = mcaprl.open(path), mcaprl.open(other)
    assert [e.length for e in one.episodes] == [e.length for e in two.episodes]
    for name in ("actions", "rewards", "terminated", "truncated", "behavior_probs"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
    mapped(np.testing.assert_array_equal, one.observations, two.observations)


@pytest.fixture(scope="module")
def resumed(tmp_path_factory: pytest.TempPathFactory) -> OnlineSummary:
    """Train, stop after 1,000 steps and resume; return the summary of a run for reading only."""
    out = tmp_path_factory.mktemp("resumed") / "run"
    settings = {**SHORT, "exploration_fraction": 1.0, "final_learning_rate_fraction": 0.1}
    task = Task.for_sim("lane", **settings)
    with pytest.raises(Stopped):
        train(task, out, progress=stop_at(1_000))
    (summary,) = train(task, out, resume=True, progress=silent)
    return summary


@pytest.fixture
def finished(_finished: Path, tmp_path: Path) -> Path:
    """Return a copy of the folder of a finished run of 200 steps."""
    return shutil.copytree(_finished, tmp_path / "run")


@pytest.fixture(scope="module")
def _finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("finished") / "run"
    train(Task.for_sim("lane", "dqn", **SHORTER), out, progress=silent)
    return out


def test_a_stopped_run_continues_from_its_last_checkpoint(resumed: OnlineSummary) -> None:
    assert (resumed.resumed_at, resumed.steps) == (800, 2_000)
    curve = read_curve(resumed.folder / "curve.csv")
    assert curve["step"].tolist() == [400, 800, 1_200, 1_600, 2_000]
    with (resumed.folder / "progress.csv").open() as file:
        steps = [int(row["time/total_timesteps"]) for row in csv.DictReader(file)]
    assert steps == sorted(steps) == [400, 800, 1_000, 1_200, 1_600, 2_000, 2_000]


def test_a_run_stopped_before_its_first_evaluation_continues(tmp_path: Path) -> None:
    settings = {**SHORT, "checkpoint_interval": 200, "eval_interval": 2_000}
    task = Task.for_sim("lane", "dqn", **settings)
    with pytest.raises(Stopped):
        train(task, tmp_path / "run", progress=stop_at(1_000))
    (summary,) = train(task, tmp_path / "run", resume=True, progress=silent)
    assert (summary.resumed_at, summary.best_step) == (800, 2_000)


def test_the_best_policy_is_that_of_the_checkpoint(finished: Path) -> None:
    best = finished / "seed-0" / "best_model.zip"
    content = best.read_bytes()
    best.write_bytes(b"of an evaluation after the checkpoint")
    train(Task.for_sim("lane", "dqn", **SHORTER), finished, resume=True, progress=silent)
    assert best.read_bytes() == content


def test_checkpoints_of_earlier_versions_are_refused_in_one_line(finished: Path) -> None:
    path = finished / "seed-0" / "checkpoint.safetensors"
    tensors, description = read_tensors(path)
    del description["episodes_in_log"]
    write_tensors(path, tensors, description)
    with pytest.raises(TrainingError, match="was written by an earlier version of mcaprl; resume"):
        train(Task.for_sim("lane", "dqn", **SHORTER), finished, resume=True, progress=silent)


def test_resuming_a_missing_run_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["train-online", "lane", "--out", str(tmp_path / "rum"), "--resume"]) == 1
    assert "rum has no run to resume: check the path" in capsys.readouterr().err
    assert not (tmp_path / "rum").exists()


def test_a_second_training_in_the_folder_is_refused(tmp_path: Path) -> None:
    task = Task.for_sim("lane", "dqn", **SHORTER)
    begun = []

    def begin_another(now: TrainingProgress) -> None:
        begun.append(now.done)
        with pytest.raises(TrainingError, match="run is in use by another"):
            train(task, tmp_path / "run", resume=True, progress=silent)

    (summary,) = train(task, tmp_path / "run", progress=begin_another)
    assert begun
    assert summary.steps == 200


def test_epsilon_and_learning_rate_continue_to_decay(resumed: OnlineSummary) -> None:
    with (resumed.folder / "progress.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["train/learning_rate"]]
    assert [row["time/total_timesteps"] for row in rows] == ["1000", "2000"]
    for row in rows:
        done = float(row["time/total_timesteps"]) / 2_000
        assert float(row["rollout/exploration_rate"]) == pytest.approx(1 - 0.95 * done)
        assert float(row["train/learning_rate"]) == pytest.approx(5e-4 * (1 - 0.9 * done))


def test_a_finished_run_is_not_repeated(finished: Path) -> None:
    task = Task.for_sim("lane", "dqn", **SHORTER)
    before = {name: (finished / name).read_text() for name in ("scores.json", "seed-0/curve.csv")}
    (again,) = train(task, finished, resume=True, progress=silent)
    score = json.loads(before["scores.json"])["seeds"]["seed-0"]["score"]
    assert (again.resumed_at, again.steps, again.score) == (200, 200, score)
    assert (finished / "seed-0" / "curve.csv").read_text() == before["seed-0/curve.csv"]


def test_resuming_trains_all_seeds_of_the_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    task, out = Task.for_sim("lane", "dqn", **SHORTER), tmp_path / "run"
    with pytest.raises(Stopped):
        train(task, out, seeds=2, seed=5, progress=stop_at(200))
    others: list[dict[str, Any]] = [{"seeds": 1}, {"seed": 0}]
    for given in others:
        with pytest.raises(UsageError, match="a run of 2 seeds, the first of which is 5"):
            mcaprl.train_online(None, out, resume=True, **given)
    assert [one.seed for one in mcaprl.train_online(None, out, resume=True)] == [5, 6]
    scores = (out / "scores.json").read_text()
    assert sorted(json.loads(scores)["seeds"]) == ["seed-5", "seed-6"]
    assert run(["train-online", "--resume", "--out", str(out)]) == 0
    assert (out / "scores.json").read_text() == scores
    assert sorted(path.name for path in out.glob("seed-*")) == ["seed-5", "seed-6"]
    capsys.readouterr()
    assert run(["train-online", "--resume", "--out", str(out), "--seeds", "1"]) == 2
    assert "resume it without --seeds and --seed" in capsys.readouterr().err
    more = mcaprl.train_online(None, out, resume=True, seeds=3)
    assert [(one.seed, one.resumed_at) for one in more] == [(5, 200), (6, 200), (7, 0)]


def test_a_killed_run_continues(tmp_path: Path) -> None:
    """The steps after the last checkpoint are taken and logged again, with the same bits."""
    code = f"""
        import sys, time
        from mcaprl.online.task import Task
        from mcaprl.online.train import train

        def report(now):
            print(now.done, flush=True)
            if now.done >= 1_000:
                time.sleep(60)

        task = Task.for_sim("lane", **{SHORT!r})
        train(task, sys.argv[1], record=sys.argv[2], progress=report)
    """
    log = tmp_path / "log.mcap"
    command = [sys.executable, "-c", textwrap.dedent(code), str(tmp_path / "run"), str(log)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if int(line) >= 1_000:
                process.send_signal(signal.SIGKILL)
                break
    task = Task.for_sim("lane", **SHORT)
    logged = len(GrowingLogs([log]).dataset)
    assert 800 < logged <= 1_000
    (summary,) = train(task, tmp_path / "run", record=log, resume=True, progress=silent)
    assert (summary.resumed_at, summary.steps) == (800, 2_000)
    assert len(mcaprl.open(log)) == 2_000
    assert len(mcaprl.open(tmp_path / "log.mcap.uncut")) == logged
    assert (tmp_path / "log.mcap.damaged").exists()
    train(task, tmp_path / "whole", record=tmp_path / "whole.mcap", progress=silent)
    check_same_logs(log, tmp_path / "whole.mcap")
    assert sha(summary.folder / "checkpoint.safetensors") == sha(
        tmp_path / "whole" / "seed-0" / "checkpoint.safetensors"
    )


def test_a_run_killed_before_its_first_checkpoint_begins_its_log_again(tmp_path: Path) -> None:
    task, log = Task.for_sim("lane", **{**SHORT, "checkpoint_interval": 5_000}), tmp_path / "l.mcap"
    with pytest.raises(Stopped):
        train(task, tmp_path / "run", record=log, progress=stop_at(1_000))
    before = mcaprl.open(log).rewards
    train(task, tmp_path / "run", record=log, resume=True, progress=silent)
    np.testing.assert_array_equal(mcaprl.open(tmp_path / "l.mcap.uncut").rewards, before)
    assert len(mcaprl.open(log)) == 2_000


def test_a_log_of_sb3_is_appended_to(tmp_path: Path) -> None:
    """SB3 takes other steps after a resume, so the log keeps those after the checkpoint."""
    task, log = Task.for_sim("lane", "dqn", **SHORT), tmp_path / "log.mcap"
    with pytest.raises(Stopped):
        train(task, tmp_path / "run", record=log, progress=stop_at(1_000))
    before = mcaprl.open(log)
    train(task, tmp_path / "run", record=log, resume=True, progress=silent)
    after = mcaprl.open(log)
    assert len(after) == len(before) + 1_200
    np.testing.assert_array_equal(after.rewards[: len(before)], before.rewards)


def test_ppo_continues(tmp_path: Path) -> None:
    settings = {**SHORT, "rollout_steps": 512}
    for name in ("learning_starts", "target_update_interval"):
        settings.pop(name)
    task = Task.for_sim("lane", "ppo", **settings)
    with pytest.raises(Stopped):
        train(task, tmp_path / "run", progress=stop_at(1_000))
    (summary,) = train(task, tmp_path / "run", resume=True, progress=silent)
    assert summary.resumed_at > 500
    assert summary.steps >= 2_000


def test_another_task_is_refused(finished: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = Task.for_sim("lane", "dqn", **{**SHORTER, "gamma": 0.5})
    with pytest.raises(TrainingError, match=r"has gamma 0\.97, not 0\.5"):
        train(other, finished, resume=True, progress=silent)
    out = ["--out", str(finished), "--resume"]
    assert run(["train-online", "racer", *out]) == 1
    assert "has sim 'lane', not 'racer'" in capsys.readouterr().err


def test_a_run_of_the_other_kind_is_refused(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, offline = tmp_path / "corridor.mcap", tmp_path / "offline"
    corridor().save(log)
    mcaprl.train(log, offline, algo="bc", updates=1, hidden=(4,))
    assert run(["train-offline", str(log), "--resume", "--out", str(finished)]) == 1
    says = f"mcaprl: {finished} is an online run: resume it with mcaprl train-online\n"
    assert capsys.readouterr().err == says
    assert run(["train-online", "lane", "--resume", "--out", str(offline)]) == 1
    says = f"mcaprl: {offline} is an offline run: resume it with mcaprl train-offline\n"
    assert capsys.readouterr().err == says


def test_the_command_resumes_with_the_runs_settings(
    finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["train-online", "--out", str(finished), "--resume"]) == 0
    assert "dqn in lane" in capsys.readouterr().out


def test_a_broken_checkpoint_is_reported(finished: Path) -> None:
    path = finished / "seed-0" / "checkpoint.safetensors"
    path.write_bytes(path.read_bytes()[:-10])
    with pytest.raises(TrainingError, match=r"is broken .* delete it to restart this seed"):
        train(Task.for_sim("lane", "dqn", **SHORTER), finished, resume=True, progress=silent)


def test_a_folder_without_a_run_is_reported(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(json.dumps({"algo": "cql", "config": {}}))
    with pytest.raises(TrainingError, match="an online run"):
        Task.of_run(tmp_path)
    (tmp_path / "config.json").write_text("[]")
    with pytest.raises(TrainingError, match="is not a JSON object"):
        Task.of_run(tmp_path)


def test_a_resumed_models_file_is_complete(tmp_path: Path) -> None:
    task = Task.for_sim("lane", "dqn", **SHORT)
    with pytest.raises(Stopped):
        train(task, tmp_path / "run", progress=stop_at(1_000))
    (summary,) = train(task, tmp_path / "run", resume=True, progress=silent)
    assert DQN.load(summary.folder / "best_model.zip").num_timesteps == summary.best_step
