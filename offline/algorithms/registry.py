"""The algorithms by name."""

from __future__ import annotations

from mcaprl.errors import UnknownNameError, UsageError
from mcaprl.offline.algorithms.bc import BC
from mcaprl.offline.algorithms.bcq import BCQ
from mcaprl.offline.algorithms.config import TrainingConfig
from mcaprl.offline.algorithms.cql import CQL
from mcaprl.offline.algorithms.dqn import DQN, DoubleDQN
from mcaprl.offline.algorithms.iql import IQL
from mcaprl.offline.algorithms.learner import Learner

ALGORITHMS: dict[str, type[Learner]] = {
    learner.name: learner for learner in (DQN, DoubleDQN, CQL, BC, BCQ, IQL)
}


def choose_algorithm(algo: str | TrainingConfig) -> tuple[type[Learner], TrainingConfig]:
    """Find an algorithm by its name, or by its settings.

    Args:
        algo: a key of `ALGORITHMS`, for default settings; or an algorithm's config.

    Raises:
        UnknownNameError: no algorithm has that name.
        UsageError: no algorithm has such a config.
    """
    if isinstance(algo, str):
        if algo not in ALGORITHMS:
            raise UnknownNameError("algorithm", algo, ALGORITHMS)
        return ALGORITHMS[algo], ALGORITHMS[algo].config_type()
    for learner in ALGORITHMS.values():
        if type(algo) is learner.config_type:
            return learner, algo
    known = ", ".join(learner.config_type.__name__ for learner in ALGORITHMS.values())
    raise UsageError(f"no algorithm has a {type(algo).__name__}; known: {known}")
