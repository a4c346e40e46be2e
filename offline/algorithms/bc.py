"""Behavior cloning: predict the logged action of each state.

BC ignores rewards and is hard to beat on good logs, so it is a baseline for other algorithms. See
Pomerleau, "ALVINN: An Autonomous Land Vehicle in a Neural Network", 1988.

With the setting `top`, only the episodes with the largest returns are learned from (10 % BC in
https://arxiv.org/abs/2106.01345). For the actions of a Box, the network outputs one action, a
Gaussian, or a mixture of Gaussians (https://arxiv.org/abs/2108.03298), which is the better choice
for demonstrations that do the same thing in several ways.

With the setting `chunk`, the network predicts the actions of the next H steps, which are masked in
the loss after the end of an episode; see `mcaprl.chunks`. A mixture is one of whole chunks, so that
the actions of a chunk are those of one way. Actions may be relative to observations; see
`offline.batches.relative`.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from mcaprl.errors import SpaceError
from mcaprl.offline.algorithms.config import BCConfig, BoxBCConfig
from mcaprl.offline.algorithms.heads import BOX_HEADS
from mcaprl.offline.algorithms.learner import Learner
from mcaprl.offline.algorithms.losses import cross_entropy
from mcaprl.offline.batches.buffer import Batch, TransitionBuffer


class BC(Learner):
    """Classifier of actions whose softmax estimates the behavior policy of the log."""

    name = "bc"
    config_type = BCConfig
    acts_by = "logits"
    policy_models = ("logits",)
    can_be_captured = True
    config: BCConfig

    def __init__(self, config: BCConfig, buffer: TransitionBuffer, seeds: Sequence[int]) -> None:
        """Initialize the networks with random weights."""
        if config.chunk > 1 and buffer.encoder.mask is not None:
            raise SpaceError(
                "a chunk of actions needs the masks of the next steps, which are not known when it"
                " is predicted: use a chunk of 1"
            )
        super().__init__(config, buffer, seeds)

    def output_shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the shape of the logits."""
        chunk = (self.config.chunk,) if self.config.chunk > 1 else ()
        return {"logits": (*chunk, self.n_actions)}

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Return the cross entropy, and whether the most likely action is the logged action."""
        logits_tm1 = self.outputs("logits", batch.observations)
        if self.config.chunk == 1:
            correct = logits_tm1.argmax(1) == batch.actions
            return {"accuracy": correct.float(), "loss": cross_entropy(logits_tm1, batch.actions)}
        actions, exist = self.buffer.chunks(batch.rows)
        correct = logits_tm1.argmax(2) == actions
        each = cross_entropy(logits_tm1.flatten(0, 1), actions.flatten()).view(actions.shape)
        return {"accuracy": _mean(correct.float(), exist), "loss": (each * exist).sum(1)}


class BoxBC(Learner):
    """Regression to the logged actions of a Box, or the most likely distribution of them."""

    name = "bc"
    config_type = BoxBCConfig
    acts_by = "deterministic"
    policy_models = ("actor",)
    continuous = True
    config: BoxBCConfig

    def __init__(self, config: BoxBCConfig, buffer: TransitionBuffer, seeds: Sequence[int]) -> None:
        """Initialize the networks with random weights."""
        self.acts_by = config.head
        self.head = BOX_HEADS[config.head]
        super().__init__(config, buffer, seeds)

    def output_shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the shape of the outputs of the head."""
        return {"actor": self.head.output_shape(self.config.chunk * self.n_actions)}

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Return the squared error or negative log density, and the absolute error, in [-1, 1]."""
        outputs = self.models["actor"](batch.observations)
        actions, known = batch.actions, torch.ones_like(batch.actions)
        relative = self.buffer.relative
        if self.config.chunk > 1 or relative is not None:
            found, exist = self.buffer.chunks(batch.rows)
            if relative is not None:
                # Only those of held-out episodes are outside.
                found = relative.numbers(found, batch.observations.vector).clamp(-1, 1)
            actions, known = found.flatten(1), exist.repeat_interleave(self.n_actions, 1).float()
        error = self.head.best(outputs) - actions
        if self.config.head == "deterministic":
            loss = (error.square() * known).mean(1)
        else:
            loss = -self.head.log_density(outputs, actions, known=known)
        return {"action_error": _mean(error.detach().abs(), known), "loss": loss}


def _mean(values: Tensor, exist: Tensor) -> Tensor:
    """Return the mean (R,) of the values (R, X) that exist; the first one of a row always does."""
    return (values * exist).sum(1) / exist.sum(1)
