"""Behavior cloning: predict the logged action of each state.

BC ignores rewards and is hard to beat on good logs, so it is a baseline for other algorithms. See
Pomerleau, "ALVINN: An Autonomous Land Vehicle in a Neural Network", 1988.
"""

from __future__ import annotations

from torch import Tensor

from mcaprl.offline.algorithms.config import BCConfig
from mcaprl.offline.algorithms.learner import Learner
from mcaprl.offline.algorithms.losses import cross_entropy
from mcaprl.offline.batches.buffer import Batch


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
