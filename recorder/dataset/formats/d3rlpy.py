"""d3rlpy's episodes: `MDPDataset` and other replay buffers, and the HDF5 files of `dump`.

An episode of d3rlpy has as many observations as actions. In a terminated episode, each step is a
transition, and the next observation of the last transition is zero. In any other episode, the last
step is not a transition: it only contains the next observation of the step before it. Therefore, an
episode that was not terminated is stored with one additional step, which contains the final
observation, a zero action and a zero reward.

Images have their channels first, other tensors are vectors, and a Dict is a list of arrays.

d3rlpy 1 wrote flat arrays, in which `episode_terminals` marks the last step of each episode. They
are read as d3rlpy 2 reads them.
"""

from __future__ import annotations

import itertools
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import LogError, MissingExtraError, SpaceError, UsageError, import_extra
from mcaprl.recorder.dataset.arrays import action_space_of, box_of, exactly, flags, numbers
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.formats import hdf5_nodes as nodes
from mcaprl.recorder.dataset.formats.columns import EpisodeArrays, dataset_of, episode_slices
from mcaprl.recorder.dataset.formats.flat import NAMES, FlatOptions, Kind, flat_dataset, unread_note
from mcaprl.recorder.format.metadata import LogMetadata, installed_versions
from mcaprl.recorder.format.spaces import (
    MIN_IMAGE_EDGE,
    Leaf,
    action_leaf,
    observation_leaves,
)

VERSION = "2.1"
_OWN = "mcaprl"
"""Group that earlier versions of this package wrote; it is not read."""
_KEYS = ("observations", "actions", "rewards", "terminated")


def matches(path: Path) -> bool:
    """Return whether a path is a file that d3rlpy's `dump` wrote."""
    if not nodes.is_hdf5(path):
        return False
    with nodes.opened(path) as file:
        is_new = all(nodes.has(file, name) for name in ("columns", "num_episodes", "version"))
        return is_new or _is_version_1(file)


def to_mdp_dataset(dataset: Dataset) -> Any:
    """Return a `d3rlpy.dataset.MDPDataset` with all transitions."""
    _check_action_space(dataset.action_space)
    try:
        d3rlpy = import_extra("d3rlpy", "")
    except MissingExtraError as error:
        raise MissingExtraError(
            "d3rlpy is not installed: run pip install --no-deps d3rlpy, and install the"
            " dependencies that docs/formats.md lists"
        ) from error
    space, kinds = dataset.action_space, d3rlpy.ActionSpace
    # Without these arguments, d3rlpy treats all integer actions as discrete, and infers the number
    # of actions from the largest one in the data.
    if isinstance(space, spaces.Discrete):
        action_space, action_size = kinds.DISCRETE, int(space.n)
    else:
        action_space, action_size = kinds.CONTINUOUS, action_leaf(space).size
    parts = list(_episodes_of(dataset))
    flags = [_flags(part) for part in parts]
    return d3rlpy.dataset.MDPDataset(
        observations=_joined([part["observations"] for part in parts]),
        actions=np.concatenate([part["actions"] for part in parts]),
        rewards=np.concatenate([part["rewards"] for part in parts]),
        terminals=np.concatenate([terminals for terminals, _ in flags]),
        timeouts=np.concatenate([timeouts for _, timeouts in flags]),
        action_space=action_space,
        action_size=action_size,
    )


def from_buffer(buffer: Any) -> Dataset:
    """Copy the episodes of a replay buffer of d3rlpy.

    d3rlpy does not store the final observation of a terminated episode. The observation before it
    is repeated instead.
    """
    if not (hasattr(buffer, "episodes") and hasattr(buffer, "dataset_info")):
        raise UsageError(
            f"expected a replay buffer of d3rlpy, but this is a {type(buffer).__name__}"
        )
    info = buffer.dataset_info
    discrete = spaces.Discrete(int(info.action_size))
    episodes = [{name: getattr(e, name) for name in _KEYS} for e in buffer.episodes]
    action_space = discrete if info.action_space.name == "DISCRETE" else None
    return _dataset_of(episodes, action_space, "the replay buffer")


def write(dataset: Dataset, path: Path, *, lossy: bool = False) -> list[str]:
    """Write a file that d3rlpy's `ReplayBuffer.load` reads.

    Returns:
        One sentence for each thing that is stored in another way.
    """
    lost = []
    try:
        _check_action_space(dataset.action_space)
    except SpaceError as error:
        if not lossy:
            raise SpaceError(
                f"{error}; pass `lossy=True` to write the actions unchanged"
            ) from error
        lost.append(f"{error}; the actions are written unchanged")
    leaves = observation_leaves(dataset.observation_space)
    if isinstance(dataset.observation_space, spaces.Dict):
        keys = ", ".join("/".join(leaf.path) for leaf in leaves)
        lost.append(f"the keys {keys} of the observations become numbers")
    for leaf in leaves:
        if len(leaf.shape) > 1 and leaf.dtype != np.uint8:
            lost.append(f"{leaf.name} of shape {leaf.shape} becomes a vector")
    with nodes.created(path) as file:
        for index, part in enumerate(_episodes_of(dataset)):
            for name, values in part.items():
                several = isinstance(values, list)
                for number, array in enumerate(values if several else [values]):
                    place = f"{name}_{index}_{number}" if several else f"{name}_{index}"
                    is_image = isinstance(array, np.ndarray) and array.ndim == 4
                    compression = "lzf" if is_image else None
                    file.create_dataset(place, data=array, compression=compression)
            nodes.stop_if_full(file)
        file["columns"] = list(_KEYS)
        file["num_episodes"] = len(dataset.episode_lengths)
        file["version"] = VERSION
    return lost


