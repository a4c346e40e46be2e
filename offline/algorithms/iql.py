"""Implicit Q-learning; only logged actions are evaluated.

    https://arxiv.org/abs/2110.06169
        V(s)    expectile regression to Q'(s, a_data): close to the value of the best logged action
        Q(s,a)  regression to r + gamma V(s')
        pi      behavior cloning, each action weighted with exp(beta A(s, a))
        A(s, a) Q'(s, a) - V(s)

Two networks Q learn from the same targets. Each has a target network, and Q' is the minimum of the
two target networks. They are synced every `target_interval` updates.

Departures from the paper: by default, advantages are divided by their root mean square, because
their size differs between tasks; with `normalize_advantages=False`, they are those of the paper.
With a finite action space, the policy is a classifier and Q has one output per action, and target
networks are synced at intervals instead of averaged. With a Box, the policy is a normal
distribution with the same deviations in all states, as in the paper, but truncated to the Box, so
that its density integrates to one there; its learning rate decays as that of the other networks,
and the target networks are averaged faster.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from mcaprl.offline.algorithms.actor_critic import ActorCritic
from mcaprl.offline.algorithms.config import BoxIQLConfig, IQLConfig
from mcaprl.offline.algorithms.heads import Gaussian
from mcaprl.offline.algorithms.learner import Learner
from mcaprl.offline.algorithms.losses import (
    chosen,
    cross_entropy,
    expectile_regression,
    square_regression,
    twin_regression,
)
from mcaprl.offline.batches.buffer import Batch, TransitionBuffer

MAX_WEIGHT = 100.0  # Maximum weight of an action in the policy's loss, as in the paper's code
_SMALLEST_ADVANTAGE = 1e-6
"""Root mean square up to which advantages count as equal, because of rounding errors."""
_TWINS = ("q", "q_twin")
LOG_STD = "log_std"  # Name of the deviations in `Learner.scalars`, before `heads.bounded_log_std`


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
            square_regression(
                chosen(self.outputs(name, batch.observations), batch.actions), target_tm1
            )
            for name in _TWINS
        )
        weight = advantage_weights(self, q_a_tm1 - v_tm1.detach().squeeze(1))
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

    @torch.no_grad()
    def targets(self, batch: Batch) -> Tensor:
        """Return the targets (R,) of Q: r + gamma V(s')."""
        v_t = self.models["v"](batch.next_observations).squeeze(1)
        return batch.rewards + batch.discounts * v_t


class BoxIQL(ActorCritic):
    """Implicit Q-learning of the actions of a Box."""

    name = "iql"
    config_type = BoxIQLConfig
    acts_by = "gaussian"
    config: BoxIQLConfig

    def __init__(
        self, config: BoxIQLConfig, buffer: TransitionBuffer, seeds: Sequence[int]
    ) -> None:
        """Initialize the networks with random weights, and copy the critics to their targets."""
        super().__init__(config, buffer, seeds)
        self.add_scalar(LOG_STD, 0.0, 1.0, size=self.n_actions)
        self.add_target_network("q", config.target_interval, polyak=config.polyak)

    def output_shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the shapes of the policy's means, of the critics, and of V."""
        return {"actor": (self.n_actions,), "q": (1,), "v": (1,)}

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Return the losses of V, Q and the policy. The three share no weights."""
        inputs = batch.observations.with_actions(batch.actions)
        with torch.no_grad():
            q_a_tm1 = self.target_networks["q"].model(inputs).amin(0)
        v_tm1 = self.models["v"](batch.observations)
        v_loss = expectile_regression(v_tm1, q_a_tm1, self.config.expectile)
        td_loss = twin_regression(self.models["q"](inputs), self.learned_targets(batch))
        weight = advantage_weights(self, q_a_tm1 - v_tm1.detach().squeeze(1))
        outputs = self.models["actor"](batch.observations)
        log_std = self.scalar_rows(LOG_STD, batch, self.n_actions)
        policy_loss = -weight * Gaussian.log_density(outputs, batch.actions, log_std)
        return {
            "mean_q": self.in_reward_units(q_a_tm1),
            "value_loss": v_loss,
            "td_loss": td_loss,
            "policy_loss": policy_loss,
            "loss": v_loss + td_loss + policy_loss,
        }

    @torch.no_grad()
    def learned_targets(self, batch: Batch) -> Tensor:
        """Return the targets (R,) of Q: r + gamma V(s')."""
        v_t = self.models["v"](batch.next_observations).squeeze(1)
        return batch.rewards + batch.discounts * v_t


def advantage_weights(learner: IQL | BoxIQL, advantages: Tensor) -> Tensor:
    """Return exp(beta A) of advantages (R,), at most `MAX_WEIGHT`."""
    # If the settings say so, those of a seed are first divided by their root mean square.
    config = learner.config
    if config.normalize_advantages:
        advantages = normalized(learner, advantages)
    return (config.beta * advantages).exp().clamp(max=MAX_WEIGHT)


def normalized(learner: Learner, advantages: Tensor) -> Tensor:
    """Divide the advantages (R,) of each seed by their root mean square in the seed's batch."""
    squares = learner.batch_means(advantages.square())
    return learner.divided(advantages, squares.sqrt().clamp_min(_SMALLEST_ADVANTAGE))
