"""NumPy archives, written by this package (a whole dataset) or by other tools.

An archive of this package has these arrays, for E episodes with N transitions:

    observations              (N, *shape); or arrays `observations/KEY` for the keys of a Dict
    final_observations        (E, *shape), named in the same way
    actions, rewards, terminations, truncations, behavior_probs    (N,) or (N, *shape)
    episode_lengths           (E,)
    log_time_ns               (N + E,)
    infos/NAME                (N + E, *shape); `missing_infos/NAME` marks the rows without the info
    mcaprl                    JSON text: metadata, summaries and the names of the observations

Other archives have the arrays of `flat.NAMES`. Pickled objects are never loaded.
"""

from __future__ import annotations

import json
import re
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from mcaprl.errors import LogError, SpaceError
from mcaprl.files import parse_json
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.formats.columns import EpisodeArrays, dataset_of, episode_slices
from mcaprl.recorder.dataset.formats.ends import Kind
from mcaprl.recorder.dataset.formats.flat import NAMES, FlatOptions, flat_dataset
from mcaprl.recorder.dataset.formats.infos import (
    StoredInfo,
    info_type,
    infos_of,
    masked,
    stored_infos,
)
from mcaprl.recorder.dataset.formats.npz_archive import Archive
from mcaprl.recorder.dataset.values import flags
from mcaprl.recorder.format.messages import MAX_SEED
from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.format.spaces import Leaf, leaves_of, nest

OWN = "mcaprl"
SUMMARY = ("reason", "policy", "epsilon", "seed", "options")
_OBSERVATIONS, _FINALS = "observations", "final_observations"
INFOS, MISSING = "infos", "missing_infos"
_PLAIN = re.compile(r"[A-Za-z0-9_.-]+")
_BLOCK_ROWS = 1024


def matches(path: Path) -> bool:
    """Return whether a path is a .npz file."""
    return path.suffix == ".npz" and path.is_file()


def write(dataset: Dataset, path: Path, *, lossy: bool = False) -> list[str]:
    """Write a dataset.

    Args:
        dataset: Episodes to write.
        path: New file.
        lossy: Whether infos that are neither numbers nor texts are left out.

    Returns:
        One sentence for each info that was left out.

    Raises:
        SpaceError: An info cannot be stored, and `lossy` is not set.
    """
    infos, lost = stored_infos(infos_of(dataset))
    if lost and not lossy:
        raise SpaceError(f"{lost[0]}; pass --lossy (lossy=True in Python) to write the rest")
    leaves = leaves_of(dataset.observation_space)
    names = [array_name(leaf) for leaf in leaves]
    slices = episode_slices(dataset)
    finals = np.array([frames.stop - 1 for _, frames in slices])
    with zipfile.ZipFile(path, "w") as archive:
        for leaf, name in zip(leaves, names, strict=True):
            column = leaf.of(dataset.frames)
            _put(archive, _OBSERVATIONS + name, column, dataset.frame_of_step)
            _put(archive, _FINALS + name, column, finals)
        for name, values in (
            ("actions", dataset.actions),
            ("rewards", dataset.rewards),
            ("terminations", dataset.terminated),
            ("truncations", dataset.truncated),
            ("behavior_probs", dataset.behavior_probs),
            ("episode_lengths", dataset.episode_lengths),
            ("log_time_ns", np.concatenate([e.log_time_ns for e in dataset.episodes])),
            (OWN, np.array(description_text(dataset, names, arrays_of(infos)))),
        ):
            _put_rows(archive, name, values.dtype, values.shape, [values])
        for number, (name, info) in enumerate(infos.items()):
            array = _info_name(name, number)
            _put_rows(archive, INFOS + array, info.values.dtype, info.values.shape, [info.values])
            missing = info.is_missing
            _put_rows(archive, MISSING + array, missing.dtype, missing.shape, [missing])
    return lost


