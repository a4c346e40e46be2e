"""Conversion of commands to actions: discrete fields, named commands, bins or Box values."""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import UsageError
from mcaprl.recorder.format.spaces import MAX_ACTIONS
from mcaprl.recorder.mapping.config import Action

_POSITION = {r"position\.[xyz]": "m"}
_TWIST = {r"linear\.[xyz]": "m/s", r"angular\.[xyz]": "rad/s"}
_DRIVE = {
    "steering_angle": "rad",
    "steering_angle_velocity": "rad/s",
    "speed": "m/s",
    "acceleration": "m/s^2",
    "jerk": "m/s^3",
}
_UNITS: Final = {
    "Twist": _TWIST,
    "TwistStamped": _TWIST,
    "TwistWithCovarianceStamped": _TWIST,
    "Odometry": _TWIST | _POSITION,
    **dict.fromkeys(("Pose", "PoseStamped", "PoseWithCovarianceStamped"), _POSITION),
    "Imu": {r"angular_velocity\.[xyz]": "rad/s", r"linear_acceleration\.[xyz]": "m/s^2"},
    "Range": {"range": "m"},
    "Accel": {r"linear\.[xyz]": "m/s^2", r"angular\.[xyz]": "rad/s^2"},
    "Wrench": {r"force\.[xyz]": "N", r"torque\.[xyz]": "N m"},
    "AckermannDrive": _DRIVE,
    "AckermannDriveStamped": _DRIVE,
}


def unit_of(type_name: str, field: str) -> str:
    """Return the unit of a field by the name of the message type; empty if it is not known.

    >>> unit_of("geometry_msgs/msg/Twist", "linear.x"), unit_of("std_msgs/msg/Float64", "data")
    ('m/s', '')
    >>> unit_of("geometry_msgs/msg/TwistStamped", "twist.angular.z")
    'rad/s'
    """
    known = _UNITS.get(re.split(r"[/.]", type_name)[-1], {})
    found = (unit for name, unit in known.items() if re.fullmatch(rf"(.*\.)?{name}", field))
    return next(found, "")


class Actions(NamedTuple):
    """Actions of N steps.

    Attributes:
        space: Action space.
        values: (N,) int64, or (N, K) float32 for a Box; 0 where the command is missing.
        missing: (N,) bool: whether there is no command.
        far: (N,) bool: whether the command is far from every named command, or outside the Box.
        meanings: Names of the discrete actions; empty if they have none.
        commands: (N, K) elements of the command: float64, 0 where missing, or texts of a `field`.
        fields: Path or expression of each element of the command.
        names: Name of each element, such as `linear.x`.
        units: Unit of each element; empty texts if they are not known.
    """

    space: spaces.Space[Any]
    values: NDArray[Any]
    missing: NDArray[np.bool_]
    far: NDArray[np.bool_]
    meanings: tuple[str, ...]
    commands: NDArray[Any]
    fields: tuple[str, ...]
    names: tuple[str, ...] = ()
    units: tuple[str, ...] = ()


