"""Behavior cloning: choose in each situation what the log chose most often.

It reads no reward, and is hard to beat where the log is good: the mark to hold every algorithm
against that does. See Pomerleau, "ALVINN: An Autonomous Land Vehicle in a Neural Network", 1988.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from mcaprl.offline.algorithms.config import TrainingConfig
from mcaprl.offline.algorithms.learner import ActsBy, Learner, Losses
from mcaprl.offline.algorithms.losses import cross_entropy
from mcaprl.offline.batches.buffer import Batch


@dataclass(frozen=True)
class BCConfig(TrainingConfig):
    """Settings of behavior cloning: the shared ones."""


class BC(Learner):
    """A classifier of actions; its softmax estimates the policy that acted in the log."""

    name = "bc"
    config_type: ClassVar[type[TrainingConfig]] = BCConfig
    acts_by: ClassVar[ActsBy] = "logits"
    policy_models: ClassVar[tuple[str, ...]] = ("logits",)
    config: BCConfig

    def output_shapes(self) -> dict[str, tuple[int, ...]]:
        """A logit for each action."""
        return {"logits": (self.n_actions,)}

    def losses(self, batch: Batch) -> Losses:
        """The cross entropy, and how often the likeliest action is the logged one."""
        logits_tm1 = self.learn("logits", batch.observations)
        right = logits_tm1.argmax(1) == batch.actions
        loss = cross_entropy(logits_tm1, batch.actions)
        return Losses({"accuracy": right.float(), "loss": loss.value}, {"logits": loss.slope})
