"""Behavior cloning: take the action that the log takes most often in a state.

It reads no reward, and is hard to beat on good logs: the baseline for algorithms that do. See
Pomerleau, "ALVINN: An Autonomous Land Vehicle in a Neural Network", 1988.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from mcaprl.offline.algorithms.config import TrainingConfig
from mcaprl.offline.algorithms.learner import ActsBy, Learner
from mcaprl.offline.algorithms.losses import cross_entropy
from mcaprl.offline.batches.buffer import Batch


@dataclass(frozen=True)
class BCConfig(TrainingConfig):
    """Settings of behavior cloning: the shared ones."""


class BC(Learner):
    """A classifier of actions; its softmax estimates the behavior policy of the log."""

    name = "bc"
    config_type: ClassVar[type[TrainingConfig]] = BCConfig
    acts_by: ClassVar[ActsBy] = "logits"
    policy_models: ClassVar[tuple[str, ...]] = ("logits",)
    config: BCConfig

    def output_shapes(self) -> dict[str, tuple[int, ...]]:
        """Return one logit per action."""
        return {"logits": (self.n_actions,)}

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Return the cross entropy, and whether the most likely action is the logged one."""
        logits_tm1 = self.outputs("logits", batch.observations)
        correct = logits_tm1.argmax(1) == batch.actions
        return {"accuracy": correct.float(), "loss": cross_entropy(logits_tm1, batch.actions)}
