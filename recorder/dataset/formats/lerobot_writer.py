"""Writing of LeRobot datasets, version 3.0: Parquet, JSON and video files, and statistics.

Each transition is a row. LeRobot has no place for the observation after the last action.

A statistic of an array has one number for each element of the last dimension. A statistic of images
has one number for each channel, in shape (channels, 1, 1); for color images, the numbers are in
[0, 1]. Image statistics are computed from at most `_MAX_IMAGES` evenly spaced images per episode.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from fractions import Fraction
from itertools import islice
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import SpaceError, import_extra
from mcaprl.files import parse_json
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.format_registry import VIDEO_NOTE
from mcaprl.recorder.dataset.formats import lerobot_features
from mcaprl.recorder.dataset.formats.columns import episode_slices
from mcaprl.recorder.dataset.formats.lerobot_features import (
    DATA_PATH,
    EPISODES_PATH,
    VIDEO_PATH,
    Feature,
    VideoWriter,
    can_mux,
)
from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.format.spaces import Leaf, action_leaf, leaves_of
from mcaprl.texts import counted

QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
NAMES = ("min", "max", "mean", "std", "count", *QUANTILES)
"""Names of the statistics."""
_MAX_IMAGES = 100
_MAX_ELEMENTS = 1 << 22

Stats = dict[str, NDArray[Any]]
"""Statistics as arrays, by the names in `NAMES`."""


def sampled(feature: Feature, count: int) -> NDArray[np.int64]:
    """Return evenly spaced indexes of an episode's images, from which statistics are computed."""
    limit = _MAX_ELEMENTS // math.prod(feature.shape) if feature.is_depth else _MAX_IMAGES
    return _spread(count, min(max(limit, 1), _MAX_IMAGES))


def describe(feature: Feature, values: NDArray[Any]) -> Stats:
    """Return the statistics of the values (T, *shape)."""
    channels = values.shape[3] if values.ndim == 4 else 1
    rows = values.reshape(-1, channels if feature.is_image else feature.shape[-1])
    if feature.is_image and values.dtype == np.uint8:
        found = _of_levels(_histogram(values.reshape(len(values), -1, channels)))
    else:
        found = _of_numbers(rows.astype(np.float64))
    if feature.is_image:
        shape = (feature.shape[-1], 1, 1)
        found = {n: np.broadcast_to(a.reshape(-1, 1, 1), shape) for n, a in found.items()}
    elif rows.dtype.kind in "biu":
        found |= {"min": rows.min(0), "max": rows.max(0)}
    return found | {"count": np.array([len(values)], np.int64)}


def pooled(episodes: Sequence[Stats]) -> Stats:
    """Combine the statistics of the episodes into the statistics of all data.

    Each quantile is the mean of the episodes' quantiles, weighted by the number of values of each
    episode.
    """
    counts = np.array([episode["count"][0] for episode in episodes], np.float64)
    column = {name: np.stack([e[name] for e in episodes]) for name in NAMES}
    shares = (counts / counts.sum()).reshape(-1, *[1] * (column["mean"].ndim - 1))
    with np.errstate(all="ignore"):
        mean = (shares * column["mean"]).sum(0)
        variance = (shares * (column["std"] ** 2 + (column["mean"] - mean) ** 2)).sum(0)
        found = {name: (shares * column[name]).sum(0) for name in QUANTILES}
        found |= {"min": column["min"].min(0), "max": column["max"].max(0)}
        found |= {"mean": mean, "std": np.sqrt(variance)}
    return found | {"count": column["count"].sum(0)}


def _spread(count: int, limit: int) -> NDArray[np.int64]:
    return np.unique(np.linspace(0, count - 1, min(count, limit)).round().astype(np.int64))


