"""Action masks: flags of the allowed actions in a Dict observation.

Some environments return the flags as an info, or as another part of the observation. The setting
`mask_from` names this source. A policy with such a source receives the Dict observation
`{"observation": ..., "action_mask": ...}`, where `observation` is that of the environment.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import PolicyError

MASK_KEY = "action_mask"
"""Key of the mask, as in PettingZoo; the value has one flag per action."""
OBSERVATION_KEY = "observation"
"""Key of the environment's observation beside a mask from `mask_from`."""
_INFO = "info:"


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


def info_name(source: str) -> str | None:
    """Return the dotted name of an info; None if the source is a part of the observation.

    >>> info_name("info:legal.moves"), info_name("robot/legal")
    ('legal.moves', None)
    """
    return source.removeprefix(_INFO) if source.startswith(_INFO) else None


def has_source(space: spaces.Space[Any] | None) -> bool:
    """Return whether an observation space is that of observations with a mask from a source."""
    return isinstance(space, spaces.Dict) and set(space.spaces) == {OBSERVATION_KEY, MASK_KEY}


def masked(observation: Any, info: Mapping[str, Any], source: str) -> dict[str, Any]:
    """Return one observation of an environment with its mask from a source.

    Raises:
        PolicyError: The environment returned no such info, or the observation has no such part.
    """
    name = info_name(source)
    found: Any = observation if name is None else info
    for key in source.split("/") if name is None else name.split("."):
        try:
            found = found[key]
        except (KeyError, TypeError, IndexError) as error:
            what = f"observation has no part {source}" if name is None else f"info has no {name}"
            raise PolicyError(
                f"the environment's {what}, which the policy needs as mask"
            ) from error
    return {OBSERVATION_KEY: observation, MASK_KEY: np.asarray(found, np.int8)}
