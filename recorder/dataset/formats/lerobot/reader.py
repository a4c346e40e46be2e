"""Reading of LeRobot datasets, version 3.0, written by LeRobot or by this package."""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import LogError, SpaceError, import_extra
from mcaprl.recorder.dataset.arrays import action_space_of, box_of
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.formats.columns import EpisodeArrays, dataset_of
from mcaprl.recorder.dataset.formats.lerobot import features
from mcaprl.recorder.dataset.formats.lerobot.features import Feature
from mcaprl.recorder.dataset.formats.lerobot.files import Files
from mcaprl.recorder.dataset.formats.lerobot.own import Own, read_own
from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.format.spaces import action_leaf, leaves_of, nest

_VERSIONS = "v3."
_STEPS = (features.ACTION, features.REWARD, features.DONE, features.TRUNCATED, features.PROBABILITY)
# LeRobot's own tolerance; 32-bit floats are less precise after half an hour.
_TIME_TOLERANCE_S = 1e-4
# What the values of damaged files raise.
_DAMAGED = (KeyError, TypeError, ValueError, AttributeError, OSError)


def read(path: Path) -> Dataset:
    """Read a dataset.

    LeRobot stores no observation after the last action of an episode. If the last frame is a
    terminal one (`next.done`), its observation is also taken for the final one; otherwise the
    last frame is taken for the final observation, without its action, and the episode is
    truncated. A warning counts both.

    Args:
        path: Folder of the dataset.

    Raises:
        LogError: A file is missing, damaged or of another version.
        SpaceError: A log cannot hold a feature.
        MissingExtraError: PyArrow, Pillow or PyAV is not installed.
    """
    arrow = import_extra("pyarrow", "tables")
    try:
        return _Reader(path).dataset()
    except (
        KeyError,
        TypeError,
        ValueError,
        AttributeError,
        OSError,
        arrow.ArrowException,
    ) as error:
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise LogError(f"{path} is a damaged LeRobot dataset: {reason}") from error


@dataclass(frozen=True)
class _Part:
    """Rows of a dataset that become an episode.

    Attributes:
        frames: Indexes (T + 1,) of the rows with its observations.
        steps: Rows of its T transitions.
        terminated: Whether the last transition led to a terminal state.
        truncated: Whether the episode was truncated.
        source: Index of LeRobot's episode.
    """

    frames: NDArray[np.int64]
    steps: slice
    terminated: bool
    truncated: bool
    source: int


