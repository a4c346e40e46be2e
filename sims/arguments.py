"""Checks of what a user hands to a sim; each refusal says what is allowed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from mcaprl.errors import UnknownNameError, UsageError


def check_name(argument: str, value: str, allowed: Sequence[str]) -> None:
    """Refuse a value that is not in the list.

    Raises:
        UnknownNameError: it is not.
    """
    if value not in allowed:
        raise UnknownNameError(argument, str(value), allowed)


def check_range(argument: str, value: float, low: float, high: float) -> None:
    """Refuse a number outside [low, high].

    Raises:
        UsageError: it is outside, or no number.
    """
    if not low <= value <= high:
        raise UsageError(f"{argument} is {low:g} to {high:g}, not {value}")


def check_action(action: int | np.integer[Any], count: int) -> None:
    """Refuse an action that is not 0 to count - 1.

    Raises:
        UsageError: it is not.
    """
    if not 0 <= action < count:
        raise UsageError(f"action {action} does not exist: 0 to {count - 1} do")


def read_pose(options: dict[str, Any], names: Sequence[str], least: int) -> list[float]:
    """Read the one option of `reset`, `pose`.

    Args:
        options: of `reset`.
        names: of all the numbers that a pose can have, with units.
        least: how many it must have; those left out are 0.

    Raises:
        UsageError: there is another option, or the pose is not so many finite numbers.
    """
    if set(options) != {"pose"}:
        raise UsageError(f"reset knows only the option 'pose', not {sorted(set(options))}")
    try:
        pose = np.asarray(options["pose"], dtype=np.float64)
    except (TypeError, ValueError):
        pose = np.full(1, math.nan)
    if pose.shape not in ((least,), (len(names),)) or not np.isfinite(pose).all():
        raise UsageError(
            f"pose {options['pose']!r} is not ({', '.join(names[:least])}) or ({', '.join(names)})"
        )
    return [*pose.tolist(), *[0.0] * (len(names) - len(pose))]
