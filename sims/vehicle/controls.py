"""Controls of a vehicle: the parts of a command, and the commands of its actions.

The rules of a sim know commands only. A continuous action is a command: a number from -1 to 1 for
each part. Each discrete action has a command, which is a row of a table.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, NamedTuple

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.compiled import compiled, ready
from mcaprl.errors import UnknownNameError, UsageError


class Pose(NamedTuple):
    """Starting pose and speed of a ground vehicle in the map."""

    x_m: float
    y_m: float
    yaw_rad: float
    speed_m_s: float


def check_name(argument: str, value: object, allowed: Sequence[object]) -> None:
    """Validate that a value is allowed."""
    if value not in allowed:
        raise UnknownNameError(argument, str(value), [str(name) for name in allowed])


def check_actions(actions: object, allowed: Sequence[object], rules: str) -> None:
    """Validate the argument `actions`; the published rules have discrete actions only."""
    check_name("actions", actions, allowed)
    if not isinstance(actions, int) and actions != "discrete" and rules != "default":
        raise UsageError(
            f"actions '{actions}' need the rules 'default': the rules '{rules}' are published with"
            " discrete actions"
        )


def check_range(argument: str, value: float, low: float, high: float) -> None:
    """Validate that a number is in [low, high]."""
    if not low <= value <= high:
        raise UsageError(f"{argument} must be {low:g} to {high:g}, not {value}")


def check_action(action: int | np.integer[Any], count: int) -> int:
    """Validate an action and return it as an int."""
    try:
        number = operator.index(action)
    except TypeError:
        raise UsageError(f"action {action!r} is not an integer") from None
    if not 0 <= number < count:
        raise UsageError(f"action {action} does not exist: actions are 0 to {count - 1}")
    return number


def read_pose(options: dict[str, Any], names: Sequence[str], least: int) -> list[float]:
    """Read `pose`, the only option of `reset`."""
    if set(options) != {"pose"}:
        raise UsageError(f"reset accepts only the option 'pose', not {sorted(set(options))}")
    try:
        pose = np.asarray(options["pose"], dtype=np.float64)
    except (TypeError, ValueError):
        pose = np.full(1, math.nan)
    if pose.shape not in ((least,), (len(names),)) or not np.isfinite(pose).all():
        raise UsageError(
            f"pose {options['pose']!r} is not ({', '.join(names[:least])}) or ({', '.join(names)})"
        )
    return [*pose.tolist(), *[0.0] * (len(names) - len(pose))]


def pose_from(options: dict[str, Any], slowest_m_s: float, fastest_m_s: float) -> Pose:
    """Read the start of a ground vehicle: (x_m, y_m, yaw_rad) or (x_m, y_m, yaw_rad, speed_m_s)."""
    pose = Pose(*read_pose(options, Pose._fields, least=3))
    check_range("a pose's speed_m_s", pose.speed_m_s, slowest_m_s, fastest_m_s)
    return pose


KINDS: Final = ("discrete", "continuous")  # Values of a sim's argument `actions`
_LIMIT = 1.0 + 1e-6
"""Largest part of a continuous action. A part slightly beyond 1 is a rounding error of a policy
that scales its actions, and counts as 1."""


@dataclass(frozen=True, eq=False)
class Controls:
    """Parts of a vehicle's command, and its actions.

    Attributes:
        names: Names of the P parts.
        units: What the value 1 of each part is.
        meanings: Meanings of the A discrete actions; empty for continuous ones.
        commands: (A, P) commands of the discrete actions; None for continuous ones.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    meanings: tuple[str, ...] = ()
    commands: NDArray[np.float64] | None = None

    @cached_property
    def space(self) -> spaces.Space[Any]:
        """Space of one action."""
        if self.commands is not None:
            return spaces.Discrete(len(self.commands))
        return spaces.Box(-1.0, 1.0, (len(self.names),), np.float32)

    @property
    def parts(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Names and units of the parts of an action; empty for discrete actions."""
        return (self.names, self.units) if self.commands is None else ((), ())

    def reader(self, actions: NDArray[Any], commands: NDArray[np.float64]) -> Callable[[], int]:
        """Return a function that writes the commands (N, P) of N actions.

        It returns the index of the first element of `actions` that is not valid, or -1. `actions`
        is an array of N int64 or of (N, P) float32, which are clipped to -1 to 1.
        """
        if self.commands is None:
            return ready(_copy_parts, actions, commands)
        return ready(_look_up, actions, self.commands, commands)

    def read(self, action: Any) -> list[float]:
        """Validate one action, and return its command.

        Raises:
            UsageError: The action does not exist.
        """
        if self.commands is not None:
            command: list[float] = self.commands[check_action(action, len(self.commands))].tolist()
            return command
        parts = self.array(action, ()).tolist()
        for name, part in zip(self.names, parts, strict=True):
            if not abs(part) <= _LIMIT:
                raise UsageError(f"action: {_problem(name, part)}")
        return [min(max(part, -1.0), 1.0) for part in parts]

    def array(self, actions: Any, shape: tuple[int, ...]) -> NDArray[Any]:
        """Return actions as an array of this shape, followed by the shape of an action.

        Raises:
            UsageError: The actions have another shape, or are not integers or numbers.
        """
        is_discrete = self.commands is not None
        found, wanted = np.asarray(actions), shape if is_discrete else (*shape, len(self.names))
        if found.shape != wanted or found.dtype.kind not in ("iu" if is_discrete else "iuf"):
            what = "integers" if is_discrete else f"numbers ({', '.join(self.names)})"
            sizes = " x ".join(map(str, wanted))
            raise UsageError(
                f"actions must be an array of {sizes} {what},"
                f" not {found.dtype} of shape {found.shape}"
            )
        # The space of continuous actions has float32, and so has a log.
        return found if is_discrete else found.astype(np.float32, copy=False)

    def error(self, actions: NDArray[Any], index: int) -> UsageError:
        """Return the error of element `index` of the actions of N vehicles."""
        wrong = actions.ravel()[index].item()
        if self.commands is not None:
            last = len(self.commands) - 1
            return UsageError(f"action {wrong} does not exist: actions are 0 to {last}")
        row, part = divmod(index, len(self.names))
        return UsageError(f"action of environment {row}: {_problem(self.names[part], wrong)}")


def _problem(name: str, part: float) -> str:
    shown = "NaN" if math.isnan(part) else f"{part:.9g}"
    return f"{name} is {shown}; it must be -1 to 1"


@compiled
def _look_up(
    actions: NDArray[np.int64], table: NDArray[np.float64], commands: NDArray[np.float64]
) -> int:
    for i in range(len(actions)):
        action = actions[i]
        if not 0 <= action < len(table):
            return i
        for k in range(table.shape[1]):
            commands[i, k] = table[action, k]
    return -1


@compiled
def _copy_parts(actions: NDArray[np.float32], commands: NDArray[np.float64]) -> int:
    for i in range(actions.shape[0]):
        for k in range(actions.shape[1]):
            part = actions[i, k]
            # The negation is also true for NaN.
            if not abs(part) <= _LIMIT:
                return int(i * actions.shape[1] + k)
            commands[i, k] = min(max(part, -1.0), 1.0)
    return -1
