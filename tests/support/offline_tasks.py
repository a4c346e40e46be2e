"""A small task with a known optimum: a corridor of five cells with an exit at each end.

Cell 0 is an exit with the reward 0.3, and cell 4 is an exit with the reward 1; both terminate. In
the cells between them, action 0 goes left, action 1 goes right, and rewards are 0. Observations are
one-hot, so a network is equivalent to a table.
"""

from __future__ import annotations

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.recorder.dataset.dataset import Dataset

N_CELLS = 5
GAMMA = 0.9
PAYS = {0: 0.3, N_CELLS - 1: 1.0}
INNER_CELLS = range(1, N_CELLS - 1)
ACTION_SPACE = spaces.Discrete(2, start=5)
"""The actions start at 5, so that code that ignores `start` fails."""


def corridor(visits: dict[tuple[int, int], int] | None = None, repeat: int = 20) -> Dataset:
    """Create transitions of the corridor; each one is a separate episode.

    Args:
        visits: Number of times that each (cell, action) is in the data; default: once.
        repeat: Number of times that all transitions are repeated.
    """
    counts = visits or {(cell, action): 1 for cell in INNER_CELLS for action in (0, 1)}
    pairs = [pair for pair, count in counts.items() for _ in range(count)] * repeat
    cells = np.array([cell for cell, _ in pairs])
    moves = np.array([action for _, action in pairs])
    next_cells = cells + 2 * moves - 1
    ends = np.isin(next_cells, list(PAYS))
    return Dataset.from_arrays(
        observations=one_hot(cells),
        actions=moves + ACTION_SPACE.start,
        rewards=np.array([PAYS.get(int(cell), 0.0) for cell in next_cells]),
        terminated=ends,
        truncated=~ends,
        next_observations=one_hot(next_cells),
        env_id="Corridor-v0",
        observation_space=spaces.Box(0, 1, (N_CELLS,), np.float32),
        action_space=ACTION_SPACE,
    )


def optimal_values() -> NDArray[np.float64]:
    """Compute Q of the inner cells, (3, 2), by value iteration."""
    q = np.zeros((N_CELLS, 2))
    for _ in range(100):
        for cell in INNER_CELLS:
            for action, after in ((0, cell - 1), (1, cell + 1)):
                q[cell, action] = PAYS.get(after, GAMMA * q[after].max())
    return q[list(INNER_CELLS)]


def inner_observations() -> NDArray[np.float32]:
    """Return the observations of the three inner cells, (3, 5)."""
    return one_hot(np.array(INNER_CELLS))


def one_hot(cells: NDArray[np.int64]) -> NDArray[np.float32]:
    """Return the one-hot observations of N cells, (N, 5)."""
    return np.eye(N_CELLS, dtype=np.float32)[cells]


def crossing(lengths: tuple[int, ...] = (40, 30, 50), n_actions: int = 1) -> Dataset:
    """Create episodes in which the observation is the number of the step, and each reward is 1."""
    steps = np.concatenate([np.arange(length, dtype=np.float32) for length in lengths])[:, None]
    last = np.concatenate([np.arange(1, length + 1) == length for length in lengths])
    return Dataset.from_arrays(
        observations=steps,
        actions=np.zeros(len(steps), np.int64),
        rewards=np.ones(len(steps)),
        terminated=last,
        truncated=np.zeros(len(steps), bool),
        next_observations=steps + 1,
        env_id="Crossing-v0",
        action_space=spaces.Discrete(n_actions),
    )


A_LQ, B_LQ, COST_LQ = 0.9, 0.25, 0.05
"""The regulator x' = A x + B u with the reward -(x^2 + COST u^2)."""
BOX_LQ = spaces.Box(-4, 4, (1,), np.float32)


def riccati() -> tuple[float, float]:
    """Return P and K of the regulator: the optimal value is -P x^2, the optimal action -K x."""
    p = 1.0
    for _ in range(1_000):
        p = 1 + A_LQ * GAMMA * p * A_LQ * COST_LQ / (COST_LQ + GAMMA * B_LQ**2 * p)
    return p, GAMMA * A_LQ * B_LQ * p / (COST_LQ + GAMMA * B_LQ**2 * p)


def regulator(count: int = 4_000, noise: float | None = None, seed: int = 0) -> Dataset:
    """Create transitions of the regulator from random states; each one is a separate episode.

    The actions are random in the Box. With `noise`, they are the optimal ones with normal noise.
    """
    random = np.random.default_rng(seed)
    x = random.uniform(-1, 1, (count, 1)).astype(np.float32)
    u = random.uniform(-4, 4, (count, 1))
    if noise is not None:
        u = (-riccati()[1] * x + noise * random.standard_normal((count, 1))).clip(-4, 4)
    return Dataset.from_arrays(
        observations=x,
        actions=u.astype(np.float32),
        rewards=-(x**2 + COST_LQ * u**2).ravel(),
        terminated=np.zeros(count, bool),
        truncated=np.ones(count, bool),
        next_observations=(A_LQ * x + B_LQ * u).astype(np.float32),
        observation_space=spaces.Box(-4, 4, (1,), np.float32),
        action_space=BOX_LQ,
    )
