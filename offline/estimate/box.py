"""Off-policy evaluation of policies with the actions of a Box.

A deterministic policy has no density of a logged action, and the product of density ratios over
many steps has an effective sample size of about one. Therefore, FQE over several seeds comes first,
and ranks the policies. FQE also evaluates the behavior, whose returns are in the log: if this value
is wrong, the others are not trusted, see `BehaviorCheck`. Importance sampling needs a policy with
densities, and is computed per decision; often only its first steps are usable.

FQE evaluates the actions of `act`, which for most policies are the modes of their distributions.
Importance sampling evaluates actions that are drawn from the densities.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Final

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from scipy.spatial.distance import cdist
from torch import Tensor

from mcaprl.base_policy import BasePolicy, RandomPolicy
from mcaprl.errors import PolicyError, UsageError
from mcaprl.frames import rows_of
from mcaprl.offline.estimate.fqe import BoxFQE, BoxFQEConfig, FQEConfig
from mcaprl.offline.estimate.importance import EpisodeTable, Floats, RatioEstimate, usable_steps
from mcaprl.offline.estimate.off_policy import (
    FOLDS,
    LEAST_SAMPLE_SIZE,
    TRUSTED,
    Estimate,
    OffPolicyEvaluator,
    PolicyEstimates,
    unusable,
)
from mcaprl.offline.estimate.values import policy_inputs

if TYPE_CHECKING:
    from mcaprl.recorder.dataset.dataset import Dataset

SEEDS: Final = 4  # Number of networks per half of the log
PER_DECISION: Final = ("PDIS", "WPDIS")
_Values = Callable[[BoxFQE], Tensor]
QUANTILE: Final = 0.95
_QUERIES: Final = 2_000
_REFERENCES: Final = 20_000
_AT_ONCE: Final = 200


@dataclass(frozen=True)
class BehaviorCheck:
    """FQE's value of the behavior policy, beside the returns that this policy had.

    The networks that predict the value of an episode were trained on the other half of the log.
    The next action of a logged step is the next logged one, and a step is drawn with the weight
    gamma^t. With this weight, the mean error of Q at a fixed point is the mean difference between
    the returns and the values of the first actions, also if several policies recorded the log: the
    sum of gamma^t (r_t + gamma Q_{t+1} - Q_t) over an episode is its return minus Q_0.

    Attributes:
        predicted: Mean value of the first logged actions of the episodes, over all networks.
        spread: Standard deviation of this value over the seeds.
        returned: Mean discounted return of the episodes. After the last action of a truncated
            episode, it is continued by the networks' value.
        interval: 95 % bootstrap-t interval of that mean.
    """

    predicted: float
    spread: float
    returned: float
    interval: tuple[float, float]

    @property
    def passes(self) -> bool:
        """Whether the prediction is within the interval."""
        return self.interval[0] <= self.predicted <= self.interval[1]

    def to_json(self) -> dict[str, Any]:
        """Return the attributes, and `passes`."""
        return {**asdict(self), "passes": self.passes}

    def __str__(self) -> str:
        """Return a one-line summary."""
        low, high = self.interval
        text = (
            f"FQE predicts {self.predicted:.3f} +- {self.spread:.3f} for the behavior, whose"
            f" held-out episodes returned {self.returned:.3f} ({low:.3f} to {high:.3f})"
        )
        return text if self.passes else f"{text}: do not trust its values"


class BoxEvaluator(OffPolicyEvaluator):
    """Evaluator of policies with the actions of a Box on one log."""

    config_type: ClassVar[type[FQEConfig]] = BoxFQEConfig

    def __init__(self, dataset: Dataset, config: FQEConfig | None = None, seed: int = 0) -> None:
        """Prepare the evaluation on a log."""
        super().__init__(dataset, config, seed)
        self._first = np.cumsum(self._lengths) - self._lengths
        self._last = self._first + self._lengths - 1
        self._check: BehaviorCheck | None = None
        self._support: Support | None = None
        vectors = self._buffer.frames.vector
        if vectors.shape[1]:
            episodes = np.repeat(np.arange(len(self._lengths)), self._lengths)
            states = vectors[self._buffer.places[0]].numpy()
            self._support = Support(states, self._buffer.actions.numpy(), episodes, seed)

    def _check_space(self, space: spaces.Space[Any]) -> None:
        assert isinstance(space, spaces.Box)

    def check_behavior(self, on_update: Callable[[], None] = lambda: None) -> BehaviorCheck:
        """Compare FQE's value of the behavior with the returns of the log, once."""
        if self._check is not None:
            return self._check
        following = self._buffer.next_rows.numpy()
        ended = self._buffer.returns[1].numpy() == 0
        # What the behavior would have done after a truncated episode is unknown.
        known = (following >= 0) | ended
        if not all(known[self._folds() != fold].any() for fold in range(FOLDS)):
            raise UsageError("the log does not show two successive actions in each half of it")
        steps = np.concatenate([np.arange(length) for length in self._lengths])
        actions = self._buffer.actions
        rows = torch.from_numpy(np.concatenate([self._first, self._last]))
        found = self._fitted(
            actions[torch.from_numpy(np.maximum(following, 0))],
            lambda learner: learner.values_of(actions[rows].expand(SEEDS, -1, -1), rows),
            known * self.gamma**steps,
            on_update,
        )
        first, last = np.split(found, 2, axis=1)
        rewards = self._padded(self._dataset.rewards, 0.0)
        cut = np.flatnonzero(~known[self._last])
        rewards[cut, self._lengths[cut] - 1] = last.mean(0)[cut]
        returns = rewards @ self.gamma ** np.arange(rewards.shape[1], dtype=np.float64)
        interval = RatioEstimate.mean(returns).interval(self._counts)
        seeds = first.mean(1)
        self._check = BehaviorCheck(
            float(seeds.mean()), float(seeds.std(ddof=1)), float(returns.mean()), interval
        )
        return self._check

    def evaluate(
        self,
        policy: BasePolicy | None,
        name: str,
        *,
        epsilon: float = 0.0,
        on_update: Callable[[], None] = lambda: None,
    ) -> PolicyEstimates:
        """Estimate a policy's return by FQE and importance sampling; None acts at random."""
        # `on_update` is called `updates_of_model` times per policy, and as many for
        # `check_behavior`.
        if epsilon:
            raise UsageError("`epsilon=` needs discrete actions; for a Box, evaluate without it")
        box = self._buffer.box
        assert box is not None
        policy = policy or RandomPolicy(self._dataset.action_space)
        check = self.check_behavior(on_update)
        here, there = (box.scaled(part) for part in self._in_states(policy, policy.act))
        chosen, rows = torch.from_numpy(here[self._first]), torch.from_numpy(self._first)
        values = self._fitted(
            torch.from_numpy(there),
            lambda learner: learner.values_of(chosen.expand(SEEDS, -1, -1), rows),
            np.ones(len(here)),
            on_update,
        ).mean(1)
        verdict = self._verdict_on_model()
        if not check.passes:
            low, high = check.interval
            verdict = (
                f"refused: {check.predicted:.2f} for the behavior, which returned {low:.2f} to"
                f" {high:.2f}"
            )
        fqe = Estimate(
            name, "FQE", float(values.mean()), None, None, verdict, spread=float(values.std(ddof=1))
        )
        weights, refused = self._ratios(policy)
        nothing = np.zeros(len(here))
        found = self._importance(name, PER_DECISION, refused, weights, nothing, nothing, nothing)
        support = None if self._support is None else self._support.of(here)
        return PolicyEstimates(name, None, (fqe, *self._marked(tuple(found))), support)

    def _fitted(
        self, next_actions: Tensor, values: _Values, weights: Floats, on_update: Callable[[], None]
    ) -> Floats:
        """Return values (SEEDS, C * E) by networks that were not trained on the episode."""
        # `values` gives C values of each of the E episodes, from a trained learner.
        fold, parts = self._folds(), []
        for held_out in range(FOLDS):
            training = self._buffer.with_weights(np.where(fold == held_out, 0.0, weights))
            seeds = [self._seed + held_out * SEEDS + k for k in range(SEEDS)]
            learner = BoxFQE(self._config, training, seeds, next_actions.expand(SEEDS, -1, -1))
            for _ in range(self._config.updates):
                learner.update()
                on_update()
            parts.append(values(learner).numpy().astype(np.float64))
        return np.where(np.tile(self._fold, parts[0].shape[1] // len(self._fold)) == 0, *parts)

    def _folds(self) -> NDArray[np.int64]:
        """Return the half (N,) of the log that each transition belongs to."""
        return np.repeat(self._fold, self._lengths)

    def _ratios(self, policy: BasePolicy) -> tuple[Floats, str | None]:
        """Return the ratios (N,) of the densities of the logged actions, or a refusal."""
        behavior = self._dataset.behavior.astype(np.float64)
        refused = unusable(behavior, self._dataset.behavior_field)
        try:
            own = self._log_densities(policy)
        except PolicyError as error:
            return np.ones(len(behavior)), f"refused: {error}"
        if np.isnan(own).any():
            refused = f"refused: {policy.name} has no density of {np.isnan(own).sum()} actions"
        with np.errstate(over="ignore", invalid="ignore"):
            return np.exp(own - behavior), refused

    def _log_densities(self, policy: BasePolicy) -> Floats:
        """Return the log densities (N,) of the logged actions under a policy."""
        parts = []
        for episode in self._dataset.episodes:
            seen = rows_of(policy_inputs(policy, episode), slice(len(episode)))
            parts.append(policy.log_prob(seen, episode.actions))
        return np.concatenate(parts).astype(np.float64)

    def _verdict_on_weights(self, estimator: str, table: EpisodeTable, size: float) -> str:
        verdict = super()._verdict_on_weights(estimator, table, size)
        if verdict == TRUSTED:
            return verdict
        steps = usable_steps(table, self._lengths, LEAST_SAMPLE_SIZE)
        return f"{verdict}; usable up to step {steps} of {self._lengths.max()}"


class Support:
    """Whether a log has actions like those of a policy, in states like those of the log.

    The distance of an action in a state to the log is that to the nearest logged pair of a
    state and an action of another episode: successive steps of one episode are alike. Each
    number of a state or an action is divided by its standard deviation in the log. The mean
    squares over the numbers of a state and over those of an action are added, so both count the
    same, however many numbers there are.

    An action is supported if its distance is at most the 95 % quantile of the distances of the
    logged actions, computed in the same way. Of the actions of the behavior policy, 95 % are
    thus supported.
    """

    def __init__(
        self,
        states: NDArray[np.floating[Any]],
        actions: NDArray[np.floating[Any]],
        episodes: NDArray[np.int64],
        seed: int = 0,
    ) -> None:
        """Compute the distances of the logged actions, of at most 2,000 rows with 20,000."""
        order = np.random.default_rng(seed).permutation(len(states))
        self._queries, self._references = np.sort(order[:_QUERIES]), np.sort(order[:_REFERENCES])
        self._states = _scaled(states, states)
        self._logged = np.asarray(actions, np.float64)
        self._episodes = episodes
        self.limit = float(np.quantile(self._distances(self._logged), QUANTILE))

    def of(self, actions: NDArray[np.floating[Any]]) -> float:
        """Return the fraction of actions (N, n) in the logged states that are supported."""
        return float((self._distances(actions) <= self.limit).mean())

    def _distances(self, actions: NDArray[np.floating[Any]]) -> Floats:
        """Return the distances of the actions in the states of the queries."""
        queries, references = self._queries, self._references
        points = np.hstack(
            [self._states[references], _scaled(self._logged, self._logged[references])]
        )
        asked = np.hstack([self._states[queries], _scaled(self._logged, actions[queries])])
        found = []
        for start in range(0, len(queries), _AT_ONCE):
            part = slice(start, start + _AT_ONCE)
            distances = cdist(asked[part], points)
            same = self._episodes[queries[part], None] == self._episodes[references]
            found.append(np.where(same, np.inf, distances).min(1))
        return np.concatenate(found)


def _scaled(logged: NDArray[np.floating[Any]], values: NDArray[np.floating[Any]]) -> Floats:
    """Divide values by `logged`'s deviations (constants: 1) and by the root of n."""
    deviations = np.asarray(logged, np.float64).std(0)
    scale = np.where(deviations > 0, deviations, 1.0) * np.sqrt(logged.shape[1])
    found: Floats = np.asarray(values, np.float64) / scale
    return found
