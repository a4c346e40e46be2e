"""Poses of coordinate frames in other frames, from the transforms of a bag."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import UsageError
from mcaprl.recorder.bags.bag import Bag
from mcaprl.recorder.mapping.align import NONE, NS_PER_S, last, nearest

Floats = NDArray[np.float64]

TF, TF_STATIC = "/tf", "/tf_static"


class _Edge(NamedTuple):
    """Poses of a frame in its parent: times (M,), positions (M, 3), quaternions (M, 4) x y z w."""

    parent: str
    times_ns: NDArray[np.int64]
    positions: Floats
    quaternions: Floats
    is_static: bool


class Transforms:
    """Tree of the coordinate frames of a bag."""

    def __init__(self, bag: Bag, *, by_header: bool = False) -> None:
        """Read all transforms.

        Args:
            bag: Bag with `/tf`, `/tf_static` or both.
            by_header: Whether to use the stamp of each transform instead of the log_time.
        """
        found: dict[str, list[tuple[str, int, list[float], list[float], bool]]] = {}
        for topic in (TF, TF_STATIC):
            if topic in bag.topics and bag.topics[topic].count:
                for child, *pose in _messages(bag, topic, by_header=by_header):
                    found.setdefault(child, []).append((*pose, topic == TF_STATIC))
        self._edges = {child: _edge(child, rows) for child, rows in found.items()}

    def planar(
        self,
        frame: str,
        fixed: str,
        steps_ns: NDArray[np.int64],
        align: str,
        tolerance_s: float | None,
    ) -> tuple[Floats, Floats]:
        """Return the planar pose of a frame in another frame at the times of steps.

        The pose is composed of the transforms between the two frames. Static transforms are valid
        at all times.

        Args:
            frame: Frame whose pose is returned.
            fixed: Reference frame of the pose.
            steps_ns: (N,) times of the steps.
            align: Selection of each transform: `last`, `nearest` or `linear` (interpolated).
            tolerance_s: Maximum age of a transform in seconds; older transforms count as missing.

        Returns:
            (N, 3) x, y and yaw, NaN where missing; and (N,) age of the oldest transform, seconds.

        Raises:
            UsageError: No transforms connect the frames.
        """
        above, below = self._chain(frame), self._chain(fixed)
        common = next((each for each in above if each in below), None)
        if common is None:
            known = sorted({*self._edges, *(edge.parent for edge in self._edges.values())})
            raise UsageError(
                f"/tf has no path from frame '{frame}' to '{fixed}'; frames:"
                f" {', '.join(known[:12])}"
            )
        count = len(steps_ns)
        age_s = np.zeros(count)
        poses = []
        for start in (above[: above.index(common)], below[: below.index(common)]):
            position, turn = np.zeros((count, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))
            for name in start:
                at, rotation, age = _at(self._edges[name], steps_ns, align, tolerance_s)
                position, turn = at + _rotated(rotation, position), _product(rotation, turn)
                age_s = np.fmax(age_s, age) + np.where(np.isnan(age), np.nan, 0.0)
            poses.append((position, turn))
        (at, turn), (origin, back) = poses
        inverse = back * [-1.0, -1.0, -1.0, 1.0]
        position, rotation = _rotated(inverse, at - origin), _product(inverse, turn)
        return np.column_stack([position[:, :2], yaw_of(rotation)]), age_s

    def _chain(self, frame: str) -> list[str]:
        """Return a frame and its ancestors."""
        chain = [frame]
        while chain[-1] in self._edges:
            parent = self._edges[chain[-1]].parent
            if parent in chain:
                raise UsageError(f"/tf has a cycle at frame '{parent}'")
            chain.append(parent)
        return chain


def yaw_of(quaternions: Floats) -> Floats:
    """Return the yaw in radians of quaternions (N, 4) x y z w; NaN for a quaternion of zeros."""
    x, y, z, w = quaternions.T
    with np.errstate(invalid="ignore"):
        is_none = ~(np.square(quaternions).sum(axis=1) > 0)
    return np.where(is_none, np.nan, np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


def _messages(bag: Bag, topic: str, *, by_header: bool) -> Iterator[tuple[Any, ...]]:
    """Yield child, parent, time, position and quaternion of each transform."""
    stream = bag.read(topic, ["transforms"])
    for time_ns, transforms in zip(
        stream.log_time_ns.tolist(), stream.columns["transforms"], strict=True
    ):
        for each in transforms:
            stamp, pose = each.header.stamp, each.transform
            if by_header and topic != TF_STATIC:
                time_ns = stamp.sec * 10**9 + stamp.nanosec
            at, turn = pose.translation, pose.rotation
            parent, child = (
                name.removeprefix("/") for name in (each.header.frame_id, each.child_frame_id)
            )
            yield child, parent, time_ns, [at.x, at.y, at.z], [turn.x, turn.y, turn.z, turn.w]


def _edge(child: str, rows: list[tuple[str, int, list[float], list[float], bool]]) -> _Edge:
    parents = sorted({row[0] for row in rows})
    if len(parents) > 1:
        raise UsageError(f"/tf gives frame '{child}' several parents: {', '.join(parents)}")
    rows = sorted(rows, key=lambda row: row[1])
    _, times_ns, positions, quaternions, static = zip(*rows, strict=True)
    turns = np.array(quaternions, np.float64)
    sizes = np.linalg.norm(turns, axis=1, keepdims=True)
    turns = np.divide(turns, sizes, out=np.full_like(turns, np.nan), where=sizes > 0)
    times = np.array(times_ns, np.int64)
    return _Edge(rows[-1][0], times, np.array(positions, np.float64), turns, all(static))


def _at(
    edge: _Edge, steps_ns: NDArray[np.int64], align: str, tolerance_s: float | None
) -> tuple[Floats, Floats, Floats]:
    """Return the pose of a frame in its parent at the times of steps: position, rotation, age."""
    if edge.is_static:
        count = len(steps_ns)
        still = (np.tile(each[-1], (count, 1)) for each in (edge.positions, edge.quaternions))
        return (*still, np.zeros(count))  # type: ignore[return-value]
    match = (nearest if align == "nearest" else last)(edge.times_ns, steps_ns, tolerance_s)
    rows, is_none = np.maximum(match.rows, 0), match.rows == NONE
    positions, turns = edge.positions[rows], edge.quaternions[rows]
    age_s = match.age_s
    if align == "linear":
        after = np.minimum(rows + 1, len(edge.times_ns) - 1)
        span = np.maximum(edge.times_ns[after] - edge.times_ns[rows], 1)
        share = np.clip((steps_ns - edge.times_ns[rows]) / span, 0.0, 1.0)[:, np.newaxis]
        is_between = edge.times_ns[rows] != steps_ns
        is_none |= is_between & (after == rows)
        if tolerance_s is not None:
            wait_s = (edge.times_ns[after] - steps_ns) / NS_PER_S
            is_none |= is_between & (wait_s > tolerance_s)
        positions = positions + share * (edge.positions[after] - positions)
        turns = _interpolated(turns, edge.quaternions[after], share)
    positions, turns = positions.copy(), turns.copy()
    positions[is_none], turns[is_none] = np.nan, np.nan
    return positions, turns, np.where(is_none, np.nan, age_s)


def _interpolated(first: Floats, second: Floats, share: Floats) -> Floats:
    """Interpolate unit quaternions along the shorter arc (slerp)."""
    cosine = (first * second).sum(axis=1, keepdims=True)
    second, cosine = np.where(cosine < 0, -second, second), np.abs(cosine).clip(max=1.0)
    angle = np.arccos(cosine)
    with np.errstate(invalid="ignore", divide="ignore"):
        weights = [np.sin((1 - share) * angle), np.sin(share * angle)] / np.sin(angle)
    close = np.broadcast_to(angle < 1e-6, weights[0].shape)
    low, high = np.where(close, 1 - share, weights[0]), np.where(close, share, weights[1])
    return low * first + high * second


def _rotated(quaternions: Floats, vectors: Floats) -> Floats:
    axis, w = quaternions[:, :3], quaternions[:, 3:]
    across = 2 * np.cross(axis, vectors)
    return vectors + w * across + np.cross(axis, across)


def _product(first: Floats, second: Floats) -> Floats:
    axis, w = first[:, :3], first[:, 3:]
    other, v = second[:, :3], second[:, 3:]
    vector = w * other + v * axis + np.cross(axis, other)
    return np.hstack([vector, w * v - (axis * other).sum(axis=1, keepdims=True)])
