"""LeRobot datasets, version 3.0: folders of Parquet files, images and videos."""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import LogError, SpaceError, import_extra
from mcaprl.files import parse_json, read_file
from mcaprl.recorder.dataset.arrays import action_space_of, box_of, flags
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.formats import lerobot_features, parquet
from mcaprl.recorder.dataset.formats.columns import EpisodeArrays, dataset_of
from mcaprl.recorder.dataset.formats.flat import unread_note
from mcaprl.recorder.dataset.formats.lerobot_features import (
    ACTION,
    DEFAULTS,
    DONE,
    STEPS,
    TRUNCATED,
    VIDEO_PATH,
    Feature,
    read_frames,
)
from mcaprl.recorder.dataset.formats.lerobot_writer import write
from mcaprl.recorder.dataset.formats.mp4 import packet_times, read_packets
from mcaprl.recorder.dataset.packets import Packets, Stream
from mcaprl.recorder.format.behavior import FIELDS
from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.format.spaces import MAX_ACTIONS
from mcaprl.texts import counted

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

    def packets(self, feature: Feature) -> Packets:
        """Return the packets of the images of a camera, in the order of the rows."""
        places = np.zeros((int(self.stops[-1]), 2), np.int64)
        streams, reasons = list[Stream](), list[str]()
        for path, rows, times_s in self._videos(feature):
            packets_s, lack = packet_times(path)
            places[rows, 0] = len(streams)
            places[rows, 1] = np.searchsorted(packets_s, times_s - 0.5 / self.fps)
            streams.append(partial(read_packets, path))
            reasons += [lack] if lack else []
        return Packets(tuple(streams), places, "".join(reasons[:1]), in_logs=True)

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
        images: NDArray[np.uint8] | None = None
        for path, rows, times_s in self._videos(feature):
            found = read_frames(path, times_s, 0.5 / self.fps)
            if images is None:
                images = np.empty((int(self.stops[-1]), *found.shape[1:]), np.uint8)
            images[rows] = found
        if images is None:
            raise LogError(f"{self.path} has no episodes")
        return images

    def _videos(
        self, feature: Feature
    ) -> Iterator[tuple[Path, NDArray[np.int64], NDArray[np.float64]]]:
        """Yield each video of a camera with its rows, and their times in it, which ascend."""
        name = f"videos/{feature.name}"
        files = [(row[f"{name}/chunk_index"], row[f"{name}/file_index"]) for row in self.episodes]
        firsts = [float(row[f"{name}/from_timestamp"]) for row in self.episodes]
        times = self.times_s() + np.repeat(firsts, self.lengths)
        for chunk, number in sorted(set(files)):
            mine = np.repeat([place == (chunk, number) for place in files], self.lengths)
            rows = np.flatnonzero(mine)
            rows = rows[np.argsort(times[rows], kind="stable")]
            path = VIDEO_PATH.format(
                video_key=feature.name, chunk_index=int(chunk), file_index=int(number)
            )
            yield self.path / path, rows, times[rows]

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
        return parquet.read_table(path)
    return parquet.read_table(path, set(columns).__contains__)


# Types of the errors that invalid values in damaged files cause.
_DAMAGED = (
    LookupError,
    TypeError,
    ValueError,
    AttributeError,
    ArithmeticError,
    MemoryError,
    RecursionError,
    OSError,
)
# LeRobot uses the same tolerance. In episodes of more than half an hour, the rounding error of the
# 32-bit timestamps exceeds this tolerance.
_TIME_TOLERANCE_S = 1e-4
_OBSERVATION = "observation"


@dataclass(frozen=True)
class _Part:
    """Rows of a dataset that become an episode of T transitions.

    Attributes:
        frames: Indexes (T + 1,) of the rows with the episode's observations.
        steps: Rows with the episode's transitions.
        terminated: Whether the last transition led to a terminal state.
        truncated: Whether the episode was truncated.
        source: Index of the episode of LeRobot that contains these rows.
    """

    frames: NDArray[np.int64]
    steps: slice
    terminated: bool
    truncated: bool
    source: int


