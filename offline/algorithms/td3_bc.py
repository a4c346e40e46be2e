"""TD3+BC: the actor maximizes the value of its actions, and stays close to the logged actions.

    https://arxiv.org/abs/2106.06860
        Q_e(s,a)  regression to r + gamma min_e Q'_e(s', a'), where a' = pi'(s') + clipped noise
        pi        minimize |pi(s) - a_data|^2 - alpha Q_1(s, pi(s)) / mean |Q_1(s, pi(s))|

Q' and pi' are target networks, averages of the learning networks. The actor and the target networks
are updated every `policy_interval` and `target_interval` updates of the critics
(https://arxiv.org/abs/1802.09477).

Departures from the paper: the target networks are averaged faster and the learning rate is larger
and decays, because logs of robots are small and are trained on for thousands of updates instead of
a million. The mean of |Q| is that of the batch before the update.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from mcaprl.offline.algorithms.actor_critic import ActorCritic
from mcaprl.offline.algorithms.config import TD3BCConfig, TD3Config
from mcaprl.offline.algorithms.losses import (
    clipped_double_q_target,
    smoothed_actions,
    twin_regression,
)
from mcaprl.offline.batches.buffer import Batch, TransitionBuffer

_SMALLEST_VALUE = 1e-6


class TD3(ActorCritic):
    """Twin critics of a deterministic actor; a subclass defines the actor's loss."""

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
        is_due = self.is_due(self.config.policy_interval)
        if not is_due and not self.is_reported:
            return {**terms, "loss": td_loss}
        with torch.set_grad_enabled(is_due):
            policy_terms = self.policy_losses(batch)
        return {**terms, **policy_terms, "loss": td_loss + policy_terms["policy_loss"]}

    def policy_losses(self, batch: Batch) -> dict[str, Tensor]:
        """Return terms to log, among them `policy_loss` (R,), which the actor minimizes."""
        raise NotImplementedError

    @torch.no_grad()
    def targets(self, batch: Batch, noise: Tensor) -> Tensor:
        """Return the targets (R,) of the critics, with noise (R, n) on the next actions."""
        outputs = self.target_networks["actor"].model(batch.next_observations)
        next_actions = smoothed_actions(outputs.tanh(), noise, self.config.noise_clip)
        next_inputs = batch.next_observations.with_actions(next_actions)
        q_t = self.target_networks["q"].model(next_inputs)
        penalty = self.next_penalty(batch, next_actions)
        return clipped_double_q_target(batch.rewards, batch.discounts, q_t, penalty)

    @torch.no_grad()
    def learned_targets(self, batch: Batch) -> Tensor:
        """Return the targets (R,), computed with the learning networks and without noise."""
        next_actions = self.act(batch.next_observations)
        q_t = self.models["q"](batch.next_observations.with_actions(next_actions))
        penalty = self.next_penalty(batch, next_actions)
        return clipped_double_q_target(batch.rewards, batch.discounts, q_t, penalty)

    def next_penalty(self, batch: Batch, next_actions: Tensor) -> Tensor | float:
        """Return the penalty (R,) that is subtracted from the values of next actions (R, n)."""
        return 0.0

    def relative(self, values: Tensor) -> Tensor:
        """Divide values (R,) by the mean of their absolute values in each seed's batch."""
        return self.divided(
            values, self.batch_means(values.detach().abs()).clamp_min(_SMALLEST_VALUE)
        )


class TD3BC(TD3):
    """TD3 with behavior cloning."""

    name = "td3-bc"
    config_type = TD3BCConfig
    config: TD3BCConfig

    def policy_losses(self, batch: Batch) -> dict[str, Tensor]:
        """Return the actor's loss: the squared error minus alpha times the relative value."""
        actions = self.act(batch.observations)
        inputs = batch.observations.with_actions(actions)
        q = self.models["q"](inputs, frozen=True, members=1).squeeze(0)
        cloning_loss = (actions - batch.actions).square().mean(1)
        policy_loss = cloning_loss - self.config.alpha * self.relative(q)
        return {"cloning_loss": cloning_loss, "policy_loss": policy_loss}
