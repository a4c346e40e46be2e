"""Shapes and poses of an episode, as arrays for the page."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.recorder.record.display import SCENE, SCENE_STATIC, TF, TF_STATIC
from mcaprl.recorder.viewer.playback import Track
from mcaprl.recorder.viewer.scene_reader import SeenFrame, SeenShape, frames_of, shapes_of


def scene_data(track: Track, start_ns: int, end_ns: int) -> dict[str, Any]:
    """Return the scene of an episode.

    Args:
        track: Track of the log, with the scene topics.
        start_ns: log_time of the episode's first record.
        end_ns: log_time of the episode's last record.

    Returns:
        `shapes`: all different shapes; see `_Shapes.columns`.
        `static`: (S,) indexes of the static shapes.
        `moments`: times at which the moving shapes change, in seconds from the start, and the
        indexes of the shapes at each time; see `_Moments.columns`.
        `frames`: coordinate frames with their parents and stamped poses.
        `follow`: name of the first moving frame; empty if there is none.
    """
    shapes, moments, static = _Shapes(), _Moments(), np.empty(0, np.int32)
    moving, fixed = list[tuple[int, SeenFrame]](), list[tuple[int, SeenFrame]]()
    latest = list(track.latest(start_ns))
    for time_ns, channel, data in [*latest, *track.between(start_ns + 1, end_ns + 1)]:
        if channel.topic == SCENE_STATIC:
            static = shapes.indexes(shapes_of(data))
        elif channel.topic == SCENE:
            moments.add((time_ns - start_ns) / 1e9, shapes.indexes(shapes_of(data)))
        elif channel.topic == TF:
            moving += frames_of(data)
        elif channel.topic == TF_STATIC:
            fixed += frames_of(data)
    return {
        "shapes": shapes.columns(),
        "static": static,
        "moments": moments.columns(),
        "frames": [*_poses(moving, start_ns), *_poses(fixed, start_ns)],
        "follow": moving[0][1].name if moving else "",
    }


class _Shapes:
    """Table of shapes, in which equal shapes have one row."""

    def __init__(self) -> None:
        self._rows: dict[Any, int] = {}
        self._shapes: list[SeenShape] = []

    def indexes(self, shapes: Iterable[SeenShape]) -> NDArray[np.int32]:
        """Return the row of each shape; add a row for each new shape."""
        return np.array([self._row(shape) for shape in shapes], np.int32)

    def _row(self, shape: SeenShape) -> int:
        key = tuple(
            value.tobytes() if isinstance(value, np.ndarray) else value
            for value in vars(shape).values()
        )
        row = self._rows.setdefault(key, len(self._shapes))
        if row == len(self._shapes):
            self._shapes.append(shape)
        return row

    def columns(self) -> dict[str, Any]:
        """Return columns: texts as lists, and numbers as arrays.

        `numbers` are (N, 11): color, size, position, yaw. The points of shape k are the rows
        `starts[k]` to `starts[k + 1]` of `points`.
        """
        shapes = self._shapes
        numbers = [(*s.color, *s.size, *s.position, s.yaw_rad) for s in shapes]
        points = [np.empty((0, 3)), *(shape.points for shape in shapes)]
        return {
            "kinds": [shape.kind for shape in shapes],
            "frames": [shape.frame for shape in shapes],
            "texts": [shape.text for shape in shapes],
            "numbers": np.array(numbers, np.float32).reshape(-1, 11),
            "points": np.concatenate(points).astype(np.float32),
            "starts": np.cumsum([len(part) for part in points]).astype(np.int32),
        }


class _Moments:
    """Lists of shapes at the times at which they change."""

    def __init__(self) -> None:
        self._times_s: list[float] = []
        self._indexes: list[NDArray[np.int32]] = []

    def add(self, time_s: float, indexes: NDArray[np.int32]) -> None:
        """Add the shapes at a time, which must not be before an earlier added time."""
        self._times_s.append(time_s)
        self._indexes.append(indexes)

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return the times, and the rows of the shapes at each time.

        The rows for time k are `indexes[starts[k] : starts[k + 1]]`.
        """
        indexes = [np.empty(0, np.int32), *self._indexes]
        return {
            "times": np.array(self._times_s, np.float64),
            "starts": np.cumsum([len(part) for part in indexes]).astype(np.int32),
            "indexes": np.concatenate(indexes),
        }


def _poses(stamped: Sequence[tuple[int, SeenFrame]], start_ns: int) -> list[dict[str, Any]]:
    """Return the poses of each coordinate frame in its first parent, with their times.

    A pose is a position and a quaternion.
    """
    found: dict[str, list[tuple[int, SeenFrame]]] = {}
    for stamp_ns, frame in stamped:
        found.setdefault(frame.name, []).append((stamp_ns, frame))
    frames = []
    for name, poses in found.items():
        # The pose at the time of a step is in two messages.
        rows = dict(sorted(poses, key=lambda pose: pose[0]))
        times = np.array([(stamp_ns - start_ns) / 1e9 for stamp_ns in rows], np.float64)
        values = [(*frame.position, *frame.rotation) for frame in rows.values()]
        frames.append(
            {
                "name": name,
                "parent": poses[0][1].parent,
                "times": times,
                "poses": np.array(values, np.float32).reshape(-1, 7),
            }
        )
    return frames
