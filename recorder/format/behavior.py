"""What a log stores about the behavior policy's choice of an action: the one definition.

The actions of a finite space have probabilities, and actions of floats have densities. So the
column of a log is the probability, or the natural logarithm of the density in the action's own
units. NaN means unknown. Logs of earlier versions have probabilities of all actions; a reader
converts them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final, TypeVar

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import SpaceError, UsageError
from mcaprl.texts import shortened

SMALLEST: Final = float(np.finfo(np.float32).smallest_subnormal)
"""Smallest positive float32; a log stores probabilities as float32."""
LARGEST: Final = 1 + 1e-6
"""Largest accepted probability, which allows for the rounding errors of a softmax."""
_LARGEST_FLOAT: Final = float(np.finfo(np.float32).max)
_MAX_SHOWN: Final = 40
_Values = TypeVar("_Values")


@dataclass(frozen=True)
class BehaviorField:
    """Meaning of the behavior column: `LOG_DENSITY` of actions of floats, else `PROBABILITY`."""

    # Name of the field in `/rl/step`, and of the column of a table. The array of all steps has this
    # name with an `s`.
    name: str
    what: str  # Name of the values in texts
    low: float  # Smallest possible value
    high: float  # Largest possible value
    expected: str  # Range of the values, for errors

    @property
    def plural(self) -> str:
        """Name of the array of all steps."""
        return f"{self.name}s"

    def is_impossible(self, values: NDArray[Any]) -> NDArray[np.bool_]:
        """Return a mask of the values out of range. NaN means unknown and is accepted."""
        inside = (values >= self.low) & (values <= self.high)
        found: NDArray[np.bool_] = ~(np.isnan(values) | inside)
        return found

    def check(self, value: Any, name: str) -> None:
        """Check the value of one action that was taken."""
        try:
            if self.low <= value <= self.high or math.isnan(value):
                return
            shown = f"{value:g}"
        except (TypeError, ValueError):
            shown = shortened(repr(value), _MAX_SHOWN)
        raise UsageError(
            f"{name} {shown} is not the {self.what} of an action that was taken: give"
            f" {self.expected}, or NaN if it is unknown"
        )

    def column(self, probs: Any, log_probs: Any) -> NDArray[np.float32] | None:
        """Return the column from either kind of values, converted if necessary."""
        # None without both.
        own, other = (log_probs, probs) if self == LOG_DENSITY else (probs, log_probs)
        if own is None and other is None:
            return None
        with np.errstate(all="ignore"):
            if own is not None:
                return np.asarray(own).astype(np.float32, copy=False)
            convert = np.log if self == LOG_DENSITY else np.exp
            found: NDArray[np.float32] = convert(np.asarray(other, np.float64)).astype(np.float32)
        return found

    def probs(self, values: _Values, instead: str = "behavior_log_probs") -> _Values:
        """Return values of this column as probabilities, or probabilities as values."""
        if self == LOG_DENSITY:
            raise SpaceError(f"actions of floats have densities, not probabilities: use {instead}")
        return values

    def log_probs(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return values of this column as logarithms of probabilities or densities."""
        if self == LOG_DENSITY:
            return values
        with np.errstate(all="ignore"):
            found: NDArray[np.float32] = np.log(values)
        return found

    def from_log_probs(self, values: Any) -> Any:
        """Return logarithms of probabilities or densities as values, which `check` checks."""
        if self == LOG_DENSITY:
            return values
        try:
            with np.errstate(all="ignore"):
                return np.exp(values)
        except TypeError:
            return values


PROBABILITY: Final = BehaviorField(
    "behavior_prob", "probability", SMALLEST, LARGEST, "a number in (0, 1]"
)
LOG_DENSITY: Final = BehaviorField(
    "behavior_log_prob", "log density", -_LARGEST_FLOAT, _LARGEST_FLOAT, "a finite number"
)
FIELDS: Final = (PROBABILITY, LOG_DENSITY)


def behavior_field(space: spaces.Space[Any]) -> BehaviorField:
    """Return the meaning of the behavior column of an action space.

    >>> behavior_field(spaces.Discrete(3)).name, behavior_field(spaces.Box(-1, 1, (2,))).name
    ('behavior_prob', 'behavior_log_prob')
    """
    has_density = isinstance(space, spaces.Box) and np.dtype(space.dtype).kind == "f"
    return LOG_DENSITY if has_density else PROBABILITY
