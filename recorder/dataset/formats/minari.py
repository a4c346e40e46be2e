"""Minari datasets: folders with `data/metadata.json` and the episodes in HDF5 or Arrow form.

Minari truncates episodes of more than 32,767 steps when it reads its Arrow form; this reader reads
all steps.

Images are stored without loss, not as JPEG.
"""

from __future__ import annotations

import io
import json
import re
import warnings
from collections.abc import Generator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError, SpaceError, import_extra
from mcaprl.files import parse_json
from mcaprl.recorder.dataset.arrays import flags
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.formats import hdf5_nodes as hdf5
from mcaprl.recorder.dataset.formats import minari_arrow as arrow
from mcaprl.recorder.dataset.formats.columns import (
    EpisodeArrays,
    dataset_of,
    episode_slices,
    masked,
    missing_rows,
    nested_names,
    stored_infos,
)
from mcaprl.recorder.dataset.formats.flat import unread_note
from mcaprl.recorder.dataset.formats.hdf5_nodes import (
    EXTRA,
    created,
    image_settings,
    stop_if_full,
    with_names_for_hdf5,
)
from mcaprl.recorder.dataset.formats.minari_metadata import (
    DATA,
    FILE,
    MAIN,
    Description,
    data_folder,
    description_text,
    local_path,
    may_be_jpeg,
    options_for,
    raw_metadata,
    read_description,
)
from mcaprl.recorder.format.messages import MAX_SEED, EpisodeSummary
from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.format.spaces import Leaf, action_leaf, leaves_of, nest, observation_leaves

_FLAGS = ("terminations", "truncations")
_KNOWN = ("observations", "actions", "rewards", *_FLAGS, "infos", "id", "mcaprl")
"""Members of an episode that are read, or that earlier versions of this package wrote."""


@dataclass(frozen=True)
class _Stored:
    """Stored data of one episode.

    Attributes:
        observations: Array of T + 1 rows, or JPEG files, of each leaf of the observation.
        steps: Arrays of T rows: `actions`, `rewards`, `terminations` and `truncations`.
        infos: Arrays by dotted name.
        attributes: `seed`, `options` and others.
        unread: Names of other arrays.
    """

    observations: Sequence[Any]
    steps: Mapping[str, NDArray[Any]]
    infos: Mapping[str, NDArray[Any]]
    attributes: Mapping[str, Any]
    unread: Sequence[str] = ()


def read(path: Path, *, lossy: bool = False) -> Dataset:
    """Read a dataset."""
    description = read_description(path, lossy=lossy)
    forms = {"hdf5": _in_hdf5, "arrow": _in_arrow, "parquet": _in_arrow}
    if description.form not in forms:
        raise LogError(f"{path}: unknown data format '{description.form}' of Minari")
    reader = _Reader(path, description)
    # `closing` closes the file even if an episode raises an error.
    with closing(forms[description.form](data_folder(path), description)) as stored:
        episodes = [reader.episode(index, part) for index, part in enumerate(stored)]
    episodes = reader.with_equal_infos(episodes)
    reader.warn()
    return dataset_of(episodes, description.metadata, path)