def read(path: Path, *, one_episode: bool = False, dones: Kind | None = None) -> Dataset:
    """Read a file that d3rlpy's `dump` or `write` wrote.

    A file of version 2 does not state whether actions are discrete. They are read as discrete if
    each step has one integer.
    """
    with nodes.opened(path) as file:
        if _is_version_1(file):
            return _version_1(file, path, FlatOptions(one_episode, dones))
        version = str(nodes.array_in(file, "version"))
        if version != VERSION:
            raise LogError(
                f"{path} has version {version} of d3rlpy's file format, expected {VERSION}:"
                " load it with d3rlpy and dump it again"
            )
        count = _whole_number(file, "num_episodes", path)
        episodes = [
            {name: _array(file, f"{name}_{index}") for name in _KEYS} for index in range(count)
        ]
        for index, episode in enumerate(episodes):
            _check_arrays(episode, f"{path}: episode {index}")
        unread = _unread(file, count)
    found = _dataset_of(episodes, None, path)
    if unread:
        warnings.warn(f"{path}: {unread_note(unread)}", stacklevel=4)
    return found


def _is_version_1(file: Any) -> bool:
    """Return whether d3rlpy 1 wrote a file, as far as the names of its arrays tell."""
    names = ("observations", "actions", "rewards", "terminals", "discrete_action")
    return all(nodes.has(file, name) for name in names)


def _version_1(file: Any, path: Path, options: FlatOptions) -> Dataset:
    """Read the flat arrays of d3rlpy 1.

    Without next observations, the last row of an episode that is not terminated is only an
    observation, as in d3rlpy.
    """
    names = nodes.names_in(file)
    arrays = {name: nodes.tree_in(file, name) for name in names if name in NAMES}
    actions, is_discrete = arrays["actions"], nodes.array_in(file, "discrete_action")
    if flags(f"{path}: discrete_action", is_discrete).reshape(-1)[:1].all():
        actions = numbers(f"{path}: actions", actions)
        arrays["actions"] = exactly(f"{path}: actions", actions, np.dtype(np.int64)).reshape(-1)
    elif np.ndim(actions) == 1:
        arrays["actions"] = actions[:, None]
    if isinstance(arrays["observations"], np.ndarray):
        arrays["observations"] = _channels_last(arrays["observations"])
    unread = [name for name in names if name not in NAMES and nodes.has_rows(file, name)]
    return flat_dataset(arrays, path, options=options, unread=unread)


def _unread(file: Any, count: int) -> list[str]:
    """Return the names of the arrays of a file of version 2 that are not those of its episodes."""
    known = re.compile(rf"({'|'.join(_KEYS)})_(\d+)(_\d+)?")

    def is_known(name: str) -> bool:
        found = known.fullmatch(name)
        return name in ("columns", _OWN) or (found is not None and int(found[2]) < count)

    names = nodes.names_in(file)
    return [name for name in names if not is_known(name) and nodes.has_rows(file, name)]


def _check_action_space(space: spaces.Space[Any]) -> None:
    if isinstance(space, spaces.Discrete) and space.start != 0:
        raise SpaceError(f"the actions are {space}; d3rlpy needs actions that start at 0")
    if isinstance(space, spaces.MultiDiscrete | spaces.MultiBinary):
        raise SpaceError(f"the actions are {space}; d3rlpy supports only Discrete and Box")


def _episodes_of(dataset: Dataset) -> Iterator[dict[str, Any]]:
    """Yield the arrays of each episode as d3rlpy stores them."""
    leaves = observation_leaves(dataset.observation_space)
    actions = dataset.actions.reshape(len(dataset), -1)
    for steps, frames in episode_slices(dataset):
        terminated = bool(dataset.terminated[steps.stop - 1])
        rows = slice(frames.start, frames.stop - terminated)
        more = ((0, 0 if terminated else 1), (0, 0))
        found = [_stored_rows(leaf, np.asarray(leaf.of(dataset.frames)[rows])) for leaf in leaves]
        yield {
            "observations": found[0] if len(found) == 1 else found,
            "actions": np.pad(actions[steps], more),
            "rewards": np.pad(dataset.rewards[steps, None], more),
            "terminated": terminated,
        }


