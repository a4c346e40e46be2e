"""What the algorithms with an actor and two critics have in common, for the actions of a Box.

The actor maps an observation to the outputs of a head (`heads.BoxHead`). The critics, the twins of
TD3, are one ensemble of two networks Q(s, a).

Where `shares_encoder` is set, all networks see images through one encoder, which learns from the
losses of the critics alone, as in "Image Augmentation Is All You Need" and "Improving Sample
Efficiency in Model-Free Reinforcement Learning from Images" (https://arxiv.org/abs/2004.13649,
https://arxiv.org/abs/1910.01741). There is no target network of the encoder, as in DrQ-v2
(https://arxiv.org/abs/2107.09645).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import ClassVar

import torch
from torch import Tensor

from mcaprl.architecture import Architecture
from mcaprl.networks import ImageInput, Network
from mcaprl.offline.algorithms.config import ActorCriticConfig
from mcaprl.offline.algorithms.heads import BOX_HEADS, ENCODER, FEATURES, encoded
from mcaprl.offline.algorithms.learner import Learner
from mcaprl.offline.algorithms.losses import action_change, clipped_double_q_target
from mcaprl.offline.algorithms.models import Model
from mcaprl.offline.batches.buffer import Batch
from mcaprl.offline.batches.observations import Observations


class ActorCritic(Learner):
    """Learner with the models `actor` and `q`; a subclass defines the losses of both."""

    acts_by: str = "deterministic"
    policy_models = ("actor", "q")
    continuous = True
    critics = ("q",)
    shares_encoder: ClassVar[bool] = False
    actor_starts = 0  # Number of updates before the first one of the actor
    # Actor, and encoder if there is one, of the policy that training continues.
    first_models: Mapping[str, Model] = MappingProxyType({})
    _anchor = 0.0
    _first_actions: Tensor
    config: ActorCriticConfig

    def continue_actor(self, starts: int, rate: float, anchor: float) -> None:
        """Continue the current policy: train the critics alone at first, and the actor slowly."""
        # The critics have errors beside the actions that they learned from, and an actor that
        # learns at once follows these errors, as one does that goes far from these actions.
        self.actor_starts, self._anchor = starts, anchor
        self.set_rate_factor("actor", rate)
        if anchor:
            names = [name for name in ("actor", ENCODER) if name in self.models]
            self.first_models = {name: self.models[name].clone() for name in names}

    def all_models(self) -> dict[str, Model]:
        """Return the learning models, the target networks and `first_models` by name."""
        first = {f"{name}_first": model for name, model in self.first_models.items()}
        return {**super().all_models(), **first}

    def output_shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the shapes of the actor's outputs, and of one value per critic."""
        encoder = {ENCODER: (FEATURES,)} if self._has_encoder else {}
        outputs = BOX_HEADS[self.acts_by].output_shape(self.n_actions)
        return {"actor": outputs, "q": (1,), **encoder}

    @property
    def _has_encoder(self) -> bool:
        return self.shares_encoder and bool(self.buffer.image_inputs)

    def inputs_of(self, name: str) -> tuple[int, Sequence[ImageInput]]:
        """Return the length of the vectors and the images that a model receives."""
        width, images = super().inputs_of(name)
        if not self._has_encoder:
            return width, images
        return (0, images) if name == ENCODER else (FEATURES + width, ())

    def inputs(self, observations: Observations) -> Observations:
        """Return the observations with the features of the encoder in place of images."""
        return encoded(self.models[ENCODER], observations) if self._has_encoder else observations

    def encoded(self, batch: Batch) -> Batch:
        """Return a batch with the networks' `inputs`; only observations have gradients."""
        if self.first_models:
            self._first_actions = self._actions_of_first(batch.observations)
        if not self._has_encoder:
            return batch
        with torch.no_grad():
            next_observations = self.inputs(batch.next_observations)
        observations = self.inputs(batch.observations)
        return replace(batch, observations=observations, next_observations=next_observations)

    def policy_networks(self, seed: int) -> dict[str, Network]:
        """Return the networks of one seed that its policy needs, with their current weights."""
        encoder = {ENCODER: self.network(ENCODER, seed)} if self._has_encoder else {}
        return {**super().policy_networks(seed), **encoder}

    def architecture_of(self, name: str) -> Architecture:
        """Return the architecture of a model; critics may have layer normalization alone."""
        if name == ENCODER:
            return self.architecture.of_encoder()
        normed = self.config.critic_layer_norm and name in self.critics
        return replace(self.architecture, layer_norm=self.architecture.layer_norm or normed)

    def act(self, observations: Observations) -> Tensor:
        """Return the actor's actions (R, n), in [-1, 1], without gradients of the encoder."""
        return BOX_HEADS[self.acts_by].best(self.models["actor"](observations.detached()))

    def smoothness_loss(self, batch: Batch, weight: float) -> Tensor | float:
        """Return the weighted change (R,) of the actor's action until the next observation."""
        if not weight:
            return 0.0
        actions, next_actions = self.act(batch.observations), self.act(batch.next_observations)
        return weight * action_change(actions, next_actions)

    @torch.no_grad()
    def _actions_of_first(self, observations: Observations) -> Tensor:
        if self._has_encoder:
            observations = encoded(self.first_models[ENCODER], observations)
        return BOX_HEADS[self.acts_by].best(self.first_models["actor"](observations))

    def anchor_loss(self, batch: Batch, q_tm1: Tensor) -> Tensor | float:
        """Return the weighted squared difference (R,) from the actions of the continued policy."""
        # The weight is multiplied by the mean absolute value (2, R) of the logged actions, so that
        # it has no unit.
        if not self.first_models:
            return 0.0
        change = (self.act(batch.observations) - self._first_actions).square().mean(1)
        scale = self.batch_means(q_tm1.detach().abs().mean(0))
        return self._anchor * scale.repeat_interleave(len(change) // len(scale)) * change

    def validate(self, batch: Batch) -> dict[str, Tensor]:
        """Return metrics of the values in units of the logged rewards, and the actor's error."""
        # The values of the actor's actions show whether it exploits errors of the critics.
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
