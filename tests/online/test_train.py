"""Tests of online training runs: files of the folder, reproducibility and learning."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3 import DQN
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from mcaprl.api.policies import load_policies
from mcaprl.cli import run
from mcaprl.errors import OutputExistsError, SpaceError, TrainingError, UnknownNameError, UsageError
from mcaprl.online.evaluation import SELECTION_SEED
from mcaprl.online.task import Task, check_spaces
from mcaprl.online.train import OnlineSummary, train
from mcaprl.progress import TrainingProgress
from mcaprl.runs import read_curve
from mcaprl.sims import make_sim
from mcaprl.sims.evaluation.evaluate import evaluate

SHORT: dict[str, Any] = {
    "steps": 600,
    "hidden": (8,),
    "eval_interval": 200,
    "eval_episodes": 3,
    "final_episodes": 4,
}
SHORT_DQN: dict[str, Any] = {**SHORT, "learning_starts": 64, "target_update_interval": 80}


def lane(**settings: Any) -> Task:
    """Return a short task in the lane sim."""
    return Task.for_sim("lane", **{**SHORT_DQN, **settings})


def silent(_: TrainingProgress) -> None:
    """A progress callback that does nothing."""


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> OnlineSummary:
    """Train with seed 2 and return the summary; tests do not change the folder."""
    out = tmp_path_factory.mktemp("lane") / "run"
    (summary,) = train(lane(), out, seed=2, progress=silent)
    return summary


def test_a_run_writes_these_files(trained: OnlineSummary) -> None:
    out = trained.folder.parent
    assert {path.name for path in out.iterdir()} == {
        "config.json",
        "scores.json",
        "curve.png",
        "seed-2",
    }
    names = {path.name.split(".tfevents")[0] for path in (out / "seed-2").iterdir()}
    assert names == {
        "policy.json",
        "policy.safetensors",
        "checkpoint.safetensors",
        "curve.csv",
        "progress.csv",
        "events.out",
    }
    assert (trained.folder.name, trained.seed, trained.steps) == ("seed-2", 2, 600)
    config = json.loads((out / "config.json").read_text())
    assert (config["algo"], config["sim"], config["config"]["steps"]) == ("double-dqn", "lane", 600)


def test_progress_has_the_results_of_the_last_evaluation(tmp_path: Path) -> None:
    reported: list[TrainingProgress] = []
    task = Task.for_sim("CartPole-v1", **{**SHORT_DQN, "steps": 1_200, "eval_interval": 1_100})
    train(task, tmp_path / "run", progress=reported.append)
    curve = read_curve(tmp_path / "run" / "seed-0" / "curve.csv")
    assert np.isnan(reported[0].terms["mean_return"])
    assert reported[-1].terms["mean_return"] in curve["mean_return"]
    assert np.isnan(reported[-1].terms["score"]), "CartPole has no pilot"
    assert [now.activity for now in reported if now.activity] == [
        "preparing",
        "evaluating on 3 episodes",
        "evaluating the best checkpoint on 4 new episodes",
    ]
    evaluation = [now.activity for now in reported].index("evaluating on 3 episodes")
    assert reported[evaluation + 1].terms["mean_return"] == curve["mean_return"][0]


def test_the_curve_has_a_row_for_each_evaluation(trained: OnlineSummary) -> None:
    curve = read_curve(trained.folder / "curve.csv")
    assert curve["step"].tolist() == [200, 400, 600]
    assert (curve["lowest_return"] <= curve["mean_return"]).all()
    assert (curve["mean_return"] <= curve["highest_return"]).all()
    best = np.maximum.accumulate(curve["mean_return"])
    assert curve["best"].tolist() == [1, *(np.diff(best) > 0)]
    assert ((curve["score"] > -1) & (curve["score"] < 1.5)).all()


def test_scalars_have_sb3s_names(trained: OnlineSummary) -> None:
    board = EventAccumulator(str(trained.folder))
    board.Reload()
    assert set(board.Tags()["scalars"]) >= {
        "eval/mean_reward",
        "eval/mean_ep_length",
        "eval/score",
        "rollout/ep_rew_mean",
        "rollout/ep_len_mean",
        "rollout/exploration_rate",
        "train/loss",
        "train/learning_rate",
        "time/fps",
    }
    assert [event.step for event in board.Scalars("eval/score")] == [200, 400, 600]


@pytest.mark.parametrize("envs", [1, 4])
def test_the_same_seed_gives_the_same_curve(tmp_path: Path, envs: int) -> None:
    curves = []
    for name in ("a", "b"):
        train(lane(envs=envs), tmp_path / name, seed=1, progress=silent)
        curves.append((tmp_path / name / "seed-1" / "curve.csv").read_text())
    assert curves[0] == curves[1]


def test_each_seed_is_independent_of_the_others(trained: OnlineSummary, tmp_path: Path) -> None:
    train(lane(), tmp_path, seed=1, seeds=2, progress=silent)
    curves = [(tmp_path / f"seed-{seed}" / "curve.csv").read_text() for seed in (1, 2)]
    assert curves[1] == (trained.folder / "curve.csv").read_text() != curves[0]
    scores = json.loads((tmp_path / "scores.json").read_text())
    assert set(scores["seeds"]) == {"seed-1", "seed-2"}


def test_the_last_score_equals_evaluates(
    trained: OnlineSummary, capsys: pytest.CaptureFixture[str]
) -> None:
    out = str(trained.folder.parent)
    assert run(["evaluate", out, "--sim", "lane", "--episodes", "4", "--json"]) == 0
    (mine, *_) = json.loads(capsys.readouterr().out)["policies"]
    assert mine["mean_return"] == trained.mean_return
    assert mine["normalized_score"] == pytest.approx(trained.score, abs=1e-12)


def test_the_saved_policy_is_the_best(trained: OnlineSummary) -> None:
    (policy,) = load_policies(trained.folder.parent)
    assert (policy.algo, policy.env_id) == ("double-dqn", "mcaprl/LaneKeeping-v0")
    best = read_curve(trained.folder / "curve.csv")
    (row,) = np.flatnonzero(best["step"] == trained.best_step)
    score = evaluate(make_sim("lane"), [policy], name="", episodes=3, seed=SELECTION_SEED)
    assert score.mean_return == pytest.approx(best["mean_return"][row])


def test_the_saved_model_of_sb3_is_the_best_and_loads_there(tmp_path: Path) -> None:
    task = Task.for_sim("lane", "dqn", **SHORT_DQN)
    (summary,) = train(task, tmp_path / "run", progress=silent)
    model = DQN.load(summary.folder / "best_model.zip")
    assert model.num_timesteps == summary.best_step
    (policy,) = load_policies(summary.folder.parent)
    observations = np.random.default_rng(0).uniform(-1, 1, (30, 12)).astype(np.float32)
    np.testing.assert_array_equal(
        policy.act(observations), model.predict(observations, deterministic=True)[0]
    )


@pytest.mark.parametrize(
    ("algo", "settings"), [("dqn", {}), ("ppo", {"rollout_steps": 192}), ("a2c", {})]
)
def test_other_algorithms_and_environments(
    tmp_path: Path, algo: str, settings: dict[str, Any]
) -> None:
    task = Task.for_sim("CartPole-v1", algo, **SHORT, **settings)
    (summary,) = train(task, tmp_path / "run", progress=silent)
    assert np.isnan(summary.score)
    assert 8 <= summary.mean_return <= 500
    scores = json.loads((tmp_path / "run" / "scores.json").read_text())
    assert scores["seeds"]["seed-0"]["score"] is None


def test_image_observations_are_learned_from(tmp_path: Path) -> None:
    sizes: dict[str, Any] = {
        "steps": 80,
        "eval_interval": 40,
        "eval_episodes": 1,
        "final_episodes": 1,
    }
    options: dict[str, Any] = {"observation": "depth"}
    task = Task.for_sim("lane", "dqn", options, **{**SHORT_DQN, **sizes, "batch_size": 4})
    (summary,) = train(task, tmp_path / "run", progress=silent)
    (policy,) = load_policies(summary.folder)
    assert policy.observation_space == make_sim("lane", **options).observation_space


def test_an_agent_learns_to_stay_upright(tmp_path: Path) -> None:
    task = Task.for_sim(
        "CartPole-v1",
        "ppo",
        steps=8_000,
        rollout_steps=256,
        batch_size=256,
        epochs=10,
        learning_rate=1e-3,
        gamma=0.98,
        gae_lambda=0.8,
        eval_interval=4_000,
        eval_episodes=5,
        final_episodes=5,
    )
    (summary,) = train(task, tmp_path / "run", progress=silent)
    assert summary.mean_return > 100


def test_an_existing_folder_is_not_touched(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "note").write_text("mine")
    with pytest.raises(OutputExistsError, match="choose another folder"):
        train(lane(), tmp_path / "run", progress=silent)
    assert [path.name for path in (tmp_path / "run").iterdir()] == ["note"]


def test_mistakes_leave_no_folder(tmp_path: Path) -> None:
    out = tmp_path / "run"
    with pytest.raises(UnknownNameError, match="unknown sim"):
        train(Task.for_sim("lame"), out)
    with pytest.raises(UnknownNameError, match="unknown algorithm"):
        Task.for_sim("lane", "double-dqm")
    with pytest.raises(SpaceError, match="dqn needs discrete actions"):
        train(Task.for_sim("Pendulum-v1", "dqn", **SHORT), out)
    with pytest.raises(SpaceError, match=r"got MultiBinary\(2\): wrap the environment so that"):
        check_spaces("ppo", spaces.Box(-1, 1, (2,)), spaces.MultiBinary(2))
    with pytest.raises(UsageError, match="seeds must be at least 1"):
        train(lane(), out, seeds=0)
    with pytest.raises(UsageError, match=r"Stable-Baselines3 needs seeds below 2\*\*32"):
        train(lane(), out, seed=2**32 - 1, seeds=2)
    with pytest.raises(UsageError, match=r"x.txt.*\.mcap"):
        train(lane(), out, record=tmp_path / "x.txt")
    for algo in ("dqn", "ppo"):
        with pytest.raises(SpaceError, match=f"{algo} needs actions that start at 0, got"):
            check_spaces(algo, spaces.Box(-1, 1), spaces.Discrete(3, start=1))
    assert not out.exists()
    out.touch()
    with pytest.raises(TrainingError, match="cannot write"):
        train(lane(), out / "below", progress=silent)


def test_the_command_trains_and_prints_a_row_for_each_seed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sizes = {"steps": 200, "eval-interval": 100, "eval-episodes": 2, "final-episodes": 2}
    options = [text for name, size in sizes.items() for text in (f"--{name}", f"{size}")]
    out = tmp_path / "run"
    command = ["train-online", "lane", "--algo", "dqn", "--out", str(out), "--seeds", "2"]
    assert run([*command, *options]) == 0
    assert "dqn in lane" in capsys.readouterr().out
    with (out / "seed-1" / "curve.csv").open() as file:
        assert [row["step"] for row in csv.DictReader(file)] == ["104", "200"]


def test_the_command_accepts_only_an_algorithms_settings(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = str(tmp_path / "run")
    assert run(["train-online", "lane", "--algo", "dqn", "--out", out, "--epochs", "3"]) == 2
    assert "dqn has no setting --epochs; it has --learning-rate" in capsys.readouterr().err
