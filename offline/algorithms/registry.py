"""Algorithms by name: the built-in ones, and those of installed packages.

A package adds an algorithm with an entry point of the group `mcaprl.algorithms`, which maps
the algorithm's name to its `Learner` subclass, `module:Class`.
"""

from __future__ import annotations

from collections.abc import Iterable
from importlib.metadata import EntryPoint, entry_points

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
    return ALGORITHMS | {name: _load(entry) for name, entry in _entry_points().items()}


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
        entries = _entry_points()
        if algo not in entries:
            raise UnknownNameError("algorithm", algo, [*ALGORITHMS, *entries, *others])
        learner = _load(entries[algo])
        return learner, learner.config_type()
    algorithms = ALGORITHMS
    if not any(type(algo) is learner.config_type for learner in algorithms.values()):
        algorithms = all_algorithms()
    for learner in algorithms.values():
        if type(algo) is learner.config_type:
            return learner, algo
    known = ", ".join(learner.config_type.__name__ for learner in algorithms.values())
    raise UsageError(f"no algorithm has a config of type {type(algo).__name__}; known: {known}")


def _entry_points() -> dict[str, EntryPoint]:
    return {entry.name: entry for entry in entry_points(group=ENTRY_POINT_GROUP)}


def _load(entry: EntryPoint) -> type[Learner]:
    """Import the algorithm of an entry point, and check it."""
    try:
        found = entry.load()
    except Exception as error:  # Importing a module can raise any exception.
        raise _broken(entry, f"{type(error).__name__}: {error}") from error
    if not (isinstance(found, type) and issubclass(found, Learner)):
        raise _broken(entry, "it is not a subclass of Learner")
    if found.name != entry.name:
        raise _broken(entry, f"its algorithm is named {found.name!r}")
    if entry.name in ALGORITHMS:
        raise _broken(entry, "a built-in algorithm has this name")
    return found


def _broken(entry: EntryPoint, reason: str) -> UsageError:
    package = entry.dist.name if entry.dist else "unknown"
    return UsageError(
        f"entry point {entry.name!r} ({entry.value}) of package {package} in group"
        f" {ENTRY_POINT_GROUP} is broken: {reason}; fix or uninstall the package"
    )