def _stored_rows(leaf: Leaf, values: NDArray[Any]) -> NDArray[Any]:
    """Return rows (N, *shape) as d3rlpy stores them: images (N, C, H, W), or vectors (N, size)."""
    if leaf.dtype == np.uint8 and len(leaf.shape) == 3 and sorted(leaf.shape)[1] >= MIN_IMAGE_EDGE:
        is_first = leaf.shape[0] == min(leaf.shape)
        return values if is_first else np.moveaxis(values, -1, 1)
    if leaf.encoding is not None:
        return values[:, None]
    return values.reshape(len(values), leaf.size)


def _joined(observations: Sequence[Any]) -> Any:
    if isinstance(observations[0], list):
        return [np.concatenate(parts) for parts in zip(*observations, strict=True)]
    return np.concatenate(observations)


def _flags(episode: Mapping[str, Any]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the terminals and the timeouts of an episode. The last step has one of these flags."""
    flags = np.zeros((2, len(episode["rewards"])), np.float32)
    flags[0 if episode["terminated"] else 1, -1] = 1
    return flags[0], flags[1]


def _dataset_of(
    episodes: Sequence[Mapping[str, Any]], action_space: spaces.Space[Any] | None, where: object
) -> Dataset:
    """Convert d3rlpy's episodes to a dataset; infer the spaces that are not given."""
    if not episodes:
        raise LogError(f"{where} has no episodes")
    frames = [_frames(episode) for episode in episodes]
    first = frames[0]
    is_dict = isinstance(first, dict)
    metadata = LogMetadata(
        spaces.Dict([(key, box_of(part)) for key, part in first.items()])
        if is_dict
        else box_of(first),
        action_space or _action_space_of([episode["actions"] for episode in episodes]),
        versions=installed_versions(),
    )
    shape = action_leaf(metadata.action_space).shape
    found = []
    for episode, observations in zip(episodes, frames, strict=True):
        terminated = bool(episode["terminated"])
        steps = slice(len(episode["rewards"]) - (not terminated))
        arrays = EpisodeArrays(
            observations=observations,
            actions=episode["actions"][steps].reshape(-1, *shape),
            rewards=episode["rewards"][steps].reshape(-1),
            terminated=terminated,
            truncated=not terminated,
        )
        found.append(arrays)
    return dataset_of(found, metadata, where)


def _frames(episode: Mapping[str, Any]) -> Any:
    """Return the T + 1 observations of an episode; images have their channels last."""
    stored = episode["observations"]
    if isinstance(stored, list | tuple):
        parts = [_frames({**episode, "observations": part}) for part in stored]
        return {str(index): part for index, part in enumerate(parts)}
    values = np.concatenate([stored, stored[-1:]]) if episode["terminated"] else stored
    return _channels_last(values)


def _channels_last(values: NDArray[Any]) -> NDArray[Any]:
    """Return images (N, C, H, W) as (N, H, W, C), and other arrays unchanged."""
    is_image = values.dtype == np.uint8 and values.ndim == 4
    if is_image and values.shape[1] < MIN_IMAGE_EDGE <= min(values.shape[2:]):
        return np.moveaxis(values, 1, -1)
    return values


def _action_space_of(actions: Sequence[NDArray[Any]]) -> spaces.Space[Any]:
    every = np.concatenate(actions)
    is_discrete = every.dtype.kind in "iu" and every.shape[1:] == (1,) and not (every < 0).any()
    return action_space_of(every[:, 0] if is_discrete else every)


def _array(file: Any, name: str) -> Any:
    """Read an array, or the list of arrays `NAME_0`, `NAME_1`, ..."""
    if nodes.has(file, name) or not nodes.has(file, f"{name}_0"):
        return nodes.array_in(file, name)
    names = (f"{name}_{number}" for number in itertools.count())
    return [nodes.array_in(file, part) for part in itertools.takewhile(file.__contains__, names)]


def _whole_number(file: Any, name: str, where: object) -> int:
    found = nodes.array_in(file, name)
    if found.ndim or found.dtype.kind not in "iu":
        raise LogError(f"{where}: {name} is not a whole number")
    return int(found)


def _check_arrays(episode: Mapping[str, Any], where: str) -> None:
    """Check that the arrays of an episode are numeric and have one row for each step."""
    stored = episode["observations"]
    parts = [*stored] if isinstance(stored, list) else [stored]
    parts += [episode["actions"], episode["rewards"]]
    if any(part.ndim < 2 for part in parts) or len({len(part) for part in parts}) > 1:
        raise LogError(
            f"{where} has arrays of shapes {[part.shape for part in parts]}, expected (steps, ...)"
        )
    if any(part.dtype.kind not in "biuf" for part in (*parts, episode["terminated"])):
        raise LogError(f"{where} has arrays that are not numbers")
    if not parts[-1].size or parts[-1].shape[1] != 1 or episode["terminated"].ndim:
        raise LogError(f"{where} has no rewards, or several rewards for each step")
    flags(f"{where}: terminated", episode["terminated"])
