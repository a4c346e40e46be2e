"""A batch of transitions, copied out of a dataset."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Batch:
    """B transitions of a dataset, copied.

    Attributes:
        observations: (B, *shape), or nested dicts of such arrays.
        actions: (B,) int64, or (B, *shape).
        rewards: (B,) float64.
        terminated: (B,) bool.
        truncated: (B,) bool.
        next_observations: like `observations`, one step on.
        behavior_probs: (B,) float32; NaN where unknown.
    """

    observations: Any
    actions: NDArray[Any]
    rewards: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    next_observations: Any
    behavior_probs: NDArray[np.float32]
