"""TD3: twin critics of a deterministic actor, which learns less often than they do.

    https://arxiv.org/abs/1802.09477
        Q_e(s,a)  regression to r + gamma min_e Q'_e(s', a'), where a' = pi'(s') + clipped noise
        pi        minimize -Q_1(s, pi(s))
                  + smoothness |pi(s) - pi(s')|, https://arxiv.org/abs/2012.06644
                  + anchor (pi(s) - action of the continued policy)^2

Q' and pi' are target networks, averages of the learning networks. The actor and the target networks
are updated every `policy_interval` and `target_interval` updates of the critics. `td3_bc` and
`rebrac` have other losses of the actor, for learning from logs alone.

Departure from the paper: the actor learns with the critics from before the update.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from mcaprl.offline.algorithms.actor_critic import ActorCritic
from mcaprl.offline.algorithms.config import TD3Config
from mcaprl.offline.algorithms.losses import (
    clipped_double_q_target,
    smoothed_actions,
    twin_regression,
)
from mcaprl.offline.batches.buffer import Batch, TransitionBuffer

_SMALLEST_VALUE = 1e-6


class TD3(ActorCritic):
    """Twin critics of a deterministic actor, which maximizes the value of its actions."""

    name = "td3"
    config_type = TD3Config
    shares_encoder = True
    config: TD3Config

    def __init__(self, config: TD3Config, buffer: TransitionBuffer, seeds: Sequence[int]) -> None:
        """Initialize the networks with random weights, and copy them to the target networks."""
        super().__init__(config, buffer, seeds)
        for name in ("actor", "q"):
            self.add_target_network(name, config.target_interval, polyak=config.polyak)

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Return the losses of the critics and, every `policy_interval` updates, of the actor."""
        noise = self.noise(self.config.policy_noise)
        target_tm1 = self.targets(batch, noise)
        q_tm1 = self.models["q"](batch.observations.with_actions(batch.actions))
        td_loss = twin_regression(q_tm1, target_tm1)
        terms = {"mean_q": self.in_reward_units(q_tm1.detach().mean(0)), "td_loss": td_loss}
        is_due = self.step >= self.actor_starts and self.is_due(self.config.policy_interval)
        if not is_due and not self.is_reported:
            return {**terms, "loss": td_loss}
        with torch.set_grad_enabled(is_due):
            policy_terms = self.policy_losses(batch)
            smoothness_loss = self.smoothness_loss(batch, self.config.smoothness)
            anchor_loss = self.anchor_loss(batch, q_tm1)
        loss = td_loss + policy_terms["policy_loss"] + smoothness_loss + anchor_loss
        return {**terms, **policy_terms, "loss": loss}

    def policy_losses(self, batch: Batch) -> dict[str, Tensor]:
        """Return terms to log, among them `policy_loss` (R,), which the actor minimizes."""
        inputs = batch.observations.detached().with_actions(self.act(batch.observations))
        return {"policy_loss": -self.models["q"](inputs, frozen=True, members=1).squeeze(0)}

    @torch.no_grad()
    def targets(self, batch: Batch, noise: Tensor) -> Tensor:
        """Return the targets (R,) of the critics, with noise (R, n) on the next actions."""
        outputs = self.target_networks["actor"].model(batch.next_observations)
        next_actions = smoothed_actions(outputs.tanh(), noise, self.config.noise_clip)
        next_inputs = batch.next_observations.with_actions(next_actions)
        q_t = self.target_networks["q"].model(next_inputs)
        penalty = self.next_penalty(batch, next_actions)
        return clipped_double_q_target(batch.rewards, batch.discounts, q_t, penalty)

    def relative(self, values: Tensor) -> Tensor:
        """Divide values (R,) by the mean of their absolute values in each seed's batch."""
        return self.divided(
            values, self.batch_means(values.detach().abs()).clamp_min(_SMALLEST_VALUE)
        )