def read(path: Path, *, one_episode: bool = False, dones: Kind | None = None) -> Dataset:
    """Read an archive. Only the arrays that are needed are read.

    Args:
        path: File.
        one_episode: See `FlatOptions`.
        dones: See `FlatOptions`.

    Raises:
        LogError: The file is damaged, or an array is missing.
        SpaceError: A log cannot store a dtype, or a value is impossible.
        UsageError: The options contradict the arrays.
    """
    with Archive.opened(path) as archive:
        if OWN in archive.names:
            return _own(archive, path)
        taken = [name for name in archive.names if name.split("/")[0] in (*NAMES, INFOS)]
        found = _nested({name: archive[name] for name in taken})
        unread = [name for name in archive.names if name not in taken and archive.is_array(name)]
    infos = found.pop(INFOS, {})
    if not isinstance(infos, dict):
        infos, unread = {}, [*unread, INFOS]
    return flat_dataset(
        found,
        path,
        dict(_dotted(infos)),
        options=FlatOptions(one_episode, dones),
        unread=unread,
    )


def _dotted(tree: Mapping[str, Any]) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield the dotted name and the values of each array in nested dicts."""
    for name, part in tree.items():
        if isinstance(part, Mapping):
            yield from ((f"{name}.{rest}", values) for rest, values in _dotted(part))
        else:
            yield name, part


def array_name(leaf: Leaf) -> str:
    """Return the suffix that follows `observations` in the name of a leaf's array.

    If a key has characters other than letters, digits, `.`, `_` and `-`, the suffix contains the
    leaf's name in the log.
    """
    if all(_PLAIN.fullmatch(key) for key in leaf.path):
        return "".join(f"/{key}" for key in leaf.path)
    return f":{leaf.name}"


def arrays_of(infos: Mapping[str, StoredInfo]) -> dict[str, list[str]]:
    """Return, for each info, its dtype and the suffix that follows `infos` in the array's name."""
    return {
        name: [_info_name(name, number), info.dtype.str]
        for number, (name, info) in enumerate(infos.items())
    }


def description_text(
    dataset: Dataset, names: Iterable[str], infos: Mapping[str, Iterable[str]] | None = None
) -> str:
    """Return JSON with the metadata, the summaries and the names of the arrays.

    Args:
        dataset: Dataset to describe.
        names: For each leaf, the suffix that follows `observations` in the array's name.
        infos: For each info, the suffix that follows `infos` in the array's name, and the dtype;
            default: no infos.
    """
    summaries = [
        {name: getattr(episode.summary, name) for name in SUMMARY} for episode in dataset.episodes
    ]
    return json.dumps(
        {
            "metadata": dataset.metadata,
            "episodes": summaries,
            _OBSERVATIONS: list(names),
            INFOS: {name: list(found) for name, found in (infos or {}).items()},
        }
    )


def parse_description(text: str, where: object) -> tuple[LogMetadata, list[dict[str, Any]], Any]:
    """Parse the text of `description_text`: metadata, fields of each summary, and array names.

    Raises:
        LogError: The text is damaged.
    """
    try:
        found = parse_json(text)
        metadata = LogMetadata.from_strings(found["metadata"])
        summaries = [_summary(part) for part in found["episodes"]]
        return metadata, summaries, list(map(str, found[_OBSERVATIONS]))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise LogError(f"{where}: the array {OWN} is damaged: {error}") from error


