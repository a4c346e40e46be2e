"""Tests of SAC and TD3: equations by hand, densities by quadrature, and one update of each."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from torch import Tensor

from mcaprl.errors import UsageError
from mcaprl.offline.algorithms.actor_critic import ActorCritic
from mcaprl.offline.algorithms.config import SACConfig, TD3Config
from mcaprl.offline.algorithms.heads import SquashedGaussian, bounded_log_std
from mcaprl.offline.algorithms.losses import (
    action_change,
    clipped_double_q_target,
    smoothed_actions,
    squashed_normal_log_density,
    temperature_loss,
)
from mcaprl.offline.algorithms.registry import choose_algorithm
from mcaprl.offline.algorithms.sac import LOG_TEMPERATURE, SAC
from mcaprl.offline.algorithms.td3 import TD3, TD3BC, ReBRAC
from mcaprl.offline.batches.buffer import TransitionBuffer
from mcaprl.recorder.dataset.dataset import Dataset

SMALL: dict[str, Any] = {
    "hidden": (8, 8),
    "batch_size": 4,
    "normalize": False,
    "scale_rewards": False,
}


def buffer() -> TransitionBuffer:
    """Return 20 random transitions with actions of two numbers."""
    random = np.random.default_rng(0)
    frames = random.normal(size=(21, 3)).astype(np.float32)
    data = Dataset.from_arrays(
        observations=frames[:-1],
        next_observations=frames[1:],
        actions=random.uniform(-2, 2, (20, 2)).astype(np.float32),
        rewards=random.normal(size=20),
        terminated=np.arange(20) == 19,
        truncated=np.zeros(20, bool),
        action_space=spaces.Box(-2, 2, (2,), np.float32),
    )
    return TransitionBuffer.from_dataset(data, SACConfig(**SMALL).packing)


def test_targets_of_sac_subtract_the_weighted_log_density() -> None:
    rewards, discounts = torch.tensor([1.0, 2.0]), torch.tensor([0.5, 0.0])
    twins = torch.tensor([[4.0, 7.0], [6.0, 5.0]])
    log_pi, alpha = torch.tensor([-2.0, 3.0]), 0.5
    found = clipped_double_q_target(rewards, discounts, twins, alpha * log_pi)
    # 1 + .5 (4 + 1), and a termination.
    assert found.tolist() == [3.5, 2.0]


def test_targets_of_td3_clip_the_noise_and_the_actions() -> None:
    actions, noise = torch.tensor([[0.0, 0.75]]), torch.tensor([[-2.0, 0.5]])
    assert smoothed_actions(actions, noise, 0.5).tolist() == [[-0.5, 1.0]]


def test_the_anchor_is_a_multiple_of_the_values_of_each_seed() -> None:
    learner = SAC(SACConfig(**SMALL | {"batch_size": 2}), buffer(), [0, 1])
    learner.continue_actor(0, 1.0, anchor=0.5)
    batch = learner.encoded(learner.buffer.batch(torch.arange(4)))
    learner._first_actions = learner.act(batch.observations) - torch.tensor([[1.0], [2], [3], [4]])
    q = torch.tensor([[1.0, -3, 10, 20], [3, -1, 30, -20]])
    # Means of |Q|: 2 of the first seed, and 20 of the second one.
    loss = learner.anchor_loss(batch, q)
    assert isinstance(loss, Tensor)
    torch.testing.assert_close(loss, torch.tensor([1.0, 4, 90, 160]))


def test_the_change_of_actions_is_the_mean_over_their_numbers() -> None:
    before = torch.tensor([[0.5, -1.0], [0.25, 0.0]], requires_grad=True)
    after = torch.tensor([[0.0, 1.0], [0.25, -0.5]], requires_grad=True)
    change = action_change(before, after)
    # (.5 + 2) / 2, and (0 + .5) / 2.
    assert change.tolist() == [1.25, 0.25]
    torch.autograd.backward(change.sum())
    assert before.grad is not None
    assert after.grad is not None
    # Both actions move toward each other.
    assert before.grad.tolist() == [[0.5, -0.5], [0.0, 0.5]]
    assert after.grad.tolist() == [[-0.5, 0.5], [0.0, -0.5]]


def test_the_temperature_falls_above_the_target_entropy() -> None:
    log_alpha = torch.zeros(2, requires_grad=True)
    # Entropies of 3 and -4 at a target of -1: gradients 4 and -3.
    torch.autograd.backward(temperature_loss(log_alpha, torch.tensor([-3.0, 4.0]), -1.0).sum())
    assert log_alpha.grad is not None
    assert log_alpha.grad.tolist() == [4.0, -3.0]


def test_the_density_after_a_tanh_is_that_by_hand() -> None:
    # At the mean 0, 1 - tanh(0)^2 is 1; at pre = atanh(.5), it is .75.
    zero = torch.zeros(1)
    density = squashed_normal_log_density(zero, zero, zero).exp()
    assert density.item() == pytest.approx(1 / math.sqrt(2 * math.pi))
    pre = torch.tensor([0.5]).atanh()
    normal = math.exp(-0.5 * pre.item() ** 2) / math.sqrt(2 * math.pi)
    assert squashed_normal_log_density(pre, zero, zero).exp().item() == pytest.approx(normal / 0.75)


@pytest.mark.parametrize("mean", [0.0, 0.8, -1.5])
@pytest.mark.parametrize("raw", [-1.0, 0.0, 2.0])
def test_densities_integrate_to_one(mean: float, raw: float) -> None:
    # The substitution a = tanh(x) makes the steps of the sum small near the bounds.
    x = torch.linspace(-12, 12, 200_001, dtype=torch.float64)
    outputs = torch.tensor([[[mean], [raw]]], dtype=torch.float64).expand(len(x), -1, -1)
    density = SquashedGaussian.log_density(outputs, x.tanh().unsqueeze(1)).exp()
    total = torch.trapezoid(density * (1 - x.tanh() ** 2), x)
    assert total.item() == pytest.approx(1, abs=2e-3)


def test_the_density_of_a_sample_is_that_of_its_action() -> None:
    torch.manual_seed(0)
    outputs, noise = torch.randn(50, 2, 3), torch.randn(50, 3)
    actions, log_density = SquashedGaussian.sample(outputs, noise)
    assert actions.abs().max() < 1
    torch.testing.assert_close(
        log_density, SquashedGaussian.log_density(outputs, actions), rtol=1e-3, atol=1e-3
    )
    pre = outputs[:, 0] + bounded_log_std(outputs[:, 1]).exp() * noise
    torch.testing.assert_close(actions, pre.tanh())


def test_a_density_at_the_bounds_is_finite() -> None:
    outputs, bounds = torch.zeros(2, 2, 1), torch.tensor([[1.0], [-1.0]])
    found = SquashedGaussian.log_density(outputs, bounds)
    assert found.isfinite().all()
    torch.testing.assert_close(found, SquashedGaussian.log_density(outputs, bounds * (1 - 1e-6)))


def weights_of(learner: SAC | TD3) -> dict[str, Tensor]:
    """Return copies of all weights of a learner."""
    return {name: model.weights.detach().clone() for name, model in learner.all_models().items()}


def test_sac_updates_every_network_and_the_temperature() -> None:
    learner = SAC(SACConfig(**SMALL, polyak=0.25), buffer(), [0])
    before = weights_of(learner)
    learner.update()
    after = weights_of(learner)
    assert set(before) == {"actor", "q", "q_target"}
    assert all((before[name] != after[name]).any() for name in before)
    torch.testing.assert_close(after["q_target"], before["q"].lerp(after["q"], 0.25))
    assert learner.scalars[LOG_TEMPERATURE][0, 0] != 0


def test_td3_updates_the_actor_every_second_time() -> None:
    learner = TD3(TD3Config(**SMALL), buffer(), [0])
    before = weights_of(learner)
    assert "policy_loss" not in learner.update()
    once = weights_of(learner)
    assert (once["q"] != before["q"]).any()
    for name in ("actor", "actor_target", "q_target"):
        torch.testing.assert_close(once[name], before[name], rtol=0, atol=0)
    assert "policy_loss" in learner.update()
    twice = weights_of(learner)
    assert all((twice[name] != once[name]).any() for name in once)


@pytest.mark.parametrize(
    "learner_type", [SAC, TD3, TD3BC, ReBRAC], ids=lambda learner_type: learner_type.name
)
def test_smoothness_adds_the_weighted_change_to_the_loss(learner_type: type[ActorCritic]) -> None:
    weights: list[dict[str, Any]] = [{"smoothness": 0.0}, {"smoothness": 3.0}]
    rough, smooth = (
        learner_type(learner_type.config_type(**SMALL, **weight), buffer(), [0])
        for weight in weights
    )
    batch = rough.buffer.batch(torch.arange(4))
    losses = []
    for learner in (rough, smooth):
        # The second update of the critics is the first one of the actor of TD3.
        learner.step = 1
        losses.append(learner.losses(batch)["loss"])
    actions = [rough.act(seen) for seen in (batch.observations, batch.next_observations)]
    torch.testing.assert_close(losses[1] - losses[0], 3 * (actions[0] - actions[1]).abs().mean(1))
    torch.autograd.backward((losses[1] - losses[0]).sum())
    assert smooth.models["actor"].weights.grad is not None
    gradients = [learner.models["q"].weights.grad for learner in (rough, smooth)]
    # That of the values is the same.
    assert gradients[0] is not None
    assert gradients[1] is not None
    torch.testing.assert_close(gradients[1], -gradients[0])


@pytest.mark.parametrize("algo", ["sac", "td3"])
def test_offline_training_names_what_to_use_instead(algo: str) -> None:
    with pytest.raises(UsageError, match=f"{algo} learns online.*iql or rebrac"):
        choose_algorithm(algo)
