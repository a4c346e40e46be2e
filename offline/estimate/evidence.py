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
the most likely action; for the actions of a Box, less than this fraction of the density.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.base_policy import BasePolicy
from mcaprl.errors import PolicyError, UsageError
from mcaprl.offline.batches.buffer import TransitionBuffer
from mcaprl.offline.batches.items import returns_to_go
from mcaprl.offline.estimate.fqe import FQE, BoxFQE, BoxFQEConfig, FQEConfig
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
CLOSE: Final = 0.1
"""Largest difference to a logged action of a Box, as a fraction of half the range, that counts as
the same action."""
LOW_PERCENTILE: Final = 1.0
_SYNCS_PER_HORIZON: Final = 6.0


@dataclass(frozen=True, eq=False)
class Evidence:
    """Scores of one policy on one log. Values are discounted returns in units of the reward.

    Attributes:
        first_value: FQE's mean value of the first states of the episodes.
        mean_value: FQE's mean value of all states of the log.
        first_values: (E,) FQE's value of the first state of each episode.
        logged_values: (N,) FQE's value of each logged action; empty for a Box.
        next_values: (N,) FQE's largest value in each next state; empty for a Box.
        agrees: (N,) whether the policy's action is the logged one, in each state; for a Box,
            whether the root mean square of the differences is at most `CLOSE`.
        support: Fraction of the states in which the policy's action is likely under the clone.
        agreement: Fraction of the states in which the policy's action is the logged one.
        own_value: Mean of the policy's own largest Q in the first states; None if it has no Q.
        bellman_error: Root mean square of r + gamma max_a Q(s', a) - Q(s, a), divided by the
            standard deviation of Q; None if the policy has no Q. For a Box, the next action is that
            of the policy.
        behavior: (2, E) value of each episode for the behavior of the log: by FQE, with the same
            models, and as logged. After a truncated episode, the return continues with the value of
            its last action. Empty for finite action spaces.
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
    behavior: Floats = field(repr=False, default_factory=lambda: np.empty((2, 0)))

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
        """Prepare a log of discrete actions; `clone` imitates its behavior, by BC for example."""
        # With `pessimistic`, an episode ends at a policy's first rare action.
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
        self._prepare(clone)
        returns = returns_to_go(dataset.rewards, lengths, config.gamma)
        self.low_value = float(np.percentile(returns, LOW_PERCENTILE))

    def _prepare(self, clone: BasePolicy) -> None:
        """Find the likely actions of each state and next state."""
        self._likely, self._next_likely = (
            likely(by_rows(clone.action_probabilities, observations))
            for observations in (self._dataset.observations, self._dataset.next_observations)
        )

    def collect(
        self, policies: Sequence[BasePolicy], on_update: Callable[[], None] = lambda: None
    ) -> list[Evidence]:
        """Return the evidence for each policy; `on_update` has FOLDS * updates calls in total."""
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
        """Return FQE's values (3, P, N) of the policy's, the logged, and the best next action."""
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


class BoxEvidenceCollector(EvidenceCollector):
    """Evaluator for the actions of a Box, and of the behavior of the log by the same models."""

    def _prepare(self, clone: BasePolicy) -> None:
        self._clone = clone

    def collect(
        self, policies: Sequence[BasePolicy], on_update: Callable[[], None] = lambda: None
    ) -> list[Evidence]:
        """Return the evidence for each policy; see `EvidenceCollector.collect`."""
        data, box = self._dataset, self._buffer.box
        assert box is not None
        states = (data.observations, data.next_observations)
        taken = [[by_rows(policy.act, seen) for seen in states] for policy in policies]
        is_likely = np.array(
            [
                [
                    likely_commands(self._clone, seen, actions)
                    for seen, actions in zip(states, mine, strict=True)
                ]
                for mine in taken
            ]
        )
        logged = self._buffer.actions.numpy()
        following = self._buffer.next_rows.numpy()
        # The action after the last one of an episode is unknown.
        after = np.where(
            (following < 0)[:, None],
            box.scaled(by_rows(self._clone.act, data.next_observations)),
            logged[following],
        )
        actions, next_actions = (
            np.stack([*(box.scaled(mine[k]) for mine in taken), own])
            for k, own in enumerate((logged, after))
        )
        fixed = np.full(actions.shape[:2], np.nan, np.float32)
        if self._pessimistic:
            fixed[:-1][~is_likely[:, 1]] = self.low_value
        values = self._values_of_box(actions, next_actions, fixed, on_update)
        if self._pessimistic:
            values[:-1][~is_likely[:, 0]] = self.low_value
        rewards = data.rewards.astype(np.float64)
        cut = (following < 0) & (self._buffer.returns[1].numpy() > 0)
        rewards[cut] = values[-1, cut]
        returned = returns_to_go(rewards, data.episode_lengths, self._config.gamma)
        behavior = np.stack([values[-1], returned])[:, self._first]
        likely = is_likely[:, 0]
        return [
            self._evidence_of_box(policy, taken[k], actions[k], values[k], likely[k], behavior)
            for k, policy in enumerate(policies)
        ]

    def _evidence_of_box(
        self,
        policy: BasePolicy,
        taken: Sequence[NDArray[Any]],
        actions: NDArray[np.float32],
        values: Floats,
        is_likely: NDArray[np.bool_],
        behavior: Floats,
    ) -> Evidence:
        """Return the evidence for one policy, of what `collect` found for all of them."""
        own_value, bellman_error = self._own_values_of_box(policy, *taken)
        agrees = np.sqrt(np.square(actions - self._buffer.actions.numpy()).mean(1)) <= CLOSE
        return Evidence(
            first_value=float(values[self._first].mean()),
            mean_value=float(values.mean()),
            first_values=values[self._first],
            logged_values=np.empty(0),
            next_values=np.empty(0),
            agrees=agrees,
            support=float(is_likely.mean()),
            agreement=float(agrees.mean()),
            own_value=own_value,
            bellman_error=bellman_error,
            behavior=behavior,
        )

    def _values_of_box(
        self,
        actions: NDArray[np.float32],
        next_actions: NDArray[np.float32],
        fixed: NDArray[np.float32],
        on_update: Callable[[], None],
    ) -> Floats:
        """Return the values (P, N) by FQE of the actions of P policies."""
        values = np.zeros(actions.shape[:2])
        own, pi_t, fixed_v_t = map(torch.from_numpy, (actions, next_actions, fixed))
        for held_out in range(FOLDS):
            training = self._buffer.with_weights((self._fold != held_out).astype(np.float64))
            seeds = [self._seed + held_out] * len(actions)
            learner = BoxFQE(self._config, training, seeds, pi_t, fixed_v_t)
            for _ in range(self._config.updates):
                learner.update()
                on_update()
            evaluated = np.flatnonzero(self._fold == held_out)
            rows = torch.from_numpy(evaluated)
            values[:, evaluated] = learner.values_of(own[:, rows], rows).numpy()
        return values

    def _own_values_of_box(
        self, policy: BasePolicy, actions: NDArray[Any], next_actions: NDArray[Any]
    ) -> tuple[float | None, float | None]:
        """Return `own_value` and `bellman_error` of a policy; see `Evidence`."""
        data = self._dataset
        asked = (
            (data.observations, actions),
            (data.observations, data.actions),
            (data.next_observations, next_actions),
        )
        try:
            v, q, v_t = (of_both(policy.action_values, *each).astype(np.float64) for each in asked)
        except PolicyError:
            return None, None
        rewards, discounts = self._buffer.returns.double().numpy()
        error = self._buffer.reward_scale * rewards + discounts * v_t - q
        spread = max(float(q.std()), 1e-12)
        return float(v[self._first].mean()), float(np.sqrt((error**2).mean())) / spread


def of_both(
    function: Callable[[Any, Any], NDArray[Any]], observations: Any, actions: NDArray[Any]
) -> NDArray[Any]:
    """Apply a function to N observations and actions in slices of limited size."""
    both = {"seen": observations, "taken": actions}
    return by_rows(lambda part: function(part["seen"], part["taken"]), both)


def likely_commands(
    clone: BasePolicy, observations: Any, actions: NDArray[Any]
) -> NDArray[np.bool_]:
    """Return whether the density of each action is at least `LIKELY` times that of the mode."""
    best = by_rows(clone.act, observations)
    densities, largest = (of_both(clone.log_prob, observations, each) for each in (actions, best))
    found: NDArray[np.bool_] = densities >= largest + math.log(LIKELY)
    return found


def weighted_value(
    dataset: Dataset, evidence: Evidence, gamma: float
) -> tuple[float, float] | None:
    """Return a policy's WPDIS and effective episodes; None without valid probabilities."""
    if isinstance(dataset.action_space, spaces.Box):
        return None
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
