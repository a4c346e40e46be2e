"""The files of a LeRobot dataset, version 3.0: tables, Parquet columns and videos."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError, SpaceError, import_extra
from mcaprl.files import parse_json
from mcaprl.recorder.dataset.formats import parquet_files
from mcaprl.recorder.dataset.formats.lerobot.features import (
    ACTION,
    DEFAULTS,
    DONE,
    STEPS,
    TRUNCATED,
    VIDEO_PATH,
    Feature,
)
from mcaprl.recorder.dataset.formats.lerobot.video import read_frames
from mcaprl.recorder.dataset.values import flags

_VERSIONS = "v3."
_MAX_TIME_S = 2.0**32
"""Longer times in nanoseconds do not fit into 64 bits."""


class Files:
    """The files of one dataset of N frames.

    Attributes:
        path: Folder of the dataset.
        features: Features by name.
        fps: Frames per second.
        episodes: Rows of the table of episodes, without statistics.
        lengths: Number of frames of each episode.
        stops: (E,) index of the last frame of each episode, plus 1.
    """

    def __init__(self, path: Path) -> None:
        """Read the description and the table of episodes."""
        self.path = path
        info = parse_json((path / "meta/info.json").read_bytes())
        version = str(info["codebase_version"])
        if not version.startswith(_VERSIONS):
            raise LogError(
                f"{path} is a LeRobot dataset of version {version}; convert it to v3.0 with LeRobot"
            )
        self.fps = float(info["fps"])
        if not 0 < self.fps < math.inf:
            raise LogError(f"{path}: fps is {self.fps}, expected a positive number")
        self.features = {
            name: Feature.from_json(name, entry) for name, entry in info["features"].items()
        }
        for name in self.features:
            # The paths of a feature's videos contain the name of the feature.
            if "/" in name or "\\" in name:
                raise LogError(f"{path}: the feature '{name}' has a slash in its name")
        self.episodes = self._episode_rows()
        self._files = sorted((path / "data").glob("*/*.parquet"))
        self.lengths = [int(row["length"]) for row in self.episodes]
        self.stops = np.cumsum(self.lengths, dtype=np.int64)
        found = self._column(Feature("episode_index", "int64", (1,)))[:, 0]
        same = sum(self.lengths) == len(found)
        if not same or not np.array_equal(
            found, np.repeat(np.arange(len(self.lengths)), self.lengths)
        ):
            raise LogError(f"{path}: the data files and the table of episodes do not agree")

    def ranges(self) -> Iterator[tuple[int, int]]:
        """Yield the row range [start, stop) of each of LeRobot's episodes."""
        return zip([0, *self.stops[:-1].tolist()], self.stops.tolist(), strict=True)

    def values(self, feature: Feature) -> NDArray[Any]:
        """Return the values (N, *shape) of a feature, or the images of a camera."""
        return self._video(feature) if feature.dtype == "video" else self._column(feature)

    def steps(self) -> dict[str, NDArray[Any]]:
        """Return the values (N, *shape) of each feature in `STEPS` that the dataset has."""
        found = {}
        for name in (name for name in STEPS if name in self.features):
            feature = self.features[name]
            if name != ACTION and feature.shape != (1,):
                raise LogError(f"{self.path}: {name} has shape {feature.shape}, expected (1,)")
            values = self.values(feature)
            is_flag = name in (DONE, TRUNCATED)
            found[name] = flags(f"{self.path}: {name}", values) if is_flag else values
        return found

    def unread(self) -> list[str]:
        """Return the names of columns of the data files that are not features."""
        parquet = import_extra("pyarrow.parquet", "tables")
        names = {name for file in self._files for name in parquet.read_schema(file).names}
        return sorted(names.difference(self.features, DEFAULTS))

    def times_s(self) -> NDArray[np.float64]:
        """Return the time (N,) of each frame since the start of its episode, seconds."""
        times = self._column(Feature("timestamp", "float32", (1,)))[:, 0].astype(np.float64)
        wrong = ~(np.abs(times) < _MAX_TIME_S)
        if wrong.any():
            row = int(wrong.argmax())
            raise LogError(
                f"{self.path}: timestamp of row {row} is {times[row]:g}, expected seconds"
            )
        return times

    def _column(self, feature: Feature) -> NDArray[Any]:
        arrow = import_extra("pyarrow", "tables")
        parquet = import_extra("pyarrow.parquet", "tables")
        known = [feature.name in parquet.read_schema(file).names for file in self._files]
        if not known or not all(known):
            raise LogError(f"{self.path}: the data files have no column '{feature.name}'")
        tables = [read_table(file, [feature.name]) for file in self._files]
        column: Any = arrow.concat_tables(tables)[feature.name]
        try:
            return feature.decode(column)
        except (LogError, SpaceError) as error:
            raise type(error)(f"{self.path}: {error}") from error

    def _video(self, feature: Feature) -> NDArray[np.uint8]:
        """Decode the images of a camera from the videos, in the order of the rows."""
        name = f"videos/{feature.name}"
        files = [(row[f"{name}/chunk_index"], row[f"{name}/file_index"]) for row in self.episodes]
        firsts = [float(row[f"{name}/from_timestamp"]) for row in self.episodes]
        times = self.times_s() + np.repeat(firsts, self.lengths)
        images: NDArray[np.uint8] | None = None
        for chunk, number in sorted(set(files)):
            mine = np.repeat([place == (chunk, number) for place in files], self.lengths)
            rows = np.flatnonzero(mine)
            rows = rows[np.argsort(times[rows], kind="stable")]
            path = VIDEO_PATH.format(
                video_key=feature.name, chunk_index=int(chunk), file_index=int(number)
            )
            found = read_frames(self.path / path, times[rows], 0.5 / self.fps)
            if images is None:
                images = np.empty((len(times), *found.shape[1:]), np.uint8)
            images[rows] = found
        if images is None:
            raise LogError(f"{self.path} has no episodes")
        return images

    def _episode_rows(self) -> list[dict[str, Any]]:
        arrow = import_extra("pyarrow", "tables")
        parquet = import_extra("pyarrow.parquet", "tables")
        files = sorted((self.path / "meta/episodes").glob("*/*.parquet"))
        if not files:
            raise LogError(f"{self.path} has no table of episodes in meta/episodes")
        tables = []
        for file in files:
            names = parquet.read_schema(file).names
            needed = [name for name in names if not name.startswith("stats/")]
            tables.append(read_table(file, needed))
        rows = arrow.concat_tables(tables, promote_options="default").to_pylist()
        found = sorted(rows, key=lambda row: int(row["episode_index"]))
        if [row["episode_index"] for row in found] != list(range(len(found))):
            raise LogError(f"{self.path}: episode_index in meta/episodes is not 0, 1, 2, ...")
        return found


def read_table(path: Path, columns: Sequence[str] | None = None) -> Any:
    """Read a Parquet file, and check the CRCs of its pages if it has any."""
    if columns is None:
        return parquet_files.read_table(path)
    return parquet_files.read_table(path, set(columns).__contains__)
