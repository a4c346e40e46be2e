"""Tests of SAC and TD3 from images: the shared encoder, its gradients, files and warm starts."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
from gymnasium import spaces

import mcaprl
from mcaprl.errors import PolicyError
from mcaprl.offline.algorithms.actor_critic import ActorCritic
from mcaprl.offline.algorithms.heads import ENCODER, FEATURES
from mcaprl.offline.algorithms.registry import configured
from mcaprl.offline.batches.buffer import Batch
from mcaprl.offline.batches.observations import ObservationEncoder
from mcaprl.offline.training.train import train as train_offline
from mcaprl.online.config import ActorCriticConfig, SACConfig, TD3Config
from mcaprl.online.engine import Agents
from mcaprl.online.learning import LearningAgent
from mcaprl.online.replay import MixedBuffer, Outcome
from mcaprl.online.task import choose_task
from mcaprl.online.train import train
from mcaprl.progress import TrainingProgress
from mcaprl.sims.evaluation.evaluate import Scale

SEEN = spaces.Dict(
    {"camera": spaces.Box(0, 255, (16, 16, 1), np.uint8), "speed": spaces.Box(-8, 8, (2,))}
)
STICK = spaces.Box(-1, 1, (2,), np.float32)
SHIFT: dict[str, Any] = {"hidden": (8, 8), "batch_size": 4, "image_shift": 2}
SHORT: dict[str, Any] = {
    **SHIFT,
    "steps": 24,
    "envs": 2,
    "learning_starts": 8,
    "steps_per_update": 2,
    "eval_interval": 12,
    "eval_episodes": 1,
    "final_episodes": 1,
    "checkpoint_interval": 12,
}
DRONE: dict[str, Any] = {"observation": "depth", "actions": "increments"}


def silent(_: TrainingProgress) -> None:
    """A progress callback that does nothing."""


def seen(random: np.random.Generator, count: int = 2) -> dict[str, Any]:
    """Return random observations."""
    return {
        "camera": random.integers(0, 256, (count, 16, 16, 1), dtype=np.uint8),
        "speed": random.uniform(-1, 1, (count, 2)).astype(np.float32),
    }


def filled(config: ActorCriticConfig) -> Agents:
    """Return an agent with twenty random transitions."""
    random, encoder = np.random.default_rng(0), ObservationEncoder(SEEN, 0)
    agents = Agents(config, encoder, STICK, [3], torch.device("cpu"))
    agents.buffer.begin(encoder.encode(seen(random)))
    for _ in range(10):
        after = encoder.encode(seen(random))
        over = torch.zeros(2, dtype=torch.bool)
        rewards = torch.from_numpy(random.uniform(-1, 1, 2).astype(np.float32))
        actions = torch.from_numpy(random.uniform(-1, 1, (2, 2)).astype(np.float32))
        none = torch.zeros(0, dtype=torch.int64)
        agents.buffer.add(actions, Outcome(rewards, over, over, after, after, none))
    return agents


def drawn(learner: ActorCritic) -> Batch:
    """Return a batch of four rows."""
    return learner.buffer.batch(learner.buffer.draw(4, ()))


@pytest.mark.parametrize("kind", [SACConfig, TD3Config])
def test_the_encoder_learns_from_the_critics_alone(kind: type[ActorCriticConfig]) -> None:
    learner = cast(ActorCritic, filled(kind(envs=2, **SHIFT)).learner)
    weights = {name: model.weights for name, model in learner.models.items()}
    assert sorted(weights) == ["actor", "encoder", "q"]
    learner.step = 1  # The actor of TD3 is due.
    terms = learner.losses(learner.encoded(drawn(learner)))
    for term, moved in (("td_loss", ["encoder", "q"]), ("policy_loss", ["actor"])):
        found = torch.autograd.grad(
            terms[term].sum(), list(weights.values()), allow_unused=True, retain_graph=True
        )
        gradients = dict(zip(weights, found, strict=True))
        changed = [name for name, one in gradients.items() if one is not None and one.any()]
        assert sorted(changed) == moved, term
    before = weights["encoder"].detach().clone()
    learner.update()
    assert not torch.equal(before, weights["encoder"])


def test_networks_receive_the_features_and_numbers() -> None:
    learner = cast(ActorCritic, filled(SACConfig(envs=2, **SHIFT)).learner)
    batch = drawn(learner)
    inputs = learner.inputs(batch.observations)
    assert inputs.images == ()
    assert inputs.vector.shape == (4, FEATURES + 2)
    torch.testing.assert_close(inputs.vector[:, FEATURES:], batch.observations.vector)
    features = inputs.vector[:, :FEATURES]
    raw = learner.network(ENCODER, 3)(batch.observations)
    expected = (raw - raw.mean(1, keepdim=True)) / raw.std(1, keepdim=True, unbiased=False)
    torch.testing.assert_close(features, expected.tanh(), rtol=1e-3, atol=1e-3)
    # Images change the action, through the features alone.
    first, second = learner.act(inputs), learner.act(learner.inputs(batch.next_observations))
    assert not torch.allclose(first, second)


def test_logged_images_are_shifted_as_the_others() -> None:
    buffer = filled(SACConfig(envs=2, **SHIFT)).buffer
    log = filled(SACConfig(envs=2, hidden=(8, 8))).buffer
    mixed = MixedBuffer.of(buffer, log, 0.5)
    rows = mixed.draw(4, ())
    mixed.counts.shifts = ((2, -1), (0, 1))
    found, plain = mixed.batch(rows), log.batch(rows[2:] - len(mixed))
    here, there = found.observations.images[0][2:], found.next_observations.images[0][2:]
    torch.testing.assert_close(here[:, 2:, :-1], plain.observations.images[0][:, :-2, 1:])
    torch.testing.assert_close(there[:, :, 1:], plain.next_observations.images[0][:, :, :-1])


@pytest.mark.parametrize("algo", ["sac", "td3"])
def test_a_run_from_images_is_saved_resumed_and_continued(tmp_path: Path, algo: str) -> None:
    task = choose_task("powerline", algo, DRONE, {**SHORT, "frame_stack": 2})
    whole, cut, log = (tmp_path / name for name in ("whole", "cut", "log.mcap"))
    train(task, whole, record=log, progress=silent)
    begin = LearningAgent._begin
    kills = iter([True])

    def killed(self: LearningAgent) -> None:
        if self.agents.steps == 24 and next(kills, False):
            raise KeyboardInterrupt
        begin(self)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(LearningAgent, "_begin", killed)
        with pytest.raises(KeyboardInterrupt):
            train(task, cut, progress=silent)
        train(task, cut, resume=True, progress=silent)
    files = [(run / "seed-0" / "policy.safetensors").read_bytes() for run in (whole, cut)]
    assert files[0] == files[1]
    policy, data = mcaprl.load_policy(whole), mcaprl.open(log)
    agent = LearningAgent(task, "", tmp_path, 0, Scale(0, 1))
    try:
        agent.start_from(None, policy)
        stack = {name: np.stack([part[:5], part[1:6]], 1) for name, part in data.frames.items()}
        np.testing.assert_allclose(agent.policy.act(stack), policy.act(stack), atol=1e-4)
        taken = data.actions[:5]
        first, second = (one.action_values(stack, taken) for one in (agent.policy, policy))
        np.testing.assert_allclose(first, second, rtol=1e-3, atol=1e-3)
    finally:
        agent.close()


def test_logged_images_are_averaged_as_stored_ones(tmp_path: Path) -> None:
    log = tmp_path / "log.mcap"
    mcaprl.record("powerline", log, steps=30, noise=0.1, **DRONE)
    data = mcaprl.open(log)
    task = choose_task("powerline", "td3", DRONE, {**SHORT, "image_shift": 0}, with_logs=True)
    agent = LearningAgent(task, "", tmp_path, 0, Scale(0, 1))
    try:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("mcaprl.online.replay._IMAGES_AT_ONCE", 7)
            agent.start_from(data, None)
        agent._begin()
        agent.agents.step()
        buffer = agent.agents.buffer
        batch = buffer.batch(buffer.draw(4, ()))
        images = data.observations["depth"].reshape(-1, 42, 2, 42, 2).mean((2, 4))
        found = batch.observations.images[0][2:, :, :, 0].numpy()
        for image, reward in zip(found, batch.rewards[2:].tolist(), strict=True):
            # Rewards of three steps identify the row.
            sums = data.rewards.copy()
            for step in (1, 2):
                sums[:-step] += 0.95**step * data.rewards[step:]
            row = np.abs(sums - reward).argmin()
            assert np.abs(images[row] - image).max() <= 0.51
    finally:
        agent.close()


def test_policies_without_an_encoder_are_refused(tmp_path: Path) -> None:
    log = tmp_path / "log.mcap"
    mcaprl.record("powerline", log, episodes=1, noise=0.1, **DRONE)
    data = mcaprl.open(log)
    settings = {"updates": 2, "hidden": (8, 8), "batch_size": 4, "held_out": 0.0, "polyak": 1.0}
    settings["gamma"] = 0.5
    chosen = configured("iql", settings, space=data.action_space)
    train_offline(data, chosen, tmp_path / "iql", progress=lambda now: None)
    agent = LearningAgent(
        choose_task("powerline", "sac", DRONE, SHORT), "", tmp_path, 0, Scale(0, 1)
    )
    try:
        with pytest.raises(PolicyError, match="from images, start from a policy of sac or td3"):
            agent.start_from(None, mcaprl.load_policy(tmp_path / "iql"))
    finally:
        agent.close()
