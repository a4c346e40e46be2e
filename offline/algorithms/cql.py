"""Conservative Q-learning, CQL(H): Double DQN that trusts no action the log does not show.

    https://arxiv.org/abs/2006.04779    Double DQN + alpha (logsumexp_a Q(s, a) - Q(s, a_data))

The second term lowers the values of actions that the data do not hold, so that the greedy policy
stays with what was seen to work.

Departures from the paper: values are plain means unless `n_quantiles` is above 1, as they are in
its Atari agent; alpha is fixed and not tuned by a Lagrange multiplier; the target is that of Double
DQN.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from mcaprl.offline.algorithms.config import TrainingConfig
from mcaprl.offline.algorithms.dqn import DoubleDQN, DoubleDQNConfig, temporal_difference
from mcaprl.offline.algorithms.learner import Losses
from mcaprl.offline.algorithms.losses import Loss, chosen, cross_entropy, mean_values
from mcaprl.offline.batches.buffer import Batch


@dataclass(frozen=True)
class CQLConfig(DoubleDQNConfig):
    """Settings of CQL: those of Double DQN and alpha."""

    alpha: float = 1.0
    """weight of the penalty on actions that the data do not show; 0 is Double DQN"""

    def __post_init__(self) -> None:
        """Refuse settings that cannot be meant."""
        super().__post_init__()
        self._require("alpha", self.alpha >= 0, "at least 0")


class CQL(DoubleDQN):
    """Double DQN with a penalty on the values of unseen actions."""

    name = "cql"
    config_type: ClassVar[type[TrainingConfig]] = CQLConfig
    config: CQLConfig

    def losses(self, batch: Batch) -> Losses:
        """The loss of Double DQN plus alpha times the penalty."""
        q_tm1, target_tm1 = self.learn_q(batch)
        td_loss = temporal_difference(q_tm1, batch.actions, target_tm1)
        penalty = conservative_penalty(q_tm1, batch.actions)
        alpha = self.config.alpha
        terms = {
            "mean_q": chosen(mean_values(q_tm1), batch.actions),
            "td_loss": td_loss.value,
            "conservative_penalty": penalty.value,
            "loss": td_loss.value + alpha * penalty.value,
        }
        return Losses(terms, {"q": td_loss.slope.add_(penalty.slope, alpha=alpha)})


def conservative_penalty(q_tm1: Tensor, a_tm1: Tensor) -> Loss:
    """`cross_entropy` of the values; of quantiles (B, A, N), of their means.

    Args:
        q_tm1: (B, A) values, or (B, A, N) quantiles, of the network that learns.
        a_tm1: (B,) int64 actions of the data.
    """
    value, slope = cross_entropy(mean_values(q_tm1), a_tm1)
    if q_tm1.ndim == 2:
        return Loss(value, slope)
    return Loss(value, slope.unsqueeze(2).expand_as(q_tm1) / q_tm1.shape[2])
