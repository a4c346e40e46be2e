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

from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar

import torch
from torch import Tensor

from mcaprl.architecture import Architecture
from mcaprl.networks import ImageInput, Network
from mcaprl.offline.algorithms.config import ActorCriticConfig
from mcaprl.offline.algorithms.heads import BOX_HEADS, ENCODER, FEATURES, encoded
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
    shares_encoder: ClassVar[bool] = False
    actor_starts = 0
    config: ActorCriticConfig

    def continue_actor(self, starts: int, rate: float) -> None:
        """Continue a given policy: train the critics alone at first, and the actor more slowly.

        The critics have errors beside the actions that they learned from, and an actor that learns
        at once follows these errors.

        Args:
            starts: Number of updates before the first one of the actor.
            rate: Learning rate of the actor, as a multiple of the critics'.
        """
        self.actor_starts = starts
        self.set_rate_factor("actor", rate)

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
        """Return a batch of the buffer with the `inputs` of the networks, for `losses`.

        Gradients flow to the encoder from the observations, and not from the next ones.
        """
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
