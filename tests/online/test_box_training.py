"""Tests of online training with the actions of a Box: logs, resuming, refusals, files and logs."""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces

import mcaprl
from mcaprl.errors import MissingExtraError, SpaceError, TrainingError, UnknownNameError, UsageError
from mcaprl.offline.algorithms.heads import Deterministic, SquashedGaussian
from mcaprl.offline.batches.observations import ObservationEncoder
from mcaprl.offline.training.train import train as train_offline
from mcaprl.online.collector import NoisyActions, SquashedSamples
from mcaprl.online.config import SACConfig, TD3Config
from mcaprl.online.engine import Agents
from mcaprl.online.learning import LearningAgent, fill_buffer
from mcaprl.online.replay import MixedBuffer, packed_log
from mcaprl.online.task import Task, check_spaces, choose_engine, choose_task
from mcaprl.online.train import train
from mcaprl.progress import TrainingProgress
from mcaprl.sims.evaluation.evaluate import Scale

SHORT: dict[str, Any] = {
    "steps": 48,
    "envs": 4,
    "hidden": (8, 8),
    "learning_starts": 16,
    "batch_size": 8,
    "eval_interval": 24,
    "eval_episodes": 1,
    "final_episodes": 1,
    "checkpoint_interval": 24,
}
ROLLOUTS = {name: SHORT[name] for name in SHORT if name not in ("learning_starts", "batch_size")}
PENDULUM = "Pendulum-v1"
OBSERVED, TORQUE = spaces.Box(-8, 8, (3,)), spaces.Box(-2.0, 6.0, (2,), np.float32)


def silent(_: TrainingProgress) -> None:
    """A progress callback that does nothing."""


def agents_of(config: SACConfig | TD3Config) -> Agents:
    """Return an agent for actions from -2 to 6."""
    return Agents(config, ObservationEncoder(OBSERVED, 0), TORQUE, [0], torch.device("cpu"))


@pytest.mark.parametrize("config", [SACConfig(hidden=(8, 8)), TD3Config(hidden=(8, 8))])
def test_densities_of_the_behavior_integrate_to_one(config: SACConfig | TD3Config) -> None:
    behavior = agents_of(config).behavior
    assert isinstance(behavior, SquashedSamples | NoisyActions)
    points = (np.arange(400) + 0.5) / 50 - 2
    grid = np.stack(np.meshgrid(points, points), -1).reshape(-1, 2).astype(np.float32)
    outputs = torch.tensor([[[0.5, -0.2], [1.0, 0.5]]])
    outputs = outputs if isinstance(config, SACConfig) else outputs[:, 0] * 2
    numbers = torch.from_numpy(behavior._box.scaled(grid))
    logs = behavior._log_density(outputs.expand(len(grid), *outputs.shape[1:]), numbers)
    total = (logs.double() + behavior._box.log_scale).exp().sum() / 50**2
    assert total.item() == pytest.approx(1, abs=0.01)
    observations = ObservationEncoder(OBSERVED, 0).encode(np.zeros((5, 3), np.float32))
    chosen = behavior.choose(observations, 1.0)
    assert chosen.behavior().exp().tolist() == pytest.approx([1 / 64] * 5)
    taken = behavior.choose(observations, 0.0).actions.numpy()
    assert all(action in TORQUE for action in taken)


@pytest.mark.parametrize(("algo", "head"), [("sac", SquashedGaussian), ("td3", Deterministic)])
def test_a_resumed_run_ends_with_the_same_bits(tmp_path: Path, algo: str, head: type) -> None:
    task = Task.for_sim(PENDULUM, algo, **SHORT)
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    train(task, whole, record=tmp_path / "whole.mcap", progress=silent)

    kills = iter([True])
    before = LearningAgent._begin

    def killed(self: LearningAgent) -> None:
        if self.agents.steps == 48 and next(kills, False):
            raise KeyboardInterrupt
        before(self)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(LearningAgent, "_begin", killed)
        with pytest.raises(KeyboardInterrupt):
            train(task, cut, record=tmp_path / "cut.mcap", progress=silent)
        train(task, cut, record=tmp_path / "cut.mcap", resume=True, progress=silent)
    for name in ("policy.safetensors", "checkpoint.safetensors"):
        contents = [(run / "seed-0" / name).read_bytes() for run in (whole, cut)]
        assert contents[0] == contents[1], name
    first, second = (mcaprl.open(tmp_path / f"{name}.mcap") for name in ("whole", "cut"))
    np.testing.assert_array_equal(first.actions, second.actions)
    np.testing.assert_array_equal(first.behavior_log_probs, second.behavior_log_probs)
    assert np.isfinite(first.behavior_log_probs).all()
    np.testing.assert_allclose(first.behavior_log_probs[:4], -np.log(4), rtol=1e-6)
    policy = mcaprl.load_policy(whole)
    assert isinstance(policy.head, head)
    assert all(action in policy.action_space for action in policy.act(first.observations))


