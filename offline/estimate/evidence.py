"""Scores of trained policies, computed from a log alone, to choose one of the policies.

Fitted Q evaluation (FQE) estimates the value of each policy. The log's episodes are divided into
two halves, and the model that is trained on one half evaluates the policies on the other. All
policies share the initial weights and the batches, which reduces the noise of their differences.

    FQE for selecting policies    Paine et al., https://arxiv.org/abs/2007.09055

FQE overestimates policies whose actions are rare in the log. A pessimistic evaluation ends an
episode at such an action. The episode then gets a low value: 99 % of the returns in the log are
higher.

    Pessimistic model             Kidambi et al., https://arxiv.org/abs/2005.05951

An action is rare if a clone of the behavior gives it less than `LIKELY` times the probability of
the most likely action.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from mcaprl.base_policy import BasePolicy
from mcaprl.errors import PolicyError, UsageError
from mcaprl.offline.batches.buffer import TransitionBuffer
from mcaprl.offline.batches.items import returns_to_go
from mcaprl.offline.estimate.fqe import FQE, BoxFQEConfig, FQEConfig
from mcaprl.offline.estimate.importance import (
    EpisodeTable,
    Floats,
    effective_sample_size,
    weighted_per_decision,
)
from mcaprl.offline.estimate.values import by_rows
from mcaprl.recorder.format.behavior import PROBABILITY

if TYPE_CHECKING:
    from mcaprl.recorder.dataset.dataset import Dataset

FOLDS: Final = 2
LIKELY: Final = 0.1
"""An action is likely if its probability is at least this fraction of the largest probability."""
LOW_PERCENTILE: Final = 1.0
_SYNCS_PER_HORIZON: Final = 6.0


@dataclass(frozen=True, eq=False)
class Evidence:
    """Scores of one policy on one log. Values are discounted returns in units of the reward.

    Attributes:
        first_value: FQE's mean value of the first states of the episodes.
        mean_value: FQE's mean value of all states of the log.
        first_values: (E,) FQE's value of the first state of each episode.
        logged_values: (N,) FQE's value of each logged action.
        next_values: (N,) FQE's largest value in each next state.
        agrees: (N,) whether the policy's action is the logged one, in each state.
        support: Fraction of the states in which the policy's action is likely under the clone.
        agreement: Fraction of the states in which the policy's action is the logged one.
        own_value: Mean of the policy's own largest Q in the first states; None if it has no Q.
        bellman_error: Root mean square of r + gamma max_a Q(s', a) - Q(s, a), divided by the
            standard deviation of Q; None if the policy has no Q.
    """

    first_value: float
    mean_value: float
    first_values: Floats = field(repr=False)
    logged_values: Floats = field(repr=False)
    next_values: Floats = field(repr=False)
    agrees: NDArray[np.bool_] = field(repr=False)
    support: float
    agreement: float
    own_value: float | None
    bellman_error: float | None

    def to_json(self) -> dict[str, Any]:
        """Return the attributes as plain JSON types, without the arrays over episodes or states."""
        return {name: one for name, one in vars(self).items() if not isinstance(one, np.ndarray)}


def fqe_config(
    gamma: float, updates: int, hidden: tuple[int, ...] = (64, 64), *, is_box: bool = False
) -> FQEConfig:
    """Return settings of FQE with enough updates of the target network for the discount."""
    interval = max(1, int(updates * (1 - gamma) / _SYNCS_PER_HORIZON))
    return (BoxFQEConfig if is_box else FQEConfig)(
        updates=updates, gamma=gamma, batch_size=128, hidden=hidden, target_interval=interval
    )


class EvidenceCollector:
    """Evaluator of several policies on one log in parallel."""

    def __init__(
        self,
        dataset: Dataset,
        clone: BasePolicy,
        config: FQEConfig,
        *,
        pessimistic: bool = True,
        seed: int = 0,
    ) -> None:
        """Prepare a log.

        Args:
            dataset: Log with discrete actions.
            clone: Policy that imitates the behavior of the log, such as one trained by BC.
            config: Settings of FQE; its `gamma` is the discount of all values.
            pessimistic: Whether an episode ends at a policy's first rare action.
            seed: Seed of the models, and of the division of the log into halves.

        Raises:
            UsageError: There are too few episodes.
        """
        lengths = dataset.episode_lengths
        if len(lengths) < FOLDS:
            raise UsageError(f"choosing a policy needs {FOLDS} episodes or more in the log")
        self._dataset = dataset
        self._config = config
        self._pessimistic = pessimistic
        self._seed = seed
        self._buffer = TransitionBuffer.from_dataset(dataset, config.packing)
        halves = np.random.default_rng(seed).permutation(len(lengths)) % FOLDS
        self._fold = np.repeat(halves, lengths)
        self._first = np.cumsum(lengths) - lengths
        self._likely, self._next_likely = (
            likely(by_rows(clone.action_probabilities, observations))
            for observations in (dataset.observations, dataset.next_observations)
        )
        returns = returns_to_go(dataset.rewards, lengths, config.gamma)
        self.low_value = float(np.percentile(returns, LOW_PERCENTILE))

    def collect(
        self, policies: Sequence[BasePolicy], on_update: Callable[[], None] = lambda: None
    ) -> list[Evidence]:
        """Return the evidence for each policy.

        Args:
            policies: Policies to evaluate.
            on_update: Function called after each update of a model; FOLDS * updates calls in total.

        Raises:
            PolicyError: The observations do not fit a policy.
        """
        actions, next_actions = (
            np.stack([self._actions(policy, observations) for policy in policies])
            for observations in (self._dataset.observations, self._dataset.next_observations)
        )
        values = self._values(actions, next_actions, on_update)
        return [
            self._evidence(policy, mine, *found)
            for policy, mine, found in zip(policies, actions, values.swapaxes(0, 1), strict=True)
        ]

    def _actions(self, policy: BasePolicy, observations: Any) -> NDArray[np.int64]:
        """Return the indexes (N,) of the policy's actions, from 0."""
        return self._buffer.joint.indexes(by_rows(policy.act, observations))

    def _values(
        self,
        actions: NDArray[np.int64],
        next_actions: NDArray[np.int64],
        on_update: Callable[[], None],
    ) -> Floats:
        """Return three values (3, P, N) by FQE for P policies.

        The values are those of the policy's action, of the logged action, and of the best action in
        the next state.
        """
        pi_t = np.eye(self._buffer.joint.count, dtype=np.float32)[next_actions]
        rows = np.arange(actions.shape[1])
        fixed_v_t = None
        if self._pessimistic:
            ends = ~self._next_likely[rows, next_actions]
            fixed_v_t = torch.from_numpy(np.where(ends, self.low_value, np.nan).astype(np.float32))
        values = np.zeros((3, *actions.shape))
        for held_out in range(FOLDS):
            evaluated = self._fold == held_out
            training = self._buffer.with_weights((~evaluated).astype(np.float64))
            seeds = [self._seed + held_out] * len(actions)
            learner = FQE(self._config, training, seeds, torch.from_numpy(pi_t), fixed_v_t)
            for _ in range(self._config.updates):
                learner.update()
                on_update()
            q = learner.values(next_states=False).numpy()
            v = np.take_along_axis(q, actions[:, :, None], 2)[:, :, 0]
            logged = q[:, rows, self._buffer.actions.numpy()]
            best_t = learner.values(next_states=True).numpy().max(2)
            values[:, :, evaluated] = np.stack([v, logged, best_t])[:, :, evaluated]
        if self._pessimistic:
            values[0, ~self._likely[rows, actions]] = self.low_value
        return values

    def _evidence(
        self,
        policy: BasePolicy,
        actions: NDArray[np.int64],
        values: Floats,
        logged_values: Floats,
        next_values: Floats,
    ) -> Evidence:
        rows = np.arange(len(actions))
        own_value, bellman_error = self._own_values(policy)
        agrees = actions == self._buffer.actions.numpy()
        return Evidence(
            first_value=float(values[self._first].mean()),
            mean_value=float(values.mean()),
            first_values=values[self._first],
            logged_values=logged_values,
            next_values=next_values,
            support=float(self._likely[rows, actions].mean()),
            agrees=agrees,
            agreement=float(agrees.mean()),
            own_value=own_value,
            bellman_error=bellman_error,
        )

    def _own_values(self, policy: BasePolicy) -> tuple[float | None, float | None]:
        """Return `own_value` and `bellman_error` of a policy; see `Evidence`."""
        try:
            q, q_t = (
                by_rows(policy.q_values, observations)
                for observations in (self._dataset.observations, self._dataset.next_observations)
            )
        except PolicyError:
            return None, None
        rewards, discounts = self._buffer.returns.numpy()
        taken = q[np.arange(len(q)), self._buffer.actions.numpy()]
        error = rewards + discounts * q_t.max(1) - taken
        spread = max(float(taken.std()), 1e-12)
        return float(q[self._first].max(1).mean()), float(np.sqrt((error**2).mean())) / spread


def weighted_value(
    dataset: Dataset, evidence: Evidence, gamma: float
) -> tuple[float, float] | None:
    """Return a policy's value by WPDIS, and its effective number of episodes.

    None is returned if the log has no valid action probabilities.
    """
    behavior = dataset.behavior_probs.astype(np.float64)
    if (np.isnan(behavior) | PROBABILITY.is_impossible(behavior)).any():
        return None
    lengths = dataset.episode_lengths
    steps = np.arange(int(lengths.max()) + 1) < lengths[:, None]
    rewards, ratios, zeros = np.zeros(steps.shape), np.ones(steps.shape), np.zeros(steps.shape)
    rewards[steps] = dataset.rewards
    ratios[steps] = evidence.agrees / behavior
    table = EpisodeTable(rewards, ratios, zeros, zeros, gamma)
    value = weighted_per_decision(table).values(np.ones((1, len(lengths))))[0]
    return float(value), effective_sample_size("WPDIS", table)


def likely(probabilities: NDArray[np.floating[Any]]) -> NDArray[np.bool_]:
    """Return whether each action's probability (N, A) is at least `LIKELY` times the largest."""
    above: NDArray[np.bool_] = probabilities >= LIKELY * probabilities.max(1, keepdims=True)
    return above
