"""Fitted Q evaluation: learn what a policy is worth from another's log.

    Le, Voloshin and Yue, "Batch policy learning under constraints", https://arxiv.org/abs/1903.08738

Q learns the target r + gamma sum_a pi(a|s') Q'(s', a), where pi is the policy in question and Q' a
copy of Q renewed every `target_interval` updates. A truncated episode would have gone on, so only
`terminated` ends the return.

Departure from the paper: gradient steps on random batches between two copies, not a fit to the end;
and targets are clipped to the returns that the logged rewards can add up to, since a network asked
about actions that the log never shows answers with anything.
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
from mcaprl.offline.losses import expected_sarsa
from mcaprl.offline.target import HardTarget

SYNCS_PER_HORIZON = 5.0
"""Fewer copies than 5 / (1 - gamma), and Q has not seen the end of its horizon."""


@dataclass(frozen=True)
class FQEConfig(TrainingConfig):
    """Settings of fitted Q evaluation."""

    updates: int = 10_000
    """gradient steps in all"""
    gamma: float = 0.97
    """discount of the reward one step later"""
    target_interval: int = 50
    """updates between two copies of the weights into the target network"""

    def __post_init__(self) -> None:
        """Refuse settings that cannot be meant."""
        super().__post_init__()
        self._require("gamma", 0 <= self.gamma <= 1, "within [0, 1]")
        self._require("target_interval", self.target_interval >= 1, "at least 1")

    @property
    def enough_syncs(self) -> bool:
        """Whether rewards have had the time to travel through the horizon.

        After k copies, Q can be (1 - gamma^k) / (1 - gamma) of the largest reward at most.
        """
        syncs = self.updates / self.target_interval
        return syncs * (1 - self.gamma) >= SYNCS_PER_HORIZON


class FQE(Learner):
    """A Q-network of a policy that is given."""

    name = "fqe"
    config_type: ClassVar[type[TrainingConfig]] = FQEConfig
    outputs: ClassVar[Outputs] = "q_values"
    config: FQEConfig

    def __init__(
        self, config: FQEConfig, buffer: TransitionBuffer, seed: int, pi_t: Tensor
    ) -> None:
        """Start with random weights, and the same ones as target.

        Args:
            config: settings.
            buffer: the log's N transitions.
            seed: of the weights and the batches.
            pi_t: (N, A) probabilities of the policy in question in each next state.
        """
        super().__init__(config, buffer, seed)
        self.pi_t = pi_t
        self.target = HardTarget(self.network, buffer, config.batch_size * config.target_interval)
        self.low, self.high = reachable(buffer.rewards, config.gamma)

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Half the squared temporal difference: unlike Huber's, its minimum is the mean target."""
        q_tm1 = self.network(batch.observations)
        q_t = self.target.values(batch).clamp(self.low, self.high)
        discount_t = self.config.gamma * batch.continues
        pi_t = self.pi_t.index_select(0, batch.rows)
        td = expected_sarsa(q_tm1, batch.actions, batch.rewards, discount_t, q_t, pi_t)
        return {"mean_q": q_tm1.detach().mean(), "loss": 0.5 * td.error.square().mean()}

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

    @torch.no_grad()
    def values(self, observations: Tensor) -> Tensor:
        """(N, A) the values of all actions, within what is reachable."""
        parts = [self.network(part) for part in torch.split(observations, 1024)]
        return torch.cat(parts).clamp(self.low, self.high)


def reachable(rewards: Tensor, gamma: float) -> tuple[float, float]:
    """The least and the most that rewards like these can add up to, from 1 step to endless ones."""
    steps = 1 / (1 - gamma) if gamma < 1 else float("inf")
    low, high = float(rewards.min()), float(rewards.max())
    return min(low, low * steps) if low else 0.0, max(high, high * steps) if high else 0.0
