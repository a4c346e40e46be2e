"""Behavior cloning: choose in each situation what the log chose most often.

It reads no reward, and is hard to beat where the log is good: the mark to hold every algorithm
against that does. See Pomerleau, "ALVINN: An Autonomous Land Vehicle in a Neural Network", 1988.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from mcaprl.offline.buffer import Batch
from mcaprl.offline.config import TrainingConfig
from mcaprl.offline.learner import Learner, Outputs
from mcaprl.offline.losses import behavior_cloning


@dataclass(frozen=True)
class BCConfig(TrainingConfig):
    """Settings of behavior cloning: the shared ones."""


class BC(Learner):
    """A classifier of actions; its softmax estimates the policy that acted in the log."""

    name = "bc"
    config_type: ClassVar[type[TrainingConfig]] = BCConfig
    outputs: ClassVar[Outputs] = "logits"
    config: BCConfig

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """The cross entropy, and how often the likeliest action is the logged one."""
        logits_tm1 = self.network(batch.observations)
        right = logits_tm1.detach().argmax(1) == batch.actions
        loss = behavior_cloning(logits_tm1, batch.actions).mean()
        return {"accuracy": right.float().mean(), "loss": loss}
