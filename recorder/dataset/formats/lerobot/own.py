"""Data that the writer adds to LeRobot's files, so that a dataset is read back unchanged."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import import_extra
from mcaprl.files import parse_json
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.formats.lerobot.features import OWN, Feature, feature_of
from mcaprl.recorder.dataset.formats.lerobot.files import read_table
from mcaprl.recorder.dataset.formats.lerobot.infos import Infos, infos_of, read_infos, write_infos
from mcaprl.recorder.dataset.formats.lerobot.tables import write_json, write_table
from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.format.spaces import leaves_of

_SUMMARY = ("reason", "policy", "epsilon", "seed", "options")


@dataclass(frozen=True)
class Own:
    """Data of E episodes that only this package stores: metadata, final observations, summaries.

    Attributes:
        metadata: Metadata of the log.
        features: Feature name of each leaf of the observation, in order.
        finals: (E, *shape) final observations by leaf name.
        times_ns: Times (T + 1,) of each episode's observations, nanoseconds since the Unix epoch.
        summaries: Fields of each `EpisodeSummary`.
        infos: Infos of all observations.
    """

    metadata: LogMetadata
    features: tuple[str, ...]
    finals: Mapping[str, NDArray[Any]]
    times_ns: Sequence[NDArray[np.int64]]
    summaries: Sequence[Mapping[str, Any]]
    infos: Infos


def write_own(path: Path, dataset: Dataset, observations: Sequence[Feature]) -> None:
    """Write the data that LeRobot's format cannot store.

    Args:
        path: Folder of the dataset.
        dataset: Dataset that is written.
        observations: Feature of each leaf of the observation.
    """
    arrow = import_extra("pyarrow", "tables")
    folder = path / OWN
    folder.mkdir()
    names = [feature.name for feature in observations]
    infos = write_infos(folder, infos_of(dataset))
    description = {"metadata": dataset.metadata, "features": names, "infos": infos}
    write_json(folder / "description.json", description)
    rows = [episode.summary._asdict() for episode in dataset.episodes]
    types = {"seed": arrow.uint64()}
    columns = {name: arrow.array([row[name] for row in rows], types.get(name)) for name in rows[0]}
    times = [episode.log_time_ns.tolist() for episode in dataset.episodes]
    columns["log_time_ns"] = arrow.array(times, arrow.list_(arrow.int64()))
    write_table(columns, folder / "episodes.parquet")
    lasts = np.cumsum(dataset.episode_lengths + 1) - 1
    finals = {}
    for leaf, name in zip(leaves_of(dataset.observation_space), names, strict=True):
        # Final observations are stored without loss, even if other observations are lossy video.
        kept = feature_of(name, leaf)
        values = np.asarray(leaf.of(dataset.frames)[lasts])
        finals[name] = kept.encode(values.reshape(len(lasts), *kept.shape))
    write_table(finals, folder / "final_observations.parquet")


def read_own(path: Path, lengths: Sequence[int]) -> Own | None:
    """Read the data of `write_own`; return None if it is missing or the episodes were changed.

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
    infos = read_infos(folder, description["infos"])
    return Own(metadata, names, finals, times, rows, infos)