class CommandPart(NamedTuple):
    """A part of the command of N steps.

    Attributes:
        name: Name of the field or expression.
        values: (N,) or (N, K) numbers, or (N,) texts of a discrete field.
        missing: (N,) bool: whether there is no value.
        names: Names of the K elements; empty if they have none.
        path: Path of the field, or the expression.
        label: Path in the message, or the expression.
        unit: Unit of the values; empty if unknown.
    """

    name: str
    values: NDArray[Any]
    missing: NDArray[np.bool_]
    names: tuple[str, ...] = ()
    path: str = ""
    label: str = ""
    unit: str = ""

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the elements in the message, or of the single value."""
        if self.values.ndim == 1:
            return (self.label,)
        return self.names or tuple(f"{self.label}[{k}]" for k in range(self.values.shape[1]))

    @property
    def elements(self) -> tuple[str, ...]:
        """Names of the elements, or of the single value."""
        if self.values.ndim == 1:
            return (self.name,)
        return self.names or tuple(f"{self.name}[{k}]" for k in range(self.values.shape[1]))

    @property
    def fields(self) -> tuple[str, ...]:
        """Paths of the elements, or of the single value."""
        if self.values.ndim == 1:
            return (self.path,)
        names = self.names or tuple(map(str, range(self.values.shape[1])))
        return tuple(f"{self.path}[{name}]" for name in names)


def actions_of(action: Action, commands: Sequence[CommandPart]) -> Actions:
    """Convert commands to actions."""
    missing = np.logical_or.reduce([each.missing for each in commands])
    none, fields = np.zeros(len(missing), bool), tuple(f for part in commands for f in part.fields)
    if action.field is not None:
        values, meanings = _discrete(action, commands[0].values, missing)
        count = max(len(meanings), int(values.max(initial=0)) + 1)
        one = commands[0].values[:, np.newaxis]
        return Actions(spaces.Discrete(count), values, missing, none, meanings, one, fields)
    numbers = np.column_stack([each.values for each in commands]).astype(np.float64)
    action.check_count(numbers.shape[1])
    missing = missing | ~np.isfinite(numbers).all(axis=1)
    numbers = np.where(missing[:, np.newaxis], 0.0, numbers)
    if action.box is not None:
        low, high = (
            np.broadcast_to(np.array(each, np.float32), numbers.shape[1])
            for each in action.box.ends
        )
        # The limits are float32, so a command that equals its limit may be beyond it in float64.
        with np.errstate(over="ignore"):
            rounded = numbers.astype(np.float32)
        far = ((rounded < low) | (rounded > high)).any(axis=1) & ~missing
        kept = np.clip(rounded, low, high)
        box = spaces.Box(low.copy(), high.copy())
        names = tuple(label for part in commands for label in part.labels)
        units = tuple(part.unit for part in commands for _ in part.labels)
        return Actions(
            box,
            kept,
            missing,
            far,
            (),
            numbers,
            fields,
            # The same fields of several topics need the names of the topics.
            names if len(set(names)) == len(names) else fields,
            tuple(action.units) or units,
        )
    if action.actions:
        values, distance = _nearest(numbers, np.array(list(action.actions.values()), np.float64))
        far = (distance > action.far) & ~missing
        names = tuple(action.actions)
        return Actions(spaces.Discrete(len(names)), values, missing, far, names, numbers, fields)
    values, meanings = _binned(
        action, numbers, [each for part in commands for each in part.elements]
    )
    count = len(meanings)
    return Actions(spaces.Discrete(count), values, missing, none, meanings, numbers, fields)


def _discrete(
    action: Action, column: NDArray[Any], missing: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], tuple[str, ...]]:
    values = np.zeros(len(column), np.int64)
    present = np.flatnonzero(~missing)
    if column.dtype.kind == "O":
        texts = [str(text) for text in column[present]]
        _check_named(action, set(texts), set(action.numbers))
        values[present] = [action.numbers[text] for text in texts]
    else:
        numbers = column[present]
        wrong = numbers[(numbers != np.rint(numbers)) | (numbers < 0)]
        if len(wrong):
            raise UsageError(
                f"{action.field} has the value {wrong[0]}; a discrete action is a whole number from"
                " 0; for a continuous command, use `fields` with `actions` or `edges`"
            )
        if len(numbers) and numbers.max() >= MAX_ACTIONS:
            raise UsageError(
                f"{action.field} has the value {numbers.max():g}; a discrete action is less than"
                f" {MAX_ACTIONS}"
            )
        values[present] = numbers.astype(np.int64)
        if action.numbers:
            _check_named(action, set(values[present].tolist()), set(action.numbers.values()))
    by_number = {number: name for name, number in action.numbers.items()}
    if sorted(by_number) != list(range(len(by_number))):
        return values, ()
    return values, tuple(by_number[number] for number in range(len(by_number)))


def _check_named(action: Action, found: set[Any], named: set[Any]) -> None:
    unknown = sorted(found - named)
    if unknown:
        names = ", ".join(f"{name}: {number}" for name, number in action.numbers.items())
        raise UsageError(
            f"{action.field} has the value {unknown[0]!r}, which `names` does not contain; names:"
            f" {names or 'none'}"
        )


def _nearest(
    commands: NDArray[np.float64], named: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the index of the named command nearest to each command, and their distance.

    The difference in each field is divided by the field's range in `named`. The largest of these
    ratios is the distance.
    """
    span = np.ptp(named, axis=0)
    span = np.where(span > 0, span, 1.0)
    distances = np.stack([(np.abs(commands - one) / span).max(axis=1) for one in named], axis=1)
    values = distances.argmin(axis=1)
    return values, distances[np.arange(len(values)), values]


def _binned(
    action: Action, commands: NDArray[np.float64], words: Sequence[str]
) -> tuple[NDArray[np.int64], tuple[str, ...]]:
    """Return the action of each command and all action names.

    An action is a combination of bins, one for each element; `words` are the elements' names.
    """
    values = np.zeros(len(commands), np.int64)
    names = list[list[str]]()
    for word, edges, column in zip(words, action.edges, commands.T, strict=True):
        values = values * (len(edges) + 1) + np.digitize(column, edges)
        limits = [f"{edge:g}" for edge in edges]
        between = [f"{low} to {high}" for low, high in itertools.pairwise(limits)]
        parts = [f"below {limits[0]}", *between, f"from {limits[-1]}"] if limits else ["any"]
        names.append([f"{word} {part}" for part in parts])
    joined, named = (", ", action.bins) if action.bins else (" and ", names)
    return values, tuple(joined.join(parts) for parts in itertools.product(*named))
