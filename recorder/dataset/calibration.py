"""Calibration of logged behavior probabilities.

A log contains only the probability p of the action taken. Over actions drawn with probabilities p,
E[1 / p] is the number of actions with p > 0. The same holds for a range of probabilities: the sum
of 1 / p over the steps in that range, divided by the number of all steps, is the mean number of
actions per state whose probability is in the range. For example, an epsilon-greedy policy over nine
actions has one action of high probability and eight of low probability.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

EDGES: Final = (0.0, 0.02, 0.05, 0.1, 0.2, 0.5, 0.8, 1.0)
"""Edges of the probability ranges (low, high]."""
_STANDARD_ERRORS = 4.0
"""Largest deviation, in standard errors, that is attributed to chance."""


@dataclass(frozen=True)
class ProbabilityRange:
    """The steps whose action has a probability in one range.

    Attributes:
        probability: Mean probability of these actions.
        steps: Number of these steps.
        actions: Mean number of actions per state with a probability in the range.
    """

    probability: float
    steps: int
    actions: float


@dataclass(frozen=True)
class Calibration:
    """Consistency of the logged probabilities with the action space.

    Attributes:
        available: Number of actions in the action space.
        actions: Number of actions implied by the probabilities, the mean of 1 / p. It is smaller
            than `available` if some actions are never taken, and larger only if the logged
            probabilities are too small.
        error: Standard error of `actions`.
        ranges: The same estimate for each range of probabilities.
    """

    available: int
    actions: float
    error: float
    ranges: tuple[ProbabilityRange, ...]

    @property
    def possible(self) -> bool:
        """Whether the probabilities are consistent with the number of actions."""
        return self.actions <= self.available + _STANDARD_ERRORS * self.error + 1e-6

    def __str__(self) -> str:
        """Return a summary of one line."""
        text = (
            f"{self.actions:.2f} +- {self.error:.2f} actions; the action space has {self.available}"
        )
        return text if self.possible else f"{text}, so the logged probabilities are too small"

    def to_json(self) -> dict[str, Any]:
        """Return the JSON object that commands print."""
        ranges = [vars(one) for one in self.ranges]
        mine = {"available": self.available, "actions": self.actions, "error": self.error}
        return {**mine, "possible": self.possible, "ranges": ranges}


def calibration(
    behavior_probs: NDArray[np.floating], action_space: spaces.Space[Any]
) -> Calibration | None:
    """Estimate the calibration of logged probabilities.

    Args:
        behavior_probs: (N,) probability of each action taken.
        action_space: Space of the actions.

    Returns:
        None if the actions are not discrete, or a probability is unknown or 0.
    """
    if not isinstance(action_space, spaces.Discrete) or len(behavior_probs) < 2:
        return None
    if not (behavior_probs > 0).all():
        return None
    probs = behavior_probs.astype(np.float64)
    inverse = 1 / probs
    place = np.searchsorted(EDGES, probs)
    ranges = [
        ProbabilityRange(
            float(probs[place == k].mean()),
            int((place == k).sum()),
            float(inverse[place == k].sum() / len(probs)),
        )
        for k in np.unique(place)
    ]
    error = float(inverse.std(ddof=1) / math.sqrt(len(inverse)))
    return Calibration(int(action_space.n), float(inverse.mean()), error, tuple(ranges))
