"""Discrete batch-constrained Q-learning: Double DQN restricted to actions likely in the log.

    https://arxiv.org/abs/1910.01708    argmax_a Q(s, a) where G(a|s) / max_a G(a|s) >= threshold

G clones the behavior policy. Neither the target nor the policy selects actions that are unlikely
according to G.

Departures from the paper: Q and G are separate networks even for images. The target network is
synced at intervals instead of averaged. The departures that `dqn` lists also apply.
"""

from __future__ import annotations

import torch
from torch import Tensor

from mcaprl.offline.algorithms.config import BCQConfig
from mcaprl.offline.algorithms.dqn import DQN
from mcaprl.offline.algorithms.losses import (
    allowed_only,
    chosen,
    cross_entropy,
    double_q_learning_target,
    likely_actions,
    mean_values,
    square_penalty,
    temporal_difference_loss,
)
from mcaprl.offline.batches.buffer import Batch


class BCQ(DQN):
    """Q-learning that selects next actions only among actions that are likely in the log."""

    name = "bcq"
    config_type = BCQConfig
    acts_by = "filtered_q_values"
    policy_models = ("q", "logits")
    config: BCQConfig

    def output_shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the output shapes of the value network and of the behavior-cloning network."""
        return {**super().output_shapes(), "logits": (self.n_actions,)}

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Return the temporal-difference loss plus the clone's cross entropy and logit penalty."""
        q_tm1 = self.outputs("q", batch.observations)
        logits_tm1 = self.outputs("logits", batch.observations)
        target_tm1 = self.targets(batch, self.target_outputs(batch))
        td_loss = temporal_difference_loss(q_tm1, batch.actions, target_tm1)
        cloning_loss = cross_entropy(logits_tm1, batch.actions)
        penalty = self.config.logits_penalty * square_penalty(logits_tm1)
        return {
            "mean_q": self.in_reward_units(chosen(mean_values(q_tm1), batch.actions)),
            "td_loss": td_loss,
            "cloning_loss": cloning_loss,
            "loss": td_loss + cloning_loss + penalty,
        }

    @torch.no_grad()
    def targets(self, batch: Batch, q_t: Tensor) -> Tensor:
        """Return the targets. The learning network selects likely actions; `q_t` evaluates them."""
        own_q_t = self.outputs("q", batch.next_observations)
        logits_t = self.outputs("logits", batch.next_observations)
        q_t_selector = allowed_only(own_q_t, likely_actions(logits_t, self.config.threshold))
        return double_q_learning_target(batch.rewards, batch.discounts, q_t, q_t_selector)
