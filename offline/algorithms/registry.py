"""Algorithms by name: the built-in ones, and those of installed packages.

A package adds an algorithm with an entry point of the group `mcaprl.algorithms`, which maps
the algorithm's name to its `Learner` subclass, `module:Class`.
"""

from __future__ import annotations

from collections.abc import Iterable

from mcaprl.entry_points import installed, load
from mcaprl.errors import UnknownNameError, UsageError
from mcaprl.offline.algorithms.bc import BC
from mcaprl.offline.algorithms.bcq import BCQ
from mcaprl.offline.algorithms.config import ENTRY_POINT_GROUP, TrainingConfig
from mcaprl.offline.algorithms.cql import CQL
from mcaprl.offline.algorithms.dqn import DQN, DoubleDQN
from mcaprl.offline.algorithms.iql import IQL
from mcaprl.offline.algorithms.learner import Learner

ALGORITHMS: dict[str, type[Learner]] = {
    learner.name: learner for learner in (DQN, DoubleDQN, CQL, BC, BCQ, IQL)
}
"""The built-in algorithms."""


def all_algorithms() -> dict[str, type[Learner]]:
    """Return the built-in algorithms and those of installed packages.

    Raises:
        UsageError: An entry point is broken.
    """
    entries = installed(ENTRY_POINT_GROUP)
    return ALGORITHMS | {name: load(entry, Learner, ALGORITHMS) for name, entry in entries.items()}


def choose_algorithm(
    algo: str | TrainingConfig, others: Iterable[str] = ()
) -> tuple[type[Learner], TrainingConfig]:
    """Return an algorithm and its settings.

    Args:
        algo: Name of an algorithm, for default settings; or an algorithm's config.
        others: More names that the caller accepts, for the message about an unknown name.

    Raises:
        UnknownNameError: No algorithm has that name.
        UsageError: No algorithm has a config of this type, or an entry point is broken.
    """
    if isinstance(algo, str):
        if algo in ALGORITHMS:
            return ALGORITHMS[algo], ALGORITHMS[algo].config_type()
        entries = installed(ENTRY_POINT_GROUP)
        if algo not in entries:
            raise UnknownNameError("algorithm", algo, [*ALGORITHMS, *entries, *others])
        learner = load(entries[algo], Learner, ALGORITHMS)
        return learner, learner.config_type()
    algorithms = ALGORITHMS
    if not any(type(algo) is learner.config_type for learner in algorithms.values()):
        algorithms = all_algorithms()
    for learner in algorithms.values():
        if type(algo) is learner.config_type:
            return learner, algo
    known = ", ".join(learner.config_type.__name__ for learner in algorithms.values())
    raise UsageError(f"no algorithm has a config of type {type(algo).__name__}; known: {known}")
