"""HDF5 files: D4RL's form is read and written, robomimic's form is only read.

D4RL's form is flat arrays of all transitions. The files written here also have `next_observations`
and, if they are known, `behavior_probs`, which D4RL's own files often lack; for actions of floats,
`behavior_log_probs`.

robomimic's form has a group `data/demo_<i>` for each episode.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import LogError, SpaceError, import_extra
from mcaprl.recorder.dataset.arrays import description_of, flags
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.formats import hdf5_nodes as nodes
from mcaprl.recorder.dataset.formats.columns import (
    EpisodeArrays,
    dataset_of,
    nested_names,
    stored_infos,
)
from mcaprl.recorder.dataset.formats.flat import (
    INFOS,
    NAMES,
    FlatOptions,
    Kind,
    flat_dataset,
    joined_trees,
    named_leaves,
    rows_of_tree,
    unread_note,
)
from mcaprl.recorder.format.spaces import leaves_of
from mcaprl.texts import counted

_OWN = "mcaprl"
"""Group that earlier versions of this package wrote; it is not read."""
_BLOCK_ROWS = 1024


def matches(path: Path) -> bool:
    """Return whether a path is an HDF5 file."""
    return nodes.is_hdf5(path)


def write(dataset: Dataset, path: Path, *, lossy: bool = False) -> list[str]:
    """Write a dataset in D4RL's form.

    Returns:
        One sentence for each thing that was left out or differs from D4RL's form.
    """
    infos, lost = stored_infos(dataset.infos)
    info_names, lost_names = nested_names(infos)
    lost += lost_names
    if isinstance(dataset.observation_space, spaces.Dict):
        lost.append("a Dict observation becomes one array for each key, which D4RL cannot read")
    if lost and not lossy:
        raise SpaceError(f"{lost[0]}; pass `lossy=True` to write the dataset")
    lasts = np.cumsum(dataset.episode_lengths) - 1
    timeouts = dataset.truncated.copy()
    timeouts[lasts] |= ~dataset.terminated[lasts]
    changed = int((timeouts != dataset.truncated).sum())
    if changed:
        episodes = counted(changed, "episode")
        lost.append(f"{episodes} without an end flag: a timeout is written at the end")
    space, _ = nodes.with_names_for_hdf5(dataset.observation_space)
    with nodes.created(path) as file:
        for leaf, named in zip(leaves_of(dataset.observation_space), leaves_of(space), strict=True):
            column, is_image = leaf.of(dataset.frames), leaf.encoding is not None
            name = "".join(f"/{key}" for key in named.path)
            _put(file, f"observations{name}", column, dataset.frame_of_step, is_image)
            _put(file, f"next_observations{name}", column, dataset.frame_of_step + 1, is_image)
        file["actions"] = dataset.actions
        file["rewards"] = dataset.rewards
        file["terminals"] = dataset.terminated
        file["timeouts"] = timeouts
        if not np.isnan(dataset.behavior).all():
            file[dataset.behavior_field.plural] = dataset.behavior
        for name, parts in info_names.items():
            values = infos[name][dataset.frame_of_step]
            is_text = values.dtype.kind == "U"
            file.create_dataset(
                "/".join((INFOS, *parts)),
                data=values.astype(object) if is_text else values,
                dtype=import_extra("h5py", nodes.EXTRA).string_dtype() if is_text else None,
            )
    return lost


def read(path: Path, *, one_episode: bool = False, dones: Kind | None = None) -> Dataset:
    """Read a file in D4RL's or robomimic's form."""
    with nodes.opened(path) as file:
        if nodes.has(file, "data"):
            return read_demos(file, path)
        if nodes.has(file, "episode_0"):
            raise LogError(f"{path} is a part of a Minari dataset: open the folder of the dataset")
        return read_flat(file, path, FlatOptions(one_episode, dones))


def read_flat(file: Any, path: Path, options: FlatOptions) -> Dataset:
    """Read flat arrays of transitions, and name those that are not read in a warning."""
    names = nodes.names_in(file)
    arrays = {name: nodes.tree_in(file, name) for name in names if name in NAMES}
    has_infos = nodes.has(file, INFOS) and nodes.is_group(file, INFOS)
    infos = dict(nodes.arrays_below(nodes.group_in(file, INFOS))) if has_infos else {}
    taken = {*arrays, _OWN, *([INFOS] if has_infos else [])}
    unread = [name for name in names if name not in taken and nodes.has_rows(file, name)]
    return flat_dataset(arrays, path, infos, options=options, unread=unread)


def _put(file: Any, name: str, column: Any, rows: NDArray[np.int64], is_image: bool) -> None:
    """Write rows of a column in blocks, because images on disk may be larger than the memory."""
    shape = (len(rows), *column.shape[1:])
    settings = nodes.image_settings(shape, column.dtype) if is_image else {}
    stored = file.create_dataset(name, shape, column.dtype, **settings)
    for start in range(0, len(rows), _BLOCK_ROWS):
        block = slice(start, start + _BLOCK_ROWS)
        stored[block] = np.asarray(column[rows[block]])
        nodes.stop_if_full(file)


_KNOWN = ("data", "mask")
"""Groups of a file; `mask` contains names of demonstrations only."""
_DEMO = ("obs", "next_obs", "actions", "rewards", "dones")


def read_demos(file: Any, path: Path) -> Dataset:
    """Read all demonstrations, in the order of their numbers.

    A demonstration is terminated if `dones` is set at its last step; otherwise it is truncated.
    If a truncated demonstration has no `next_obs`, its last step is left out, because the next
    observation of this step is unknown.
    """
    data = nodes.group_in(file, "data")
    names = sorted((name for name in nodes.names_in(data) if name.startswith("demo_")), key=_number)
    if not names:
        raise LogError(f"{path}: the group data has no demo_0, demo_1, ...: unknown form of HDF5")
    notes: dict[str, None] = {}
    unread = {
        name: None
        for name in nodes.names_in(file)
        if name not in _KNOWN and nodes.has_rows(file, name)
    }
    episodes = []
    for name in names:
        group = nodes.group_in(data, name)
        episodes.append(_demo(group, f"{path}: {name}", notes))
        others = (key for key in nodes.names_in(group) if key not in _DEMO)
        unread |= {f"demo_<i>/{key}": None for key in others if nodes.has_rows(group, key)}
    if notes:
        warnings.warn(f"{path}: {', and '.join(notes)}", stacklevel=4)
    if unread:
        warnings.warn(f"{path}: {unread_note(list(unread))}", stacklevel=4)
    try:
        actions = np.concatenate([episode.actions for episode in episodes])
        metadata = description_of("", episodes[0].observations, actions, None, None)
    except (SpaceError, ValueError) as error:
        raise SpaceError(f"{path}: {error}") from error
    return dataset_of(episodes, metadata, path)


def _demo(group: Any, where: str, notes: dict[str, None]) -> EpisodeArrays:
    if not nodes.has(group, "obs"):
        raise LogError(f"{where} has no observations: extract them with robomimic's scripts")
    observations = nodes.tree_in(group, "obs")
    actions, rewards = nodes.array_in(group, "actions"), nodes.array_in(group, "rewards")
    dones = None
    if nodes.has(group, "dones"):
        dones = flags(f"{where}: dones", nodes.array_in(group, "dones"))
    columns = [actions, rewards, *([] if dones is None else [dones])]
    if rewards.ndim != 1 or any(np.shape(values)[:1] != rewards.shape for values in columns):
        shapes = [values.shape for values in columns]
        raise LogError(f"{where}: actions, rewards and dones have shapes {shapes}")
    count = len(rewards)
    for name, part in named_leaves("obs", observations):
        if part.shape[:1] != (count,):
            raise LogError(f"{where}: {name} has shape {part.shape}, but there are {count} rewards")
    is_done = dones is not None and count > 0 and bool(dones[-1])
    if dones is not None and dones[:-1].any():
        notes["dones before the last step of a demonstration are ignored"] = None
    if nodes.has(group, "next_obs"):
        following = nodes.tree_in(group, "next_obs")
        _check_follows(observations, following, where)
        frames = joined_trees([observations, rows_of_tree(following, slice(count - 1, count))])
    elif is_done:
        notes["without next_obs, the last observation is also used as next observation"] = None
        frames = rows_of_tree(observations, np.minimum(np.arange(count + 1), count - 1))
    else:
        notes["without next_obs, the last step of a demonstration is left out"] = None
        frames, count = observations, count - 1
    return EpisodeArrays(
        observations=frames,
        actions=actions[:count],
        rewards=rewards[:count],
        terminated=is_done,
        truncated=not is_done,
    )


def _check_follows(here: Any, there: Any, where: str) -> None:
    """Check that each next observation is the observation of the following step."""
    if isinstance(here, dict):
        for key, part in here.items():
            _check_follows(part, there.get(key), f"{where}/{key}")
        return
    if there is None or not np.array_equal(_bytes(here[1:]), _bytes(there[:-1])):
        raise LogError(f"{where}: next_obs is not the observation of the following step")


def _bytes(array: NDArray[Any]) -> NDArray[np.uint8]:
    """Return the bytes of an array, because NaN is equal to NaN as bytes, but not as floats."""
    return np.frombuffer(array.tobytes(), np.uint8)


def _number(name: str) -> tuple[int, str]:
    digits = name.removeprefix("demo_")
    return (int(digits) if digits.isdecimal() else 0, name)
