"""What the writer stores beside LeRobot's files, so that a dataset is read back unchanged."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.files import parse_json
from mcaprl.recorder.dataset.formats.lerobot.features import OWN, feature_of
from mcaprl.recorder.dataset.formats.lerobot.files import read_table
from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.format.spaces import leaves_of

_SUMMARY = ("reason", "policy", "epsilon", "seed", "options")


@dataclass(frozen=True)
class Own:
    """Metadata, final observations and summaries of E episodes.

    Attributes:
        metadata: Metadata of the log.
        features: Names of the features of the observation, in the order of its leaves.
        finals: (E, *shape) final observations by the names of the leaves.
        times_ns: Times (T + 1,) of each episode's observations, nanoseconds since the Unix epoch.
        summaries: Fields of each `EpisodeSummary`.
    """

    metadata: LogMetadata
    features: tuple[str, ...]
    finals: Mapping[str, NDArray[Any]]
    times_ns: Sequence[NDArray[np.int64]]
    summaries: Sequence[Mapping[str, Any]]


def read_own(path: Path, lengths: Sequence[int]) -> Own | None:
    """Read what the writer stored; None if there is nothing, or if the episodes have changed.

    Args:
        path: Folder of the dataset.
        lengths: Number of frames of each episode.
    """
    folder = path / OWN
    if not (folder / "description.json").exists():
        return None
    episodes = read_table(folder / "episodes.parquet")
    if episodes["length"].to_pylist() != list(lengths):
        warnings.warn(
            f"{path}: {OWN} is ignored, because the episodes were changed after it was written",
            stacklevel=2,
        )
        return None
    description = parse_json((folder / "description.json").read_bytes())
    metadata = LogMetadata.from_strings(description["metadata"])
    table = read_table(folder / "final_observations.parquet")
    names, finals = tuple(description["features"]), {}
    for leaf, name in zip(leaves_of(metadata.observation_space), names, strict=True):
        values = feature_of(name, leaf).decode(table[name])
        finals[leaf.name] = values.reshape(len(lengths), *leaf.shape)
    rows = episodes.select(list(_SUMMARY)).to_pylist()
    times = [np.array(found, np.int64) for found in episodes["log_time_ns"].to_pylist()]
    return Own(metadata, names, finals, times, rows)