@pytest.mark.parametrize("algo", ["sac", "td3", "tqc", "ppo"])
def test_models_of_sb3_are_recorded_and_loaded(tmp_path: Path, algo: str) -> None:
    if algo == "tqc":
        pytest.importorskip("sb3_contrib")
    settings = {**ROLLOUTS, "rollout_steps": 24, "batch_size": 12} if algo == "ppo" else SHORT
    task = choose_task(PENDULUM, algo, {}, settings, engine="sb3")
    train(task, tmp_path / "run", record=tmp_path / "log.mcap", progress=silent)
    data = mcaprl.open(tmp_path / "log.mcap")
    inside = np.abs(data.actions[:, 0]) < 2
    assert np.isfinite(data.behavior_log_probs[inside]).all()
    policy = mcaprl.load_policy(tmp_path / "run")
    if algo == "ppo":
        for found in (data.behavior_log_probs, policy.log_prob(data.observations, data.actions)):
            assert np.isnan(found[~inside]).all()
    from mcaprl.online.sb3 import model_type_of

    model: Any = model_type_of(algo).load(
        tmp_path / "run" / "seed-0" / "best_model.zip", device="cpu"
    )
    expected = model.predict(data.observations, deterministic=True)[0]
    np.testing.assert_allclose(policy.act(data.observations), expected, atol=1e-5)
    # A file of plain SB3 has no description of this package.
    model.save(tmp_path / "plain.zip")
    plain = mcaprl.load_policy(tmp_path / "plain.zip")
    assert plain.action_space == gym.make(PENDULUM).action_space
    np.testing.assert_allclose(plain.act(data.observations), expected, atol=1e-5)


def logged() -> mcaprl.Dataset:
    """Return 40 transitions of the Pendulum with numbered rewards."""
    random = np.random.default_rng(0)
    frames = random.uniform(-1, 1, (41, 3)).astype(np.float32)
    env = gym.make(PENDULUM)
    return mcaprl.Dataset.from_arrays(
        observations=frames[:-1],
        next_observations=frames[1:],
        actions=random.uniform(-2, 2, (40, 1)).astype(np.float32),
        rewards=100.0 + np.arange(40),
        terminated=np.zeros(40, bool),
        truncated=np.arange(40) == 39,
        observation_space=env.observation_space,
        action_space=env.action_space,
    )


def test_half_of_each_batch_is_from_the_log(tmp_path: Path) -> None:
    task = choose_task(PENDULUM, None, {}, SHORT, with_logs=True)
    assert task.algo == "sac"
    assert task.config.to_json()["critic_layer_norm"]
    agent = LearningAgent(task, PENDULUM, tmp_path, 0, Scale(0, 1))
    try:
        agent.start_from(logged(), None)
        agent._begin()
        agent.agents.step()
        buffer = agent.agents.buffer
        assert isinstance(buffer, MixedBuffer)
        batch = buffer.batch(buffer.draw(8, ()))
        # The rewards of the Pendulum are negative.
        assert (batch.rewards > 99).tolist() == [False] * 4 + [True] * 4
        rows = (batch.rewards[4:] - 100).long()
        box = buffer.box
        assert box is not None
        np.testing.assert_array_equal(batch.actions[4:], box.scaled(logged().actions)[rows])
        np.testing.assert_array_equal(
            batch.observations.vector[4:], logged().observations[rows.numpy()]
        )
        assert agent.agents.learning_starts == 0
        assert len(packed_log(logged(), buffer)) == 40
    finally:
        agent.close()


def test_a_log_fills_the_replay_buffer_if_no_part_is_drawn_from_it(tmp_path: Path) -> None:
    task = choose_task(PENDULUM, "td3", {}, {**SHORT, "data_fraction": 0.0}, with_logs=True)
    agent = LearningAgent(task, PENDULUM, tmp_path, 0, Scale(0, 1))
    try:
        agent.start_from(logged(), None)
        buffer = agent.agents.buffer
        assert not isinstance(buffer, MixedBuffer)
        assert buffer.stored * buffer.width == 40
        batch = buffer.batch(buffer.draw(20, ()))
        rows = (batch.rewards - 100).long().numpy()
        assert buffer.box is not None
        expected = buffer.box.scaled(logged().actions)[rows]
        np.testing.assert_array_equal(batch.actions, expected)
        np.testing.assert_array_equal(batch.observations.vector, logged().observations[rows])
    finally:
        agent.close()


