"""Properties of a log that `auto` considers, and the candidates that it trains."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from mcaprl.errors import UnknownNameError
from mcaprl.offline.algorithms.config import TrainingConfig
from mcaprl.offline.algorithms.registry import choose_algorithm
from mcaprl.offline.estimate.evidence import Clone, likely
from mcaprl.offline.estimate.values import by_rows
from mcaprl.offline.selection.config import ALL, AutoConfig
from mcaprl.recorder.dataset.lint import lint
from mcaprl.recorder.format.probability import is_impossible

if TYPE_CHECKING:
    from mcaprl.recorder.dataset.dataset import Dataset

DETERMINISTIC: Final = 0.05
"""If the entropy of the behavior policy is lower, candidates are rated by agreement with it."""
LEAST_COVERAGE: Final = 0.5
"""Fraction of the actions that must be likely in the log before Double DQN is tried."""
_IQL_INTERVAL: Final = 50
_OWN: Final = ("finalists", "survivors", "short_fraction", "model_updates")


@dataclass(frozen=True)
class LogTraits:
    """Properties of a log that determine which algorithms may work.

    Attributes:
        episodes: Number of episodes.
        transitions: Number of transitions.
        mean_return: Mean undiscounted return of the episodes.
        return_spread: Standard deviation of these returns.
        terminated: Fraction of the episodes that end in a terminal state.
        entropy: Mean entropy of the behavior policy, from 0 (deterministic) to 1 (uniform). If all
            logged probabilities are valid, it is computed from them, otherwise from the clone.
        coverage: Mean fraction of the actions that are likely under the behavior policy.
        probabilities: Whether the log has the probabilities of its actions.
        problems: Problems that the lint found.
    """

    episodes: int
    transitions: int
    mean_return: float
    return_spread: float
    terminated: float
    entropy: float
    coverage: float
    probabilities: bool
    problems: tuple[str, ...]

    @property
    def is_deterministic(self) -> bool:
        """Whether the behavior is almost deterministic."""
        return self.entropy < DETERMINISTIC

    def to_json(self) -> dict[str, Any]:
        """Return the attributes as plain JSON types."""
        return {**asdict(self), "problems": list(self.problems)}


def traits_of(dataset: Dataset, clone: Clone) -> LogTraits:
    """Return the properties of a log. The clone imitates its behavior policy."""
    chances = by_rows(clone.action_probabilities, dataset.observations).astype(np.float64)
    behavior = dataset.behavior_probs.astype(np.float64)
    known = not bool((np.isnan(behavior) | is_impossible(behavior)).any())
    logs = np.log(np.where(chances > 0, chances, 1.0))
    nats = -np.log(behavior).mean() if known else -(chances * logs).sum(1).mean()
    returns = dataset.statistics.returns
    return LogTraits(
        episodes=len(dataset.episodes),
        transitions=len(dataset),
        mean_return=float(returns.mean()),
        return_spread=float(returns.std()),
        terminated=float(dataset.terminated.sum() / len(dataset.episodes)),
        entropy=float(nats / np.log(max(chances.shape[1], 2))),
        coverage=float(likely(chances).mean()),
        probabilities=known,
        problems=tuple(one.what for one in lint(dataset) if one.severity == "problem"),
    )


@dataclass(frozen=True)
class Candidate:
    """Algorithm with settings that differ from the shared ones.

    Attributes:
        name: Name in tables and of the folder of its run.
        algo: Name of the algorithm.
        special: Settings that differ from the shared ones.
    """

    name: str
    algo: str
    special: Mapping[str, Any]

    def config(self, shared: AutoConfig) -> TrainingConfig:
        """Return the settings of the algorithm. Its special settings override the shared ones."""
        _, defaults = choose_algorithm(self.algo)
        names = {field.name for field in fields(defaults)}
        given = {
            field.name: getattr(shared, field.name)
            for field in fields(shared)
            if field.name in names and field.name not in _OWN
        }
        if self.algo == "iql":
            given["target_interval"] = min(_IQL_INTERVAL, shared.target_interval)
        given["checkpoint_interval"] = shared.candidate_interval
        return replace(defaults, **{**given, **self.special})


PORTFOLIO: Final = (
    Candidate("iql", "iql", {"normalize_advantages": True, "beta": 0.3}),
    Candidate("cql-alpha-0.1", "cql", {"alpha": 0.1}),
    Candidate("bcq", "bcq", {}),
    Candidate("cql", "cql", {}),
    Candidate("bc", "bc", {}),
    Candidate("cql-scaled", "cql", {"scale_rewards": True}),
    Candidate("double-dqn", "double-dqn", {}),
)
"""All candidates, in the order of their training; the first is used if none can be evaluated."""


def skipped_candidates(traits: LogTraits) -> dict[str, str]:
    """Return a dict from the name of each candidate that is not tried on a log to the reason."""
    skipped = {}
    if traits.coverage <= LEAST_COVERAGE:
        skipped["double-dqn"] = (
            f"only {traits.coverage:.0%} of the actions are likely in the log, and it overestimates"
            " the others"
        )
    if traits.return_spread == 0 and traits.terminated == 0:
        alike = "all episodes have the same return, so there is nothing to prefer"
        skipped |= {one.name: alike for one in PORTFOLIO if one.algo not in ("bc", "bcq", "cql")}
    return skipped


def check_finalists(config: AutoConfig) -> None:
    """Check the names of the finalists.

    Raises:
        UnknownNameError: There is no candidate of this name.
    """
    known = [one.name for one in PORTFOLIO]
    for name in config.finalists.split(","):
        if name not in (*known, ALL):
            raise UnknownNameError("candidate", name, known)


def eligible(config: AutoConfig, trying: Sequence[Candidate]) -> frozenset[str]:
    """Return the names of the candidates among which the choice is made.

    These are the finalists, or all that are tried if a finalist is not.
    """
    names = frozenset(one.name for one in trying)
    finalists = frozenset(config.finalists.split(","))
    return finalists if finalists <= names else names


def tried(skipped: Sequence[str] | Mapping[str, str]) -> list[Candidate]:
    """Return the candidates of the portfolio that are not skipped."""
    return [one for one in PORTFOLIO if one.name not in skipped]
