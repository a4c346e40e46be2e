"""Whether logged behavior probabilities can be true, as far as the actions taken tell.

Of each step only the probability of the action taken is known. But over actions drawn with
probabilities p, the mean of 1 / p is the number of actions that can be drawn, and the same holds
for those actions whose p is in a given range: their share of the steps, each counted 1 / p, is how
many actions of that probability a state has. An epsilon-greedy policy of nine actions has one that
is likely and eight that are not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

EDGES: Final = (0.0, 0.02, 0.05, 0.1, 0.2, 0.5, 0.8, 1.0)
"""Ranges of probabilities, the lower end not included."""
_STANDARD_ERRORS = 4.0
"""So far from what must be, chance no longer explains it."""


@dataclass(frozen=True)
class ProbabilityRange:
    """The steps whose action had a probability in some range.

    Attributes:
        probability: their mean.
        steps: how many they are.
        actions: how many actions of such a probability a state has in the mean.
    """

    probability: float
    steps: int
    actions: float


@dataclass(frozen=True)
class Calibration:
    """What logged probabilities say of themselves.

    Attributes:
        available: actions that there are.
        actions: how many the probabilities speak of: all, fewer if some never come, and more only
            if the probabilities are smaller than they should be.
        error: the standard error of `actions`.
        ranges: the same by size of the probability.
    """

    available: int
    actions: float
    error: float
    ranges: tuple[ProbabilityRange, ...]

    @property
    def possible(self) -> bool:
        """Whether the probabilities can be true."""
        return self.actions <= self.available + _STANDARD_ERRORS * self.error + 1e-6

    def __str__(self) -> str:
        """On one line."""
        text = f"{self.actions:.2f} +- {self.error:.2f} of {self.available} actions"
        return text if self.possible else f"{text}: too many, so they are smaller than the truth"

    def to_json(self) -> dict[str, Any]:
        """As commands print it."""
        ranges = [vars(one) for one in self.ranges]
        mine = {"available": self.available, "actions": self.actions, "error": self.error}
        return {**mine, "possible": self.possible, "ranges": ranges}


def calibration(
    behavior_probs: NDArray[np.floating], action_space: spaces.Space[Any]
) -> Calibration | None:
    """Examine the logged probabilities of the actions taken.

    Args:
        behavior_probs: (N,).
        action_space: of these actions.

    Returns:
        None if actions are not discrete, or probabilities are unknown or 0.
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
