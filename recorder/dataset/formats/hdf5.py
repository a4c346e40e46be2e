"""HDF5 files: D4RL's form is read and written, robomimic's form is only read.

D4RL's form is flat arrays of all transitions. The files written here also have `next_observations`,
which D4RL's own files often lack, and a group `mcaprl` with the data that D4RL's form cannot store.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import LogError, SpaceError, import_extra
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.formats import hdf5_nodes as nodes
from mcaprl.recorder.dataset.formats.columns import EpisodeArrays, dataset_of, episode_slices
from mcaprl.recorder.dataset.formats.ends import Kind
from mcaprl.recorder.dataset.formats.flat import NAMES, FlatOptions, flat_dataset
from mcaprl.recorder.dataset.formats.infos import (
    StoredInfo,
    infos_of,
    masked,
    nested_names,
    stored_infos,
)
from mcaprl.recorder.dataset.formats.npz import (
    INFOS,
    MISSING,
    OWN,
    description_text,
    parse_description,
    parse_infos,
)
from mcaprl.recorder.dataset.formats.robomimic import read_demos
from mcaprl.recorder.dataset.values import flags
from mcaprl.recorder.format.spaces import leaves_of, nest, observation_leaves
from mcaprl.texts import counted

_DESCRIPTION, _FINALS = "description", "final_infos"
_BLOCK_ROWS = 1024


def matches(path: Path) -> bool:
    """Return whether a path is an HDF5 file."""
    return nodes.is_hdf5(path)


def write(dataset: Dataset, path: Path, *, lossy: bool = False) -> list[str]:
    """Write a dataset in D4RL's form.

    Args:
        dataset: Episodes to write.
        path: New file.
        lossy: Whether to write Dict observations as one array for each key, and to leave out infos
            that HDF5 cannot store.

    Returns:
        One sentence for each thing that was left out or differs from D4RL's form.

    Raises:
        SpaceError: `lossy` is not set, and observations are a Dict or HDF5 cannot store an info.
        MissingExtraError: h5py is not installed.
    """
    infos, lost = stored_infos(infos_of(dataset))
    info_names, lost_names = nested_names(infos)
    lost += lost_names
    if isinstance(dataset.observation_space, spaces.Dict):
        lost.append("a Dict observation becomes one array for each key, which D4RL cannot read")
    if lost and not lossy:
        raise SpaceError(f"{lost[0]}; pass --lossy (lossy=True in Python) to write the dataset")
    slices = episode_slices(dataset)
    lasts = np.array([steps.stop - 1 for steps, _ in slices])
    timeouts = dataset.truncated.copy()
    timeouts[lasts] |= ~dataset.terminated[lasts]
    changed = int((timeouts != dataset.truncated).sum())
    if changed:
        episodes = counted(changed, "episode")
        lost.append(f"{episodes} without an end flag: a timeout is written at the end")
    space, _ = nodes.with_names_for_hdf5(dataset.observation_space)
    names = ["".join(f"/{key}" for key in leaf.path) for leaf in observation_leaves(space)]
    with nodes.created(path) as file:
        for leaf, name in zip(leaves_of(dataset.observation_space), names, strict=True):
            column, is_image = leaf.of(dataset.frames), leaf.encoding is not None
            _put(file, f"observations{name}", column, dataset.frame_of_step, is_image)
            _put(file, f"next_observations{name}", column, dataset.frame_of_step + 1, is_image)
        file["actions"] = dataset.actions
        file["rewards"] = dataset.rewards
        file["terminals"] = dataset.terminated
        file["timeouts"] = timeouts
        own = file.create_group(OWN)
        arrays = {}
        for name, parts in info_names.items():
            _put_info(file, "/".join(parts), infos[name], dataset)
            arrays[name] = "/".join(parts), infos[name].dtype.str
        own[_DESCRIPTION] = description_text(dataset, names, arrays)
        own["episode_lengths"] = dataset.episode_lengths
        own["truncated"] = dataset.truncated[lasts]
        own["behavior_probs"] = dataset.behavior_probs
        own["log_time_ns"] = np.concatenate([e.log_time_ns for e in dataset.episodes])
    return lost


def read(path: Path, *, one_episode: bool = False, dones: Kind | None = None) -> Dataset:
    """Read a file in D4RL's or robomimic's form.

    Args:
        path: File.
        one_episode: See `FlatOptions`; ignored for robomimic's form.
        dones: See `FlatOptions`; ignored for robomimic's form.

    Raises:
        LogError: The file is damaged, or has another form.
        SpaceError: A log cannot store a dtype, or a value is impossible.
        UsageError: The options contradict the arrays.
        MissingExtraError: h5py is not installed.
    """
    with nodes.opened(path) as file:
        if nodes.has(file, "data"):
            return read_demos(file, path)
        if nodes.has(file, "episode_0"):
            raise LogError(f"{path} is a part of a Minari dataset: open the folder of the dataset")
        if nodes.has(file, OWN):
            found = _own(file, path)
            if found is not None:
                return found
        return read_flat(file, path, FlatOptions(one_episode, dones))


def read_flat(file: Any, path: Path, options: FlatOptions) -> Dataset:
    """Read flat arrays of transitions, and name those that are not read in a warning.

    Raises:
        LogError, SpaceError, UsageError: See `flat_dataset`.
    """
    names = nodes.names_in(file)
    arrays = {name: nodes.tree_in(file, name) for name in names if name in NAMES}
    has_infos = nodes.has(file, INFOS) and nodes.is_group(file, INFOS)
    infos = dict(nodes.arrays_below(nodes.group_in(file, INFOS))) if has_infos else {}
    taken = {*arrays, OWN, *([INFOS] if has_infos else [])}
    unread = [name for name in names if name not in taken and nodes.has_rows(file, name)]
    return flat_dataset(arrays, path, infos, options=options, unread=unread)


def _own(file: Any, path: Path) -> Dataset | None:
    """Return the dataset that `write` stored; None if array lengths were changed afterwards."""
    own = nodes.group_in(file, OWN)
    text = str(nodes.array_in(own, _DESCRIPTION))
    metadata, summaries, names = parse_description(text, path)
    leaves = leaves_of(metadata.observation_space)
    steps = {name: nodes.array_in(file, name) for name in ("actions", "rewards", "terminals")}
    columns = [
        [nodes.array_at(file, f"{role}{name}".split("/")) for name in names]
        for role in ("observations", "next_observations")
    ]
    parts = {
        name: nodes.array_in(own, name)
        for name in ("episode_lengths", "truncated", "behavior_probs", "log_time_ns")
    }
    lengths, count = parts["episode_lengths"].astype(int).tolist(), len(steps["rewards"])
    terminals = flags(f"{path}: terminals", steps["terminals"])
    truncated = flags(f"{path}: {OWN}/truncated", parts["truncated"])
    rows = [*steps.values(), *columns[0], *columns[1], parts["behavior_probs"]]
    same = sum(lengths) == count and all(len(array) == count for array in rows)
    same &= len(truncated) == len(lengths) == len(summaries)
    if not same or len(parts["log_time_ns"]) != count + len(lengths) or min(lengths, default=0) < 1:
        warnings.warn(
            f"{path}: the group {OWN} is ignored, because the arrays were changed afterwards",
            stacklevel=4,
        )
        return None
    infos = _own_infos(file, lengths, parse_infos(text, path))

    def episodes() -> Iterator[EpisodeArrays]:
        last = 0
        for index, (length, summary) in enumerate(zip(lengths, summaries, strict=True)):
            taken, last = slice(last, last + length), last + length
            frames = slice(taken.start + index, last + index + 1)
            observations = [
                np.concatenate([here[taken], there[last - 1 : last]])
                for here, there in zip(*columns, strict=True)
            ]
            yield EpisodeArrays(
                observations=nest(leaves, observations),
                actions=steps["actions"][taken],
                rewards=steps["rewards"][taken],
                terminated=bool(terminals[last - 1]),
                truncated=bool(truncated[index]),
                behavior_probs=parts["behavior_probs"][taken],
                times_ns=parts["log_time_ns"][frames],
                infos={name: values[frames] for name, values in infos.items()},
                summary=summary,
            )

    return dataset_of(list(episodes()), metadata, path)


def _own_infos(
    file: Any, lengths: Sequence[int], described: Mapping[str, tuple[str, np.dtype[Any]]]
) -> dict[str, Any]:
    """Return the infos (F, *shape) of all F observations, including the final ones."""
    finals = np.cumsum(np.array(lengths) + 1) - 1
    found = {}
    for name, (array, dtype) in described.items():
        steps = nodes.array_at(file, f"{INFOS}/{array}".split("/"))
        last, missing = (
            nodes.array_at(file, f"{OWN}/{group}/{array}".split("/"))
            for group in (_FINALS, MISSING)
        )
        if len(steps) != sum(lengths) or len(last) != len(finals):
            raise LogError(
                f"{nodes.source()}: {INFOS}/{array} has {len(steps)} rows, which does not fit"
                " episode_lengths"
            )
        steps = steps.astype(np.result_type(steps, last))
        rows = np.insert(steps, finals - np.arange(len(finals)), last, axis=0)
        found[name] = masked(rows, missing.astype(bool), dtype)
    return found


def _put_info(file: Any, name: str, info: StoredInfo, dataset: Dataset) -> None:
    """Write an info: one row per step, as in D4RL's files, and the rows of final observations."""
    finals = np.cumsum(dataset.episode_lengths + 1) - 1
    is_text = info.values.dtype.kind == "U"
    values = info.values.astype(object) if is_text else info.values
    dtype = import_extra("h5py", nodes.EXTRA).string_dtype() if is_text else values.dtype
    file.create_dataset(f"{INFOS}/{name}", data=values[dataset.frame_of_step], dtype=dtype)
    file.create_dataset(f"{OWN}/{_FINALS}/{name}", data=values[finals], dtype=dtype)
    file[f"{OWN}/{MISSING}/{name}"] = info.is_missing


def _put(file: Any, name: str, column: Any, rows: NDArray[np.int64], is_image: bool) -> None:
    """Write rows of a column in blocks, because images on disk may be larger than the memory."""
    shape = (len(rows), *column.shape[1:])
    settings = nodes.image_settings(shape, column.dtype) if is_image else {}
    stored = file.create_dataset(name, shape, column.dtype, **settings)
    for start in range(0, len(rows), _BLOCK_ROWS):
        block = slice(start, start + _BLOCK_ROWS)
        stored[block] = np.asarray(column[rows[block]])
        nodes.stop_if_full(file)
