"""Commands that the actions of a mapping stand for."""

from __future__ import annotations

import difflib
import itertools
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import UsageError
from mcaprl.recorder.format.action_commands import ActionCommands, Command
from mcaprl.recorder.format.metadata import MAX_NUMBERED_ACTIONS
from mcaprl.recorder.mapping.config import Action


def action_commands(
    action: Action,
    fields: tuple[str, ...],
    space: spaces.Space[Any],
    meanings: tuple[str, ...],
    values: NDArray[Any],
    commands: NDArray[Any],
) -> ActionCommands | None:
    """Return the command of each action; see `Action.representatives`.

    Args:
        action: Action of the mapping.
        fields: Path or expression of each element of a command.
        space: Action space of the dataset.
        meanings: Names of the actions; empty if they have none.
        values: (N,) actions of the transitions.
        commands: (N, K) logged commands of the transitions.

    Returns:
        None for a Box, and for a numeric field with too many values to list them.
    """
    if not isinstance(space, spaces.Discrete):
        return None
    count = int(space.n)
    given = _given(action, meanings, count, commands.shape[1])
    if action.field is not None:
        if not given and count > MAX_NUMBERED_ACTIONS:
            return None
        found = _of_field(action, count, is_text=commands.dtype.kind == "O")
    elif action.actions:
        found = [tuple(each) for each in action.actions.values()]
    else:
        found = _of_bins(action.edges, values, commands.astype(np.float64))
    return ActionCommands(fields, tuple(given.get(k, each) for k, each in enumerate(found)))


def _given(action: Action, meanings: tuple[str, ...], count: int, size: int) -> dict[int, Command]:
    """Return the commands that the mapping lists, by action."""
    listed = action.representatives
    if isinstance(listed, list):
        # The number of values of a field depends on the bag.
        if listed and len(listed) != count and action.field is None:
            raise UsageError(
                f"representatives has {len(listed)} commands, but there are {count} actions"
            )
        found = dict(enumerate(listed[:count]))
    else:
        numbers = {name: k for name, k in action.numbers.items() if k < count}
        numbers |= {str(k): k for k in range(count)} | {name: k for k, name in enumerate(meanings)}
        for name in listed:
            if name not in numbers:
                near = difflib.get_close_matches(name, numbers, n=3, cutoff=0.3) or list(numbers)
                raise UsageError(
                    f"representatives: no action is named '{name}'; nearest: {', '.join(near[:8])}"
                )
        found = {numbers[name]: each for name, each in listed.items()}
    commands = {k: tuple(each) if isinstance(each, list) else (each,) for k, each in found.items()}
    for command in commands.values():
        if len(command) != size:
            raise UsageError(
                f"representatives has the command {list(command)}, which does not have one value"
                f" for each of {size} fields"
            )
    return commands


def _of_field(action: Action, count: int, *, is_text: bool) -> list[Command | None]:
    """Return the value of the field for each action."""
    if not is_text:
        return [(k,) for k in range(count)]
    # If several texts have the same number, the first of them is the command.
    texts = {number: (text,) for text, number in reversed(action.numbers.items())}
    return [texts.get(k) for k in range(count)]


def _of_bins(
    edges: list[list[float]], values: NDArray[np.int64], commands: NDArray[np.float64]
) -> list[Command | None]:
    """Return the typical command of each combination of bins.

    This is the median, field by field, of the commands of the combination. If there are none, a
    field has the median of all commands in its bin, or else the middle of the bin; for an open bin,
    its edge, and for the only bin, 0.
    """
    medians = []
    for column, limits in zip(commands.T, edges, strict=True):
        bins = np.digitize(column, limits)
        middles = [(low + high) / 2 for low, high in itertools.pairwise(limits)]
        empty = [limits[0], *middles, limits[-1]] if limits else [0.0]
        medians.append(
            [
                float(np.median(column[bins == k])) if (bins == k).any() else each
                for k, each in enumerate(empty)
            ]
        )
    grid = np.stack(np.meshgrid(*medians, indexing="ij"), axis=-1).reshape(-1, len(edges))
    order = np.argsort(values, kind="stable")
    found, firsts = np.unique(values[order], return_index=True)
    for k, rows in zip(found.tolist(), np.split(order, firsts[1:]), strict=True):
        grid[k] = np.median(commands[rows], axis=0)
    return [tuple(each) for each in grid.tolist()]
