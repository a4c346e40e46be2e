"""Conservative Q-learning, CQL(H): Double DQN that lowers the values of actions not in the log.

    https://arxiv.org/abs/2006.04779    Double DQN + alpha (logsumexp_a Q(s, a) - Q(s, a_data))

The second term is a penalty that keeps the greedy policy close to the logged actions.

Departures from the paper: by default, the network learns mean values; with `n_quantiles` above 1,
it learns quantiles, like the paper's Atari agent. The weight alpha is fixed instead of tuned by a
Lagrange multiplier. The target is that of Double DQN.
"""

from __future__ import annotations

from torch import Tensor

from mcaprl.offline.algorithms.config import CQLConfig
from mcaprl.offline.algorithms.dqn import DoubleDQN
from mcaprl.offline.algorithms.losses import (
    chosen,
    cross_entropy,
    mean_values,
    temporal_difference_loss,
)
from mcaprl.offline.batches.buffer import Batch


class CQL(DoubleDQN):
    """Double DQN with a penalty on the values of actions that are not in the data."""

    name = "cql"
    config_type = CQLConfig
    config: CQLConfig

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Return the loss of Double DQN plus alpha times the penalty."""
        q_tm1 = self.outputs("q", batch.observations)
        mean_q_tm1 = mean_values(q_tm1)
        target_tm1 = self.targets(batch, self.target_outputs(batch))
        td_loss = temporal_difference_loss(q_tm1, batch.actions, target_tm1)
        penalty = cross_entropy(mean_q_tm1, batch.actions)
        return {
            "mean_q": self.in_reward_units(chosen(mean_q_tm1, batch.actions)),
            "td_loss": td_loss,
            "conservative_penalty": penalty,
            "loss": td_loss + self.config.alpha * penalty,
        }
