"""HDF5 files: D4RL's form is read and written, robomimic's form is only read.

D4RL's form is flat arrays of all transitions. The files written here also have `next_observations`
and, if they are known, `behavior_probs`, which D4RL's own files often lack.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import LogError, SpaceError, import_extra
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.formats import hdf5_nodes as nodes
from mcaprl.recorder.dataset.formats.ends import Kind
from mcaprl.recorder.dataset.formats.flat import INFOS, NAMES, FlatOptions, flat_dataset
from mcaprl.recorder.dataset.formats.infos import nested_names, stored_infos
from mcaprl.recorder.dataset.formats.robomimic import read_demos
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
        if not np.isnan(dataset.behavior_probs).all():
            file["behavior_probs"] = dataset.behavior_probs
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
