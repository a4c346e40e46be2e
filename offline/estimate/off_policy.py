"""Off-policy evaluation: estimates of a policy's value from a log, with intervals and verdicts.

Values are discounted returns of whole episodes. A truncated episode lacks its later rewards.
Estimators with a model (FQE, DR, WDR) include an estimate of these rewards; the others do not.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Final

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.base_policy import BasePolicy, RandomPolicy
from mcaprl.errors import SpaceError, UsageError
from mcaprl.offline.batches.buffer import TransitionBuffer, discrete_actions
from mcaprl.offline.estimate.fqe import FQE, FQEConfig
from mcaprl.offline.estimate.importance import (
    ESTIMATORS,
    WHOLE_EPISODE,
    EpisodeTable,
    Floats,
    RatioEstimate,
    effective_sample_size,
    mean_weight,
    usable_steps,
)
from mcaprl.offline.estimate.values import by_rows, policy_inputs
from mcaprl.recorder.dataset.statistics import calibration
from mcaprl.recorder.format.behavior import BehaviorField

if TYPE_CHECKING:
    from mcaprl.recorder.dataset.dataset import Dataset

LEAST_SAMPLE_SIZE: Final = 10.0  # Effective number of episodes below which an estimate is refused
LARGEST_WEIGHT: Final = 1e100
"""Importance weight above which sums of squares may overflow, so an estimate is refused."""
RESAMPLES: Final = 1000
FOLDS: Final = 2
TRUSTED: Final = "ok"
BY_ESTIMATES: Final = "; behavior_prob is estimated"
"""Suffix of verdicts that are based on estimated behavior probabilities."""
PREFERENCE: Final = ("WDR", "WPDIS", "DR", "PDIS")
"""Estimators for rankings, from the most to the least reliable."""
_STANDARD_ERRORS = 4.0
"""Deviation of the mean weight from 1, in standard errors, above which an estimate is refused."""


@dataclass(frozen=True)
class Estimate:
    """Estimate of one policy's value by one estimator.

    Attributes:
        policy: Name of the policy.
        estimator: `FQE` or one of `importance.ESTIMATORS`.
        value: Discounted return; None if it cannot be computed.
        interval: 95 % bootstrap-t interval over episodes; None for FQE or if `value` is None.
        effective_sample_size: Number of episodes that would give an equally precise estimate if the
            policy itself were recorded; None for FQE of the actions of a Box.
        verdict: `ok`, or `refused: ` or `no interval: ` with a reason. FQE is never `ok`.
            A verdict based on estimated behavior probabilities ends with `BY_ESTIMATES`.
        spread: Standard deviation of FQE's values over its seeds; None if there is one seed.
        usable_steps: Number of first steps of the episodes whose weights have an effective sample
            size that suffices; None for estimators without weights, and for TIS and WIS.
    """

    policy: str
    estimator: str
    value: float | None
    interval: tuple[float, float] | None
    effective_sample_size: float | None
    verdict: str
    spread: float | None = None
    usable_steps: int | None = None

    @property
    def trusted(self) -> bool:
        """Whether the estimate may be used to choose a policy."""
        return self.verdict.removesuffix(BY_ESTIMATES) == TRUSTED

    @property
    def is_refused(self) -> bool:
        """Whether the value must not be used at all."""
        return self.verdict.startswith("refused")

    def to_json(self) -> dict[str, Any]:
        """Return the attributes, as `mcaprl evaluate --data --json` prints them."""
        return asdict(self)


@dataclass(frozen=True)
class PolicyEstimates:
    """Estimates of one policy's value by all estimators.

    Attributes:
        policy: Name of the policy.
        coverage: Mean probability of the logged actions under the policy. If it is low, the
            estimates depend on few steps or on the model's values of unseen actions. None for the
            actions of a Box.
        estimates: One estimate per estimator.
        support: Fraction of the policy's actions, in the states of the log, that are as near to
            logged ones as 95 % of the log's own actions are; see `box.Support`. None for
            discrete actions, and if all observations are images.
    """

    policy: str
    coverage: float | None
    estimates: tuple[Estimate, ...]
    support: float | None = None


class OffPolicyEvaluator:
    """Evaluator of policies with discrete actions on one log."""

    config_type: ClassVar[type[FQEConfig]] = FQEConfig

    def __init__(self, dataset: Dataset, config: FQEConfig | None = None, seed: int = 0) -> None:
        """Prepare the evaluation on a log of discrete actions; `config` is that of the model."""
        self._check_space(dataset.action_space)
        self._config = config or self.config_type()
        self._seed = seed
        self._dataset = dataset
        self._buffer = TransitionBuffer.from_dataset(dataset, self._config.packing)
        self._lengths = np.array([len(episode) for episode in dataset.episodes])
        if len(self._lengths) < FOLDS:
            raise UsageError(f"off-policy evaluation needs {FOLDS} episodes or more in the log")
        self.gamma = self._config.gamma  # Discount per step
        self._calibration = calibration(dataset.behavior, dataset.action_space)
        random = np.random.default_rng(seed)
        shape = (RESAMPLES, len(self._lengths))
        self._counts = random.multinomial(shape[1], [1 / shape[1]] * shape[1], shape[0]).astype(
            np.float64
        )
        self._fold = random.permutation(len(self._lengths)) % FOLDS
        rewards = self._padded(dataset.rewards, 0.0)
        returns = rewards @ self.gamma ** np.arange(rewards.shape[1], dtype=np.float64)
        # Mean discounted return of the logged episodes.
        self.behavior_return = float(returns.mean())
        # 95 % bootstrap-t interval of that mean.
        self.behavior_interval = RatioEstimate.mean(returns).interval(self._counts)

    def _check_space(self, space: spaces.Space[Any]) -> None:
        discrete_actions(space, "evaluation from the log alone")

    def evaluate(
        self,
        policy: BasePolicy | None,
        name: str,
        *,
        epsilon: float = 0.0,
        on_update: Callable[[], None] = lambda: None,
    ) -> PolicyEstimates:
        """Estimate a policy's return with every estimator; None is the uniform random policy."""
        # A larger `epsilon` requires fewer episodes. `on_update` is called `updates_of_model`
        # times.
        pi, pi_next = self._probabilities(policy, epsilon)
        q, v, v_last = self._model(pi, pi_next, on_update)
        own = pi[np.arange(len(pi)), self._buffer.actions.numpy()]
        behavior = self._dataset.behavior.astype(np.float64)
        weights, refused = own, unusable(behavior, self._dataset.behavior_field)
        if refused is None:
            weights = own / behavior
        found = self._importance(name, tuple(ESTIMATORS), refused, weights, q, v, v_last)
        every = self._marked((self._fqe_estimate(name, v, weights), *found))
        return PolicyEstimates(name, float(own.mean()), every)

    def _importance(
        self,
        name: str,
        estimators: Sequence[str],
        refused: str | None,
        weights: Floats,
        *model: Floats,
    ) -> list[Estimate]:
        """Return the estimates with importance weights (N,), or the reason of their refusal."""
        if refused is None:
            table = self._table(weights, *model)
            refused = _overflow(table.rho)
        if refused is not None:
            return [Estimate(name, each, None, None, 0.0, refused) for each in estimators]
        return [self._estimate(name, each, table) for each in estimators]

    def _marked(self, estimates: tuple[Estimate, ...]) -> tuple[Estimate, ...]:
        """Mark the verdicts that are based on estimated behavior probabilities."""
        if not self._dataset.has_estimated_probs:
            return estimates
        return tuple(replace(one, verdict=f"{one.verdict}{BY_ESTIMATES}") for one in estimates)

    @property
    def updates_of_model(self) -> int:
        """Number of calls of `on_update` in `evaluate`."""
        return FOLDS * self._config.updates

    def _probabilities(self, policy: BasePolicy | None, epsilon: float) -> tuple[Floats, Floats]:
        """Return a policy's probabilities (N, A), with `epsilon`, now and in the next states."""
        random = RandomPolicy(self._dataset.action_space)
        pi, pi_next = self._in_states(random, random.action_probabilities)
        policy = policy or random
        own, own_next = self._in_states(policy, policy.action_probabilities)
        if own.shape != pi.shape:
            raise SpaceError(
                f"the policy has {own.shape[1]} actions, but the log has {pi.shape[1]}"
            )
        return (
            (1 - epsilon) * own.astype(np.float64) + epsilon * pi,
            (1 - epsilon) * own_next.astype(np.float64) + epsilon * pi_next,
        )

    def _in_states(
        self, policy: BasePolicy, function: Callable[[Any], NDArray[Any]]
    ) -> tuple[NDArray[Any], NDArray[Any]]:
        """Apply a function of a policy to the observations, and to the next observations."""
        if policy.frame_stack == 1:
            both = (self._dataset.observations, self._dataset.next_observations)
            here, there = (by_rows(function, part) for part in both)
            return here, there
        each = [
            by_rows(function, policy_inputs(policy, episode)) for episode in self._dataset.episodes
        ]
        return np.concatenate([one[:-1] for one in each]), np.concatenate([one[1:] for one in each])

    def _model(
        self, pi: Floats, pi_next: Floats, on_update: Callable[[], None]
    ) -> tuple[Floats, Floats, Floats]:
        """Return Q of the actions taken, V of the states, and V of the next states, (N,) each."""
        # The model of an episode is trained on the other half of the log (cross-fitting), because a
        # model's values for its own training episodes are biased.
        fold = np.repeat(self._fold, self._lengths)
        actions = self._buffer.actions.numpy()
        q, v, v_next = (np.zeros(len(fold)) for _ in range(3))
        for held_out in range(FOLDS):
            evaluated = fold == held_out
            training = self._buffer.with_weights((~evaluated).astype(np.float64))
            learner = FQE(
                self._config,
                training,
                [self._seed + held_out],
                torch.from_numpy(pi_next.astype(np.float32)).unsqueeze(0),
            )
            for _ in range(self._config.updates):
                learner.update()
                on_update()
            values = learner.values(next_states=False)[0].numpy().astype(np.float64)
            values_next = learner.values(next_states=True)[0].numpy()
            q[evaluated] = values[np.arange(len(fold)), actions][evaluated]
            v[evaluated] = (pi * values).sum(1)[evaluated]
            v_next[evaluated] = (pi_next * values_next.astype(np.float64)).sum(1)[evaluated]
        return q, v, v_next

    def _table(self, ratios: Floats, q: Floats, v: Floats, v_next: Floats) -> EpisodeTable:
        values = self._padded(v, 0.0)
        lasts = np.cumsum(self._lengths) - 1
        # The model adds no value to an episode with both flags, because its last state is terminal.
        cut = self._dataset.truncated[lasts] & ~self._dataset.terminated[lasts]
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
            usable_steps=usable_steps(table, self._lengths, LEAST_SAMPLE_SIZE)
            if estimator not in WHOLE_EPISODE
            else None,
        )

    def _verdict_on_weights(self, estimator: str, table: EpisodeTable, size: float) -> str:
        if self._calibration is not None and not self._calibration.possible:
            return f"refused: behavior_prob implies {self._calibration}"
        verdict, weights = _verdict(size), mean_weight(estimator, table)
        if verdict != TRUSTED or weights is None:
            return verdict
        once = np.ones((1, len(self._lengths)))
        mean, error = float(weights.values(once)[0]), float(weights.errors(once)[0])
        if abs(mean - 1) <= _STANDARD_ERRORS * error + 1e-9:
            return verdict
        return (
            f"refused: mean importance weight {mean:.2f}, expected 1: the log does not cover this"
            " policy's actions"
        )

    def _fqe_estimate(self, name: str, v: Floats, weights: Floats) -> Estimate:
        """Return the model's mean value of the first states, without interval, never trusted."""
        # Most of its error is the model's bias, which a log does not show. The model is trained on
        # single steps: the effective sample size is their number divided by the mean length.
        first = v[np.cumsum(self._lengths) - self._lengths]
        steps = weights.sum() ** 2 / max((weights**2).sum(), 1e-300)
        size = float(steps / self._lengths.mean())
        verdict = _verdict(size)
        if verdict == TRUSTED:
            verdict = self._verdict_on_model()
        return Estimate(name, "FQE", float(first.mean()), None, size, verdict)

    def _verdict_on_model(self) -> str:
        """Return the verdict on an estimate by the model alone, which is never `TRUSTED`."""
        if self._config.enough_syncs:
            return "no interval: the error of the model cannot be estimated from the log"
        return (
            f"refused: {self._config.updates // self._config.target_interval} target syncs"
            f" are too few for gamma {self.gamma}; increase the updates"
        )

    def _padded(self, column: NDArray[Any], fill: float) -> Floats:
        """Split the values of all steps into rows (E, T), one per episode, padded with `fill`."""
        table = np.full((len(self._lengths), int(self._lengths.max()) + 1), fill)
        steps = np.arange(table.shape[1]) < self._lengths[:, None]
        table[steps] = column
        return table


