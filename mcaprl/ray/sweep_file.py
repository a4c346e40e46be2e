"""Sweep files: algorithms, settings and seeds to train, in YAML or JSON.

    algos: [bc, cql]              algorithms, or a mapping from algorithms to their settings
    settings:                     settings; each applies to the algorithms that have it
      updates: 4000
      learning_rate: [3e-4, 1e-3] each value of a list is tried, in all combinations
    seeds: 2                      number of networks of each combination
    seed: 0                       seed of the first network
    score:
      every: 1000                 updates between two scores
      fraction: 0.2               part of the episodes that is used only for scores
      updates: 1000               updates of the model that the estimators use
      epsilon: 0.1                probability of random actions of the scored policies
      gamma: 0.97                 discount of the scores
    stop: 3                       1 of 3 trials continues after each stage; 0: all continue

Only `algos` is required.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from mcaprl.errors import UsageError
from mcaprl.files import read_yaml
from mcaprl.offline.algorithms.config import TrainingConfig
from mcaprl.offline.algorithms.registry import choose_algorithm
from mcaprl.settings import check_settings

MOST_TRIALS = 10_000


@dataclass(frozen=True)
class Scoring:
    """Settings for scoring policies. The docstring of the module describes the fields."""

    every: int = 1_000
    fraction: float = 0.2
    updates: int = 1_000
    epsilon: float = 0.1
    gamma: float = 0.97

    def __post_init__(self) -> None:
        """Validate the fields."""
        for name in ("every", "updates"):
            if getattr(self, name) < 1:
                raise UsageError(f"score: {name} must be at least 1, got {getattr(self, name)}")
        if not 0 < self.fraction < 1:
            raise UsageError(f"score: fraction must be between 0 and 1, got {self.fraction}")
        for name in ("epsilon", "gamma"):
            if not 0 <= getattr(self, name) <= 1:
                raise UsageError(f"score: {name} must be within [0, 1], got {getattr(self, name)}")


@dataclass(frozen=True)
class Trial:
    """One combination of algorithm and settings.

    Attributes:
        name: Name of the folder of the trial, such as `cql-003`.
        algo: Name of the algorithm.
        config: Settings.
        varied: This trial's values of the settings that have several values in the file.
    """

    name: str
    algo: str
    config: TrainingConfig
    varied: dict[str, Any]


@dataclass(frozen=True)
class SweepPlan:
    """Content of a sweep file."""

    trials: tuple[Trial, ...]
    seeds: int = 1
    seed: int = 0
    score: Scoring = field(default_factory=Scoring)
    stop: int = 3


def read_plan(source: str | Path | Mapping[str, Any]) -> SweepPlan:
    """Read and check a sweep file, or a mapping of the same form."""
    where, tree = "the sweep", source
    if not isinstance(source, Mapping):
        where, tree = str(source), read_yaml(Path(source), "ray")
    try:
        return _plan(tree)
    except UsageError as error:
        raise UsageError(f"{where}: {error}") from error


def _plan(tree: object) -> SweepPlan:
    tree = _mapping("a sweep", tree, ["algos", "settings", "seeds", "seed", "score", "stop"])
    found = tree.get("algos")
    if isinstance(found, list):
        found = {str(name): {} for name in found}
    if not isinstance(found, Mapping) or not found:
        raise UsageError("algos must be a list of algorithms, or a mapping to their settings")
    common = _mapping("settings", tree.get("settings"), None)
    names = {str(name) for name in common}
    numbers = {
        name: _typed(name, tree.get(name, default), default)
        for name, default in (("seeds", 1), ("seed", 0), ("stop", 3))
    }
    if numbers["seeds"] < 1 or numbers["seed"] < 0 or numbers["stop"] not in (0, *range(2, 100)):
        raise UsageError("seeds must be at least 1, seed at least 0, and stop 0 or 2 to 99")
    score = _scoring(tree.get("score"))
    trials: list[Trial] = []
    for algo, own in found.items():
        _, defaults = choose_algorithm(str(algo))
        own = _mapping(f"algos: {algo}", own, None)
        known = {one.name for one in fields(defaults)}
        check_settings(str(algo), defaults, map(str, own))
        names -= known
        values = {name: value for name, value in common.items() if name in known} | dict(own)
        trials += _combinations(str(algo), defaults, values, score, len(trials))
    if names:
        for name in sorted(names):
            # No algorithm has this setting. Raise the error of the first algorithm, which lists
            # the settings that it has.
            check_settings(
                str(next(iter(found))), choose_algorithm(str(next(iter(found))))[1], [name]
            )
    return SweepPlan(tuple(trials), score=score, **numbers)


def _combinations(
    algo: str, defaults: TrainingConfig, values: Mapping[str, Any], score: Scoring, first: int
) -> list[Trial]:
    choices = {
        name: [_typed(name, one, getattr(defaults, name)) for one in _listed(name, value, defaults)]
        for name, value in values.items()
    }
    several = [name for name, options in choices.items() if len(options) > 1]
    found = []
    for number, chosen in enumerate(itertools.product(*choices.values()), first):
        if number >= MOST_TRIALS:
            raise UsageError(f"more than {MOST_TRIALS:,} combinations: remove some values")
        settings = dict(zip(choices, chosen, strict=True))
        # Policies are scored at each checkpoint, so `every` is the checkpoint interval.
        config = type(defaults)(**{"checkpoint_interval": score.every, **settings})
        if config.checkpoint_interval != score.every:
            raise UsageError("checkpoint_interval is the `every` of score: set that instead")
        varied = {name: settings[name] for name in several}
        found.append(Trial(f"{algo}-{number:03d}", algo, config, varied))
    return found


def _listed(name: str, value: Any, defaults: TrainingConfig) -> list[Any]:
    """Return the values to try.

    If each value of the setting is a list, a flat list is one value, and a list of lists contains
    several values.
    """
    is_list = isinstance(value, list)
    if isinstance(getattr(defaults, name), tuple):
        return value if is_list and any(isinstance(one, list) for one in value) else [value]
    if is_list and not value:
        raise UsageError(f"{name} has no values")
    return value if is_list else [value]


def _typed(name: str, value: Any, default: Any) -> Any:
    """Return a value as the type of the default."""
    kind = type(default)
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if kind is tuple and isinstance(value, list | tuple):
        if all(type(one) is int for one in value):
            return tuple(value)
    elif type(value) is kind:
        return value
    wanted = {"int": "a whole number", "float": "a number", "bool": "true or false"}
    text = wanted.get(kind.__name__, "a list of whole numbers" if kind is tuple else "text")
    raise UsageError(f"{name} must be {text}, got {json.dumps(value, default=str, skipkeys=True)}")


def _scoring(tree: object) -> Scoring:
    known = {one.name: one.default for one in fields(Scoring)}
    given = _mapping("score", tree, list(known))
    return Scoring(**{name: _typed(name, value, known[name]) for name, value in given.items()})


def _mapping(what: str, tree: object, known: list[str] | None) -> Mapping[str, Any]:
    if tree is None and what != "a sweep":
        return {}
    if not isinstance(tree, Mapping):
        raise UsageError(f"{what} must be a mapping of names to values")
    for name in tree:
        if known is not None and name not in known:
            raise UsageError(f"{what} has no key {name!r}; it has {', '.join(known)}")
    return tree