class _Reader:
    """Conversion of stored episodes to arrays."""

    def __init__(self, path: Path, description: Description) -> None:
        self._path = path
        self._space = description.metadata.observation_space
        self._leaves = leaves_of(self._space)
        self._action = action_leaf(description.metadata.action_space)
        self._is_jpeg = [
            description.is_jpeg and may_be_jpeg(self._space, leaf) for leaf in self._leaves
        ]
        self._tuples = any(isinstance(key, int) for keys in description.keys for key in keys)
        self._odd_infos: set[str] = set()
        self._unread: dict[str, None] = {}
        self._lost = description.lost

    def episode(self, index: int, stored: _Stored) -> EpisodeArrays:
        where = f"{self._path}: episode {index}"
        parts = zip((leaf.name for leaf in self._leaves), stored.observations, strict=True)
        for name, values in [*stored.steps.items(), *parts]:
            if not np.ndim(values):
                raise LogError(f"{where}: {name} is one value, expected one for each step")
        steps = {name: _column(values) for name, values in stored.steps.items()}
        count = len(steps["rewards"])
        ends = []
        for name in _FLAGS:
            if len(steps[name]) != count:
                raise LogError(f"{where} has {len(steps[name])} {name}, but {count} rewards")
            ended = flags(f"{where}: {name}", steps[name])
            if ended[:-1].any():
                raise LogError(f"{where} has steps after {name} at step {int(ended.argmax())}")
            ends.append(bool(ended.any()))
        observations = [
            self._images(leaf, values, where) if is_jpeg else values
            for leaf, values, is_jpeg in zip(
                self._leaves, stored.observations, self._is_jpeg, strict=True
            )
        ]
        self._unread |= dict.fromkeys(stored.unread)
        return EpisodeArrays(
            observations=nest(self._leaves, observations),
            actions=stored.steps["actions"].reshape(-1, *self._action.shape),
            rewards=steps["rewards"],
            terminated=ends[0],
            truncated=ends[1],
            infos=self._infos(stored, count),
            summary=_summary(stored.attributes, where),
        )

    def with_equal_infos(self, episodes: Sequence[EpisodeArrays]) -> list[EpisodeArrays]:
        """Leave out the infos whose rows differ in shape or kind between the episodes."""
        found: dict[str, set[Any]] = {}
        for episode in episodes:
            for name, values in episode.infos.items():
                kind = (values.shape[1:], values.dtype.kind == "U")
                found.setdefault(name, set()).add(kind)
        self._odd_infos |= {name for name, kinds in found.items() if len(kinds) > 1}
        return [
            replace(
                episode,
                infos={
                    name: values
                    for name, values in episode.infos.items()
                    if name not in self._odd_infos
                },
            )
            for episode in episodes
        ]

    def warn(self) -> None:
        """Warn about data that was changed or left out."""
        images = [leaf.name for leaf, jpeg in zip(self._leaves, self._is_jpeg, strict=True) if jpeg]
        if images:
            warnings.warn(
                f"{self._path}: {', '.join(images)} is stored as JPEG, which changed its pixels"
                " when the dataset was written",
                stacklevel=4,
            )
        if self._tuples:
            warnings.warn(
                f"{self._path}: Tuple observations are read as Dict observations with the keys"
                " '0', '1', ...",
                stacklevel=4,
            )
        for sentence in self._lost:
            warnings.warn(f"{self._path}: {sentence}", stacklevel=4)
        if self._unread:
            warnings.warn(f"{self._path}: {unread_note(sorted(self._unread))}", stacklevel=4)
        if self._odd_infos:
            warnings.warn(
                f"{self._path}: infos whose type, row shape or row count does not fit are left out:"
                f" {', '.join(sorted(self._odd_infos))}",
                stacklevel=4,
            )

    def _infos(self, stored: _Stored, count: int) -> dict[str, Any]:
        """Return the infos with T + 1 rows; add a first row for the reset to infos of T rows."""
        found: dict[str, Any] = {}
        for name, values in stored.infos.items():
            is_plain = values.ndim > 0 and values.dtype.kind in "biufU"
            if not is_plain or len(values) not in (count, count + 1):
                self._odd_infos.add(name)
                continue
            first = count + 1 - len(values)
            rows = np.concatenate([np.zeros((first, *values.shape[1:]), values.dtype), values])
            found[name] = masked(rows, np.arange(count + 1) < first)
        return found

    def _images(self, leaf: Leaf, values: Any, where: str) -> NDArray[np.uint8]:
        if getattr(values, "dtype", None) == np.uint8 and values.shape[1:] == leaf.shape:
            return np.asarray(values)
        image_module = import_extra("PIL.Image", hdf5.EXTRA)
        images = np.empty((len(values), *leaf.shape), np.uint8)
        for row, data in enumerate(values):
            try:
                # Pillow reads the size first, so images of a wrong size are not decoded.
                with image_module.open(io.BytesIO(bytes(data)), formats=["JPEG"]) as image:
                    if image.size != (leaf.shape[1], leaf.shape[0]):
                        width, height = image.size
                        raise OSError(f"the image has a wrong size: {width} x {height} pixels")
                    images[row] = np.asarray(image)
            except (OSError, ValueError) as error:
                raise LogError(f"{where}: {leaf.name} of step {row}: {error}") from error
        return images


def _column(values: NDArray[Any]) -> NDArray[Any]:
    """Return one value per step; some datasets store each value as an array of one element."""
    values = np.asarray(values)
    return values.reshape(len(values)) if values.size == len(values) else values


