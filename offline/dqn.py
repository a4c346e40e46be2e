"""DQN and Double DQN on a fixed data set.

    DQN         https://doi.org/10.1038/nature14236   target r + gamma max_a Q'(s', a)
    Double DQN  https://arxiv.org/abs/1509.06461      target r + gamma Q'(s', argmax_a Q(s', a))

Q is the network that learns, Q' a copy of it renewed every `target_interval` updates.

Departures from the papers: the data are a log and not a growing replay buffer, so there is no
exploration; Adam takes the place of RMSProp; the learning rate falls to almost nothing, because no
new data come that a large one would help to follow. Neither algorithm knows which actions the log
never shows, and both overrate them: they are the baseline that CQL mends.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from mcaprl.offline.buffer import Batch, TransitionBuffer
from mcaprl.offline.config import TrainingConfig
from mcaprl.offline.learner import Learner, Outputs
from mcaprl.offline.losses import TemporalDifference, double_q_learning, huber, q_learning
from mcaprl.offline.target import HardTarget


@dataclass(frozen=True)
class DQNConfig(TrainingConfig):
    """Settings of DQN."""

    gamma: float = 0.97
    """discount of the reward one step later; 0.97 looks about 33 steps ahead"""
    target_interval: int = 500
    """updates between two copies of the weights into the target network"""

    def __post_init__(self) -> None:
        """Refuse settings that cannot be meant."""
        super().__post_init__()
        self._require("gamma", 0 <= self.gamma <= 1, "within [0, 1]")
        self._require("target_interval", self.target_interval >= 1, "at least 1")


@dataclass(frozen=True)
class DoubleDQNConfig(DQNConfig):
    """Settings of Double DQN: those of DQN."""


class DQN(Learner):
    """Q-learning with a target network."""

    name = "dqn"
    config_type: ClassVar[type[TrainingConfig]] = DQNConfig
    outputs: ClassVar[Outputs] = "q_values"
    config: DQNConfig

    def __init__(self, config: DQNConfig, buffer: TransitionBuffer, seed: int) -> None:
        """Start with random weights, and the same ones as target."""
        super().__init__(config, buffer, seed)
        rows_per_sync = config.batch_size * config.target_interval
        self.target = HardTarget(self.network, buffer, rows_per_sync)

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """The Huber loss of the temporal difference."""
        q_tm1 = self.network(batch.observations)
        td_loss = huber(self.temporal_difference(q_tm1, batch).error).mean()
        return {"mean_q": q_tm1.detach().mean(), "loss": td_loss}

    def temporal_difference(self, q_tm1: Tensor, batch: Batch) -> TemporalDifference:
        """The target network both chooses the next action and judges it."""
        discount_t = self.config.gamma * batch.continues
        q_t = self.target.values(batch)
        return q_learning(q_tm1, batch.actions, batch.rewards, discount_t, q_t)

    def update(self) -> dict[str, Tensor]:
        """Make one gradient step, then copy the weights into the target when it is due."""
        terms = super().update()
        if self.step % self.config.target_interval == 0:
            self.target.sync(self.network)
        return terms

    def networks(self) -> dict[str, nn.Module]:
        """The network that learns and its target."""
        return super().networks() | {"target": self.target.network}

    def load_state(self, tensors: Mapping[str, Tensor], step: int) -> None:
        """Go back to what `state` returned after `step` updates."""
        super().load_state(tensors, step)
        self.target.refresh()


class DoubleDQN(DQN):
    """DQN whose learning network chooses the next action that the target network judges."""

    name = "double-dqn"
    config_type: ClassVar[type[TrainingConfig]] = DoubleDQNConfig
    config: DoubleDQNConfig

    def temporal_difference(self, q_tm1: Tensor, batch: Batch) -> TemporalDifference:
        """The learning network chooses, the target network judges."""
        discount_t = self.config.gamma * batch.continues
        with torch.no_grad():
            q_t_selector = self.network(batch.next_observations)
        q_t_value = self.target.values(batch)
        return double_q_learning(
            q_tm1, batch.actions, batch.rewards, discount_t, q_t_value, q_t_selector
        )
