"""Algorithms by name: the built-in ones, and those of installed packages.

A package adds an algorithm with an entry point of the group `mcaprl.algorithms`, which maps
the algorithm's name to its `Learner` subclass, `module:Class`. A name may stand for two built-in
algorithms: one for finite action spaces, and one for the actions of a Box.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final, NamedTuple

from gymnasium import spaces

from mcaprl.actions import short_name
from mcaprl.errors import SpaceError, UnknownNameError, UsageError
from mcaprl.lazy import installed, load
from mcaprl.offline.algorithms.bc import BC, BoxBC
from mcaprl.offline.algorithms.bcq import BCQ
from mcaprl.offline.algorithms.config import ENTRY_POINT_GROUP, TrainingConfig
from mcaprl.offline.algorithms.cql import CQL
from mcaprl.offline.algorithms.dqn import DQN, DoubleDQN
from mcaprl.offline.algorithms.iql import IQL, BoxIQL
from mcaprl.offline.algorithms.learner import Learner
from mcaprl.offline.algorithms.td3 import TD3BC, ReBRAC
from mcaprl.settings import check_settings

ALGORITHMS: dict[str, type[Learner]] = {
    learner.name: learner for learner in (DQN, DoubleDQN, CQL, BC, BCQ, IQL)
}
"""The built-in algorithms for finite action spaces."""
BOX_ALGORITHMS: dict[str, type[Learner]] = {
    learner.name: learner for learner in (BoxBC, TD3BC, ReBRAC, BoxIQL)
}
"""The built-in algorithms for the actions of a Box."""
_BUILT_IN: Final = [*ALGORITHMS.values(), *BOX_ALGORITHMS.values()]
_DEFAULTS: Final = (CQL, BoxIQL)
_ONLINE: Final = ("sac", "td3")
"""Names of learners of online training alone, which overestimate actions that no log has."""
_SUGGESTED: Final = {False: "cql or iql", True: "iql or rebrac"}


class Algorithm(NamedTuple):
    """An algorithm and its settings."""

    learner_type: type[Learner]
    config: TrainingConfig


def all_algorithms() -> list[type[Learner]]:
    """Return the built-in algorithms and those of installed packages."""
    entries = installed(ENTRY_POINT_GROUP).values()
    names = {learner.name for learner in _BUILT_IN}
    return [*_BUILT_IN, *(load(entry, Learner, names) for entry in entries)]


def algorithms_named(
    algo: str | type[Learner] | None, others: Iterable[str] = ()
) -> list[type[Learner]]:
    """Return the algorithms with a name; None for the default algorithms."""
    if algo is None:
        return list(_DEFAULTS)
    if not isinstance(algo, str):
        return [_checked(algo)]
    if found := [learner for learner in _BUILT_IN if learner.name == algo]:
        return found
    entries = installed(ENTRY_POINT_GROUP)
    if algo in _ONLINE and algo not in entries:
        raise UsageError(f"{algo} learns online only, not from logs: use {_SUGGESTED[True]}")
    if algo not in entries:
        known = dict.fromkeys(learner.name for learner in _BUILT_IN)
        raise UnknownNameError("algorithm", algo, [*known, *entries, *others])
    return [load(entries[algo], Learner, ALGORITHMS | BOX_ALGORITHMS)]


def choose_algorithm(
    algo: str | type[Learner] | TrainingConfig | Algorithm | None,
    others: Iterable[str] = (),
    *,
    space: spaces.Space[Any] | None = None,
) -> Algorithm:
    """Return an algorithm and its settings, by a name, a class, a config, or as given."""
    if isinstance(algo, Algorithm):
        found = [algo]
    elif isinstance(algo, TrainingConfig):
        found = [Algorithm(_learner_of(algo), algo)]
    else:
        named = algorithms_named(algo, others)
        found = [Algorithm(learner, learner.config_type()) for learner in named]
    if space is None:
        return found[0]
    is_box = isinstance(space, spaces.Box)
    for each in found:
        if each.learner_type.continuous == is_box:
            return each
    needed = "discrete actions" if is_box else "the actions of a Box"
    raise SpaceError(
        f"{found[0].learner_type.name} needs {needed}; for {short_name(space)} use"
        f" {_SUGGESTED[is_box]}"
    )


def configured(
    algo: str | type[Learner] | None,
    settings: dict[str, Any],
    others: Iterable[str] = (),
    *,
    space: spaces.Space[Any] | None = None,
) -> Algorithm:
    """Return an algorithm with some settings; without a space, one with them by this name."""
    if space is not None:
        named = [choose_algorithm(algo, others, space=space).learner_type]
    else:
        named = algorithms_named(algo, others)
    errors: list[UsageError] = []
    for learner in named:
        try:
            check_settings(learner.name, learner.config_type, settings)
            return Algorithm(learner, learner.config_type(**settings))
        except UsageError as error:
            errors.append(error)
    raise errors[0]


def _learner_of(config: TrainingConfig) -> type[Learner]:
    algorithms = _BUILT_IN
    if not any(type(config) is learner.config_type for learner in algorithms):
        algorithms = all_algorithms()
    for learner in algorithms:
        if type(config) is learner.config_type:
            return learner
    known = ", ".join(learner.config_type.__name__ for learner in algorithms)
    raise UsageError(f"no algorithm has a config of type {type(config).__name__}; known: {known}")


def _checked(learner: type[Learner]) -> type[Learner]:
    """Check that a class can be trained without an entry point."""
    if not (isinstance(learner, type) and issubclass(learner, Learner)):
        raise UsageError(f"{learner!r} is not an algorithm: pass a name or a subclass of Learner")
    missing = [name for name in ("name", "config_type", "acts_by") if not hasattr(learner, name)]
    if missing or learner.__abstractmethods__:
        names = ", ".join([*missing, *sorted(learner.__abstractmethods__)])
        raise UsageError(f"the algorithm {learner.__name__} does not define {names}")
    if learner not in _BUILT_IN and any(each.name == learner.name for each in _BUILT_IN):
        raise UsageError(
            f"the algorithm {learner.__name__} has the name {learner.name!r} of a built-in one"
        )
    return learner
