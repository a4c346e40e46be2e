"""TD3: twin critics of a deterministic actor, which learns less often than they do; and variants.

    https://arxiv.org/abs/1802.09477
        Q_e(s,a)  regression to r + gamma min_e Q'_e(s', a'), where a' = pi'(s') + clipped noise
        pi        minimize -Q_1(s, pi(s))
                  + smoothness |pi(s) - pi(s')|, https://arxiv.org/abs/2012.06644
                  + anchor (pi(s) - action of the continued policy)^2

Q' and pi' are target networks, averages of the learning networks. The actor and the target networks
are updated every `policy_interval` and `target_interval` updates of the critics.

Departure from the paper: the actor learns with the critics from before the update.

For learning from logs alone, TD3+BC has an actor that stays close to the logged actions:

    https://arxiv.org/abs/2106.06860
        pi        minimize |pi(s) - a_data|^2 - alpha Q_1(s, pi(s)) / mean |Q_1(s, pi(s))|

Departures from the paper: the target networks are averaged faster and the learning rate is larger
and decays, because logs of robots are small and are trained on for thousands of updates instead of
a million. The mean of |Q| is that of the batch before the update.

ReBRAC has two weights of cloning, and layer normalization in the critics:

    https://arxiv.org/abs/2305.09836
        Q_e(s,a)  regression to r + gamma (min_e Q'_e(s', a') - critic_weight |a' - a'_data|^2)
        pi        minimize actor_weight |pi(s) - a_data|^2 - Q(s, pi(s)) / mean |Q(s, pi(s))|

Here Q is the smaller one of the two critics, and a'_data is the logged action of the next state.
The last step of an episode has no next logged action; its penalty is 0.

Departures from the paper: batches of 256 instead of 1,024, three layers of 128 instead of 256, and
those of TD3+BC. The weights depend on the data in the paper; here they have one default.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from mcaprl.offline.algorithms.actor_critic import ActorCritic
from mcaprl.offline.algorithms.config import ReBRACConfig, TD3BCConfig, TD3Config
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


class TD3BC(TD3):
    """TD3 with behavior cloning."""

    name = "td3-bc"
    shares_encoder = False
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


class ReBRAC(TD3):
    """TD3 with a penalty on unlike actions in the loss of the actor and in the targets."""

    name = "rebrac"
    shares_encoder = False
    config_type = ReBRACConfig
    config: ReBRACConfig

    def policy_losses(self, batch: Batch) -> dict[str, Tensor]:
        """Return the actor's loss: the weighted squared distance minus the relative value."""
        actions = self.act(batch.observations)
        q = self.models["q"](batch.observations.with_actions(actions), frozen=True).amin(0)
        cloning_loss = (actions - batch.actions).square().sum(1)
        policy_loss = self.config.actor_weight * cloning_loss - self.relative(q)
        return {"cloning_loss": cloning_loss, "policy_loss": policy_loss}

    def next_penalty(self, batch: Batch, next_actions: Tensor) -> Tensor | float:
        """Return the weighted squared distances (R,) of next actions from the logged ones."""
        buffer = self.buffer
        next_rows = buffer.next_rows.index_select(0, batch.rows)
        logged = buffer.actions.index_select(0, next_rows.clamp_min(0))
        distance = (next_actions - logged).square().sum(1)
        return self.config.critic_weight * distance * (next_rows >= 0)
