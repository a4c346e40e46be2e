"""Conservative Q-learning, CQL(H): Double DQN that trusts no action the log does not show.

    https://arxiv.org/abs/2006.04779    Double DQN + alpha (logsumexp_a Q(s, a) - Q(s, a_data))

The second term lowers the values of actions that the data do not hold, so that the greedy policy
stays with what was seen to work.

Departures from the paper: its Atari agent has a quantile head, here values are plain means; alpha
is fixed and not tuned by a Lagrange multiplier; the target is that of Double DQN.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from mcaprl.offline.buffer import Batch
from mcaprl.offline.config import TrainingConfig
from mcaprl.offline.dqn import DoubleDQN, DoubleDQNConfig
from mcaprl.offline.losses import conservative_penalty, huber


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

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """The loss of Double DQN plus alpha times the penalty."""
        q_tm1 = self.network(batch.observations)
        td_loss = huber(self.temporal_difference(q_tm1, batch).error).mean()
        penalty = conservative_penalty(q_tm1, batch.actions).mean()
        return {
            "mean_q": q_tm1.detach().mean(),
            "td_loss": td_loss,
            "conservative_penalty": penalty,
            "loss": td_loss + self.config.alpha * penalty,
        }
