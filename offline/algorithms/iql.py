"""Implicit Q-learning with discrete actions: no action is ever valued that the log does not show.

    https://arxiv.org/abs/2110.06169
        V(s)    expectile regression to Q'(s, a_data): nearly the best that was done there
        Q(s,a)  regression to r + gamma V(s')
        pi      behavior cloning, each action weighted with exp(beta (Q'(s, a) - V(s)))

Q is the smaller of two networks that learn alike, Q' a copy of both renewed every `target_interval`
updates.

Departures from the paper: discrete actions, so the policy is a classifier and Q has an output for
each action; hard copies of the target where the paper averages; the Huber loss for Q.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from mcaprl.offline.algorithms.config import BootstrapConfig, TrainingConfig
from mcaprl.offline.algorithms.learner import ActsBy, Learner, Losses
from mcaprl.offline.algorithms.losses import (
    chosen,
    cross_entropy,
    expectile_regression,
    huber_regression,
    scaled,
)
from mcaprl.offline.batches.buffer import Batch, TransitionBuffer

MAX_WEIGHT = 100.0
"""The most that one action can count in the policy's loss, as in the paper's code."""
_TWINS = ("q", "q_twin")


@dataclass(frozen=True)
class IQLConfig(BootstrapConfig):
    """Settings of IQL."""

    target_interval: int = 50
    """updates between two copies of the weights into the target network"""
    expectile: float = 0.8
    """which part of what was done in a state its value follows; 0.5 the mean, near 1 the best"""
    beta: float = 3.0
    """how much more what beat the expected return by a reward of 1 is cloned; 0 clones all alike"""

    def __post_init__(self) -> None:
        """Refuse settings that cannot be meant."""
        super().__post_init__()
        self._require("expectile", 0 < self.expectile < 1, "within (0, 1)")
        self._require("beta", self.beta >= 0, "at least 0")


class IQL(Learner):
    """Values of what was done, and a clone that prefers the better of it."""

    name = "iql"
    config_type: ClassVar[type[TrainingConfig]] = IQLConfig
    acts_by: ClassVar[ActsBy] = "logits"
    policy_models: ClassVar[tuple[str, ...]] = ("logits", "q")
    config: IQLConfig

    def __init__(self, config: IQLConfig, buffer: TransitionBuffer, seeds: Sequence[int]) -> None:
        """Start with random weights, and the same ones as targets."""
        super().__init__(config, buffer, seeds)
        for name in _TWINS:
            self.add_target(name, config.target_interval, next_states=False)

    def output_shapes(self) -> dict[str, tuple[int, ...]]:
        """Two networks of values, one of states, and the policy's logits."""
        per_action = (self.n_actions,)
        return {"logits": per_action, "q": per_action, "q_twin": per_action, "v": (1,)}

    def losses(self, batch: Batch) -> Losses:
        """Each network has a loss of its own; what is logged is their sum."""
        values = [chosen(self.copies[name].outputs(batch), batch.actions) for name in _TWINS]
        q_a_tm1 = torch.minimum(*values)
        target_tm1 = self.next_values(batch)
        v_tm1 = self.models["v"].learn_from(batch.observations)
        v_loss = expectile_regression(v_tm1, q_a_tm1, self.config.expectile)
        q_loss, twin_loss = (
            huber_regression(self.learn(name, batch.observations), batch.actions, target_tm1)
            for name in _TWINS
        )
        weight = (self.config.beta * (q_a_tm1 - v_tm1.squeeze(1))).exp().clamp(max=MAX_WEIGHT)
        logits_tm1 = self.learn("logits", batch.observations)
        policy_loss = scaled(cross_entropy(logits_tm1, batch.actions), weight)
        terms = {
            "mean_q": q_a_tm1,
            "value_loss": v_loss.value,
            "td_loss": q_loss.value,
            "policy_loss": policy_loss.value,
            "loss": v_loss.value + q_loss.value + twin_loss.value + policy_loss.value,
        }
        slopes = {
            "q": q_loss.slope,
            "q_twin": twin_loss.slope,
            "v": v_loss.slope,
            "logits": policy_loss.slope,
        }
        return Losses(terms, slopes)

    def judge(self, batch: Batch) -> dict[str, Tensor]:
        """The values of the actions taken, and how far they are from their targets."""
        q_a_tm1 = chosen(self.outputs("q", batch.observations), batch.actions)
        return {"q": q_a_tm1, "td_error": (self.next_values(batch) - q_a_tm1).abs()}

    def next_values(self, batch: Batch) -> Tensor:
        """(R,) r + gamma V(s')."""
        v_t = self.models["v"](batch.next_observations).squeeze(1)
        return batch.rewards + batch.discounts * v_t
