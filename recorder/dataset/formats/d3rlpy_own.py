"""The group `mcaprl` in d3rlpy's files: the data that d3rlpy's format cannot store.

The group contains the log's metadata, fields of the episode summaries such as the end reason, the
final observations of terminated episodes, truncations, probabilities, log_times and infos.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.formats import hdf5_nodes as nodes
from mcaprl.recorder.dataset.formats.columns import EpisodeArrays, dataset_of
from mcaprl.recorder.dataset.formats.infos import StoredInfo, masked
from mcaprl.recorder.dataset.formats.npz import (
    OWN,
    description_text,
    parse_description,
    parse_infos,
)
from mcaprl.recorder.format.spaces import (
    MIN_IMAGE_EDGE,
    Leaf,
    action_leaf,
    leaves_of,
    nest,
    observation_leaves,
)

_DESCRIPTION = "description"


def write_own(group: Any, dataset: Dataset, infos: Mapping[str, StoredInfo]) -> None:
    """Write to `group` the data that d3rlpy's format cannot store."""
    lasts = np.cumsum(dataset.episode_lengths) - 1
    ends = dataset.frame_of_step[lasts[dataset.terminated[lasts]]] + 1
    names = []
    for number, leaf in enumerate(observation_leaves(dataset.observation_space)):
        names.append(f"final_observations_{number}")
        group[names[-1]] = stored_rows(leaf, np.asarray(leaf.of(dataset.frames)[ends]))
    arrays = {}
    for number, (name, info) in enumerate(infos.items()):
        arrays[name] = f"info_{number}", info.dtype.str
        is_text = info.values.dtype.kind == "U"
        group[f"info_{number}"] = info.values.astype(object) if is_text else info.values
        group[f"missing_info_{number}"] = info.is_missing
    group[_DESCRIPTION] = description_text(dataset, names, arrays)
    group["truncated"] = dataset.truncated[lasts]
    group["behavior_probs"] = dataset.behavior_probs
    group["log_time_ns"] = np.concatenate([e.log_time_ns for e in dataset.episodes])


def read_own(file: Any, episodes: Sequence[Mapping[str, Any]], path: Path) -> Dataset | None:
    """Return the dataset that `write_own` stored; None if the episodes were changed later."""
    group = nodes.group_in(file, OWN)
    text = str(nodes.array_in(group, _DESCRIPTION))
    metadata, summaries, names = parse_description(text, path)
    leaves, action = leaves_of(metadata.observation_space), action_leaf(metadata.action_space)
    finals = [nodes.array_in(group, name) for name in names]
    truncated, probabilities, times = (
        nodes.array_in(group, name) for name in ("truncated", "behavior_probs", "log_time_ns")
    )
    lengths = [len(e["rewards"]) - (not e["terminated"]) for e in episodes]
    terminated = sum(bool(e["terminated"]) for e in episodes)
    same = len(episodes) == len(summaries) == len(truncated) and len(finals) == len(leaves)
    same &= sum(lengths) == len(probabilities) == len(times) - len(episodes)
    infos = _infos(group, parse_infos(text, path))
    same &= all(len(values) == len(times) for values in infos.values())
    if not same or any(len(final) != terminated for final in finals):
        warnings.warn(
            f"{path}: the group {OWN} is ignored, because the episodes were changed afterwards",
            stacklevel=4,
        )
        return None
    found, step, end = [], 0, 0
    for index, (episode, length) in enumerate(zip(episodes, lengths, strict=True)):
        stored = episode["observations"]
        rows = stored if isinstance(stored, list) else [stored]
        if episode["terminated"]:
            rows = [
                np.concatenate([part, final[end : end + 1]])
                for part, final in zip(rows, finals, strict=True)
            ]
            end += 1
        frames = [restored_rows(leaf, part) for leaf, part in zip(leaves, rows, strict=True)]
        at = slice(step + index, step + index + length + 1)
        arrays = EpisodeArrays(
            observations=nest(leaves, frames),
            actions=episode["actions"][:length].reshape(-1, *action.shape),
            rewards=episode["rewards"][:length, 0],
            terminated=bool(episode["terminated"]),
            truncated=bool(truncated[index]),
            behavior_probs=probabilities[step : step + length],
            times_ns=times[at],
            infos={name: values[at] for name, values in infos.items()},
            summary=summaries[index],
        )
        found.append(arrays)
        step += length
    return dataset_of(found, metadata, path)


def stored_rows(leaf: Leaf, values: NDArray[Any]) -> NDArray[Any]:
    """Return rows (N, *shape) as d3rlpy stores them: images (N, C, H, W), or vectors (N, size)."""
    if leaf.dtype == np.uint8 and len(leaf.shape) == 3 and sorted(leaf.shape)[1] >= MIN_IMAGE_EDGE:
        is_first = leaf.shape[0] == min(leaf.shape)
        return values if is_first else np.moveaxis(values, -1, 1)
    if leaf.encoding is not None:
        return values[:, None]
    return values.reshape(len(values), leaf.size)


def restored_rows(leaf: Leaf, values: NDArray[Any]) -> NDArray[Any]:
    """Convert rows from the form of `stored_rows` back to (N, *shape)."""
    empty = np.empty((1, *leaf.shape), leaf.dtype)
    if values.shape[1:] != stored_rows(leaf, empty).shape[1:]:
        raise LogError(
            f"{leaf.name} has rows of shape {values.shape[1:]}, which do not fit its space"
        )
    is_moved = values.ndim == 4 and values.shape[1:] != leaf.shape and len(leaf.shape) == 3
    ordered = np.moveaxis(values, 1, -1) if is_moved else values
    return ordered.reshape(len(values), *leaf.shape)


def _infos(
    group: Any, described: Mapping[str, tuple[str, np.dtype[Any]]]
) -> dict[str, np.ma.MaskedArray[Any, Any]]:
    found = {}
    for name, (array, dtype) in described.items():
        values, missing = (nodes.array_in(group, part) for part in (array, f"missing_{array}"))
        if len(values) != len(missing):
            raise LogError(f"{OWN}/{array} has {len(values)} rows, expected {len(missing)}")
        found[name] = masked(values, missing.astype(bool), dtype)
    return found