def _summary(attributes: Mapping[str, Any], where: str) -> dict[str, Any]:
    try:
        summary: dict[str, Any] = {}
        if attributes.get("seed") is not None:
            summary["seed"] = _seed(int(attributes["seed"]))
        if attributes.get("options"):
            summary["options"] = json.dumps(attributes["options"])
        return summary
    except (ValueError, TypeError, AttributeError) as error:
        raise LogError(f"{where}: the attributes cannot be read: {error}") from error


def _seed(seed: int) -> int:
    if not 0 <= seed <= MAX_SEED:
        raise ValueError(f"a log cannot store the seed {seed}")
    return seed


def _in_hdf5(folder: Path, description: Description) -> Generator[_Stored]:
    with hdf5.opened(folder / MAIN) as file:
        more = [name for name in hdf5.names_in(file) if not _is_episode(name, description)]
        for index in range(description.episodes):
            group = hdf5.group_in(file, f"episode_{index}")
            infos = hdf5.group_in(group, "infos") if hdf5.has(group, "infos") else None
            yield _Stored(
                observations=[
                    hdf5.array_at(group, ("observations", *keys)) for keys in description.keys
                ],
                steps={
                    "actions": _joined(
                        [hdf5.array_at(group, ("actions", *k)) for k in description.action_keys]
                    ),
                    **{name: hdf5.array_in(group, name) for name in ("rewards", *_FLAGS)},
                },
                infos={} if infos is None else dict(hdf5.arrays_below(infos)),
                attributes=hdf5.attributes_of(group),
                unread=[
                    *more,
                    *(
                        f"episode_<i>/{name}"
                        for name in hdf5.names_in(group)
                        if name not in _KNOWN and hdf5.has_rows(group, name)
                    ),
                ],
            )