def test_a_run_with_a_log_resumes_without_it(tmp_path: Path) -> None:
    task = choose_task(PENDULUM, "td3", {}, SHORT, with_logs=True)
    train(task, tmp_path / "run", data=logged(), progress=silent)
    agent = LearningAgent(task, PENDULUM, tmp_path / "run" / "seed-0", 0, Scale(0, 1), resume=True)
    try:
        buffer = agent.agents.buffer
        assert isinstance(buffer, MixedBuffer)
        np.testing.assert_array_equal(buffer.log.returns[0], logged().rewards)
    finally:
        agent.close()


def test_seeds_without_a_checkpoint_resume_from_the_same_sources(tmp_path: Path) -> None:
    log, out, whole = tmp_path / "log.mcap", tmp_path / "run", tmp_path / "whole"
    logged().save(log)
    given: dict[str, Any] = {"seeds": 2, "sources": log, **SHORT}
    mcaprl.train_online(PENDULUM, whole, algo="sac", **given)

    def stop(now: TrainingProgress) -> None:
        if now.seed == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        mcaprl.train_online(PENDULUM, out, algo="sac", progress=stop, **given)
    (out / "seed-1" / "checkpoint.safetensors").unlink(missing_ok=True)
    mcaprl.train_online(None, out, resume=True)
    for seed in range(2):
        name = f"seed-{seed}/checkpoint.safetensors"
        assert (out / name).read_bytes() == (whole / name).read_bytes()
    # All seeds have checkpoints, which contain the log.
    log.unlink()
    mcaprl.train_online(None, out, resume=True)
    assert json.loads((out / "config.json").read_text())["sources"] == [str(log)]


@pytest.mark.parametrize(("offline", "algo"), [("iql", "sac"), ("td3-bc", "sac"), ("iql", "td3")])
def test_an_agent_continues_an_offline_policy(tmp_path: Path, offline: str, algo: str) -> None:
    settings = {"updates": 10, "hidden": (8, 8), "gamma": 0.5, "polyak": 1.0, "held_out": 0.0}
    from mcaprl.offline.algorithms.registry import configured

    chosen = configured(offline, settings, space=logged().action_space)
    train_offline(logged(), chosen, tmp_path / "offline", progress=lambda now: None)
    policy = mcaprl.load_policy(tmp_path / "offline")
    task = choose_task(PENDULUM, algo, {}, SHORT, with_policy=True)
    agent = LearningAgent(task, PENDULUM, tmp_path, 0, Scale(0, 1))
    try:
        agent.start_from(None, policy)
        observations = logged().observations
        np.testing.assert_allclose(
            agent.policy.act(observations), policy.act(observations), atol=1e-4
        )
        actions = logged().actions
        np.testing.assert_allclose(
            agent.policy.action_values(observations, actions),
            policy.action_values(observations, actions),
            rtol=1e-4,
            atol=1e-3,
        )
        weights = agent.agents.learner.all_models()
        torch.testing.assert_close(weights["q"].weights, weights["q_target"].weights)
        first, second = (agent.agents.learner.network("q", 0, member) for member in (0, 1))
        assert not torch.equal(*(cast(Any, one).head.weight for one in (first, second)))
        assert agent.agents.epsilon == 0
    finally:
        agent.close()


@pytest.mark.parametrize("algo", ["sac", "td3"])
def test_the_actor_of_a_continued_policy_learns_later_and_more_slowly(
    tmp_path: Path, algo: str
) -> None:
    changes = {}
    for rate in (0.01, 1.0):
        settings = {**SHORT, "actor_starts": 3, "actor_rate": rate}
        agent = LearningAgent(
            Task.for_sim(PENDULUM, algo, **settings), PENDULUM, tmp_path, 0, Scale(0, 1)
        )
        try:
            agents = agent.agents
            fill_buffer(agents, logged())
            agents.continue_policy()
            models = agents.learner.models
            start = {name: model.weights.detach().clone() for name, model in models.items()}
            for _ in range(3):
                agents.learner.update()
            assert torch.equal(models["actor"].weights, start["actor"])
            assert not torch.equal(models["q"].weights, start["q"])
            for _ in range(2):
                agents.learner.update()
            changes[rate] = (models["actor"].weights - start["actor"]).abs().max().item()
        finally:
            agent.close()
    # The first steps of Adam are as long as the learning rate.
    assert 0 < changes[0.01] < 0.03 * changes[1.0]


