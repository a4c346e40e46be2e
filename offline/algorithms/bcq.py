"""Discrete batch-constrained Q-learning: Double DQN among the actions that the log would take.

    https://arxiv.org/abs/1910.01708    argmax_a Q(s, a) where G(a|s) / max_a G(a|s) >= threshold

G clones the behavior. Where the log never did a thing, its value is not asked for, neither for the
target nor when the policy acts.

Departures from the paper: Q and G are networks of their own for images, too; hard copies of the
target; Double DQN's target with the rest as in `dqn`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from mcaprl.offline.algorithms.config import TrainingConfig
from mcaprl.offline.algorithms.dqn import DQN, DQNConfig, temporal_difference
from mcaprl.offline.algorithms.learner import ActsBy, Losses
from mcaprl.offline.algorithms.losses import (
    allowed_only,
    bellman_target,
    best_actions,
    chosen,
    cross_entropy,
    likely_actions,
    mean_values,
    scaled,
    square_penalty,
)
from mcaprl.offline.batches.buffer import Batch


@dataclass(frozen=True)
class BCQConfig(DQNConfig):
    """Settings of discrete BCQ: those of DQN, and of its clone of the behavior."""

    threshold: float = 0.3
    """actions count if they are at least so likely as the likeliest; 0 is Double DQN, 1 cloning"""
    logits_penalty: float = 0.01
    """weight of the mean square of the clone's logits"""

    def __post_init__(self) -> None:
        """Refuse settings that cannot be meant."""
        super().__post_init__()
        self._require("threshold", 0 <= self.threshold <= 1, "within [0, 1]")
        self._require("logits_penalty", self.logits_penalty >= 0, "at least 0")


class BCQ(DQN):
    """Q-learning that chooses next actions among likely ones."""

    name = "bcq"
    config_type: ClassVar[type[TrainingConfig]] = BCQConfig
    acts_by: ClassVar[ActsBy] = "filtered_q_values"
    policy_models: ClassVar[tuple[str, ...]] = ("q", "logits")
    config: BCQConfig

    def output_shapes(self) -> dict[str, tuple[int, ...]]:
        """Values, and the clone's logits."""
        return {**super().output_shapes(), "logits": (self.n_actions,)}

    def losses(self, batch: Batch) -> Losses:
        """The loss of the temporal difference; for the clone its cross entropy."""
        q_tm1, q_t = self.learn_with_next("q", batch)
        logits_tm1, logits_t = self.learn_with_next("logits", batch)
        target_tm1 = self._targets(batch, q_t, logits_t)
        td_loss = temporal_difference(q_tm1, batch.actions, target_tm1)
        cloning = cross_entropy(logits_tm1, batch.actions)
        penalty = scaled(square_penalty(logits_tm1), self.config.logits_penalty)
        terms = {
            "mean_q": chosen(mean_values(q_tm1), batch.actions),
            "td_loss": td_loss.value,
            "cloning_loss": cloning.value,
            "loss": td_loss.value + cloning.value + penalty.value,
        }
        return Losses(terms, {"q": td_loss.slope, "logits": cloning.slope + penalty.slope})

    def targets(self, batch: Batch) -> Tensor:
        """The learning network chooses among likely actions, the target network judges."""
        q_t = self.outputs("q", batch.next_observations)
        return self._targets(batch, q_t, self.outputs("logits", batch.next_observations))

    def _targets(self, batch: Batch, q_t: Tensor, logits_t: Tensor) -> Tensor:
        likely = likely_actions(logits_t, self.config.threshold)
        q_t_selector = allowed_only(q_t, likely)
        q_t_value = self.target_outputs(batch)
        return bellman_target(batch.rewards, batch.discounts, q_t_value, best_actions(q_t_selector))
