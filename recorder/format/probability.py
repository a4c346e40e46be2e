"""Range of `behavior_prob`, the probability of an action that was taken."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import UsageError

SMALLEST: Final = float(np.finfo(np.float32).smallest_subnormal)
"""Smallest positive float32; a log stores probabilities as float32."""
LARGEST: Final = 1 + 1e-6
"""Largest accepted probability, which allows for the rounding errors of a softmax."""


def is_impossible(probs: NDArray[Any]) -> NDArray[np.bool_]:
    """Return a mask of the numbers outside (0, 1]. NaN means unknown and is accepted."""
    found: NDArray[np.bool_] = ~(np.isnan(probs) | ((probs >= SMALLEST) & (probs <= LARGEST)))
    return found


def check_probability(prob: float, name: str) -> None:
    """Check one probability.

    Args:
        prob: Probability, or NaN.
        name: Name of the probability in the error message.

    Raises:
        UsageError: The number is not within (0, 1].
    """
    if not (SMALLEST <= prob <= LARGEST or prob != prob):
        raise UsageError(
            f"{name} {prob:g} is not the probability of an action that was taken: give a number"
            " above 0 and up to 1, or NaN if it is unknown"
        )
