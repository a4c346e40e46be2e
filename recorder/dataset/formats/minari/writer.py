"""Writing of Minari datasets in their HDF5 form, without Minari.

Images are stored without loss, not as JPEG.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import SpaceError, import_extra
from mcaprl.files import parse_json
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.formats.columns import episode_slices
from mcaprl.recorder.dataset.formats.hdf5_nodes import (
    EXTRA,
    created,
    image_settings,
    stop_if_full,
    with_names_for_hdf5,
)
from mcaprl.recorder.dataset.formats.infos import missing_rows, nested_names, stored_infos
from mcaprl.recorder.dataset.formats.minari.description import (
    DATA,
    FILE,
    MAIN,
    description_text,
)
from mcaprl.recorder.format.messages import EpisodeSummary
from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.format.spaces import observation_leaves

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
