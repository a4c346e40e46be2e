"""Tests of fitted Q evaluation of Box actions, on a regulator whose values are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from mcaprl.offline.batches.buffer import TransitionBuffer
from mcaprl.offline.estimate.fqe import BoxFQE, BoxFQEConfig
from mcaprl.recorder.dataset.dataset import Dataset
from tests.support.offline_tasks import A_LQ, B_LQ, COST_LQ, GAMMA, regulator, riccati

FAST = BoxFQEConfig(
    updates=1_500, hidden=(32, 32), learning_rate=3e-3, target_interval=15, gamma=GAMMA
)
GAINS = (riccati()[1], 0.0)


def value_of_gain(k: float) -> float:
    """Return P of the value -P x^2 of the policy u = -k x."""
    return (1 + COST_LQ * k**2) / (1 - GAMMA * (A_LQ - B_LQ * k) ** 2)


def learner_of(config: BoxFQEConfig, data: Dataset) -> BoxFQE:
    """Return a learner of the policies of both gains, with two networks each."""
    torch.set_num_threads(1)
    buffer = TransitionBuffer.from_dataset(data, config.packing)
    assert buffer.box is not None
    pi_t = [buffer.box.scaled((-k * data.next_observations).clip(-4, 4)) for k in GAINS]
    return BoxFQE(config, buffer, [0, 1, 0, 1], torch.from_numpy(np.repeat(pi_t, 2, 0)))


def values_of(learner: BoxFQE, data: Dataset) -> NDArray[np.float32]:
    box = learner.buffer.box
    assert box is not None
    now = np.repeat([box.scaled((-k * data.observations).clip(-4, 4)) for k in GAINS], 2, 0)
    found: NDArray[np.float32] = learner.values_of(torch.from_numpy(now)).numpy()
    return found


def test_the_values_of_two_policies_are_the_known_ones() -> None:
    data = regulator(noise=1.0)
    learner = learner_of(FAST, data)
    for _ in range(FAST.updates):
        learner.update()
    found = values_of(learner, data)
    for k, gain in enumerate(GAINS):
        true = -value_of_gain(gain) * data.observations[:, 0] ** 2
        # An error of a step's fit is multiplied by the effective horizon of 10 steps.
        for network in found[2 * k : 2 * k + 2]:
            assert network.mean() == pytest.approx(true.mean(), abs=0.2)
            assert np.std(network - true) < 0.1 * np.abs(true).mean()


@torch.no_grad()
def test_the_target_by_hand_is_the_reward_and_the_value_of_the_policys_next_action() -> None:
    data = regulator(64)
    learner = learner_of(replace(FAST, batch_size=8), data)
    rows = torch.arange(8).repeat(4)
    batch = learner.buffer.batch(rows)
    offsets = torch.arange(4).repeat_interleave(8) * 64
    network = learner.network("q", 1)
    pi_t = learner._pi_t[rows + offsets]
    inputs = batch.next_observations.with_actions(pi_t)
    q_t = learner.target_network.model(inputs).squeeze(1).clamp(learner.low, learner.high)
    expected = batch.rewards + GAMMA * q_t
    torch.testing.assert_close(learner.targets(batch, pi_t), expected)
    # The second network belongs to seed 1: its loss is that of rows 8 to 15.
    one = slice(8, 16)
    q = network(batch.observations.with_actions(batch.actions))[one, 0]
    loss = learner.losses(batch)["loss"][one]
    torch.testing.assert_close(loss, 0.5 * (q - expected[one]).square())


def test_values_are_in_units_of_the_rewards_and_fixed_values_end_an_episode() -> None:
    # With the value fixed to -10 in all next states, Q is the reward minus 10 gamma.
    data = regulator()
    config = replace(FAST, updates=800)
    buffer = TransitionBuffer.from_dataset(data, config.packing)
    assert buffer.reward_scale != 1
    nothing = torch.zeros(1, len(data), 1)
    learner = BoxFQE(config, buffer, [0], nothing, torch.full((1, len(data)), -10.0))
    for _ in range(config.updates):
        learner.update()
    found = learner.values_of(buffer.actions.unsqueeze(0))[0].numpy()
    np.testing.assert_allclose(found, data.rewards - 10 * GAMMA, atol=0.5)
    few = learner.values_of(buffer.actions[None, 5:7], torch.arange(5, 7))
    np.testing.assert_allclose(few[0].numpy(), found[5:7], rtol=1e-5)
