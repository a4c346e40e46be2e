"""SAC: an actor that maximizes values and its entropy, whose weight is learned.

    https://arxiv.org/abs/1812.05905
        Q_e(s,a)  regression to r + gamma (min_e Q'_e(s', a') - alpha log pi(a'|s')), a' ~ pi(s')
        pi        minimize alpha log pi(a|s) - min_e Q_e(s, a), a ~ pi(s)
                  + smoothness |mode of pi(s) - mode of pi(s')|, https://arxiv.org/abs/2012.06644
                  + anchor (mode of pi(s) - mode of the continued policy)^2
        alpha     minimize log(alpha) (entropy of pi - target entropy)

Q' are target networks, averages of the learning networks. The policy is the tanh of a normal
distribution.

Departures from the paper: actor and temperature learn with the critics from before the update, and
with n-step returns, the entropy of the steps between is not counted.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from mcaprl.offline.algorithms.actor_critic import ActorCritic
from mcaprl.offline.algorithms.config import SACConfig
from mcaprl.offline.algorithms.heads import SquashedGaussian
from mcaprl.offline.algorithms.losses import (
    clipped_double_q_target,
    temperature_loss,
    twin_regression,
)
from mcaprl.offline.batches.buffer import Batch, TransitionBuffer

LOG_TEMPERATURE = "log_temperature"  # Name of the logarithm of alpha in `Learner.scalars`


class SAC(ActorCritic):
    """Soft actor-critic with twin critics and a learned temperature."""

    name = "sac"
    config_type = SACConfig
    acts_by = "squashed_gaussian"
    shares_encoder = True
    config: SACConfig

    def __init__(self, config: SACConfig, buffer: TransitionBuffer, seeds: Sequence[int]) -> None:
        """Initialize the networks with random weights, and copy the critics to their targets."""
        super().__init__(config, buffer, seeds)
        self.add_scalar(LOG_TEMPERATURE, math.log(config.temperature), 1.0)
        self.add_target_network("q", config.target_interval, polyak=config.polyak)
        self._target_entropy = config.target_entropy * self.n_actions

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Return the losses of the critics, of the actor, and of the temperature."""
        log_alpha = self.scalar_rows(LOG_TEMPERATURE, batch)
        alpha = log_alpha.detach().exp()
        target_tm1 = self.targets(batch, alpha, self.noise(1.0))
        q_tm1 = self.models["q"](batch.observations.with_actions(batch.actions))
        td_loss = twin_regression(q_tm1, target_tm1)
        observations = batch.observations.detached()
        outputs = self.models["actor"](observations)
        actions, log_pi = SquashedGaussian.sample(outputs, self.noise(1.0))
        q = self.models["q"](observations.with_actions(actions), frozen=True)
        policy_loss = alpha * log_pi - q.amin(0)
        smoothness_loss = self.smoothness_loss(batch, self.config.smoothness)
        entropy_loss = temperature_loss(log_alpha, log_pi.detach(), self._target_entropy)
        loss = td_loss
        if self.step >= self.actor_starts:
            anchor_loss = self.anchor_loss(batch, q_tm1)
            loss = td_loss + policy_loss + smoothness_loss + anchor_loss + entropy_loss
        return {
            "mean_q": self.in_reward_units(q_tm1.detach().mean(0)),
            "td_loss": td_loss,
            "policy_loss": policy_loss,
            "entropy": -log_pi,
            "temperature": alpha,
            "loss": loss,
        }

    @torch.no_grad()
    def targets(self, batch: Batch, alpha: Tensor, noise: Tensor) -> Tensor:
        """Return the targets (R,) of the critics, for next actions with normal noise (R, n)."""
        outputs = self.models["actor"](batch.next_observations)
        next_actions, log_pi = SquashedGaussian.sample(outputs, noise)
        q_t = self.target_networks["q"].model(batch.next_observations.with_actions(next_actions))
        return clipped_double_q_target(batch.rewards, batch.discounts, q_t, alpha * log_pi)
