"""Tracks of a vehicle in the episodes so far, as shapes of the topic `/scene/tracks`."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.recorder.record.scene import Quad, Vector

_MAX_TRACKS = 32
_MAX_POINTS = 64
_RAISED_M = 0.2
_MIN_WIDTH_M = 0.05
# A track is 1/250 of the world's size wide, so that it is visible in a view of the whole world. A
# mark is five times as wide as a track.
_WIDTHS_PER_WORLD, _WIDTHS_PER_MARK = 250, 5
_LOW_RETURN, _HIGH_RETURN = np.array([0.30, 0.25, 0.80]), np.array([0.98, 0.85, 0.25])
_FAILED: Quad = (0.90, 0.10, 0.10, 1.0)


class TrackShape(NamedTuple):
    """A track, or a mark at the end of a failed track. For the attributes, see `scene.Shape`."""

    name: str
    kind: str
    color: Quad
    points: NDArray[np.float64]
    size: Vector
    position: Vector = (0.0, 0.0, 0.0)
    yaw_rad: float = 0.0
    frame: str = "map"
    text: str = ""


class _Track(NamedTuple):
    episode: int
    points_m: NDArray[np.float64]
    total_reward: float
    failed: bool


class Tracks:
    """Tracks of the last 32 episodes, colored by return from blue (lowest) to yellow (highest)."""

    def __init__(self) -> None:
        """Start without tracks."""
        self._tracks: deque[_Track] = deque(maxlen=_MAX_TRACKS)
        self._points_m: list[Vector] = []

    def begin(self) -> None:
        """Begin an episode."""
        self._points_m = []

    def add(self, position_m: Vector) -> None:
        """Add a position (x, y, z) of the vehicle in the map, meters."""
        self._points_m.append(position_m)

    def end(self, episode: int, total_reward: float, *, failed: bool) -> None:
        """Keep the episode's track, reduced to at most 64 evenly spaced positions."""
        points_m = np.array(self._points_m, np.float64).reshape(-1, 3)
        if len(points_m) < 2:
            return
        kept = np.linspace(0, len(points_m) - 1, min(len(points_m), _MAX_POINTS)).round()
        raised = points_m[kept.astype(int)] + [0.0, 0.0, _RAISED_M]
        self._tracks.append(_Track(episode, raised, total_reward, failed))

    def shapes(self) -> list[TrackShape]:
        """Return a line for each track, and a red sphere at the end of each failed one."""
        if not self._tracks:
            return []
        width_m = self._width_m()
        shapes = [
            TrackShape(f"track_{track.episode}", "line", color, track.points_m, (width_m, 0.0, 0.0))
            for track, color in zip(self._tracks, self._colors(), strict=True)
        ]
        mark_m = _WIDTHS_PER_MARK * width_m
        for track in self._tracks:
            if track.failed:
                x_m, y_m, z_m = track.points_m[-1].tolist()
                size, nothing = (mark_m, mark_m, mark_m), np.empty((0, 3))
                name, at = f"failed_{track.episode}", (x_m, y_m, z_m)
                shapes.append(TrackShape(name, "sphere", _FAILED, nothing, size, at))
        return shapes

    def _width_m(self) -> float:
        points_m = np.concatenate([track.points_m for track in self._tracks])
        world_m = float(np.ptp(points_m, axis=0).max())
        return max(_MIN_WIDTH_M, world_m / _WIDTHS_PER_WORLD)

    def _colors(self) -> list[Quad]:
        # Infinite returns and NaN have no color, so finite numbers replace them.
        returns = np.nan_to_num([track.total_reward for track in self._tracks])
        low, high = returns.min(), returns.max()
        shares = np.ones(len(returns))
        if high > low:
            shares = returns / (high - low) - low / (high - low)
        colors = _LOW_RETURN + shares[:, None] * (_HIGH_RETURN - _LOW_RETURN)
        return [(red, green, blue, 1.0) for red, green, blue in colors.tolist()]
