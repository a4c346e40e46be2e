"""Implicit Q-learning with discrete actions; only logged actions are evaluated.

    https://arxiv.org/abs/2110.06169
        V(s)    expectile regression to Q'(s, a_data): close to the value of the best logged action
        Q(s,a)  regression to r + gamma V(s')
        pi      behavior cloning, each action weighted with exp(beta A(s, a))
        A(s, a) Q'(s, a) - V(s)

Two networks Q learn from the same targets. Each has a target network, and Q' is the minimum of the
two target networks. They are synced every `target_interval` updates.

Departures from the paper: actions are discrete, so the policy is a classifier and Q has one output
per action. Target networks are synced at intervals instead of averaged. Q is trained with the Huber
loss. By default, advantages are divided by their root mean square, because their size differs
between tasks; with `normalize_advantages=False`, they are those of the paper.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from mcaprl.offline.algorithms.config import IQLConfig
from mcaprl.offline.algorithms.learner import Learner
from mcaprl.offline.algorithms.losses import (
    chosen,
    cross_entropy,
    expectile_regression,
    huber_regression,
)
from mcaprl.offline.batches.buffer import Batch, TransitionBuffer

MAX_WEIGHT = 100.0
"""Maximum weight of an action in the policy's loss, as in the paper's code."""
_SMALLEST_ADVANTAGE = 1e-6
"""Root mean square up to which advantages count as equal, because of rounding errors."""
_TWINS = ("q", "q_twin")


class IQL(Learner):
    """Implicit Q-learning: values by expectile regression, policy by weighted behavior cloning."""

    name = "iql"
    config_type = IQLConfig
    acts_by = "logits"
    policy_models = ("logits", "q")
    can_be_captured = True
    config: IQLConfig

    def __init__(self, config: IQLConfig, buffer: TransitionBuffer, seeds: Sequence[int]) -> None:
        """Initialize the networks with random weights, and copy them to the target networks."""
        super().__init__(config, buffer, seeds)
        for name in _TWINS:
            self.add_target_network(name, config.target_interval, next_states=False)

    def output_shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the shapes of the policy's logits, two networks Q, and V."""
        per_action = (self.n_actions,)
        return {"logits": per_action, "q": per_action, "q_twin": per_action, "v": (1,)}

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Return the losses of V, Q and the policy. The three share no weights."""
        q_a_tm1 = torch.minimum(
            *(chosen(self.target_networks[name].outputs(batch), batch.actions) for name in _TWINS)
        )
        v_tm1 = self.models["v"](batch.observations)
        v_loss = expectile_regression(v_tm1, q_a_tm1, self.config.expectile)
        target_tm1 = self.targets(batch)
        q_loss, twin_loss = (
            huber_regression(self.outputs(name, batch.observations), batch.actions, target_tm1)
            for name in _TWINS
        )
        advantage = q_a_tm1 - v_tm1.detach().squeeze(1)
        if self.config.normalize_advantages:
            advantage = self.normalized(advantage)
        weight = (self.config.beta * advantage).exp().clamp(max=MAX_WEIGHT)
        logits_tm1 = self.outputs("logits", batch.observations)
        policy_loss = weight * cross_entropy(logits_tm1, batch.actions)
        return {
            "mean_q": self.in_reward_units(q_a_tm1),
            "value_loss": v_loss,
            "td_loss": q_loss,
            "policy_loss": policy_loss,
            "loss": v_loss + q_loss + twin_loss + policy_loss,
        }

    def validate(self, batch: Batch) -> dict[str, Tensor]:
        """Return the Q-values of the logged actions, and the absolute TD errors of these values."""
        q_a_tm1 = chosen(self.outputs("q", batch.observations), batch.actions)
        terms = {"q": q_a_tm1, "td_error": (self.targets(batch) - q_a_tm1).abs()}
        return {name: self.in_reward_units(term) for name, term in terms.items()}

    def normalized(self, advantages: Tensor) -> Tensor:
        """Divide the advantages (R,) of each seed by their root mean square in the seed's batch."""
        of_seeds = advantages.view(len(self.seeds), -1)
        squares = self.batch_means(advantages.square())
        return (of_seeds / squares.sqrt().clamp_min(_SMALLEST_ADVANTAGE).unsqueeze(1)).flatten()

    @torch.no_grad()
    def targets(self, batch: Batch) -> Tensor:
        """Return the targets (R,) of Q: r + gamma V(s')."""
        v_t = self.models["v"](batch.next_observations).squeeze(1)
        return batch.rewards + batch.discounts * v_t
