"""Fitted Q evaluation: learn the value of a policy from the log of another policy.

    Le, Voloshin and Yue, "Batch policy learning under constraints", https://arxiv.org/abs/1903.08738

Q learns the target r + gamma sum_a pi(a|s') Q'(s', a), where pi is the evaluated policy and Q' is
the target network, which is synced every `target_interval` updates. A truncated episode would have
continued, so only `terminated` ends the return.

Departures from the paper: gradient steps on random batches between two syncs replace a fit to
convergence. Targets are clipped to the range of possible returns, because the network's values of
actions that are not in the log are arbitrary.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from mcaprl.offline.algorithms.config import TrainingConfig
from mcaprl.offline.algorithms.learner import Learner
from mcaprl.offline.algorithms.losses import chosen, expected_sarsa_target, square_regression
from mcaprl.offline.algorithms.models import outputs_of_buffer
from mcaprl.offline.batches.buffer import Batch, TransitionBuffer
from mcaprl.offline.batches.packing import Packing

SYNCS_PER_HORIZON = 5.0
"""Minimum number of syncs per effective horizon 1 / (1 - gamma) after which Q can converge."""


@dataclass(frozen=True)
class FQEConfig(TrainingConfig):
    """Settings of fitted Q evaluation."""

    updates: int = 10_000
    """number of gradient updates"""
    gamma: float = 0.97
    """discount per step"""
    target_interval: int = 50
    """updates between two syncs of the target network"""

    def __post_init__(self) -> None:
        """Validate the settings."""
        super().__post_init__()
        self._require("gamma", 0 <= self.gamma <= 1, "within [0, 1]")
        self._require("target_interval", self.target_interval >= 1, "at least 1")

    @property
    def packing(self) -> Packing:
        """Settings by which the log is divided into single-step transitions.

        n-step returns are not used, because they depend on the behavior policy.
        """
        return Packing(gamma=self.gamma)

    @property
    def enough_syncs(self) -> bool:
        """Whether there are enough syncs to propagate rewards through the effective horizon.

        After k syncs, Q is at most (1 - gamma^k) / (1 - gamma) times the largest reward.
        """
        syncs = self.updates / self.target_interval
        return syncs * (1 - self.gamma) >= SYNCS_PER_HORIZON


class FQE(Learner):
    """Learner of the Q-values of given policies, one network for each policy."""

    name = "fqe"
    config_type: ClassVar[type[TrainingConfig]] = FQEConfig
    acts_by: str = "q_values"
    policy_models: ClassVar[tuple[str, ...]] = ("q",)
    config: FQEConfig

    def __init__(
        self,
        config: FQEConfig,
        buffer: TransitionBuffer,
        seeds: Sequence[int],
        pi_t: Tensor,
        fixed_v_t: Tensor | None = None,
    ) -> None:
        """Initialize the network with random weights, and copy them to the target network.

        Args:
            config: Settings.
            buffer: N transitions of the log.
            seeds: Seeds of the weights and batches of each of K policies. Equal seeds give equal
                initial weights and batches, which reduces the noise of differences.
            pi_t: Probabilities (K, N, A) of each policy in each next state.
            fixed_v_t: Fixed values (K, N) of next states; NaN where the value is learned. Default:
                all values are learned.
        """
        super().__init__(config, buffer, seeds)
        self._pi_t = pi_t.flatten(0, 1)
        self._fixed_v_t = None if fixed_v_t is None else fixed_v_t.flatten()
        networks = torch.arange(len(seeds), device=buffer.device)
        self._offsets = (networks * len(buffer)).repeat_interleave(config.batch_size)
        self.target_network = self.add_target_network("q", config.target_interval)
        rewards, _ = buffer.returns
        drawn = rewards if buffer.drawable is None else rewards[buffer.drawable]
        self.low, self.high = return_bounds(drawn, config.gamma)

    def output_shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the shape of the values of all actions."""
        return {"q": (self.n_actions,)}

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Return half the squared temporal difference."""
        q_tm1 = self.outputs("q", batch.observations)
        q_t = self.target_network.outputs(batch).clamp(self.low, self.high)
        rows = batch.rows + self._offsets
        pi_t = self._pi_t.index_select(0, rows)
        target_tm1 = expected_sarsa_target(batch.rewards, batch.discounts, q_t, pi_t)
        if self._fixed_v_t is not None:
            fixed_v_t = self._fixed_v_t.index_select(0, rows)
            fixed_tm1 = batch.rewards + batch.discounts * fixed_v_t
            target_tm1 = torch.where(fixed_v_t.isnan(), target_tm1, fixed_tm1)
        td_loss = square_regression(q_tm1, batch.actions, target_tm1)
        return {"mean_q": chosen(q_tm1, batch.actions), "loss": td_loss}

    def values(self, *, next_states: bool) -> Tensor:
        """Return the values (K, N, A) of the networks, clipped to the possible returns."""
        outputs = outputs_of_buffer(self.models["q"], self.buffer, next_states=next_states)
        values = outputs.view(len(self.seeds), len(self.buffer), -1)
        return values.clamp(self.low, self.high)


def return_bounds(rewards: Tensor, gamma: float) -> tuple[float, float]:
    """Return the lowest and highest possible discounted return, from the range of `rewards`."""
    steps = 1 / (1 - gamma) if gamma < 1 else float("inf")
    low, high = float(rewards.min()), float(rewards.max())
    return min(low, low * steps) if low else 0.0, max(high, high * steps) if high else 0.0