def ranking(estimates: Sequence[Estimate]) -> dict[str, Any]:
    """Rank policies by the first estimator of `PREFERENCE` that is trusted for all policies."""
    # Without one, FQE ranks them. `close` differ from the best by less than two deviations over
    # seeds.
    by_estimator = {
        name: [estimate for estimate in estimates if estimate.estimator == name]
        for name in (*PREFERENCE, "FQE")
    }
    trusted = [
        name
        for name, each in by_estimator.items()
        if each and name in PREFERENCE and all(one.trusted for one in each)
    ]
    chosen = trusted[0] if trusted else "FQE"
    ordered = sorted(by_estimator[chosen], key=lambda estimate: -(estimate.value or 0.0))
    return {
        "estimator": chosen,
        "policies": [estimate.policy for estimate in ordered],
        "trusted": bool(trusted),
        "close": [one.policy for one in ordered[1:] if _is_close(ordered[0], one)],
    }


def _is_close(best: Estimate, other: Estimate) -> bool:
    """Return whether the difference of two values by FQE is within the noise of its seeds."""
    if best.spread is None or other.spread is None:
        return False
    difference = (best.value or 0.0) - (other.value or 0.0)
    return difference < 2 * float(np.hypot(best.spread, other.spread))


def unusable(behavior: Floats, field: BehaviorField) -> str | None:
    """Return a refusal if logged probabilities or densities are missing or impossible."""
    for wrong, what in (
        (field.is_impossible(behavior), f"not {field.expected}"),
        (np.isnan(behavior), "unknown; `estimate_behavior=True` estimates it"),
    ):
        if wrong.any():
            return f"refused: {field.name} of {wrong.sum()} of {len(wrong)} steps is {what}"
    return None


def _overflow(rho: Floats) -> str | None:
    """Return a refusal if importance weights may overflow, else None."""
    largest = float(np.nanmax(rho))
    if largest <= LARGEST_WEIGHT:
        return None
    return f"refused: an importance weight is {largest:.0e}, above {LARGEST_WEIGHT:.0e}"


def _verdict(size: float) -> str:
    if size >= LEAST_SAMPLE_SIZE:
        return TRUSTED
    return f"refused: {size:.1f} effective episodes, {LEAST_SAMPLE_SIZE:.0f} needed"
