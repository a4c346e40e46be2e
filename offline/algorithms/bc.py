"""Behavior cloning: predict the logged action of each state.

BC ignores rewards and is hard to beat on good logs, so it is a baseline for other algorithms. See
Pomerleau, "ALVINN: An Autonomous Land Vehicle in a Neural Network", 1988.

With the setting `top`, only the episodes with the largest returns are learned from (10 % BC in
https://arxiv.org/abs/2106.01345). For the actions of a Box, the network outputs one action, a
Gaussian, or a mixture of Gaussians (https://arxiv.org/abs/2108.03298), which is the better choice
for demonstrations that do the same thing in several ways.
"""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

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

    def output_shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the shape of the logits."""
        return {"logits": (self.n_actions,)}

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Return the cross entropy, and whether the most likely action is the logged action."""
        logits_tm1 = self.outputs("logits", batch.observations)
        correct = logits_tm1.argmax(1) == batch.actions
        return {"accuracy": correct.float(), "loss": cross_entropy(logits_tm1, batch.actions)}


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
        return {"actor": self.head.output_shape(self.n_actions)}

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Return the mean squared error or the negative log density, and the absolute error.

        Both are those of actions that are scaled to [-1, 1].
        """
        outputs = self.models["actor"](batch.observations)
        error = self.head.best(outputs) - batch.actions
        if self.config.head == "deterministic":
            loss = error.square().mean(1)
        else:
            loss = -self.head.log_density(outputs, batch.actions)
        return {"action_error": error.detach().abs().mean(1), "loss": loss}