def _summary(part: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a summary.

    Raises:
        ValueError: A value cannot be stored in a log.
    """
    seed = None if part["seed"] is None else int(part["seed"])
    if seed is not None and not 0 <= seed <= MAX_SEED:
        raise ValueError(f"seed {seed}")
    texts = {name: str(part[name]) for name in ("reason", "policy", "options")}
    return {**texts, "epsilon": float(part["epsilon"]), "seed": seed}


def parse_infos(text: str, where: object) -> dict[str, tuple[str, np.dtype[Any]]]:
    """Parse the descriptions of the infos in the text of `description_text`.

    Returns:
        For each info, the suffix that follows `infos` in the array's name, and the dtype.

    Raises:
        LogError: The text is damaged.
    """
    try:
        found = parse_json(text).get(INFOS, {})
        return {name: (str(array), info_type(str(dtype))) for name, (array, dtype) in found.items()}
    except (ValueError, TypeError, AttributeError) as error:
        raise LogError(f"{where}: the array {OWN} is damaged: {error}") from error


def _own(arrays: Archive, path: Path) -> Dataset:
    text = str(arrays[OWN])
    metadata, summaries, names = parse_description(text, path)
    described = parse_infos(text, path)
    leaves = leaves_of(metadata.observation_space)
    try:
        lengths = [int(length) for length in arrays["episode_lengths"].tolist()]
        columns = [(arrays[_OBSERVATIONS + name], arrays[_FINALS + name]) for name in names]
        infos = {
            name: masked(arrays[INFOS + array], arrays[MISSING + array].astype(bool), dtype)
            for name, (array, dtype) in described.items()
        }
        steps: dict[str, Any] = {
            name: arrays[name] for name in ("actions", "rewards", "behavior_probs")
        }
        ends = {
            name: flags(f"{path}: {name}", arrays[name]) for name in ("terminations", "truncations")
        }
        times_ns = arrays["log_time_ns"]
        rows = [len(values) for values in (*steps.values(), *ends.values())]
        if min(lengths) < 1 or {*rows} != {sum(lengths)}:
            raise ValueError(f"columns of {rows} rows, and episodes of {sum(lengths)}")
        episodes, first = [], 0
        for index, (length, summary) in enumerate(zip(lengths, summaries, strict=True)):
            taken, frames = (
                slice(first, first + length),
                slice(first + index, first + index + length + 1),
            )
            parts = [
                np.concatenate([rows[taken], finals[index : index + 1]]) for rows, finals in columns
            ]
            last = first + length - 1
            episode = EpisodeArrays(
                observations=nest(leaves, parts),
                terminated=bool(ends["terminations"][last]),
                truncated=bool(ends["truncations"][last]),
                times_ns=times_ns[frames],
                infos={name: values[frames] for name, values in infos.items()},
                summary=summary,
                **{name: values[taken] for name, values in steps.items()},
            )
            episodes.append(episode)
            first += length
        return dataset_of(episodes, metadata, path)
    except (KeyError, ValueError, TypeError, IndexError, AssertionError) as error:
        raise LogError(f"{path}: an array is missing or too short: {error}") from error


def _info_name(name: str, number: int) -> str:
    return f"/{name}" if _PLAIN.fullmatch(name) else f":{number}"


def _nested(arrays: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
    """Return arrays with names such as `observations/state` as nested dicts."""
    nested: dict[str, Any] = {}
    for name, values in arrays.items():
        *groups, last = name.split("/")
        inner = nested
        for group in groups:
            inner = inner.setdefault(group, {})
            if not isinstance(inner, dict):
                break
        else:
            inner[last] = values
    return nested


def _put(archive: zipfile.ZipFile, name: str, column: Any, rows: NDArray[np.int64]) -> None:
    """Write rows of a column in blocks, because images on disk may be larger than the memory."""
    blocks = (
        np.asarray(column[rows[start : start + _BLOCK_ROWS]])
        for start in range(0, len(rows), _BLOCK_ROWS)
    )
    _put_rows(archive, name, column.dtype, (len(rows), *column.shape[1:]), blocks)


def _put_rows(
    archive: zipfile.ZipFile,
    name: str,
    dtype: np.dtype[Any],
    shape: tuple[int, ...],
    blocks: Iterable[NDArray[Any]],
) -> None:
    header = {"descr": npy.dtype_to_descr(dtype), "fortran_order": False, "shape": shape}
    with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
        npy.write_array_header_2_0(file, header)
        for block in blocks:
            file.write(block.tobytes())