@pytest.mark.parametrize("algo", ["sac", "td3"])
def test_an_anchor_keeps_the_actions_of_a_continued_policy(tmp_path: Path, algo: str) -> None:
    changes, observations = {}, logged().observations
    for anchor in (0.0, 1e4):
        settings = {**SHORT, "actor_starts": 0, "actor_rate": 1.0, "anchor": anchor}
        task = Task.for_sim(PENDULUM, algo, **settings)
        agent = LearningAgent(task, PENDULUM, tmp_path / f"{anchor}", 0, Scale(0, 1))
        other = LearningAgent(task, PENDULUM, tmp_path / f"{anchor} again", 0, Scale(0, 1))
        try:
            for each in (agent, other):
                fill_buffer(each.agents, logged())
            agent.agents.continue_policy()
            learner, first = agent.agents.learner, agent.policy.act(observations)
            for _ in range(40):
                learner.update()
            changes[anchor] = np.abs(agent.policy.act(observations) - first).mean()
            # A resumed agent has the same anchor.
            other.agents.load_state(agent.agents.state(), agent.agents.counters())
            for one in (learner, other.agents.learner):
                one.update()
            for name, model in learner.all_models().items():
                assert torch.equal(model.weights, other.agents.learner.all_models()[name].weights)
            assert ("actor_first" in learner.all_models()) == (anchor > 0)
        finally:
            agent.close()
            other.close()
    assert changes[1e4] < 0.2 * changes[0.0]


def test_a_missing_package_is_named_before_the_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "sb3_contrib", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'mcaprl\[contrib\]'"):
        mcaprl.train_online("lane", tmp_path / "run", algo="tqc", actions="continuous")
    assert not (tmp_path / "run").exists()


def test_a_reference_has_settings_that_it_supports() -> None:
    options = {"observation": "dashboard", "actions": "continuous"}
    own = choose_task("lane", "td3", options, {}).config.to_json()
    reference = choose_task("lane", "td3", options, {}, engine="sb3").config.to_json()
    changed = {name: reference[name] for name in own if own[name] != reference[name]}
    assert changed == {"image_shift": 0, "encoder": "nature", "center_images": False}
    assert own["gamma"] == reference["gamma"] == 0.97
    options = {"observation": "depth", "actions": "increments"}
    assert (
        choose_task("powerline", "sac", options, {}, engine="sb3").config.to_json()["n_steps"] == 1
    )


def test_wrong_combinations_name_those_that_fit(tmp_path: Path) -> None:
    vector, box, buttons = spaces.Box(-1, 1, (3,)), spaces.Box(-1, 1, (2,)), spaces.Discrete(5)
    with pytest.raises(SpaceError, match=r"double-dqn needs discrete actions; for Box\(2,\) use s"):
        check_spaces("double-dqn", vector, box)
    with pytest.raises(
        SpaceError, match=r"sac needs the actions of a Box; for Discrete\(5\) use d"
    ):
        check_spaces("sac", vector, buttons)
    with pytest.raises(SpaceError, match="infinite bounds"):
        check_spaces("td3", vector, spaces.Box(-np.inf, np.inf, (2,)))
    check_spaces("ppo", vector, box)
    with pytest.raises(UsageError, match=r"`engine='sb3'` has no double-dqn, but dqn, sac, td3"):
        choose_engine("double-dqn", "sb3")
    with pytest.raises(UnknownNameError, match="unknown engine"):
        choose_engine("sac", "sb2")
    assert [choose_engine(algo, None) for algo in ("sac", "ppo")] == ["mcaprl", "sb3"]
    lacking: dict[str, Any] = {"critic_layer_norm": True, "smoothness": 0.1}
    for name, value in lacking.items():
        task = choose_task(PENDULUM, "td3", {}, {name: value}, engine="sb3")
        with pytest.raises(UsageError, match=f"td3 of Stable-Baselines3 has no {name}"):
            train(task, tmp_path / name, progress=silent)


def test_the_reference_has_the_settings_of_a_sim_without_those_that_it_lacks() -> None:
    options = {"actions": "continuous"}
    own = choose_task("lane", "sac", options, {}).config
    reference = choose_task("lane", "sac", options, {}, engine="sb3").config
    assert isinstance(own, SACConfig)
    assert own.smoothness > 0
    assert reference == dataclasses.replace(own, smoothness=0.0)


def test_runs_of_versions_without_a_setting_are_resumed(tmp_path: Path) -> None:
    task = Task.for_sim(PENDULUM, "sac", **SHORT)
    train(task, tmp_path, progress=silent)
    path = tmp_path / "config.json"
    written = json.loads(path.read_text())
    assert written["config"].pop("smoothness") == 0
    path.write_text(json.dumps(written))
    other = Task.for_sim(PENDULUM, "sac", **SHORT, smoothness=1.0)
    with pytest.raises(TrainingError, match=r"has smoothness None, not 1\.0"):
        train(other, tmp_path, resume=True, progress=silent)
    (summary,) = train(task, tmp_path, resume=True, progress=silent)
    assert summary.resumed_at == SHORT["steps"]