def read(path: Path) -> Dataset:
    """Read a dataset.

    LeRobot does not store the observation after the last action of an episode. If `next.done` is
    set in the last frame, the observation of this frame is repeated as the final observation.
    Otherwise, the observation of the last frame becomes the final observation, the action of the
    last frame is left out, and the episode is truncated. A warning states the number of episodes
    in each of these cases.
    """
    arrow = import_extra("pyarrow", "tables")
    try:
        return _dataset_of(Files(path))
    except (*_DAMAGED, arrow.ArrowException) as error:
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise LogError(f"{path} is a damaged LeRobot dataset: {reason}") from error


def _dataset_of(files: Files) -> Dataset:
    """Convert a dataset that has no final observations; warn about the missing data."""
    observed = _observed(files)
    values, parts, labels = _observations(files, observed)
    steps = files.steps()
    if lerobot_features.ACTION not in steps:
        raise LogError(f"{files.path} has no feature '{lerobot_features.ACTION}'")
    _warn_of_steps(files, steps)
    if unread := files.unread():
        _warn(files, unread_note(unread))
    actions, action_space = _values_and_space(steps[lerobot_features.ACTION], is_action=True)
    is_single = len(parts) == 1
    metadata = _metadata(files, parts, labels, action_space)
    rewards = steps.get(lerobot_features.REWARD, np.full((len(actions), 1), np.nan))
    behavior: dict[str, Any] = {
        field.plural: steps[name][:, 0]
        for field, name in zip(FIELDS, lerobot_features.BEHAVIORS, strict=True)
        if name in steps
    }
    times, infos = _times_ns(files), _infos(files)
    episodes, every = [], _parts(files, steps)
    for part in every:
        observations = {key: array[part.frames] for key, array in values.items()}
        episode = EpisodeArrays(
            observations=next(iter(observations.values())) if is_single else observations,
            actions=actions[part.steps],
            rewards=rewards[part.steps, 0],
            terminated=part.terminated,
            truncated=part.truncated,
            **{name: values[part.steps] for name, values in behavior.items()},
            times_ns=_frame_times(times, part, metadata.step_duration_ns),
            infos={name: _info_rows(array[part.steps]) for name, array in infos.items()},
            summary={"options": _options(files, part.source)},
        )
        episodes.append(episode)
    rows = np.concatenate([np.zeros(0, np.int64), *(part.frames for part in every)])
    return dataset_of(
        episodes,
        metadata,
        files.path,
        has_rewards=lerobot_features.REWARD in steps,
        packets={
            () if is_single else (key,): files.packets(feature).rows(rows)
            for key, feature in observed.items()
            if feature.dtype == "video"
        },
    )


def _metadata(
    files: Files,
    parts: Mapping[str, spaces.Space[Any]],
    labels: tuple[str, ...],
    action_space: spaces.Space[Any],
) -> LogMetadata:
    is_single, is_vector = len(parts) == 1, isinstance(action_space, spaces.Box)
    return LogMetadata(
        next(iter(parts.values())) if is_single else spaces.Dict(list(parts.items())),
        action_space,
        observation_names=labels if is_single else (),
        action_part_names=_labels(files.features[lerobot_features.ACTION]) if is_vector else (),
        step_duration_ns=_step_ns(files),
    )


def _observations(
    files: Files, observed: Mapping[str, Feature]
) -> tuple[dict[str, NDArray[Any]], dict[str, spaces.Space[Any]], tuple[str, ...]]:
    """Return values and spaces by observation key, and the element names of the first key."""
    values, parts, labels = {}, {}, []
    for key, feature in observed.items():
        values[key], parts[key] = _values_and_space(files.values(feature))
        labels.append(_labels(feature))
    return values, parts, labels[0]


