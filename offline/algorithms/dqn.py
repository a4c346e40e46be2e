"""DQN and Double DQN on a fixed data set.

    DQN         https://doi.org/10.1038/nature14236   target r + gamma max_a Q'(s', a)
    Double DQN  https://arxiv.org/abs/1509.06461      target r + gamma Q'(s', argmax_a Q(s', a))
    quantiles   https://arxiv.org/abs/1710.10044      Q is the mean of `n_quantiles` learned ones

Q is the network that learns, Q' a copy of it renewed every `target_interval` updates.

Departures from the papers: the data are a log and not a growing replay buffer, so there is no
exploration; Adam takes the place of RMSProp; the learning rate falls to almost nothing, because no
new data come that a large one would help to follow. Neither algorithm knows which actions the log
never shows, and both overrate them: they are the baseline that CQL mends.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

from torch import Tensor

from mcaprl.offline.algorithms.config import BootstrapConfig, TrainingConfig
from mcaprl.offline.algorithms.learner import ActsBy, Learner, Losses
from mcaprl.offline.algorithms.losses import (
    Loss,
    allowed_only,
    chosen,
    double_q_learning_target,
    huber_regression,
    mean_values,
    q_learning_target,
    quantile_regression,
)
from mcaprl.offline.algorithms.networks import Architecture
from mcaprl.offline.batches.buffer import Batch, TransitionBuffer


@dataclass(frozen=True)
class DQNConfig(BootstrapConfig):
    """Settings of DQN."""

    dueling: bool = False
    """learn the value of a state apart from the advantages of its actions"""
    n_quantiles: int = 1
    """learn so many quantiles of the return, and act by their mean; 1 learns the mean alone"""

    def __post_init__(self) -> None:
        """Refuse settings that cannot be meant."""
        super().__post_init__()
        self._require("n_quantiles", self.n_quantiles >= 1, "at least 1")
        self._require("hidden", bool(self.hidden) or not self.dueling, "not empty if dueling")

    @property
    def architecture(self) -> Architecture:
        """What networks look like."""
        return replace(super().architecture, dueling=self.dueling)


@dataclass(frozen=True)
class DoubleDQNConfig(DQNConfig):
    """Settings of Double DQN: those of DQN."""


class DQN(Learner):
    """Q-learning with a target network."""

    name = "dqn"
    config_type: ClassVar[type[TrainingConfig]] = DQNConfig
    acts_by: ClassVar[ActsBy] = "q_values"
    policy_models: ClassVar[tuple[str, ...]] = ("q",)
    config: DQNConfig

    def __init__(self, config: DQNConfig, buffer: TransitionBuffer, seeds: Sequence[int]) -> None:
        """Start with random weights, and the same ones as target."""
        super().__init__(config, buffer, seeds)
        self.target = self.add_target("q", config.target_interval)

    def output_shapes(self) -> dict[str, tuple[int, ...]]:
        """A value for each action, or quantiles."""
        count = self.config.n_quantiles
        return {"q": (self.n_actions,) if count == 1 else (self.n_actions, count)}

    def losses(self, batch: Batch) -> Losses:
        """The loss of the temporal difference."""
        q_tm1, target_tm1 = self.learn_q(batch)
        td_loss = temporal_difference(q_tm1, batch.actions, target_tm1)
        q_a_tm1 = chosen(mean_values(q_tm1), batch.actions)
        return Losses({"mean_q": q_a_tm1, "loss": td_loss.value}, {"q": td_loss.slope})

    def judge(self, batch: Batch) -> dict[str, Tensor]:
        """The values of the actions taken, and how far they are from their targets."""
        q_a_tm1 = chosen(mean_values(self.outputs("q", batch.observations)), batch.actions)
        target_tm1 = self.targets(batch)
        mean_target_tm1 = target_tm1.mean(1) if target_tm1.ndim == 2 else target_tm1
        return {"q": q_a_tm1, "td_error": (mean_target_tm1 - q_a_tm1).abs()}

    def learn_q(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """Values (R, A) or quantiles (R, A, N) to be learned from, and the targets of some."""
        return self.learn("q", batch.observations), self.targets(batch)

    def targets(self, batch: Batch) -> Tensor:
        """The target network both chooses the next action and judges it."""
        return q_learning_target(batch.rewards, batch.discounts, self.target_outputs(batch))

    def target_outputs(self, batch: Batch) -> Tensor:
        """(R, A) values of the next states, or (R, A, N) quantiles, under the target network."""
        return allowed_only(self.target.outputs(batch), batch.next_observations.mask)


class DoubleDQN(DQN):
    """DQN whose learning network chooses the next action that the target network judges."""

    name = "double-dqn"
    config_type: ClassVar[type[TrainingConfig]] = DoubleDQNConfig
    config: DoubleDQNConfig

    def learn_q(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """What is learned from, and the next states' values, come out of one pass."""
        q_tm1, q_t_selector = self.learn_with_next("q", batch)
        return q_tm1, self._targets(batch, q_t_selector)

    def targets(self, batch: Batch) -> Tensor:
        """The learning network chooses, the target network judges."""
        return self._targets(batch, self.outputs("q", batch.next_observations))

    def _targets(self, batch: Batch, q_t_selector: Tensor) -> Tensor:
        q_t_value = self.target_outputs(batch)
        return double_q_learning_target(batch.rewards, batch.discounts, q_t_value, q_t_selector)


def temporal_difference(q_tm1: Tensor, a_tm1: Tensor, target_tm1: Tensor) -> Loss:
    """The regression of values (R, A), or quantiles (R, A, N), of actions to their targets."""
    regression = huber_regression if q_tm1.ndim == 2 else quantile_regression
    return regression(q_tm1, a_tm1, target_tm1)