def _joined(actions: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Return the action (T, *shape), or the parts of the action as vectors (T, size)."""
    if len(actions) == 1:
        return actions[0]
    if len({len(part) for part in actions}) != 1:
        raise LogError("the parts of the action have different numbers of steps")
    return np.concatenate([part.reshape(len(part), -1) for part in actions], axis=1)


def _is_episode(name: str, description: Description) -> bool:
    """Return whether a group of the file is one of the episodes that the description counts."""
    number = name.removeprefix("episode_")
    return number.isdecimal() and int(number) < description.episodes


def _in_arrow(folder: Path, description: Description) -> Generator[_Stored]:
    for index in range(description.episodes):
        table = arrow.read_table(folder / str(index), description.form)
        yield _Stored(
            observations=[
                arrow.array_at(table, ("observations", *keys), leaf.shape)
                for keys, leaf in zip(
                    description.keys,
                    leaves_of(description.metadata.observation_space),
                    strict=True,
                )
            ],
            # The last row contains the final observation; its other columns are padding.
            steps={
                "actions": _joined(
                    [
                        arrow.array_at(table, ("actions", *keys), None)[:-1]
                        for keys in description.action_keys
                    ]
                ),
                **{
                    name: arrow.array_at(table, (name,), None)[:-1] for name in ("rewards", *_FLAGS)
                },
            },
            unread=[name for name in table.column_names if name not in _KNOWN],
            infos=arrow.infos_of(table),
            attributes=arrow.attributes_of(folder / str(index)),
        )


# HDF5 stores attributes of at most 64 KiB.
_MAX_ATTRIBUTE_BYTES = 60_000


def write(dataset: Dataset, path: Path, *, lossy: bool = False, dataset_id: str = "") -> list[str]:
    """Write a dataset to an empty folder.

    Returns:
        One sentence for each thing that was left out or changed.
    """
    metadata = LogMetadata.from_strings(dataset.metadata)
    space, renamed = with_names_for_hdf5(dataset.observation_space)
    lost = [f"the key '{key}' is renamed, because it is not a valid HDF5 name" for key in renamed]
    infos, lost_infos = stored_infos(dataset.infos)
    info_names, lost_names = nested_names(infos)
    lost += [*_lost_options(dataset), *lost_infos, *lost_names]
    if lost and not lossy:
        raise SpaceError(f"{lost[0]}; pass `lossy=True` to write the dataset")
    leaves = observation_leaves(dataset.observation_space)
    keys = [leaf.path for leaf in observation_leaves(space)]
    columns = [leaf.of(dataset.frames) for leaf in leaves]
    data = path / DATA
    data.mkdir()
    with created(data / MAIN, track_order=True) as file:
        for index, (steps, frames) in enumerate(episode_slices(dataset)):
            group = file.create_group(f"episode_{index}")
            _put_attributes(group, index, dataset.episodes[index].summary)
            for leaf, key, column in zip(leaves, keys, columns, strict=True):
                values = np.asarray(column[frames])
                name = "/".join(("observations", *key))
                is_image = leaf.encoding is not None
                settings = image_settings(values.shape, values.dtype) if is_image else {}
                _put(group, name, values, **settings)
            _put(group, "actions", dataset.actions[steps])
            _put(group, "rewards", dataset.rewards[steps])
            _put(group, "terminations", dataset.terminated[steps])
            _put(group, "truncations", dataset.truncated[steps])
            group.create_group("infos")
            for name, parts in info_names.items():
                if not missing_rows(dataset.infos[name][frames]).all():
                    _put_info(group, "/".join(parts), infos[name][frames])
            stop_if_full(file)
    counts = {
        "total_episodes": len(dataset.episode_lengths),
        "total_steps": len(dataset),
        "dataset_size": round((data / MAIN).stat().st_size / 1e6, 1),
    }
    text = description_text(metadata, space, dataset_id=dataset_id or path.name, counts=counts)
    (data / FILE).write_text(text)
    return lost


def _put(group: Any, name: str, values: NDArray[Any], **settings: Any) -> None:
    # The arrays are resizable, because Minari may append to them.
    group.create_dataset(
        name,
        data=values,
        maxshape=(None, *values.shape[1:]),
        **{"chunks": True, **settings},
    )


def _put_info(group: Any, name: str, values: NDArray[Any]) -> None:
    is_text = values.dtype.kind == "U"
    group.create_dataset(
        f"infos/{name}",
        data=values.astype(object) if is_text else values,
        dtype=import_extra("h5py", EXTRA).string_dtype() if is_text else None,
        chunks=True if values.size else None,
        maxshape=(None, *values.shape[1:]) if values.size else None,
    )


def _put_attributes(group: Any, index: int, summary: EpisodeSummary) -> None:
    group.attrs["id"] = index
    group.attrs["total_steps"] = summary.length
    if summary.seed is not None:
        group.attrs["seed"] = summary.seed
    for name, value in _flat_options(summary.options).items():
        if _is_attribute(name, value):
            group.attrs[f"options/{name}"] = value


def _lost_options(dataset: Dataset) -> list[str]:
    names = {
        name: None
        for episode in dataset.episodes
        for name, value in _flat_options(episode.summary.options).items()
        if not _is_attribute(name, value)
    }
    return [f"the reset option '{name}' is left out, because HDF5 cannot hold it" for name in names]


def _flat_options(options: str) -> dict[str, Any]:
    """Return the options of a reset by path, such as `start/x`."""
    try:
        found = parse_json(options or "{}")
    except ValueError:
        return {}
    return dict(_flat(found, ())) if isinstance(found, dict) else {}


def _flat(options: dict[str, Any], path: tuple[str, ...]) -> list[tuple[str, Any]]:
    found = []
    for key, value in options.items():
        if isinstance(value, dict):
            found += _flat(value, (*path, key))
        else:
            found.append(("/".join((*path, key)), value))
    return found


def _is_attribute(name: str, value: Any) -> bool:
    """Return whether HDF5 can hold an option: a number, text, or an array of numbers."""
    if not _is_text(name):
        return False
    if isinstance(value, str):
        return _is_text(value)
    if value is None:
        return False
    try:
        array = np.asarray(value)
    except (ValueError, OverflowError):
        return False
    return array.dtype.kind in "biuf" and array.nbytes <= _MAX_ATTRIBUTE_BYTES


def _is_text(text: str) -> bool:
    """Return whether HDF5 can store a string."""
    return not re.search("[\\0\\ud800-\\udfff]", text)


__all__ = ["local_path", "matches", "options_for", "read", "write"]


def matches(path: Path) -> bool:
    """Return whether a folder is a Minari dataset, or its folder `data`."""
    try:
        raw_metadata(path)
    except LogError:
        return False
    return True
