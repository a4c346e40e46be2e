"""Conversion of commands to actions: discrete fields, named commands, bins or Box values."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import UsageError
from mcaprl.recorder.format.spaces import MAX_ACTIONS
from mcaprl.recorder.mapping.config import Action


class Actions(NamedTuple):
    """Actions of N steps.

    Attributes:
        space: Action space.
        values: (N,) int64, or (N, K) float32 for a Box; 0 where the command is missing.
        missing: (N,) bool: whether there is no command.
        far: (N,) bool: whether the command is far from every named command, or outside the Box.
        meanings: Names of the discrete actions; empty if they have none.
        commands: (N, K) values of the K fields: float64, 0 where missing, or texts of a `field`.
    """

    space: spaces.Space[Any]
    values: NDArray[Any]
    missing: NDArray[np.bool_]
    far: NDArray[np.bool_]
    meanings: tuple[str, ...]
    commands: NDArray[Any]


def actions_of(
    action: Action, columns: Sequence[NDArray[Any]], missing: NDArray[np.bool_]
) -> Actions:
    """Convert commands to actions.

    Args:
        action: Action of the mapping.
        columns: (N,) values of each field: numbers, or texts of a discrete field.
        missing: (N,) bool: whether there is no command.

    Raises:
        UsageError: A value is not a whole number, or is a text that `names` does not contain.
    """
    none = np.zeros(len(missing), bool)
    if action.field is not None:
        values, meanings = _discrete(action, columns[0], missing)
        count = max(len(meanings), int(values.max(initial=0)) + 1)
        commands = columns[0][:, np.newaxis]
        return Actions(spaces.Discrete(count), values, missing, none, meanings, commands)
    commands = np.column_stack(columns).astype(np.float64)
    missing = missing | ~np.isfinite(commands).all(axis=1)
    commands = np.where(missing[:, np.newaxis], 0.0, commands)
    if action.box is not None:
        low, high = (np.array(each, np.float32) for each in (action.box.low, action.box.high))
        far = ((commands < low) | (commands > high)).any(axis=1) & ~missing
        kept = np.clip(commands.astype(np.float32), low, high)
        return Actions(spaces.Box(low, high), kept, missing, far, (), commands)
    if action.actions:
        values, distance = _nearest(commands, np.array(list(action.actions.values()), np.float64))
        far = (distance > action.far) & ~missing
        space = spaces.Discrete(len(action.actions))
        return Actions(space, values, missing, far, tuple(action.actions), commands)
    values, meanings = _binned(action, commands)
    return Actions(spaces.Discrete(len(meanings)), values, missing, none, meanings, commands)


def _discrete(
    action: Action, column: NDArray[Any], missing: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], tuple[str, ...]]:
    values = np.zeros(len(column), np.int64)
    present = np.flatnonzero(~missing)
    if column.dtype.kind == "O":
        texts = [str(text) for text in column[present]]
        _check_named(action, set(texts), set(action.names))
        values[present] = [action.names[text] for text in texts]
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
        if action.names:
            _check_named(action, set(values[present].tolist()), set(action.names.values()))
    by_number = {number: name for name, number in action.names.items()}
    if sorted(by_number) != list(range(len(by_number))):
        return values, ()
    return values, tuple(by_number[number] for number in range(len(by_number)))


def _check_named(action: Action, found: set[Any], named: set[Any]) -> None:
    unknown = sorted(found - named)
    if unknown:
        names = ", ".join(f"{name}: {number}" for name, number in action.names.items())
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
    action: Action, commands: NDArray[np.float64]
) -> tuple[NDArray[np.int64], tuple[str, ...]]:
    """Return the action of each command and all action names.

    An action is a combination of bins, one for each field.
    """
    values = np.zeros(len(commands), np.int64)
    names = []
    for field, edges, column in zip(action.fields, action.edges, commands.T, strict=True):
        values = values * (len(edges) + 1) + np.digitize(column, edges)
        word = field.rpartition(".")[2]
        limits = [f"{edge:g}" for edge in edges]
        between = [f"{low} to {high}" for low, high in itertools.pairwise(limits)]
        parts = [f"below {limits[0]}", *between, f"from {limits[-1]}"] if limits else ["any"]
        names.append([f"{word} {part}" for part in parts])
    return values, tuple(" and ".join(parts) for parts in itertools.product(*names))
