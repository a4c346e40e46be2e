"""What a policy is worth, from a log of others alone: estimates, how sure they are, and refusals.

Returns are discounted, and of whole episodes: from their first step to their end in the log. What a
truncated episode would still have earned is counted by the estimators that have a model (FQE, DR,
WDR), and not by those that only weigh what was logged.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from mcaprl.errors import SpaceError, UsageError
from mcaprl.offline.batches.buffer import TransitionBuffer
from mcaprl.offline.estimate.fqe import FQE, FQEConfig
from mcaprl.offline.estimate.importance import (
    ESTIMATORS,
    EpisodeTable,
    effective_sample_size,
    mean_weight,
)
from mcaprl.offline.estimate.self_normalized import Floats, RatioEstimate

if TYPE_CHECKING:
    from mcaprl.recorder.dataset.dataset import Dataset

LEAST_SAMPLE_SIZE: Final = 10.0
"""Below this effective number of episodes there is an estimate, but no verdict."""
RESAMPLES: Final = 1000
FOLDS: Final = 2
TRUSTED: Final = "ok"
_ROWS_AT_ONCE = 4096
_STANDARD_ERRORS = 4.0
"""So far from what must be, chance no longer explains it."""


class StochasticPolicy(Protocol):
    """What is to be evaluated."""

    def action_probabilities(self, observations: Any) -> NDArray[np.floating]:
        """(B, A) for B observations."""


@dataclass(frozen=True)
class Estimate:
    """One estimator's answer.

    Attributes:
        policy: its name.
        estimator: `FQE` or one of `importance.ESTIMATORS`.
        value: the discounted return; None where nothing can be computed.
        interval: 95 % bootstrap-t interval over episodes.
        effective_sample_size: how many episodes of the policy itself the log is worth.
        verdict: `ok`, or `refused: ` and why.
    """

    policy: str
    estimator: str
    value: float | None
    interval: tuple[float, float] | None
    effective_sample_size: float
    verdict: str

    @property
    def trusted(self) -> bool:
        """Whether the estimate may be used to choose a policy."""
        return self.verdict == TRUSTED

    def to_json(self) -> dict[str, Any]:
        """As `mcaprl evaluate --data --json` prints it."""
        return {
            "policy": self.policy,
            "estimator": self.estimator,
            "value": self.value,
            "interval": self.interval and list(self.interval),
            "effective_sample_size": self.effective_sample_size,
            "verdict": self.verdict,
        }


@dataclass(frozen=True)
class PolicyEstimates:
    """What a log says of one policy.

    Attributes:
        policy: its name.
        coverage: the mean probability that it has for the logged actions: 1 if the log does just
            what it would do, 0 if never. Where it is low, estimates rest on few steps or on the
            model's guesses.
        estimates: one for each estimator.
    """

    policy: str
    coverage: float
    estimates: tuple[Estimate, ...]


class OffPolicyEvaluator:
    """A log, ready to be asked about policies.

    Attributes:
        gamma: the discount.
        behavior_return: mean discounted return of the logged episodes.
        behavior_interval: its 95 % bootstrap-t interval.
    """

    def __init__(self, dataset: Dataset, config: FQEConfig | None = None, seed: int = 0) -> None:
        """Prepare a log.

        Args:
            dataset: with discrete actions.
            config: of the model; its `gamma` is the discount of all estimates.
            seed: of the model and of the resampling.

        Raises:
            SpaceError: the actions are not discrete.
            TrainingError: there are no transitions, or numbers that are not finite.
            UsageError: there are fewer episodes than the model needs to be tested on others.
        """
        self._config = config or FQEConfig()
        self._seed = seed
        self._dataset = dataset
        self._buffer = TransitionBuffer.from_dataset(dataset, self._config.packing)
        self._lengths = np.array([len(episode) for episode in dataset.episodes])
        if len(self._lengths) < FOLDS:
            raise UsageError(f"off-policy evaluation needs {FOLDS} episodes or more in the log")
        self.gamma = self._config.gamma
        random = np.random.default_rng(seed)
        shape = (RESAMPLES, len(self._lengths))
        self._counts = random.multinomial(shape[1], [1 / shape[1]] * shape[1], shape[0]).astype(
            np.float64
        )
        self._fold = random.permutation(len(self._lengths)) % FOLDS
        returns = self._padded(dataset.rewards, 0.0) @ self._discounts()
        self.behavior_return = float(returns.mean())
        self.behavior_interval = RatioEstimate.mean(returns).interval(self._counts)

    def evaluate(
        self,
        policy: StochasticPolicy | None,
        name: str,
        *,
        epsilon: float = 0.0,
        on_update: Callable[[], None] = lambda: None,
    ) -> PolicyEstimates:
        """Estimate a policy's discounted return with every estimator.

        Args:
            policy: what is to be evaluated; None acts at random.
            name: for tables.
            epsilon: probability with which it is to act at random; some, and the estimates need
                fewer episodes.
            on_update: called after each of the model's updates, `updates_of_model` in all.

        Raises:
            PolicyError: the policy takes other observations.
            SpaceError: it has another number of actions.
        """
        pi, pi_next = (
            self._probabilities(policy, observations, epsilon)
            for observations in (self._dataset.observations, self._dataset.next_observations)
        )
        q, v, v_last = self._model(pi, pi_next, on_update)
        own = pi[np.arange(len(pi)), self._buffer.actions.numpy()]
        behavior = self._dataset.behavior_probs.astype(np.float64)
        unknown = int(np.isnan(behavior).sum())
        if unknown:
            verdict = f"refused: behavior_prob of {unknown} of {len(behavior)} steps is unknown"
            found = [Estimate(name, each, None, None, 0.0, verdict) for each in ESTIMATORS]
            weights = own
        else:
            weights = own / behavior
            table = self._table(weights, q, v, v_last)
            found = [self._estimate(name, each, table) for each in ESTIMATORS]
        fqe = self._fqe_estimate(name, v, weights)
        return PolicyEstimates(name, float(own.mean()), (fqe, *found))

    @property
    def updates_of_model(self) -> int:
        """How often `evaluate` calls `on_update`."""
        return FOLDS * self._config.updates

    def _probabilities(
        self, policy: StochasticPolicy | None, observations: Any, epsilon: float
    ) -> Floats:
        """(N, A) of the policy in question."""
        actions = int(self._buffer.action_space.n)
        uniform = np.full((len(self._buffer), actions), 1 / actions)
        if policy is None:
            return uniform
        parts = [
            policy.action_probabilities(_rows(observations, start, start + _ROWS_AT_ONCE))
            for start in range(0, len(self._buffer), _ROWS_AT_ONCE)
        ]
        own = np.concatenate(parts).astype(np.float64)
        if own.shape != uniform.shape:
            raise SpaceError(f"the policy has {own.shape[1]} actions, the log {actions}")
        return (1 - epsilon) * own + epsilon * uniform

    def _model(
        self, pi: Floats, pi_next: Floats, on_update: Callable[[], None]
    ) -> tuple[Floats, Floats, Floats]:
        """Estimate Q of the actions, V of the states and V of the next states, (N,) each.

        Cross-fitting: each half of the episodes is evaluated by a model that was trained on the
        other half, because a model is biased on its training data.
        """
        fold = np.repeat(self._fold, self._lengths)
        actions = self._buffer.actions.numpy()
        q, v, v_next = (np.zeros(len(fold)) for _ in range(3))
        for held_out in range(FOLDS):
            in_fold = fold == held_out
            seen = self._buffer.drawn_by((~in_fold).astype(np.float64))
            learner = FQE(
                self._config,
                seen,
                [self._seed + held_out],
                torch.from_numpy(pi_next.astype(np.float32)),
            )
            for _ in range(self._config.updates):
                learner.update()
                on_update()
            values = learner.values(next_states=False).numpy().astype(np.float64)
            values_next = learner.values(next_states=True).numpy()
            q[in_fold] = values[np.arange(len(fold)), actions][in_fold]
            v[in_fold] = (pi * values).sum(1)[in_fold]
            v_next[in_fold] = (pi_next * values_next.astype(np.float64)).sum(1)[in_fold]
        return q, v, v_next

    def _table(self, ratios: Floats, q: Floats, v: Floats, v_next: Floats) -> EpisodeTable:
        values = self._padded(v, 0.0)
        lasts = np.cumsum(self._lengths) - 1
        cut = self._dataset.truncated[lasts]
        values[np.flatnonzero(cut), self._lengths[cut]] = v_next[lasts][cut]
        return EpisodeTable(
            self._padded(self._dataset.rewards, 0.0),
            self._padded(ratios, 1.0),
            self._padded(q, 0.0),
            values,
            self.gamma,
        )

    def _estimate(self, name: str, estimator: str, table: EpisodeTable) -> Estimate:
        estimate = ESTIMATORS[estimator](table)
        value = estimate.values(np.ones((1, len(self._lengths))))[0]
        size = effective_sample_size(estimator, table)
        return Estimate(
            name,
            estimator,
            float(value),
            estimate.interval(self._counts),
            size,
            self._verdict_on_weights(estimator, table, size),
        )

    def _verdict_on_weights(self, estimator: str, table: EpisodeTable, size: float) -> str:
        verdict, weights = _verdict(size), mean_weight(estimator, table)
        if verdict != TRUSTED or weights is None:
            return verdict
        once = np.ones((1, len(self._lengths)))
        mean, error = float(weights.values(once)[0]), float(weights.errors(once)[0])
        if abs(mean - 1) <= _STANDARD_ERRORS * error + 1e-9:
            return verdict
        return f"refused: weights of {mean:.2f} in the mean, not 1: the log lacks what it does"

    def _fqe_estimate(self, name: str, v: Floats, weights: Floats) -> Estimate:
        """The model's mean value of the first states; the interval knows of no other model.

        Its sample size is that of single steps, in episodes: the model follows no trajectory.
        """
        first = v[np.cumsum(self._lengths) - self._lengths]
        steps = weights.sum() ** 2 / max((weights**2).sum(), 1e-300)
        size = float(steps / self._lengths.mean())
        verdict = _verdict(size)
        if verdict == TRUSTED and not self._config.enough_syncs:
            verdict = (
                f"refused: {self._config.updates // self._config.target_interval} target syncs"
                f" are too few for gamma {self.gamma}: more updates"
            )
        interval = RatioEstimate.mean(first).interval(self._counts)
        return Estimate(name, "FQE", float(first.mean()), interval, size, verdict)

    def _padded(self, column: NDArray[Any], fill: float) -> Floats:
        """(E, T) a column of steps as one row for each episode, one longer than the longest."""
        table = np.full((len(self._lengths), int(self._lengths.max()) + 1), fill)
        steps = np.arange(table.shape[1]) < self._lengths[:, None]
        table[steps] = column
        return table

    def _discounts(self) -> Floats:
        discounts: Floats = self.gamma ** np.arange(int(self._lengths.max()) + 1, dtype=np.float64)
        return discounts


def _verdict(size: float) -> str:
    if size >= LEAST_SAMPLE_SIZE:
        return TRUSTED
    return f"refused: {size:.1f} effective episodes, {LEAST_SAMPLE_SIZE:.0f} needed"


def _rows(observations: Any, start: int, stop: int) -> Any:
    if isinstance(observations, dict):
        return {key: _rows(part, start, stop) for key, part in observations.items()}
    return observations[start:stop]
