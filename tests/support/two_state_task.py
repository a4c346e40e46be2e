"""An MDP with two states whose values follow from linear equations.

The reward of a step is `PAYS[state, action]`. A step ends the episode with probability 0.25.
Otherwise, it leads to state 1 with probability `TO_ONE[state, action]`. Episodes start in state 0.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mcaprl.offline.estimate.importance import EpisodeTable

GAMMA = 0.9
ENDS = 0.25
PAYS = np.array([[1.0, 0.0], [0.0, 2.0]])
TO_ONE = np.array([[0.2, 0.8], [0.3, 0.6]])
BEHAVIOR = np.array([[0.6, 0.4], [0.5, 0.5]])
"""(states, actions) action probabilities of the behavior policy."""
EVALUATED = np.array([[0.4, 0.6], [0.35, 0.65]])
"""(states, actions) action probabilities of the evaluated policy."""


def _values() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Solve Q (2, 2) and V (2,) of EVALUATED: Q = r + gamma (1 - ENDS) P V, V = sum_a pi Q."""
    after = np.stack([1 - TO_ONE, TO_ONE], axis=-1)
    step = np.einsum("sa,sat->st", EVALUATED, after)
    paid = (EVALUATED * PAYS).sum(1)
    v = np.linalg.solve(np.eye(2) - GAMMA * (1 - ENDS) * step, paid)
    return PAYS + GAMMA * (1 - ENDS) * after @ v, v


TRUE_Q, TRUE_V = _values()


def true_value() -> float:
    """Return the expected discounted return of EVALUATED from the start."""
    return float(TRUE_V[0])


def play(policy: NDArray[np.float64] | None, *, episodes: int, seed: int) -> EpisodeTable:
    """Sample episodes of a policy; None means BEHAVIOR.

    The table has the ratios, the true Q and the true V of EVALUATED. Episodes are cut off after 60
    steps; only one in 30 million episodes is that long.
    """
    acting = BEHAVIOR if policy is None else policy
    random = np.random.default_rng(seed)
    steps = 60
    shape = (episodes, steps + 1)
    rewards, ratios, q, v = np.zeros(shape), np.ones(shape), np.zeros(shape), np.zeros(shape)
    state, alive = np.zeros(episodes, dtype=np.int64), np.ones(episodes, dtype=bool)
    for t in range(steps):
        action = (random.random(episodes) < acting[state, 1]).astype(np.int64)
        rewards[:, t] = np.where(alive, PAYS[state, action], 0.0)
        ratios[:, t] = np.where(alive, EVALUATED[state, action] / acting[state, action], 1.0)
        q[:, t] = np.where(alive, TRUE_Q[state, action], 0.0)
        v[:, t] = np.where(alive, TRUE_V[state], 0.0)
        to_one = random.random(episodes) < TO_ONE[state, action]
        alive &= random.random(episodes) >= ENDS
        state = to_one.astype(np.int64)
    v[:, steps] = np.where(alive, TRUE_V[state], 0.0)
    return EpisodeTable(rewards, ratios, q, v, GAMMA)