def _observed(files: Files) -> dict[str, Feature]:
    """Return the features of the observation by key."""
    found: dict[str, Feature] = {}
    for name, feature in files.features.items():
        if not name.startswith(_OBSERVATION) or not _is_kept(files, feature):
            continue
        full = name.removeprefix(_OBSERVATION).strip(".") or "state"
        short = name.removeprefix(lerobot_features.IMAGES)
        key = short if short != name and short not in found else full
        if key in found:
            raise SpaceError(f"{files.path}: two observations have the name '{key}'")
        found[key] = feature
    if not found:
        raise LogError(f"{files.path} has no feature '{_OBSERVATION}...' that can be read")
    return found


def _infos(files: Files) -> dict[str, NDArray[Any]]:
    """Return the infos: the values (N, *shape) of each feature that becomes one, by name."""
    taken = {*lerobot_features.STEPS, *lerobot_features.DEFAULTS}
    found = {}
    for name, feature in files.features.items():
        is_other = name not in taken and not name.startswith(_OBSERVATION)
        if is_other and _is_kept(files, feature, images=False):
            found[name.removeprefix(lerobot_features.INFO)] = files.values(feature)
    return found


def _is_kept(files: Files, feature: Feature, *, images: bool = True) -> bool:
    """Return whether a feature has numbers or images that can be read; warn if not.

    Depth videos cannot be read, because LeRobot compresses them in its own way.
    """
    is_video_of_depth = feature.is_depth and feature.dtype == "video"
    if images and feature.is_image and not is_video_of_depth:
        return True
    if not feature.is_image and feature.is_numeric:
        return True
    kind = f"depth {feature.dtype}" if feature.is_depth else feature.dtype
    _warn(files, f"the feature '{feature.name}' of type {kind} is left out")
    return False


def _warn_of_steps(files: Files, steps: Mapping[str, Any]) -> None:
    if lerobot_features.REWARD not in steps:
        _warn(files, f"there is no feature '{lerobot_features.REWARD}': all rewards are NaN")
    if lerobot_features.DONE in steps and lerobot_features.TRUNCATED not in steps:
        _warn(
            files,
            f"'{lerobot_features.DONE}' may also mean truncation, because there is no feature"
            f" '{lerobot_features.TRUNCATED}'; it is read as termination",
        )


def _parts(files: Files, steps: Mapping[str, NDArray[Any]]) -> list[_Part]:
    """Divide the rows into episodes; `next.done` or `next.truncated` ends an episode."""
    none = np.zeros((sum(files.lengths), 1), bool)
    done = steps.get(lerobot_features.DONE, none)[:, 0]
    truncated = steps.get(lerobot_features.TRUNCATED, none)[:, 0]
    found: list[_Part] = []
    repeated = dropped = 0
    for source, start, stop, is_last in _stretches(files, done | truncated):
        frames = np.arange(start, stop + 1)
        flags = bool(done[stop - 1]), bool(truncated[stop - 1])
        if is_last and flags[0]:
            frames[-1] = stop - 1
            repeated += 1
        elif is_last:
            frames, flags = frames[:-1], (False, True)
            dropped += 1
        if len(frames) > 1:
            found.append(_Part(frames, slice(start, start + len(frames) - 1), *flags, source))
    _warn_of_ends(files, repeated, dropped)
    return found


def _stretches(files: Files, ends: NDArray[np.bool_]) -> Iterator[tuple[int, int, int, bool]]:
    """Divide LeRobot's episodes after each row in which `ends` (N,) is true.

    For each part, yield the index of LeRobot's episode, the first row, the last row + 1, and
    whether the part is the last one of this episode.
    """
    for source, (start, stop) in enumerate(files.ranges()):
        inner = (start + 1 + np.flatnonzero(ends[start : stop - 1])).tolist()
        for first, last in zip([start, *inner], [*inner, stop], strict=True):
            yield source, first, last, last == stop


