"""Tests of training with sims, replay buffer and networks on one device."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import mcaprl
from mcaprl.cli import run
from mcaprl.device.training import SETTINGS, device_task, make_agents
from mcaprl.errors import OutputExistsError, TrainingError, UnknownNameError, UsageError
from mcaprl.online.config import DoubleDQNConfig
from mcaprl.online.engine import Agents
from mcaprl.runs import read_curves
from mcaprl.sims import make_device_sims

SMALL: dict[str, Any] = {
    "envs": 16,
    "steps": 4_000,
    "steps_per_update": 32,
    "batch_size": 16,
    "buffer_size": 2_000,
    "learning_starts": 400,
    "target_update_interval": 640,
    "final_episodes": 2,
    "hidden": (16, 16),
}


LEARNING: dict[str, Any] = {
    "envs": 64,
    "steps": 60_000,
    "batch_size": 64,
    "buffer_size": 60_000,
    "target_update_interval": 4_800,
    "learning_rate": 1e-3,
    "hidden": (64, 64),
}


def agents_of(seeds: int, device: str = "cpu", **settings: Any) -> Agents:
    """Return untrained agents in the lane sim."""
    config = device_task("lane", **{**SMALL, **settings}).config
    assert isinstance(config, DoubleDQNConfig)
    sims = make_device_sims("lane", seeds * config.envs, device=device, seed=3)
    return make_agents(sims, config, range(3, 3 + seeds), torch.device(device))


def test_a_run_has_the_policies_metrics_and_scores_of_all_seeds(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    found = mcaprl.train_online("lane", folder, device="cpu", seeds=2, seed=5, **SMALL)
    assert [summary.seed for summary in found] == [5, 6]
    assert all(summary.steps == 4_000 and summary.algo == "double-dqn" for summary in found)
    scores = json.loads((folder / "scores.json").read_text())
    assert scores["seeds"]["seed-6"]["mean_return"] == found[1].mean_return
    config = json.loads((folder / "config.json").read_text())
    assert (config["device"], config["seeds"], config["seed"]) == ("cpu", 2, 5)
    curves = read_curves(folder, "metrics.csv")
    assert [curve["steps"][-1] for curve in curves] == [4_000, 4_000]
    # The random steps end after 400 steps. An update follows each multiple of 32 steps, the first
    # after 416 and the last after 4,000.
    assert [curve["update"][-1] for curve in curves] == [113, 113]
    policy = mcaprl.load_policy(folder)
    assert policy.env_id == "mcaprl/LaneKeeping-v0"
    assert policy.act(np.zeros((3, 12), np.float32)).shape == (3,)
    with pytest.raises(OutputExistsError):
        mcaprl.train_online("lane", folder, device="cpu", **SMALL)
    with pytest.raises(TrainingError, match="was trained with `device=`"):
        mcaprl.train_online("lane", folder, resume=True)


def test_the_same_seed_trains_the_same_weights() -> None:
    first, again = agents_of(2), agents_of(2)
    for _ in range(100):
        rewards = [agents.step().rewards for agents in (first, again)]
        torch.testing.assert_close(*rewards, rtol=0, atol=0)
    weights = [agents.learner.models["q"].weights.detach() for agents in (first, again)]
    torch.testing.assert_close(*weights, rtol=0, atol=0)
    assert not torch.equal(weights[0][0], weights[0][1])


def test_updates_follow_the_random_steps_at_the_chosen_rate() -> None:
    agents = agents_of(1)
    updates = []
    for _ in range(250):
        agents.step()
        updates.append(agents.learner.step)
    # Step 26 is the first after 400 steps; every second step has an update then.
    assert updates[24] == 0
    assert updates[25:29] == [1, 1, 2, 2]
    assert updates[-1] == 113


def test_the_command_names_the_last_policy(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    words = [f"--{name.replace('_', '-')}={value}" for name, value in SMALL.items()]
    words = [word.replace("(16, 16)", "16,16") for word in words]
    assert (
        run(["train-online", "lane", "--device", "cpu", "--out", str(tmp_path / "a"), *words]) == 0
    )
    shown = capfd.readouterr()
    assert "the last policy of each seed" in shown.out
    assert "curve.png" not in shown.out + shown.err


def test_epsilon_falls_linearly() -> None:
    agents = agents_of(1, exploration_fraction=0.5, exploration_final_eps=0.1)
    seen = []
    for step in range(250):
        if step in (0, 62, 125, 200):
            seen.append(agents.epsilon)
        agents.step()
    np.testing.assert_allclose(seen, [1.0, 1 - 0.9 * 62 / 125, 0.1, 0.1])


def test_agents_learn_to_keep_the_lane() -> None:
    agents = agents_of(1, **LEARNING)
    rewards = [float(agents.step().rewards.mean()) for _ in range(60_000 // 64)]
    # Random cars leave the lane every few steps, which costs 5; a car that keeps it earns up to 1.
    assert np.mean(rewards[:60]) < -0.1
    assert np.mean(rewards[-300:]) > 0.1


@pytest.mark.parametrize(
    ("request_", "message"),
    [
        ({"algo": "ppo"}, "`device=` trains double-dqn only: omit `algo='ppo'`"),
        ({"record": "log.mcap"}, "`record=` cannot be combined with `device=`"),
        ({"resume": True}, "`resume=` cannot be combined with `device=`"),
        ({"live": True}, "`live=` cannot be combined with `device=`"),
        ({"sources": "log.mcap"}, "`sources=` cannot be combined with `device=`"),
        ({"eval_interval": 100}, "`eval_interval=` has no effect with `device=`"),
        ({"observation": "depth"}, "has no argument observation"),
        ({"envs": 0}, "envs"),
    ],
)
def test_what_a_device_does_not_support_is_refused(
    tmp_path: Path, request_: dict[str, Any], message: str
) -> None:
    with pytest.raises(UsageError, match=message):
        mcaprl.train_online("lane", tmp_path / "run", device="cpu", **request_)
    assert not (tmp_path / "run").exists()


def test_other_sims_and_devices_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="cannot stay on a device"):
        mcaprl.train_online("powerline", tmp_path / "run", device="cpu")
    with pytest.raises(UnknownNameError, match="device"):
        mcaprl.train_online("lane", tmp_path / "run", device="tpu")
    with pytest.raises(UsageError, match="needs a sim"):
        mcaprl.train_online(None, tmp_path / "run", device="cpu")
    assert not (tmp_path / "run").exists()


def test_the_default_settings_are_valid() -> None:
    for sim in ("lane", "racer"):
        assert device_task(sim).config.envs == SETTINGS["envs"]


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="torch finds no CUDA device")
def test_agents_learn_on_a_gpu() -> None:
    agents = agents_of(4, "cuda", **LEARNING)
    steps = [agents.step().rewards.view(4, -1).mean(1) for _ in range(60_000 // 64)]
    rewards = torch.stack(steps)
    assert (rewards[:60].mean(0) < -0.1).all()
    assert (rewards[-300:].mean(0) > 0.1).all()