class _Reader:
    """Reader of one dataset."""

    def __init__(self, path: Path) -> None:
        self._path, self._files = path, Files(path)
        self._features = self._files.features
        self._step_ns = round(1e9 / self._files.fps)

    def dataset(self) -> Dataset:
        """Return all episodes."""
        own = read_own(self._path, self._files.lengths)
        if own is not None and {*own.features, features.ACTION} <= set(self._features):
            return self._own_dataset(own)
        return self._foreign_dataset()

    def _own_dataset(self, own: Own) -> Dataset:
        leaves = leaves_of(own.metadata.observation_space)
        action = action_leaf(own.metadata.action_space)
        steps = self._steps()
        columns = []
        for leaf, name in zip(leaves, own.features, strict=True):
            values = self._files.values(self._features[name])
            if leaf.encoding == "mono8":
                values = values[..., 0]
            columns.append(values.reshape(len(values), *leaf.shape))
        found = []
        for index, (start, stop) in enumerate(self._files.ranges()):
            finals = [own.finals[leaf.name][index : index + 1] for leaf in leaves]
            parts = [
                np.concatenate([column[start:stop], final])
                for column, final in zip(columns, finals, strict=True)
            ]
            actions = steps[features.ACTION][start:stop]
            episode = EpisodeArrays(
                observations=nest(leaves, parts),
                actions=actions.reshape(stop - start, *action.shape),
                rewards=steps[features.REWARD][start:stop, 0],
                terminated=bool(steps[features.DONE][stop - 1, 0]),
                truncated=bool(steps[features.TRUNCATED][stop - 1, 0]),
                behavior_probs=_first(steps.get(features.PROBABILITY), slice(start, stop)),
                times_ns=own.times_ns[index],
                summary=own.summaries[index],
            )
            found.append(episode)
        return dataset_of(found, own.metadata, self._path)

    def _foreign_dataset(self) -> Dataset:
        observed = self._observed()
        steps = self._steps()
        if features.ACTION not in steps:
            raise LogError(f"{self._path} has no feature '{features.ACTION}'")
        if features.REWARD not in steps:
            self._warn(f"there is no feature '{features.REWARD}': all rewards are NaN")
        if features.DONE in steps and features.TRUNCATED not in steps:
            self._warn(
                f"'{features.DONE}' may also mean truncation, because there is no feature"
                f" '{features.TRUNCATED}'; it is read as termination"
            )
        action, action_space = _space_and_values(steps.pop(features.ACTION), is_action=True)
        values, parts = {}, {}
        for key, feature in observed.items():
            values[key], parts[key] = _space_and_values(self._files.values(feature))
        is_single = len(parts) == 1
        metadata = LogMetadata(
            next(iter(parts.values())) if is_single else spaces.Dict(list(parts.items())),
            action_space,
            observation_names=_labels(next(iter(observed.values()))) if is_single else (),
            step_duration_ns=self._step_ns,
        )
        times = self._times_ns()
        starts = self._starts_ns(times).tolist()
        infos = {name: self._files.values(feature) for name, feature in self._infos().items()}
        episodes = []
        for part in self._parts(steps):
            if len(part.frames) < 2:
                continue
            observations = {key: array[part.frames] for key, array in values.items()}
            count = part.steps.stop - part.steps.start
            rewards = _first(steps.get(features.REWARD), part.steps)
            episode = EpisodeArrays(
                observations=next(iter(observations.values())) if is_single else observations,
                actions=action[part.steps],
                rewards=np.full(count, np.nan) if rewards is None else rewards,
                terminated=part.terminated,
                truncated=part.truncated,
                behavior_probs=_first(steps.get(features.PROBABILITY), part.steps),
                times_ns=self._frame_times(times, part, starts[part.source]),
                infos={name: _info_rows(array[part.steps]) for name, array in infos.items()},
                summary={"options": self._options(part.source)},
            )
            episodes.append(episode)
        return dataset_of(episodes, metadata, self._path)

    def _steps(self) -> dict[str, NDArray[Any]]:
        """Return the values (N, *shape) of the features that have one for each step, if present."""
        known = {name: self._features[name] for name in _STEPS if name in self._features}
        return {name: self._files.values(feature) for name, feature in known.items()}

    def _observed(self) -> dict[str, Feature]:
        """Return the features of the observation by key."""
        found: dict[str, Feature] = {}
        for name, feature in self._features.items():
            if not name.startswith("observation"):
                continue
            if not _is_readable(feature):
                self._warn(f"the feature '{name}' of type {_type_of(feature)} is left out")
                continue
            full = name.removeprefix("observation").strip(".") or "state"
            short = name.removeprefix(features.IMAGES)
            key = short if short != name and short not in found else full
            if key in found:
                raise SpaceError(f"{self._path}: two observations have the name '{key}'")
            found[key] = feature
        if not found:
            raise LogError(f"{self._path} has no feature 'observation...' that can be read")
        return found

    def _infos(self) -> dict[str, Feature]:
        """Return the features that become infos, by the names of the infos."""
        taken = {*_STEPS, *features.DEFAULTS}
        found = {}
        for name, feature in self._features.items():
            if name in taken or name.startswith("observation"):
                continue
            if feature.is_image or not _is_readable(feature):
                self._warn(f"the feature '{name}' of type {_type_of(feature)} is left out")
            else:
                found[name.removeprefix(features.INFO)] = feature
        return found

    def _parts(self, steps: Mapping[str, NDArray[Any]]) -> list[_Part]:
        """Divide the rows into episodes; `next.done` ends one."""
        total = int(self._files.stops[-1]) if len(self._files.stops) else 0
        none = np.zeros((total, 1), bool)
        done = steps.get(features.DONE, none)[:, 0] != 0
        truncated = steps.get(features.TRUNCATED, none)[:, 0] != 0
        found: list[_Part] = []
        repeated = dropped = 0
        for source, (start, stop) in enumerate(self._files.ranges()):
            ends = start + 1 + np.flatnonzero((done | truncated)[start : stop - 1])
            for first, last in zip([start, *ends.tolist()], [*ends.tolist(), stop], strict=True):
                rows = np.arange(first, last + 1)
                flags = bool(done[last - 1]), bool(truncated[last - 1])
                if last == stop and flags[0]:
                    rows[-1] -= 1
                    repeated += 1
                elif last == stop:
                    rows, flags = rows[:-1], (False, True)
                    dropped += 1
                found.append(_Part(rows, slice(first, first + len(rows) - 1), *flags, source))
        if repeated:
            self._warn(
                f"{repeated} of {len(found)} episodes end in a terminal state whose observation is"
                " not stored; the last observation is repeated in its place"
            )
        if dropped:
            self._warn(
                f"{dropped} of {len(found)} episodes have no observation after their last action:"
                " that action is left out, and the episodes are marked as truncated"
            )
        return found

    def _times_ns(self) -> NDArray[np.int64]:
        """Return the time (N,) of each frame since the start of its episode, nanoseconds."""
        seconds = self._files.times_s()
        numbers = np.concatenate([np.arange(stop - start) for start, stop in self._files.ranges()])
        regular = numbers / self._files.fps
        tolerance = np.maximum(_TIME_TOLERANCE_S, np.spacing(np.float32(regular)))
        is_regular = np.abs(seconds - regular) <= tolerance
        return np.where(is_regular, numbers * self._step_ns, np.round(seconds * 1e9)).astype(
            np.int64
        )

    def _frame_times(self, times: NDArray[np.int64], part: _Part, first: int) -> NDArray[np.int64]:
        """Return the times (T + 1,) of the frames of an episode that starts at `first`."""
        found = first + times[part.frames]
        if part.frames[-1] == part.frames[-2]:
            found[-1] += self._step_ns
        return found

    def _starts_ns(self, times: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the start (E,) of each episode, two steps after the end of the one before."""
        lengths = times[self._files.stops - 1] + 2 * self._step_ns
        return np.cumsum(lengths) - lengths

    def _options(self, episode: int) -> str:
        tasks = list(self._files.episodes[episode].get("tasks") or ())
        if not tasks:
            return ""
        return json.dumps({"task": tasks[0]} if len(tasks) == 1 else {"tasks": tasks})

    def _warn(self, text: str) -> None:
        warnings.warn(f"{self._path}: {text}", stacklevel=2)


def _type_of(feature: Feature) -> str:
    return f"depth {feature.dtype}" if feature.is_depth else feature.dtype


def _is_readable(feature: Feature) -> bool:
    """Return whether the values are numbers or images; depth in a video is compressed codes."""
    if feature.is_image:
        return not (feature.is_depth and feature.dtype == "video")
    try:
        return np.dtype(feature.dtype).kind in "biuf"
    except TypeError:
        return False


def _space_and_values(
    values: NDArray[Any], *, is_action: bool = False
) -> tuple[NDArray[Any], spaces.Space[Any]]:
    """Return values (N, *shape) and a space that holds them."""
    if values.dtype.kind == "b":
        return values.astype(np.int8), spaces.MultiBinary(list(values.shape[1:]))
    if is_action and values.shape[1:] == (1,) and values.dtype.kind in "iu":
        scalars = values[:, 0].astype(np.int64)
        return scalars, action_space_of(scalars)
    return values, box_of(values)


def _labels(feature: Feature) -> tuple[str, ...]:
    """Return the names of a vector's elements, from a list or from lists by their kind."""
    names = feature.names
    if isinstance(names, dict) and len(names) == 1:
        names = next(iter(names.values()))
    is_vector = isinstance(names, list) and not feature.is_image
    fits = is_vector and (len(names),) == feature.shape
    return tuple(map(str, names)) if fits else ()


def _first(values: NDArray[Any] | None, rows: slice) -> NDArray[Any] | None:
    """Return the numbers (T,) in these rows of a feature of shape (1,); None without one."""
    return None if values is None else values[rows, 0]


def _info_rows(values: NDArray[Any]) -> Any:
    """Return the info (T + 1, *shape) of the steps' values (T, *shape): there is none at reset."""
    plain = values[:, 0] if values.shape[1:] == (1,) else values
    rows = np.concatenate([np.zeros((1, *plain.shape[1:]), plain.dtype), plain])
    mask = np.zeros(rows.shape, bool)
    mask[0] = True
    return np.ma.MaskedArray(rows, mask)
