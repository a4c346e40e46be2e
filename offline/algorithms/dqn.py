"""DQN and Double DQN on a fixed dataset.

    DQN         https://doi.org/10.1038/nature14236   target r + gamma max_a Q'(s', a)
    Double DQN  https://arxiv.org/abs/1509.06461      target r + gamma Q'(s', argmax_a Q(s', a))
    quantiles   https://arxiv.org/abs/1710.10044      Q is the mean of `n_quantiles` quantiles

Q is the learning network. Q' is the target network, which is synced every `target_interval`
updates.

Departures from the papers: the data are a fixed log, so there is no exploration. Adam replaces
RMSProp. The learning rate decays to almost 0, because no new data arrive. Both algorithms
overestimate actions that are not in the log, so they are baselines for CQL.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import torch
from torch import Tensor

from mcaprl.offline.algorithms.config import DoubleDQNConfig, DQNConfig
from mcaprl.offline.algorithms.learner import Learner
from mcaprl.offline.algorithms.losses import (
    allowed_only,
    chosen,
    double_q_learning_target,
    mean_values,
    q_learning_target,
    temporal_difference_loss,
)
from mcaprl.offline.batches.buffer import Batch, TransitionBuffer


class DQN(Learner):
    """Q-learning with a target network."""

    name = "dqn"
    config_type = DQNConfig
    acts_by: str = "q_values"
    policy_models: ClassVar[tuple[str, ...]] = ("q",)
    can_be_captured = True
    config: DQNConfig

    def __init__(self, config: DQNConfig, buffer: TransitionBuffer, seeds: Sequence[int]) -> None:
        """Initialize the network with random weights, and copy them to the target network."""
        super().__init__(config, buffer, seeds)
        self.target_network = self.add_target_network("q", config.target_interval)

    def output_shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the shape of the values or quantiles of all actions."""
        count = self.config.n_quantiles
        return {"q": (self.n_actions,) if count == 1 else (self.n_actions, count)}

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Return the temporal-difference loss."""
        q_tm1 = self.outputs("q", batch.observations)
        target_tm1 = self.targets(batch, self.target_outputs(batch))
        td_loss = temporal_difference_loss(q_tm1, batch.actions, target_tm1)
        mean_q = self.in_reward_units(chosen(mean_values(q_tm1), batch.actions))
        return {"mean_q": mean_q, "loss": td_loss}

    def validate(self, batch: Batch) -> dict[str, Tensor]:
        """Return the values of the logged actions, and their absolute TD errors."""
        # The target network is not used: it may be up to date in one validation and outdated in the
        # next.
        q_a_tm1 = chosen(mean_values(self.outputs("q", batch.observations)), batch.actions)
        target_tm1 = self.targets(batch, self.outputs("q", batch.next_observations))
        mean_target_tm1 = target_tm1.mean(1) if target_tm1.ndim == 2 else target_tm1
        terms = {"q": q_a_tm1, "td_error": (mean_target_tm1 - q_a_tm1).abs()}
        return {name: self.in_reward_units(term) for name, term in terms.items()}

    @torch.no_grad()
    def targets(self, batch: Batch, q_t: Tensor) -> Tensor:
        """Return targets (R,) for values, or (R, N) for quantiles (R, A, N), of next states."""
        return q_learning_target(batch.rewards, batch.discounts, q_t)

    def target_outputs(self, batch: Batch) -> Tensor:
        """Return the target network's values (R, A) or quantiles (R, A, N) of the next states."""
        return allowed_only(self.target_network.outputs(batch), batch.next_observations.mask)


class DoubleDQN(DQN):
    """DQN in which the learning network selects the next action."""

    name = "double-dqn"
    config_type = DoubleDQNConfig
    config: DoubleDQNConfig

    @torch.no_grad()
    def targets(self, batch: Batch, q_t: Tensor) -> Tensor:
        """Return the targets. The learning network selects actions, and `q_t` evaluates them."""
        q_t_selector = self.outputs("q", batch.next_observations)
        return double_q_learning_target(batch.rewards, batch.discounts, q_t, q_t_selector)
