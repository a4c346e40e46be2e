"""Tests of the loop of online training: schedules, updates, target syncs, exploration."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from mcaprl.offline.algorithms.cql import CQL
from mcaprl.offline.batches.observations import ObservationEncoder, Observations
from mcaprl.online.collector import VectorEnvironments
from mcaprl.online.config import DoubleDQNConfig
from mcaprl.online.engine import Agents

CPU = torch.device("cpu")
VECTOR = spaces.Box(-1, 1, (2,))
MASKED = spaces.Dict({"action_mask": spaces.Box(0, 1, (3,), np.int8), "x": VECTOR})


class Clock(gym.Env[Any, Any]):
    """Environment whose episodes have three steps, with a reward of 1 for each."""

    observation_space = VECTOR
    action_space = spaces.Discrete(3)

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        super().reset(**kwargs)
        self.step_number = 0
        return self.np_random.uniform(-1, 1, 2).astype(np.float32), {}

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.step_number += 1
        seen = self.np_random.uniform(-1, 1, 2).astype(np.float32)
        return seen, 1.0, self.step_number == 3, False, {}


def agents_of(envs: int = 4, seeds: tuple[int, ...] = (0,), **settings: Any) -> Agents:
    """Return agents that are connected to `Clock`."""
    given: dict[str, Any] = {
        "steps": 400,
        "steps_per_update": envs,
        "learning_starts": 40,
        "target_update_interval": 20,
        "batch_size": 8,
        "hidden": (8,),
    }
    config = DoubleDQNConfig(envs=envs, **{**given, **settings})
    encoder = ObservationEncoder(VECTOR, 3)
    agents = Agents(config, encoder, Clock.action_space, seeds, CPU)
    batch = SyncVectorEnv([Clock] * (envs * len(seeds)), autoreset_mode=AutoresetMode.SAME_STEP)
    agents.connect(VectorEnvironments(batch, encoder))
    agents.collector.begin(5)
    return agents


def target_is_synced(agents: Agents) -> bool:
    models = agents.learner.all_models()
    return torch.equal(models["q"].weights, models["q_target"].weights)


def test_updates_follow_the_random_steps_at_the_chosen_rate() -> None:
    agents = agents_of(steps_per_update=2)
    updates = []
    for _ in range(13):
        agents.step()
        updates.append(agents.learner.step)
    # 44 is the first number of steps above 40; each step of four environments has two updates then.
    assert updates[9:] == [0, 2, 4, 6]


def test_the_target_is_synced_by_steps() -> None:
    agents, synced = agents_of(), []
    for _ in range(16):
        agents.step()
        synced.append((agents.steps, target_is_synced(agents)))
    # Each multiple of 20 steps syncs, before the update of that step; updates begin at 44.
    assert [steps for steps, same in synced if same] == list(range(4, 44, 4))
    weights = agents.learner.all_models()["q"].weights.clone()
    for _ in range(4):
        agents.step()
    target = agents.learner.all_models()["q_target"].weights
    assert agents.steps == 80
    assert not torch.equal(target, weights), "it was synced at 80"


def test_the_target_is_synced_by_episodes() -> None:
    agents = agents_of(envs=1, target_update_episodes=2, learning_starts=6)
    changes, before = [], agents.learner.all_models()["q_target"].weights.clone()
    for _ in range(26):
        agents.step()
        target = agents.learner.all_models()["q_target"].weights
        if not torch.equal(target, before):
            changes.append(agents.steps)
            before = target.clone()
    # Two episodes have 6 steps; the first sync after an update, of step 7, is that of step 12.
    assert changes == [12, 18, 24]


def test_epsilon_and_the_learning_rate_follow_the_steps() -> None:
    agents = agents_of(exploration_fraction=0.5, exploration_final_eps=0.1, learning_rate=1.0)
    assert agents.epsilon == 1.0
    agents.steps = 36
    assert agents.epsilon == 1.0, "random steps"
    agents.steps = 100
    assert agents.epsilon == pytest.approx(1 - 0.9 * 0.5)
    agents.steps = 300
    assert agents.epsilon == 0.1
    agents.is_pretrained = True
    agents.steps = 0
    assert agents.epsilon == 0.1, "no random steps with a pretrained policy"
    slower = agents_of(learning_rate=1.0, final_learning_rate_fraction=0.2)
    slower.steps = 100
    assert slower.learning_rate == pytest.approx(0.8)
    decay = DoubleDQNConfig(exploration_decay=0.5, exploration_final_eps=0.1)
    assert [decay.epsilon_at(steps) for steps in (0, 1, 3, 4)] == [1.0, 0.5, 0.125, 0.1]


def test_gradients_of_each_seed_are_clipped_by_themselves() -> None:
    agents = agents_of(seeds=(0, 1), max_grad_norm=1e-3)
    for _ in range(12):
        agents.step()
    learner = agents.learner
    rows = agents.buffer.draw(8, [])
    learner._gradients(rows)
    (weights,) = (model.weights for model in learner.models.values())
    clipped = weights.grad
    assert clipped is not None
    clipped = clipped.clone()
    learner.max_grad_norm = np.inf
    learner._gradients(rows)
    assert weights.grad is not None
    norms = weights.grad.norm(dim=1, keepdim=True)
    assert (norms > 1e-3).all()
    torch.testing.assert_close(clipped, weights.grad * 1e-3 / (norms + 1e-6))
    learner.max_grad_norm = 1e3
    learner._gradients(rows)
    unchanged = weights.grad.clone()
    learner.max_grad_norm = np.inf
    learner._gradients(rows)
    torch.testing.assert_close(unchanged, weights.grad)


def test_alpha_selects_the_penalty_of_cql() -> None:
    learner = agents_of(alpha=0.5).learner
    assert isinstance(learner, CQL)
    assert (learner.name, learner.config.alpha) == ("double-dqn", 0.5)
    assert not isinstance(agents_of().learner, CQL)


def test_probabilities_are_those_of_the_choices() -> None:
    """Over many draws, each action is as frequent as its probability says."""
    agents, epsilon, count = agents_of(), 0.6, 4_000
    seen = Observations(torch.tensor([[0.3, -0.7]]).repeat(count, 1))
    choice = agents.behavior.choose(seen, epsilon)
    assert choice.values is not None
    best = int(choice.values[0].argmax())
    found = choice.behavior()
    for action in range(3):
        expected = epsilon / 3 + (1 - epsilon) * (action == best)
        taken = choice.actions == action
        torch.testing.assert_close(
            found[taken], torch.full((int(taken.sum()),), expected, dtype=torch.float64)
        )
        assert float(taken.double().mean()) == pytest.approx(expected, abs=0.03)
    random = agents.behavior.choose(seen, 1.0)
    assert random.values is None
    assert set(random.behavior().tolist()) == {1 / 3}


@pytest.mark.parametrize("epsilon", [0.0, 0.5, 1.0])
def test_only_allowed_actions_are_chosen(epsilon: float) -> None:
    config = DoubleDQNConfig(hidden=(8,))
    encoder = ObservationEncoder(MASKED, 3)
    agents = Agents(config, encoder, spaces.Discrete(3), [0], CPU)
    masks = np.array([[1, 0, 0], [0, 1, 1], [0, 1, 0], [1, 1, 1]] * 50, np.int8)
    x = np.random.default_rng(0).uniform(-1, 1, (200, 2)).astype(np.float32)
    choice = agents.behavior.choose(encoder.encode({"action_mask": masks, "x": x}), epsilon)
    assert masks[np.arange(200), choice.actions.numpy()].all()
    chances = choice.behavior().numpy()
    np.testing.assert_allclose(chances[masks.sum(1) == 1], 1)
    if epsilon == 1.0:
        np.testing.assert_allclose(chances, 1 / masks.sum(1))
