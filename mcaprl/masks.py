"""Action masks: flags of the allowed actions in a Dict observation."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

MASK_KEY = "action_mask"
"""Key of the mask, as in PettingZoo; the value has one flag per action."""


def allowed_actions(observations: Any) -> NDArray[np.bool_] | None:
    """Return the mask (..., A) of one or more observations; None if they have no mask.

    After an episode's end, a mask may allow no action. Then all actions are allowed, because the
    values and actions of that state are never used.
    """
    if not isinstance(observations, dict) or MASK_KEY not in observations:
        return None
    allowed = np.asarray(observations[MASK_KEY]).astype(bool)
    found: NDArray[np.bool_] = allowed | ~allowed.any(-1, keepdims=True)
    return found
