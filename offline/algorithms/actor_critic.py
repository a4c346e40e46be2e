"""What the algorithms with an actor and two critics have in common, for the actions of a Box.

The actor maps an observation to the outputs of a head (`heads.BoxHead`). The critics, the twins of
TD3, are one ensemble of two networks Q(s, a).
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from mcaprl.architecture import Architecture
from mcaprl.offline.algorithms.config import ActorCriticConfig
from mcaprl.offline.algorithms.heads import BOX_HEADS
from mcaprl.offline.algorithms.learner import Learner
from mcaprl.offline.algorithms.losses import action_change, clipped_double_q_target
from mcaprl.offline.batches.buffer import Batch
from mcaprl.offline.batches.observations import Observations


class ActorCritic(Learner):
    """Learner with the models `actor` and `q`; a subclass defines the losses of both."""

    acts_by: str = "deterministic"
    policy_models = ("actor", "q")
    continuous = True
    critics = ("q",)
    config: ActorCriticConfig

    def output_shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the shapes of the actor's outputs, and of one value per critic."""
        return {"actor": BOX_HEADS[self.acts_by].output_shape(self.n_actions), "q": (1,)}

    def architecture_of(self, name: str) -> Architecture:
        """Return the architecture of a model; critics may have layer normalization alone."""
        normed = self.config.critic_layer_norm and name in self.critics
        return replace(self.architecture, layer_norm=self.architecture.layer_norm or normed)

    def act(self, observations: Observations) -> Tensor:
        """Return the actor's actions (R, n), in [-1, 1]."""
        return BOX_HEADS[self.acts_by].best(self.models["actor"](observations))

    def smoothness_loss(self, batch: Batch, weight: float) -> Tensor | float:
        """Return the weighted change (R,) of the actor's action until the next observation.

        With n-step returns, that is the observation n steps later.
        """
        if not weight:
            return 0.0
        actions, next_actions = self.act(batch.observations), self.act(batch.next_observations)
        return weight * action_change(actions, next_actions)

    def validate(self, batch: Batch) -> dict[str, Tensor]:
        """Return metrics of the values in units of the logged rewards, and the actor's error.

        In addition to the values of the logged actions and their TD errors, these are the values of
        the actor's actions, which show whether it exploits errors of the critics, and the mean
        absolute difference between both actions, which are scaled to [-1, 1].
        """
        q_tm1 = self.models["q"](batch.observations.with_actions(batch.actions)).amin(0)
        actions = self.act(batch.observations)
        policy_q = self.models["q"](batch.observations.with_actions(actions)).amin(0)
        terms = {
            "q": q_tm1,
            "td_error": (self.learned_targets(batch) - q_tm1).abs(),
            "policy_q": policy_q,
        }
        error = (actions - batch.actions).abs().mean(1)
        return {name: self.in_reward_units(x) for name, x in terms.items()} | {
            "action_error": error
        }

    @torch.no_grad()
    def learned_targets(self, batch: Batch) -> Tensor:
        """Return the targets (R,) of the critics, with the learning networks and without noise."""
        next_actions = self.act(batch.next_observations)
        q_t = self.models["q"](batch.next_observations.with_actions(next_actions))
        penalty = self.next_penalty(batch, next_actions)
        return clipped_double_q_target(batch.rewards, batch.discounts, q_t, penalty)

    def next_penalty(self, batch: Batch, next_actions: Tensor) -> Tensor | float:
        """Return the penalty (R,) that is subtracted from the values of next actions (R, n)."""
        return 0.0
