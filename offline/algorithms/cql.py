"""Conservative Q-learning, CQL(H): Double DQN that lowers the values of actions not in the log.

    https://arxiv.org/abs/2006.04779    Double DQN + alpha (logsumexp_a Q(s, a) - Q(s, a_data))

The second term is a penalty that keeps the greedy policy close to the logged actions.

Departures from the paper: by default, the network learns mean values; with `n_quantiles` above 1,
it learns quantiles, like the paper's Atari agent. The target is that of Double DQN.

The weight alpha is fixed, or with `target_gap` it is a Lagrange multiplier, as in the paper:

    min_Q max_alpha    Double DQN + alpha (E[logsumexp_a Q(s, a) - Q(s, a_data)] - target_gap)

alpha rises while the mean penalty is above the target and falls while it is below. Departures: the
gradient with respect to log alpha is not multiplied with alpha, which Adam would cancel, and alpha
is at most 100. The gradients of the Huber loss and of the penalty are both at most 1, so at 100
the values of next states hardly matter.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import torch
from torch import Tensor

from mcaprl.offline.algorithms.config import ALPHA_RANGE, CQLConfig
from mcaprl.offline.algorithms.dqn import DoubleDQN
from mcaprl.offline.algorithms.losses import (
    chosen,
    cross_entropy,
    mean_values,
    temporal_difference_loss,
)
from mcaprl.offline.batches.buffer import Batch, TransitionBuffer

RATE_FACTOR: Final = 10.0  # Learning rate of log alpha, as a multiple of the learning rate of Q
_ALPHA: Final = "log_alpha"


class CQL(DoubleDQN):
    """Double DQN with a penalty on the values of actions that are not in the data."""

    name = "cql"
    config_type = CQLConfig
    config: CQLConfig

    def __init__(self, config: CQLConfig, buffer: TransitionBuffer, seeds: Sequence[int]) -> None:
        """Initialize the networks with random weights, and alpha with its setting."""
        super().__init__(config, buffer, seeds)
        if config.target_gap:
            self.add_scalar(_ALPHA, math.log(config.alpha), RATE_FACTOR)

    def update(self) -> dict[str, Tensor]:
        """Run one gradient step, and limit alpha to its range."""
        terms = super().update()
        with torch.no_grad():
            for log_alpha in self.scalars.values():
                log_alpha.clamp_(*map(math.log, ALPHA_RANGE))
        return terms

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Return Double DQN's loss plus alpha times the penalty; a target gap changes alpha."""
        q_tm1 = self.outputs("q", batch.observations)
        mean_q_tm1 = mean_values(q_tm1)
        target_tm1 = self.targets(batch, self.target_outputs(batch))
        td_loss = temporal_difference_loss(q_tm1, batch.actions, target_tm1)
        penalty = cross_entropy(mean_q_tm1, batch.actions)
        terms = {
            "mean_q": self.in_reward_units(chosen(mean_q_tm1, batch.actions)),
            "td_loss": td_loss,
            "conservative_penalty": penalty,
        }
        if not self.config.target_gap:
            return {**terms, "loss": td_loss + self.config.alpha * penalty}
        log_alpha = self.scalar_rows(_ALPHA, batch)
        alpha = log_alpha.detach().exp()
        dual_loss = log_alpha * (self.config.target_gap - penalty.detach())
        return {**terms, "alpha": alpha, "loss": td_loss + alpha * penalty + dual_loss}
