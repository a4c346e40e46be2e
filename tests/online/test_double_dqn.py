"""Tests of Double DQN: targets by hand, agreement with SB3's DQN, and learning."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3 import DQN
from stable_baselines3.common.logger import configure
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from torch import Tensor

from mcaprl.online.algorithms import DoubleDQN
from mcaprl.online.zip_file import write_model


class Table(torch.nn.Module):
    """Table of Q-values, which are its weights; row k belongs to observation k."""

    def __init__(self, rows: list[list[float]]) -> None:
        super().__init__()
        self.rows = torch.nn.Parameter(torch.tensor(rows))
        self.set_training_mode = self.train

    def forward(self, observations: Tensor) -> Tensor:
        return self.rows[observations[:, 0].long()]


class OneBatch:
    """Replay buffer that always returns the same transitions."""

    def __init__(self, **columns: list[float]) -> None:
        self.columns = {name: torch.tensor(values)[:, None] for name, values in columns.items()}

    def sample(self, batch_size: int, env: Any = None) -> ReplayBufferSamples:
        columns: dict[str, Any] = {"discounts": None, **self.columns}
        return ReplayBufferSamples(**columns)


def model_of(kind: type[DQN], max_grad_norm: float = 10.0, gamma: float = 0.5) -> Any:
    """Make a model.

    In the next state, the online network prefers action 1, and the target network prefers action 0.
    """
    model: Any = kind(
        "MlpPolicy",
        gym.make("CartPole-v1"),
        gamma=gamma,
        buffer_size=10,
        max_grad_norm=max_grad_norm,
        seed=0,
        learning_rate=0.1,
        device="cpu",
        policy_kwargs={"net_arch": [4], "optimizer_class": torch.optim.SGD},
    )
    online = Table([[0.0, 0.0], [1.0, 2.0]])
    model.q_net = model.policy.q_net = online
    model.q_net_target = model.policy.q_net_target = Table([[0.0, 0.0], [5.0, 3.0]])
    model.policy.optimizer = torch.optim.SGD(online.parameters(), lr=0.1)
    model.set_logger(configure(None, []))
    return model


def step_of(model: Any, **columns: list[float]) -> float:
    """Return the change of Q(s=0, a=0) in one update; the value starts at 0."""
    batch = {
        "observations": [0.0],
        "actions": [0.0],
        "next_observations": [1.0],
        "dones": [0.0],
        "rewards": [1.0],
        **columns,
    }
    model.replay_buffer = OneBatch(**batch)
    model.train(gradient_steps=1, batch_size=1)
    return float(model.q_net.rows[0, 0].item())


@pytest.mark.parametrize(
    ("columns", "target"),
    [
        # The online network selects action 1 (2 > 1). Its value in the target network is 3, so the
        # target is 1 + .5 x 3.
        ({}, 2.5),
        ({"dones": [1.0]}, 1.0),
        # The buffer sums three rewards; the discount of the next value is gamma^3.
        ({"rewards": [1.75], "discounts": [0.125]}, 2.125),
        ({"rewards": [1.75], "discounts": [0.125], "dones": [1.0]}, 1.75),
    ],
)
def test_the_target_by_hand(columns: dict[str, list[float]], target: float) -> None:
    # If the error is above 1, the gradient of the Huber loss is -1. If it is between 0 and 1, the
    # gradient is minus the error. SGD subtracts .1 times the gradient from the value.
    assert step_of(model_of(DoubleDQN), **columns) == pytest.approx(0.1 * min(target, 1.0))
    small = {**columns, "rewards": [columns.get("rewards", [1.0])[0] - target + 0.5]}
    assert step_of(model_of(DoubleDQN), **small) == pytest.approx(0.05)


def test_the_penalty_by_hand() -> None:
    # Both actions have the value 0, so the gradient of their cross entropy is -.5 and .5.
    model = model_of(DoubleDQN)
    model.alpha = 0.4
    assert step_of(model, dones=[1.0], rewards=[0.25]) == pytest.approx(0.1 * (0.25 + 0.4 * 0.5))
    assert model.q_net.rows[0, 1].item() == pytest.approx(-0.1 * 0.4 * 0.5)


def test_with_gamma_0_only_the_reward_counts() -> None:
    assert step_of(model_of(DoubleDQN, gamma=0.0), rewards=[0.25]) == pytest.approx(0.025)


def test_dqn_uses_the_target_networks_maximum() -> None:
    # With the reward -2, the target of DQN is -2 + .5 x 5 = .5, and that of Double DQN is
    # -2 + .5 x 3 = -.5. SGD changes the value by .1 times the target.
    assert step_of(model_of(DQN), rewards=[-2.0]) == pytest.approx(0.05)
    assert step_of(model_of(DoubleDQN), rewards=[-2.0]) == pytest.approx(-0.05)


def test_gradients_are_clipped() -> None:
    assert step_of(model_of(DoubleDQN, max_grad_norm=0.2)) == pytest.approx(0.02)


def test_double_dqn_changes_only_the_target() -> None:
    model = model_of(DoubleDQN)
    step_of(model)
    assert model.q_net.rows[1].tolist() == [1.0, 2.0]
    assert model.q_net_target.rows.tolist() == [[0.0, 0.0], [5.0, 3.0]]


def cartpole(kind: type[DQN], **kwargs: Any) -> Any:
    return kind(
        "MlpPolicy",
        gym.make("CartPole-v1"),
        learning_starts=50,
        buffer_size=1_000,
        target_update_interval=4,
        seed=3,
        device="cpu",
        policy_kwargs={"net_arch": [16]},
        **kwargs,
    )


def test_double_dqn_equals_dqn_if_both_networks_agree() -> None:
    # A target network that is copied after each step equals the online network.
    states = []
    for kind in (DQN, DoubleDQN):
        model = cartpole(kind)
        model.learn(200)
        assert model._n_updates > 30
        states.append(model.policy.state_dict())
    assert all(torch.equal(states[0][name], states[1][name]) for name in states[0])


def test_plain_sb3_loads_it_as_dqn(tmp_path: Path) -> None:
    model = cartpole(DoubleDQN, n_steps=3)
    model.learn(100)
    write_model(tmp_path / "model.zip", model, {})
    loaded = DQN.load(tmp_path / "model.zip")
    observations = np.random.default_rng(0).normal(size=(20, 4)).astype(np.float32)
    np.testing.assert_array_equal(
        loaded.predict(observations, deterministic=True)[0],
        model.predict(observations, deterministic=True)[0],
    )
