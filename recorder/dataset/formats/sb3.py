"""Stable-Baselines3's replay buffers, filled as its algorithms fill them.

SB3 stores images with the channels first, actions of a bounded Box scaled to [-1, 1], and rewards
and float64 actions as float32. It marks the end of an episode in `dones`. If the episode was
truncated, it also marks the end in `timeouts`, so that the learning target includes the value of
the last observation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import LogError, SpaceError, UsageError, import_extra
from mcaprl.recorder.dataset.arrays import with_fresh_times
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.format.metadata import DEFAULT_STEP_DURATION_NS, LogMetadata
from mcaprl.recorder.format.spaces import (
    MIN_IMAGE_EDGE,
    Leaf,
    action_leaf,
    nest,
    observation_leaves,
)

Order = tuple[int, int, int]
_MODULE = "stable_baselines3.common.buffers"


def to_buffer(
    dataset: Dataset, *, device: str = "cpu", buffer_class: Any = None, **options: Any
) -> Any:
    """Return a replay buffer that contains all transitions, in order."""
    buffers = import_extra(_MODULE, "online")
    observation_space, action_space = dataset.observation_space, dataset.action_space
    _check_spaces(observation_space, action_space)
    if options.pop("n_envs", 1) != 1:
        raise UsageError("n_envs must be 1: all episodes are stored as episodes of one environment")
    count = len(dataset)
    # With `optimize_memory_usage`, the next observation is the observation of the following row, so
    # the last next observation needs an additional row.
    needed = count + bool(options.get("optimize_memory_usage"))
    size = options.pop("buffer_size", needed)
    if size < needed:
        raise UsageError(f"buffer_size is {size}, but the dataset needs {needed} rows")
    if buffer_class is None:
        is_dict = isinstance(observation_space, spaces.Dict)
        buffer_class = buffers.DictReplayBuffer if is_dict else buffers.ReplayBuffer
    stored_space = _converted(observation_space, _sb3_order)
    try:
        buffer = buffer_class(size, stored_space, action_space, device=device, **options)
    # SB3 raises these errors if options exclude each other or do not exist.
    except (AssertionError, NotImplementedError, TypeError, ValueError) as error:
        raise UsageError(f"{buffer_class.__name__}: {error}") from error
    _fill_observations(buffer, dataset)
    actions = _scaled(action_space, dataset.actions).reshape(count, -1)
    buffer.actions[:count, 0] = _rounded("action", actions, buffer.actions.dtype)
    buffer.rewards[:count, 0] = _rounded("reward", dataset.rewards, buffer.rewards.dtype)
    is_end = np.zeros(count, bool)
    is_end[np.cumsum(dataset.episode_lengths) - 1] = True
    buffer.dones[:count, 0] = is_end
    if buffer.handle_timeout_termination:
        buffer.timeouts[:count, 0] = is_end & ~dataset.terminated
    buffer.pos, buffer.full = count % size, count == size
    return buffer


def from_buffer(
    buffer: Any, *, channels_last: bool = True, scaled_actions: bool = True, lossy: bool = False
) -> Dataset:
    """Copy the transitions of a replay buffer, environment by environment and from old to new.

    If the buffer was full, the beginning of the first episode of each environment is missing,
    because SB3 has overwritten it.
    """
    if not isinstance(buffer, import_extra(_MODULE, "online").ReplayBuffer):
        raise UsageError(f"expected a ReplayBuffer of SB3, but this is a {type(buffer).__name__}")
    rows = _rows_in_order(buffer)
    if not lossy and not buffer.handle_timeout_termination and buffer.dones[rows].any():
        raise LogError(
            "the replay buffer has handle_timeout_termination=False, so truncations and"
            " terminations look the same; pass lossy=True to read all as terminations"
        )
    order_of = _environment_order if channels_last else _stored_order
    space = _converted(buffer.observation_space, order_of)
    orders = [order_of(part) for _, part in _parts(buffer.observation_space)]
    parts = [
        _of_environment(buffer, number, rows, space, orders, scaled_actions=scaled_actions)
        for number in range(buffer.n_envs)
    ]
    joined = Dataset.concatenate(parts)
    columns = with_fresh_times(joined._transitions, 0, DEFAULT_STEP_DURATION_NS)
    return Dataset(columns, LogMetadata.from_strings(joined.metadata))


def _fill_observations(buffer: Any, dataset: Dataset) -> None:
    count = len(dataset)
    for leaf, part in _parts(dataset.observation_space):
        stored, order = leaf.of(buffer.observations), _sb3_order(part)
        frames = _reordered(np.asarray(leaf.of(dataset.frames)), order)
        frames = frames.reshape(len(frames), *stored.shape[2:])
        stored[:count, 0] = frames[dataset.frame_of_step]
        following = frames[dataset.frame_of_step + 1]
        if buffer.optimize_memory_usage:
            stored[count % len(stored), 0] = following[-1]
        else:
            leaf.of(buffer.next_observations)[:count, 0] = following


def _rows_in_order(buffer: Any) -> NDArray[np.int64]:
    """Return the indexes of a buffer's valid rows, from old to new."""
    # With `optimize_memory_usage`, the newest next observation has overwritten the oldest
    # observation.
    oldest = buffer.pos + buffer.optimize_memory_usage if buffer.full else 0
    stop = buffer.pos + buffer.buffer_size if buffer.full else buffer.pos
    if oldest >= stop:
        raise LogError("the replay buffer has no transitions")
    rows: NDArray[np.int64] = np.arange(oldest, stop) % buffer.buffer_size
    return rows


