"""Range of `behavior_prob`, the probability of an action that was taken."""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import UsageError
from mcaprl.texts import shortened

SMALLEST: Final = float(np.finfo(np.float32).smallest_subnormal)
"""Smallest positive float32; a log stores probabilities as float32."""
LARGEST: Final = 1 + 1e-6
"""Largest accepted probability, which allows for the rounding errors of a softmax."""
_MAX_SHOWN: Final = 40


def is_impossible(probs: NDArray[Any]) -> NDArray[np.bool_]:
    """Return a mask of the numbers outside (0, 1]. NaN means unknown and is accepted."""
    found: NDArray[np.bool_] = ~(np.isnan(probs) | ((probs >= SMALLEST) & (probs <= LARGEST)))
    return found


def check_probability(prob: Any, name: str) -> None:
    """Check one probability."""
    try:
        if SMALLEST <= prob <= LARGEST or math.isnan(prob):
            return
        shown = f"{prob:g}"
    except (TypeError, ValueError):
        shown = shortened(repr(prob), _MAX_SHOWN)
    raise UsageError(
        f"{name} {shown} is not the probability of an action that was taken: give a number"
        " above 0 and up to 1, or NaN if it is unknown"
    )
