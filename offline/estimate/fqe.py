"""Fitted Q evaluation: learn the value of a policy from the log of another policy.

    Le, Voloshin and Yue, "Batch policy learning under constraints", https://arxiv.org/abs/1903.08738

Q learns the target r + gamma sum_a pi(a|s') Q'(s', a), where pi is the evaluated policy and Q' is
the target network, which is synced every `target_interval` updates. A truncated episode would have
continued, so only `terminated` ends the return. For the actions of a Box, Q has the action as an
additional input, and the target is r + gamma Q'(s', a') with one action a' of the policy.

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
_ROWS_AT_ONCE = 1024


@dataclass(frozen=True)
class FQEConfig(TrainingConfig):
    """Settings of fitted Q evaluation."""

    updates: int = 10_000
    """number of gradient updates"""
    gamma: float = 0.97
    """discount per step"""
    target_interval: int = 50
    """updates between two syncs of the target network"""
    scale_rewards: bool = False
    """divide rewards by the standard deviation of the discounted returns of the log"""

    def __post_init__(self) -> None:
        """Validate the settings."""
        super().__post_init__()
        self._require("gamma", 0 <= self.gamma <= 1, "within [0, 1]")
        self._require("target_interval", self.target_interval >= 1, "at least 1")

    @property
    def packing(self) -> Packing:
        """Settings of single-step transitions: n-step returns depend on the behavior policy."""
        return Packing(
            normalize=self.normalize,
            gamma=self.gamma,
            scale_rewards=self.scale_rewards,
            clip_actions=self.clip_actions,
        )

    @property
    def enough_syncs(self) -> bool:
        """Whether there are enough syncs to propagate rewards through the effective horizon."""
        # After k syncs, Q is at most (1 - gamma^k) / (1 - gamma) times the largest reward.
        syncs = self.updates / self.target_interval
        return syncs * (1 - self.gamma) >= SYNCS_PER_HORIZON


@dataclass(frozen=True)
class BoxFQEConfig(FQEConfig):
    """Settings of fitted Q evaluation for the actions of a Box."""

    normalize: bool = True
    """normalize the network's inputs to mean 0 and standard deviation 1 over the data"""
    scale_rewards: bool = True
    """divide rewards by the standard deviation of the discounted returns of the log"""


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
        """Initialize the network with random weights, and copy them to the target network."""
        # Equal `seeds` give equal weights and batches, which reduces the noise of differences.
        # `pi_t` is (K, N, A), or for a Box scaled actions (K, N, n). `fixed_v_t` (K, N) is in units
        # of the logged rewards, NaN where the value is learned.
        super().__init__(config, buffer, seeds)
        self._pi_t = pi_t.flatten(0, 1)
        self._fixed_v_t = None if fixed_v_t is None else fixed_v_t.flatten() / buffer.reward_scale
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
        rows = batch.rows + self._offsets
        target_tm1 = self.targets(batch, self._pi_t.index_select(0, rows))
        if self._fixed_v_t is not None:
            fixed_v_t = self._fixed_v_t.index_select(0, rows)
            fixed_tm1 = batch.rewards + batch.discounts * fixed_v_t
            target_tm1 = torch.where(fixed_v_t.isnan(), target_tm1, fixed_tm1)
        q_tm1 = self.logged_values(batch)
        return {"mean_q": q_tm1, "loss": square_regression(q_tm1, target_tm1)}

    def targets(self, batch: Batch, pi_t: Tensor) -> Tensor:
        """Return the targets (R,), given rows (R, ...) of `pi_t`."""
        q_t = self.target_network.outputs(batch).clamp(self.low, self.high)
        return expected_sarsa_target(batch.rewards, batch.discounts, q_t, pi_t)

    def logged_values(self, batch: Batch) -> Tensor:
        """Return the values (R,) of the logged actions."""
        return chosen(self.outputs("q", batch.observations), batch.actions)

    def values(self, *, next_states: bool) -> Tensor:
        """Return the values (K, N, A) of the networks, clipped to the possible returns."""
        outputs = outputs_of_buffer(self.models["q"], self.buffer, next_states=next_states)
        values = outputs.view(len(self.seeds), len(self.buffer), -1)
        return values.clamp(self.low, self.high)


class BoxFQE(FQE):
    """Learner of the values Q(s, a) of given policies with the actions of a Box."""

    continuous = True
    critics = ("q",)

    def output_shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the shape of the value of one action."""
        return {"q": (1,)}

    def targets(self, batch: Batch, pi_t: Tensor) -> Tensor:
        """Return the targets (R,), given the next actions (R, n)."""
        with torch.no_grad():
            v_t = self.target_network.model(batch.next_observations.with_actions(pi_t)).squeeze(1)
        return batch.rewards + batch.discounts * v_t.clamp(self.low, self.high)

    def logged_values(self, batch: Batch) -> Tensor:
        """Return the values (R,) of the logged actions."""
        return self.models["q"](batch.observations.with_actions(batch.actions)).squeeze(1)

    @torch.no_grad()
    def values_of(self, actions: Tensor, rows: Tensor | None = None) -> Tensor:
        """Return values (K, M) of scaled actions (K, M, n) in rows (M,), within the returns."""
        # They are in units of the logged rewards.
        buffer, networks = self.buffer, len(self.seeds)
        rows = torch.arange(len(buffer)) if rows is None else rows
        places, parts = buffer.places[0].index_select(0, rows), []
        for part in torch.split(torch.arange(len(rows)), _ROWS_AT_ONCE):
            states = buffer.observe(places[part].repeat(networks))
            values = self.models["q"](states.with_actions(actions[:, part].flatten(0, 1)))
            parts.append(values.view(networks, -1))
        return self.in_reward_units(torch.cat(parts, 1).clamp(self.low, self.high))

    def _members(self, name: str) -> int:
        # Networks are averaged over seeds, which also draw other batches.
        return 1


def return_bounds(rewards: Tensor, gamma: float) -> tuple[float, float]:
    """Return the lowest and highest possible discounted return, from the range of `rewards`."""
    steps = 1 / (1 - gamma) if gamma < 1 else float("inf")
    low, high = float(rewards.min()), float(rewards.max())
    return min(low, low * steps) if low else 0.0, max(high, high * steps) if high else 0.0
