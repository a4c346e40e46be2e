"""Items of LeRobot's dataset, read from a log: nothing is converted or written."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import UsageError, import_extra
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.formats.lerobot_features import Feature
from mcaprl.recorder.dataset.formats.lerobot_writer import Frames, losses, pooled


class LeRobotItems:
    """Frames of a dataset, in the form of `LeRobotDataset` of LeRobot 0.4.

    An item is a dict of tensors: of each feature its value (*shape) in float32, int64 or bool; of
    an image (channels, height, width) in float32 in [0, 1]. A shape of (1,) is dropped. With
    `delta_timestamps`, a value has a first axis of the K frames at these times, and the feature has
    flags (K,) `NAME_is_pad` of those outside of the episode, which repeat its first or last frame.
    `task` is a text.

    Attributes:
        meta: Description: `info`, `features`, `stats`, `episodes`, `tasks` and others.
        repo_id: Name of the data.
        episodes: Indexes of the selected episodes; None for all.
        delta_timestamps: Times of further frames, seconds, by feature.
        image_transforms: Function of an image, or None.
    """

    def __init__(
        self,
        dataset: Dataset,
        *,
        episodes: Sequence[int] | None = None,
        delta_timestamps: Mapping[str, Sequence[float]] | None = None,
        image_transforms: Callable[[Any], Any] | None = None,
        tolerance_s: float = 1e-4,
    ) -> None:
        """See `Dataset.as_lerobot`."""
        losses(dataset, lossy=False, video=False)
        self._torch = import_extra("torch", "offline")
        self.meta = Meta(dataset)
        self.repo_id = self.meta.repo_id
        self.episodes = None if episodes is None else list(episodes)
        self.delta_timestamps, self.image_transforms = delta_timestamps, image_transforms
        self._frames, self._by_name = self.meta.frames, self.meta.by_name
        slices = self._frames.slices
        for index in self.episodes or ():
            if not 0 <= index < len(slices):
                raise UsageError(f"there is no episode {index}, but {len(slices)} episodes")
        chosen = slices if self.episodes is None else [slices[k] for k in sorted({*self.episodes})]
        whole = [np.arange(each.start, each.stop) for each in chosen]
        self._rows = np.concatenate([np.zeros(0, np.int64), *whole])
        self._steps = {
            name: _steps_of(name, times, self.fps, tolerance_s)
            for name, times in (delta_timestamps or {}).items()
        }
        if missing := [name for name in self._steps if name not in self._by_name]:
            raise UsageError(
                f"delta_timestamps has '{missing[0]}'; the features are {', '.join(self._by_name)}"
            )

    @property
    def fps(self) -> int | float:
        """Frames per second."""
        return self._frames.fps

    @property
    def features(self) -> dict[str, Any]:
        """Features by name, as in `meta/info.json`."""
        features: dict[str, Any] = self.meta.info["features"]
        return features

    @property
    def num_frames(self) -> int:
        """Number of frames of the selected episodes."""
        return len(self._rows)

    @property
    def num_episodes(self) -> int:
        """Number of selected episodes."""
        return len(self._frames.slices) if self.episodes is None else len(self.episodes)

    def __len__(self) -> int:
        """Return the number of frames."""
        return self.num_frames

    def __getitem__(self, number: int) -> dict[str, Any]:
        """Return a frame of the selected episodes."""
        row = int(self._rows[number])
        steps = self._frames.slices[int(self._frames.episode_of_frame[row])]
        item: dict[str, Any] = {}
        for name, feature in self._by_name.items():
            rows = row + self._steps.get(name, np.zeros(1, np.int64))
            values = self._tensor(feature, np.clip(rows, steps.start, steps.stop - 1))
            item[name] = values if name in self._steps else values[0]
            if name in self._steps:
                is_pad = (rows < steps.start) | (rows >= steps.stop)
                item[f"{name}_is_pad"] = self._torch.from_numpy(is_pad)
            if feature.is_image and self.image_transforms is not None:
                item[name] = self.image_transforms(item[name])
        item["task"] = self.meta.task_texts[int(item["task_index"])]
        return item

    def _tensor(self, feature: Feature, rows: NDArray[np.int64]) -> Any:
        values = self._frames.values(feature, rows)
        if feature.is_image:
            # Depth in meters is not scaled.
            scale = 255 if values.dtype == np.uint8 else 1
            pixels = np.moveaxis(values, 3, 1).astype(np.float32) / np.float32(scale)
            return self._torch.from_numpy(np.ascontiguousarray(pixels))
        kind = {"f": np.float32, "b": np.bool_}.get(values.dtype.kind, np.int64)
        flat = values[:, 0] if feature.shape == (1,) else values
        return self._torch.from_numpy(np.array(flat, kind))


class Meta:
    """Description of a dataset, in the form of LeRobot's `LeRobotDatasetMetadata`.

    Attributes:
        frames: The frames.
        by_name: Features by name.
        info: Content of `meta/info.json`.
        task_texts: Texts of the tasks.
        episodes: Rows by number, and columns by name: `length`, `tasks`, `dataset_from_index` and
            `dataset_to_index`, the indexes of its first frame and of the one after its last.
    """

    subtasks = None
    robot_type = None

    def __init__(self, dataset: Dataset) -> None:
        """Describe a dataset."""
        self.frames = Frames(dataset)
        self.by_name = {feature.name: feature for feature in self.frames.features}
        entries = {name: feature.to_json() for name, feature in self.by_name.items()}
        for entry in entries.values():
            entry["shape"] = tuple(entry["shape"])
        self.info = self.frames.info(entries, has_videos=False)
        self.repo_id = ", ".join(map(str, dataset.sources))
        self.task_texts = list(self.frames.tasks)
        self.episodes = _Rows(
            {
                "episode_index": k,
                "tasks": [self.task_texts[self.frames.task_of_episode[k]]],
                "length": steps.stop - steps.start,
                "dataset_from_index": steps.start,
                "dataset_to_index": steps.stop,
            }
            for k, steps in enumerate(self.frames.slices)
        )

    def __getattr__(self, name: str) -> Any:
        """Return an entry of `info`, such as `fps`, `features` and `total_frames`."""
        if name.startswith("_") or name not in self.__dict__.get("info", {}):
            raise AttributeError(f"LeRobot's description of a log has no '{name}'")
        return self.info[name]

    @cached_property
    def stats(self) -> dict[str, dict[str, NDArray[Any]]]:
        """Statistics of each feature: those that `Dataset.to_lerobot` writes."""
        count = len(self.frames.slices)
        return {
            one.name: dict(pooled([self.frames.stats(one, k) for k in range(count)]))
            for one in self.frames.features
        }

    @cached_property
    def tasks(self) -> Any:
        """DataFrame with the index of each task by its text."""
        numbers = {"task_index": list(self.frames.tasks.values())}
        index = import_extra("pandas", "tables").Index(self.task_texts, name="task")
        return import_extra("pandas", "tables").DataFrame(numbers, index=index)

    @property
    def names(self) -> dict[str, Any]:
        """Names of the elements or dimensions of each feature."""
        return {name: feature.names for name, feature in self.by_name.items()}

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of each feature."""
        return {name: feature.shape for name, feature in self.by_name.items()}

    @property
    def camera_keys(self) -> list[str]:
        """Names of the features that are images."""
        return [name for name, feature in self.by_name.items() if feature.is_image]

    image_keys = camera_keys

    @property
    def video_keys(self) -> list[str]:
        """Names of the features that are videos: none."""
        return []


class _Rows(list[dict[str, Any]]):
    """Rows of a table; a name selects a column."""

    def __getitem__(self, key: Any) -> Any:
        return [row[key] for row in self] if isinstance(key, str) else super().__getitem__(key)


def _steps_of(
    name: str, times: Sequence[float], fps: float, tolerance_s: float
) -> NDArray[np.int64]:
    """Return times in frames."""
    frames = np.asarray(times, np.float64) * fps
    steps = np.round(frames).astype(np.int64)
    wrong = np.abs(frames - steps) / fps > tolerance_s
    if wrong.any():
        raise UsageError(
            f"delta_timestamps of '{name}' has {np.asarray(times)[wrong][0]:g} s, which is no"
            f" multiple of 1/{fps:g} s"
        )
    return steps