def _of_environment(
    buffer: Any,
    number: int,
    rows: NDArray[np.int64],
    space: spaces.Space[Any],
    orders: Sequence[Order | None],
    *,
    scaled_actions: bool,
) -> Dataset:
    """Return the transitions of one environment."""
    dones, timeouts = (array[rows, number] > 0 for array in (buffer.dones, buffer.timeouts))
    leaves = observation_leaves(space)
    here: list[NDArray[Any]] = []
    following: list[NDArray[Any]] = []
    for leaf, order in zip(leaves, orders, strict=True):
        both = _stored_observations(buffer, leaf, number, rows, dones)
        for parts, values in zip((here, following), both, strict=True):
            parts.append(_reordered(values, order).reshape(len(rows), *leaf.shape))
    actions = buffer.actions[rows, number]
    actions = actions.reshape(len(rows), *action_leaf(buffer.action_space).shape)
    return Dataset.from_arrays(
        observations=nest(leaves, here),
        next_observations=nest(leaves, following),
        actions=_unscaled(buffer.action_space, actions) if scaled_actions else actions,
        rewards=buffer.rewards[rows, number],
        terminated=dones & ~timeouts,
        truncated=dones & timeouts,
        observation_space=space,
        action_space=buffer.action_space,
    )


def _stored_observations(
    buffer: Any, leaf: Leaf, number: int, rows: NDArray[np.int64], dones: NDArray[np.bool_]
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the observations and next observations of these rows of an environment."""
    stored = leaf.of(buffer.observations)[:, number]
    here = stored[rows]
    if not buffer.optimize_memory_usage:
        return here, leaf.of(buffer.next_observations)[rows, number]
    following = stored[(rows + 1) % len(stored)]
    # The row after the end of an episode contains the first observation of the next episode.
    lost = np.flatnonzero(dones[:-1])
    following[lost] = here[lost]
    return here, following


def _parts(space: spaces.Space[Any]) -> list[tuple[Leaf, spaces.Space[Any]]]:
    """Return each leaf and its space; the observation space must not have nested Dicts."""
    parts = list(space.spaces.values()) if isinstance(space, spaces.Dict) else [space]
    return list(zip(observation_leaves(space), parts, strict=True))


def _check_spaces(observation_space: spaces.Space[Any], action_space: spaces.Space[Any]) -> None:
    """Check that SB3's algorithms can learn from data in these spaces."""
    if isinstance(observation_space, spaces.Dict):
        for key, part in observation_space.spaces.items():
            if isinstance(part, spaces.Dict):
                raise SpaceError(f"observation['{key}'] is a Dict; SB3 cannot nest Dicts")
    for leaf, part in _parts(observation_space):
        if isinstance(part, spaces.Box) and not leaf.shape:
            raise SpaceError(f"{leaf.name} is a Box of shape (); SB3 needs at least (1,)")
        _check_integers(leaf.name, part)
    _check_integers("action", action_space)
    if isinstance(action_space, spaces.MultiBinary) and len(action_space.shape) > 1:
        raise SpaceError(f"action is {action_space}; SB3 needs MultiBinary of one dimension")
    if isinstance(action_space, spaces.Box) and action_space.dtype.kind != "f":
        raise SpaceError(f"action is a Box of {action_space.dtype}; SB3 needs a Box of floats")


def _check_integers(name: str, space: spaces.Space[Any]) -> None:
    if not isinstance(space, spaces.Discrete | spaces.MultiDiscrete):
        return
    if np.any(space.start):
        raise SpaceError(f"{name} is {space}; SB3 needs a {type(space).__name__} that starts at 0")
    if isinstance(space, spaces.MultiDiscrete) and space.nvec.ndim > 1:
        raise SpaceError(f"{name} is {space}; SB3 needs MultiDiscrete of one dimension")


def _converted(
    space: spaces.Space[Any], order_of: Callable[[spaces.Space[Any]], Order | None]
) -> spaces.Space[Any]:
    """Permute the axes of each Box in a space by `order_of(box)`.

    If `order_of` returns None for a Box, the Box keeps its axes.
    """
    if isinstance(space, spaces.Dict):
        return spaces.Dict([(key, _converted(part, order_of)) for key, part in space.items()])
    order = order_of(space)
    if order is None or not isinstance(space, spaces.Box):
        return space
    return spaces.Box(space.low.transpose(order), space.high.transpose(order), dtype=np.uint8)


def _sb3_order(space: spaces.Space[Any]) -> Order | None:
    """Return the axis permutation from an environment's image to SB3's; None if not needed."""
    return (2, 0, 1) if _is_image(space) and np.argmin(space.shape or ()) > 0 else None


def _environment_order(space: spaces.Space[Any]) -> Order | None:
    """Return the axis permutation from SB3's image to an environment's; None if not needed."""
    if not _is_image(space):
        return None
    channels, height, width = space.shape or ()
    return (1, 2, 0) if channels < MIN_IMAGE_EDGE <= min(height, width) else None


def _stored_order(space: spaces.Space[Any]) -> Order | None:
    """Return None, which means that images keep SB3's order of axes."""
    return None


def _is_image(space: spaces.Space[Any]) -> bool:
    if not isinstance(space, spaces.Box) or len(space.shape) != 3 or space.dtype != np.uint8:
        return False
    return not space.low.any() and bool((space.high == 255).all())


def _reordered(values: NDArray[Any], order: Order | None) -> NDArray[Any]:
    """Permute the axes of each row of `values` (N, *shape) by `order`.

    If `order` is None, return `values` unchanged.
    """
    return values if order is None else values.transpose(0, *(axis + 1 for axis in order))


def _scaled(space: spaces.Space[Any], actions: NDArray[Any]) -> NDArray[Any]:
    """Return actions as SB3 stores them: scaled to [-1, 1] for a bounded Box."""
    if not isinstance(space, spaces.Box) or not space.is_bounded():
        return actions
    with np.errstate(all="ignore"):
        scaled: NDArray[Any] = 2.0 * ((actions - space.low) / (space.high - space.low)) - 1.0
    if not np.isfinite(scaled).all():
        raise SpaceError(f"actions in {space} cannot be scaled to [-1, 1], as SB3 stores them")
    return scaled


def _rounded(name: str, values: NDArray[Any], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return numbers in the dtype of the buffer."""
    with np.errstate(over="ignore"):
        found = values.astype(dtype)
    changed = values[np.isinf(found) & ~np.isinf(values)]
    if len(changed):
        raise SpaceError(f"{name} {changed[0]} is too large for {dtype}, in which SB3 stores it")
    return found


def _unscaled(space: spaces.Space[Any], actions: NDArray[Any]) -> NDArray[Any]:
    """Scale the actions of a bounded Box from [-1, 1], as SB3 stores them, to the bounds."""
    if not isinstance(space, spaces.Box) or not space.is_bounded():
        return actions
    if not (np.abs(actions) <= 1).all():
        raise SpaceError(
            "the replay buffer has actions outside [-1, 1], so they are not scaled as SB3 scales"
            " them; pass scaled_actions=False"
        )
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    found = low + 0.5 * (actions.astype(np.float64) + 1.0) * (high - low)
    unscaled: NDArray[Any] = found.astype(space.dtype)
    return unscaled