def _of_numbers(numbers: NDArray[np.float64]) -> Stats:
    """Return the statistics (D,) of rows (N, D)."""
    limit = max(_MAX_ELEMENTS // numbers.shape[1], 1)
    few = numbers if len(numbers) <= limit else numbers[_spread(len(numbers), limit)]
    # NumPy warns about NaN and infinite values, which have no finite mean.
    with np.errstate(all="ignore"):
        quantiles = np.quantile(few, list(QUANTILES.values()), axis=0)
        return {
            "min": numbers.min(0),
            "max": numbers.max(0),
            "mean": numbers.mean(0),
            "std": numbers.std(0),
            **dict(zip(QUANTILES, quantiles, strict=True)),
        }


def _histogram(images: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Return a histogram (C, 256) of the values in each channel of images (T, pixels, C)."""
    counts = np.zeros((images.shape[2], 256), np.int64)
    for image in images:
        for channel, row in enumerate(counts):
            row += np.bincount(image[:, channel], minlength=256)
    return counts


def _of_levels(counts: NDArray[np.int64]) -> Stats:
    """Return the statistics (C,) of pixel values k / 255, given their histograms (C, 256)."""
    levels = np.arange(256) / 255
    total = int(counts[0].sum())
    mean = counts @ levels / total
    variance = (counts * (levels - mean[:, None]) ** 2).sum(1) / total
    found = {"mean": mean, "std": np.sqrt(variance)}
    ends = np.cumsum(counts, axis=1)

    def at(rank: int) -> NDArray[np.float64]:
        return levels[[int(np.searchsorted(row, rank, side="right")) for row in ends]]

    for name, share in QUANTILES.items():
        # Like `np.quantile`, interpolate linearly between the two values next to the quantile.
        place = share * (total - 1)
        low, high = at(math.floor(place)), at(math.ceil(place))
        found[name] = low + (place - math.floor(place)) * (high - low)
    return found | {"min": at(0), "max": at(total - 1)}


MAX_FILE_BYTES = 100 << 20
CHUNK_FILES = 1000
"""Number of files in a folder."""


class ParquetFiles:
    """Writer of the data files, with one row group for each episode."""

    def __init__(self, path: Path, every: list[Feature]) -> None:
        """Create a writer; the first episode creates a file."""
        self._path = path
        self._stored = [feature for feature in every if feature.dtype != "video"]
        self._number, self._file = -1, Path()
        self._writer: Any = None

    def add_episode(self, columns: dict[str, Any]) -> dict[str, int]:
        """Write the columns of an episode, and return the indexes of its folder and its file."""
        arrow = import_extra("pyarrow", "tables")
        table = arrow.table(columns)
        if self._writer is None or self._file.stat().st_size + table.nbytes > MAX_FILE_BYTES:
            self._next_file(table.schema)
        self._writer.write_table(table, row_group_size=len(table))
        return {
            "data/chunk_index": self._number // CHUNK_FILES,
            "data/file_index": self._number % CHUNK_FILES,
        }

    def close(self) -> None:
        """Finish the last file."""
        if self._writer is not None:
            self._writer.close()

    def _next_file(self, schema: Any) -> None:
        self.close()
        self._number += 1
        chunk, number = divmod(self._number, CHUNK_FILES)
        self._file = self._path / DATA_PATH.format(chunk_index=chunk, file_index=number)
        self._file.parent.mkdir(parents=True, exist_ok=True)
        parquet = import_extra("pyarrow.parquet", "tables")
        described = {f.name: _hugging_face(f) for f in self._stored}
        text = json.dumps({"info": {"features": described}})
        self._writer = parquet.ParquetWriter(
            self._file,
            schema.with_metadata({b"huggingface": text.encode()}),
            compression="snappy",
            write_page_checksum=True,
            use_dictionary=[f.name for f in self._stored if not f.is_image],
        )


def write_tasks(path: Path, tasks: Mapping[str, int]) -> None:
    """Write the table of tasks; `tasks` contains the index of each task by its text."""
    arrow = import_extra("pyarrow", "tables")
    table = arrow.table({"task_index": list(tasks.values()), "task": list(tasks)})
    # LeRobot reads this table with pandas, and needs the task texts as the index of the DataFrame.
    metadata = {b"pandas": json.dumps(_TASKS_IN_PANDAS).encode()}
    parquet = import_extra("pyarrow.parquet", "tables")
    parquet.write_table(table.replace_schema_metadata(metadata), path)


def _hugging_face(feature: Feature) -> dict[str, Any]:
    """Return the description of a column for the library `datasets`."""
    if feature.dtype == "image":
        return {"_type": "Image"}
    value = {"dtype": feature.dtype, "_type": "Value"}
    if feature.shape == (1,):
        return value
    if len(feature.shape) == 1:
        return {"feature": value, "length": feature.shape[0], "_type": "List"}
    kind = f"Array{len(feature.shape)}D"
    return {"shape": list(feature.shape), "dtype": feature.dtype, "_type": kind}


def write_table(columns: dict[str, Any], path: Path) -> None:
    """Write Arrow arrays by name as a Parquet file."""
    arrow, parquet = import_extra("pyarrow", "tables"), import_extra("pyarrow.parquet", "tables")
    path.parent.mkdir(parents=True, exist_ok=True)
    parquet.write_table(arrow.table(columns), path, write_page_checksum=True)


def write_json(path: Path, value: Any) -> None:
    """Write JSON; non-finite numbers become `NaN` and `Infinity`, which Python can read."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"{json.dumps(value, indent=4)}\n")


def _pandas_column(name: str | None, field: str | None, kind: str, dtype: str) -> dict[str, Any]:
    return {
        "name": name,
        "field_name": field,
        "pandas_type": kind,
        "numpy_type": dtype,
        "metadata": {"encoding": "UTF-8"} if name is None else None,
    }


_TASKS_IN_PANDAS = {
    "index_columns": ["task"],
    "column_indexes": [_pandas_column(None, None, "unicode", "object")],
    "columns": [
        _pandas_column("task_index", "task_index", "int64", "int64"),
        _pandas_column("task", "task", "unicode", "object"),
    ],
    "pandas_version": "2.2.0",
}


VERSION = "v3.0"
MAX_VIDEO_BYTES = 200 << 20
_DEFAULT_TASK = "act"


def write(
    dataset: Dataset, path: Path, *, lossy: bool = False, video: bool | None = None
) -> list[str]:
    """Write a dataset to an empty folder.

    Args:
        dataset: Episodes to write.
        path: Empty folder.
        lossy: Whether to leave out or convert data that LeRobot cannot store.
        video: See `Dataset.to_lerobot`.

    Returns:
        One sentence for each thing that was left out or changed, and for each video.
    """
    copies = {} if video is False else copies_of(dataset)
    lost = losses(dataset, lossy=lossy, video=bool(video), copies=copies)
    writer = _Writer(dataset, path, video=bool(video), copies=copies)
    for index in range(len(dataset.episode_lengths)):
        writer.add_episode(index)
    writer.finish()
    return lost + writer.notes()


class Copy(NamedTuple):
    """Whether the packets of a video are copied.

    Attributes:
        packets: Packet of each transition's observation.
        codec: Codec of the packets; empty if they cannot be copied.
        lack: Why they cannot be copied.
    """

    packets: Iterator[tuple[str, bytes]]
    codec: str
    lack: str


def copies_of(dataset: Dataset) -> dict[str, Copy]:
    """Return whether packets are copied, for each feature whose images are frames of a video."""
    found = {}
    rows = [slice(frames.start, frames.stop - 1) for _, frames in episode_slices(dataset)]
    names = lerobot_features.observation_names(leaves_of(dataset.observation_space))
    for leaf, packets in dataset._transitions.packets.items():
        codec, lack = packets.codec(rows)
        if codec and not can_mux():
            codec, lack = "", "PyAV is older than 18"
        found[names[leaf]] = Copy(packets.read(dataset.frame_of_step), codec, lack)
    return found


def frames_per_second(step_duration_ns: int) -> int | float:
    """Return the frame rate. It is rounded to an integer if this keeps the step duration."""
    rate = 1e9 / step_duration_ns
    whole = round(rate)
    return whole if whole and round(1e9 / whole) == step_duration_ns else rate


def task_of(options: str, metadata: LogMetadata) -> str:
    """Return the text of an episode's task: the reset option `task`, or the environment's id."""
    try:
        task = parse_json(options or "{}").get("task")
    except (ValueError, AttributeError):
        task = None
    return task if isinstance(task, str) and task else metadata.env_id or _DEFAULT_TASK


def losses(
    dataset: Dataset, *, lossy: bool, video: bool, copies: Mapping[str, Copy] = MappingProxyType({})
) -> list[str]:
    """Return one sentence for each change that loses data, and for each video."""
    leaves = leaves_of(dataset.observation_space)
    named = zip(lerobot_features.observation_names(leaves), leaves, strict=True)
    every = [*named, (lerobot_features.ACTION, action_leaf(dataset.action_space))]
    for name, leaf in every:
        if leaf.dtype == np.uint64 and _is_large(dataset, leaf):
            raise SpaceError(
                f"{name} has values of 2^63 or more, which LeRobot cannot read: use another dtype"
            )
    found = [
        f"{name} of shape {leaf.shape} is flattened, because LeRobot has at most"
        f" {lerobot_features.MAX_DIMENSIONS} dimensions"
        for name, leaf in every
        if len(leaf.shape) > lerobot_features.MAX_DIMENSIONS
    ]
    copied = {name for name, copy in copies.items() if copy.codec}
    if video:
        reasons = {name: f", because {copy.lack}" for name, copy in copies.items()}
        found += [
            f"{name} is compressed as video, which changes its pixels{reasons.get(name, '')}"
            for name, leaf in every
            if name not in copied
            and lerobot_features.feature_of(name, leaf, video=True).dtype == "video"
        ]
    if found and not lossy:
        raise SpaceError(f"{found[0]}; pass `lossy=True` to write the dataset")
    return found + [
        f"{VIDEO_NOTE}{name} is copied, {copy.codec}"
        if copy.codec
        else f"{VIDEO_NOTE}{name} is written as images, because {copy.lack}"
        for name, copy in copies.items()
        if copy.codec or not video
    ]


def _is_large(dataset: Dataset, leaf: Leaf) -> bool:
    """Return whether a leaf has a value that does not fit into a signed 64-bit integer."""
    values = dataset.actions if leaf.name == "action" else leaf.of(dataset.frames)
    return bool((values >= 2**63).any())


class Frames:
    """A dataset as LeRobot's frames, each of which is a transition.

    Attributes:
        fps: Frames per second.
        observations: Features of the leaves of an observation.
        infos: Feature of each info that LeRobot has a place for.
        features: All features.
        slices: Frames of each episode.
        tasks: Index of each task by its text.
        task_of_episode: Index of the task of each episode.
        episode_of_frame: (N,) index of the episode of each frame.
    """

    def __init__(
        self, dataset: Dataset, *, video: bool = False, copied: Collection[str] = ()
    ) -> None:
        """Name the features of a dataset; with `video`, or `copied`, images are videos."""
        self._dataset = dataset
        metadata = LogMetadata.from_strings(dataset.metadata)
        self._leaves = leaves_of(dataset.observation_space)
        self.fps = frames_per_second(metadata.step_duration_ns)
        labels = metadata.observation_names
        named = zip(lerobot_features.observation_names(self._leaves), self._leaves, strict=True)
        self.observations = [
            lerobot_features.feature_of(
                name, leaf, () if leaf.path else labels, video=video or name in copied
            )
            for name, leaf in named
        ]
        self._places = {one.name: k for k, one in enumerate(self.observations)}
        self.infos = lerobot_features.info_features(dataset.infos, dataset.frame_of_step + 1)
        self._names = {feature.name: name for name, feature in self.infos.items()}
        others = [*self.infos.values(), *lerobot_features.default_features()]
        self.features = [*self.observations, *_step_features(dataset), *others]
        self.slices = [steps for steps, _ in episode_slices(dataset)]
        self.tasks: dict[str, int] = {}
        self.task_of_episode = [
            self.tasks.setdefault(task_of(episode.summary.options, metadata), len(self.tasks))
            for episode in dataset.episodes
        ]
        lengths = dataset.episode_lengths
        numbers = np.arange(len(dataset)) - np.repeat(np.cumsum(lengths) - lengths, lengths)
        self.episode_of_frame = np.repeat(np.arange(len(lengths)), lengths)
        self._columns: dict[str, NDArray[Any]] = {
            lerobot_features.ACTION: dataset.actions,
            lerobot_features.REWARD: dataset.rewards,
            lerobot_features.DONE: dataset.terminated,
            lerobot_features.TRUNCATED: dataset.truncated,
            _behavior_feature(dataset): dataset.behavior,
            "timestamp": numbers / float(self.fps),
            "frame_index": numbers,
            "episode_index": self.episode_of_frame,
            "index": np.arange(len(dataset)),
            "task_index": np.repeat(np.array(self.task_of_episode, np.int64), lengths),
        }

    def values(self, feature: Feature, rows: Any) -> NDArray[Any]:
        """Return the values (B, *shape) of a feature in frames: a slice, or B indexes."""
        found: NDArray[Any]
        if feature.name in self._columns:
            found = self._columns[feature.name][rows]
        elif feature.name in self._places:
            leaf = self._leaves[self._places[feature.name]]
            found = np.asarray(leaf.of(self._dataset.frames)[self._dataset.frame_of_step[rows]])
        else:
            info = self._dataset.infos[self._names[feature.name]]
            found = info[self._dataset.frame_of_step[rows] + 1].data
        if feature.dtype == "video":
            return found
        kind = found.dtype if feature.dtype == "image" else feature.dtype
        shaped: NDArray[Any] = found.astype(kind, copy=False).reshape(len(found), *feature.shape)
        return shaped

    def stats(self, feature: Feature, index: int) -> Stats:
        """Return the statistics of a feature in an episode."""
        steps = self.slices[index]
        if not feature.is_image:
            return describe(feature, self.values(feature, steps))
        count = steps.stop - steps.start
        return describe(feature, self.values(feature, steps.start + sampled(feature, count)))

    def info(self, entries: dict[str, Any], *, has_videos: bool) -> dict[str, Any]:
        """Return the content of `meta/info.json`; `entries` describes the features."""
        count = len(self.slices)
        return {
            "codebase_version": VERSION,
            "robot_type": None,
            "total_episodes": count,
            "total_frames": len(self._dataset),
            "total_tasks": len(self.tasks),
            "chunks_size": CHUNK_FILES,
            "data_files_size_in_mb": MAX_FILE_BYTES >> 20,
            "video_files_size_in_mb": MAX_VIDEO_BYTES >> 20,
            "fps": self.fps,
            "splits": {"train": f"0:{count}"},
            "data_path": DATA_PATH,
            "video_path": VIDEO_PATH if has_videos else None,
            "features": entries,
        }


class _Writer:
    """Writer of the data files, videos and tables of episodes."""

    def __init__(
        self, dataset: Dataset, path: Path, *, video: bool, copies: Mapping[str, Copy]
    ) -> None:
        self._dataset, self._path = dataset, path
        self._copied = {name: copy for name, copy in copies.items() if copy.codec}
        self._frames = Frames(dataset, video=video, copied=self._copied)
        self._features = self._frames.features
        self._rows: list[dict[str, Any]] = []
        self._stats: list[dict[str, Stats]] = []
        self._files = ParquetFiles(path, self._features)
        rate = Fraction(self._frames.fps).limit_denominator(1001)
        self._videos = {
            feature.name: VideoWriter(
                path,
                feature,
                rate,
                VIDEO_PATH,
                MAX_VIDEO_BYTES,
                CHUNK_FILES,
                self._copied[feature.name].codec if feature.name in self._copied else "",
            )
            for feature in self._frames.observations
            if feature.dtype == "video"
        }

    def add_episode(self, index: int) -> None:
        """Write the rows and videos of an episode."""
        frames, steps = self._frames, self._frames.slices[index]
        task = list(frames.tasks)[frames.task_of_episode[index]]
        count = steps.stop - steps.start
        row: dict[str, Any] = {"episode_index": index, "tasks": [task], "length": count}
        columns: dict[str, Any] = {}
        stats: dict[str, Stats] = {}
        for feature in self._features:
            if feature.name in self._copied:
                stats[feature.name] = frames.stats(feature, index)
                packets = islice(self._copied[feature.name].packets, count)
                row |= self._videos[feature.name].copy(packets)
                continue
            array = frames.values(feature, steps)
            shown = array[sampled(feature, count)] if feature.is_image else array
            stats[feature.name] = describe(feature, shown)
            if feature.dtype == "video":
                row |= self._videos[feature.name].encode(array)
            else:
                columns[feature.name] = feature.encode(array)
        row |= self._files.add_episode(columns)
        row |= {"dataset_from_index": steps.start, "dataset_to_index": steps.stop}
        self._rows.append(row)
        self._stats.append(stats)

    def finish(self) -> None:
        """Close the files, and write the tables and descriptions."""
        self._files.close()
        for video in self._videos.values():
            video.close()
        self._write_info()
        self._write_episodes()
        write_tasks(self._path / "meta/tasks.parquet", self._frames.tasks)
        stats = {
            feature.name: pooled([episode[feature.name] for episode in self._stats])
            for feature in self._features
        }
        plain = {name: _plain(found) for name, found in stats.items()}
        write_json(self._path / "meta/stats.json", plain)

    def notes(self) -> list[str]:
        """Return a sentence for each thing that LeRobot has no place for."""
        found, infos = [], self._dataset.infos.keys() - self._frames.infos.keys()
        if infos:
            found.append(
                f"not written: the infos {', '.join(sorted(infos))}; LeRobot has a place for"
                " numbers of every step"
            )
        if any(each is not None for each in self._dataset.relative_to):
            found.append(
                "not written: which observations the actions are relative to, because LeRobot has"
                " absolute actions; restore it by `with_relative_actions`"
            )
        lasts = np.cumsum(self._dataset.episode_lengths) - 1
        if cut := int((~self._dataset.terminated[lasts]).sum()):
            found.append(
                "not written: the observation after the last action; mcaprl reads"
                f" {counted(cut, 'episode')} that did not terminate without the last transition"
            )
        return found

    def _write_info(self) -> None:
        entries = {feature.name: feature.to_json() for feature in self._features}
        for name, video in self._videos.items():
            entries[name]["info"] = video.info()
        info = self._frames.info(entries, has_videos=bool(self._videos))
        write_json(self._path / "meta/info.json", info)

    def _write_episodes(self) -> None:
        arrow = import_extra("pyarrow", "tables")
        columns: dict[str, Any] = {
            name: arrow.array([row[name] for row in self._rows]) for name in self._rows[0]
        }
        for feature in self._features:
            found = [episode[feature.name] for episode in self._stats]
            for name in found[0]:
                lists = [episode[name].tolist() for episode in found]
                columns[f"stats/{feature.name}/{name}"] = arrow.array(lists)
        for name in ("chunk_index", "file_index"):
            columns[f"meta/episodes/{name}"] = arrow.array([0] * len(self._rows))
        write_table(columns, self._path / EPISODES_PATH.format(chunk_index=0, file_index=0))


def _step_features(dataset: Dataset) -> list[Feature]:
    """Return the features of actions, rewards, end flags and action probabilities."""
    leaf = action_leaf(dataset.action_space)
    rewards = dataset.rewards
    with np.errstate(over="ignore"):
        fits = np.array_equal(rewards.astype(np.float32), rewards, equal_nan=True)
    found = [
        lerobot_features.feature_of(lerobot_features.ACTION, leaf, dataset.action_part_names),
        Feature(lerobot_features.REWARD, "float32" if fits else "float64", (1,)),
        Feature(lerobot_features.DONE, "bool", (1,)),
        Feature(lerobot_features.TRUNCATED, "bool", (1,)),
    ]
    if not np.isnan(dataset.behavior).all():
        found.append(Feature(_behavior_feature(dataset), "float32", (1,)))
    return found


def _behavior_feature(dataset: Dataset) -> str:
    return f"{lerobot_features.INFO}{dataset.behavior_field.name}"


def _plain(stats: Stats) -> dict[str, Any]:
    return {name: array.tolist() for name, array in stats.items()}