def _warn_of_ends(files: Files, repeated: int, dropped: int) -> None:
    if repeated:
        _warn(
            files,
            "the final observation is not stored for"
            f" {counted(repeated, 'terminated episode')}; the last observation is repeated instead",
        )
    if dropped:
        _warn(
            files,
            "the observation after the last action is not stored for"
            f" {counted(dropped, 'other episode')}; such an episode is read as truncated,"
            " without its last action",
        )


def _step_ns(files: Files) -> int:
    return round(1e9 / files.fps)


def _times_ns(files: Files) -> NDArray[np.int64]:
    """Return the time (N,) of each frame, nanoseconds.

    Each episode starts two step durations after the last frame of the previous episode.
    """
    seconds = files.times_s()
    numbers = np.concatenate([np.arange(length) for length in files.lengths])
    regular = numbers / files.fps
    tolerance = np.maximum(_TIME_TOLERANCE_S, np.spacing(np.float32(regular)))
    is_regular = np.abs(seconds - regular) <= tolerance
    step_ns = _step_ns(files)
    times = np.where(is_regular, numbers * step_ns, np.round(seconds * 1e9)).astype(np.int64)
    lengths = times[files.stops - 1] + 2 * step_ns
    found: NDArray[np.int64] = times + np.repeat(np.cumsum(lengths) - lengths, files.lengths)
    return found


def _frame_times(times: NDArray[np.int64], part: _Part, step_ns: int) -> NDArray[np.int64]:
    """Return the times (T + 1,) of the frames of an episode."""
    found = times[part.frames]
    if part.frames[-1] == part.frames[-2]:
        found[-1] += step_ns
    return found


def _options(files: Files, episode: int) -> str:
    """Return an episode's tasks as JSON of reset options; empty if the episode has no tasks."""
    tasks = list(files.episodes[episode].get("tasks") or ())
    if not tasks:
        return ""
    return json.dumps({"task": tasks[0]} if len(tasks) == 1 else {"tasks": tasks})


def _values_and_space(
    values: NDArray[Any], *, is_action: bool = False
) -> tuple[NDArray[Any], spaces.Space[Any]]:
    """Convert values (N, *shape) to a dtype that a space can have; return values and space."""
    if values.dtype.kind == "b":
        return values.astype(np.int8), spaces.MultiBinary(list(values.shape[1:]))
    is_scalar = values.shape[1:] == (1,) and values.dtype.kind in "iu"
    if is_action and is_scalar and ((values >= 0) & (values < MAX_ACTIONS)).all():
        scalars = values[:, 0].astype(np.int64)
        return scalars, action_space_of(scalars)
    return values, box_of(values)


def _labels(feature: Feature) -> tuple[str, ...]:
    """Return the names of a vector's elements, from a list or from a dict with one list."""
    names = feature.names
    if isinstance(names, dict) and len(names) == 1:
        names = next(iter(names.values()))
    is_vector = isinstance(names, list) and not feature.is_image
    return tuple(map(str, names)) if is_vector and (len(names),) == feature.shape else ()


def _info_rows(values: NDArray[Any]) -> Any:
    """Convert values of T steps to an info with T + 1 rows. The row of the reset is masked."""
    plain = values[:, 0] if values.shape[1:] == (1,) else values
    rows = np.concatenate([np.zeros((1, *plain.shape[1:]), plain.dtype), plain])
    mask = np.zeros(rows.shape, bool)
    mask[0] = True
    return np.ma.MaskedArray(rows, mask)


def _warn(files: Files, text: str) -> None:
    warnings.warn(f"{files.path}: {text}", stacklevel=2)


__all__ = ["matches", "read", "write"]


def matches(path: Path) -> bool:
    """Return whether a folder is a LeRobot dataset of any version."""
    try:
        info = parse_json(read_file(path / "meta/info.json"))
    except (OSError, ValueError):
        return False
    return isinstance(info, dict) and "codebase_version" in info
