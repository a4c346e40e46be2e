"""Poses of coordinate frames in other frames, from the transforms of a bag."""

from __future__ import annotations

import math
from collections.abc import Iterator
from copy import copy
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import UsageError
from mcaprl.recorder.bags.bag import Bag
from mcaprl.recorder.mapping.align import NONE, NS_PER_S, last, nearest, time_order
from mcaprl.recorder.mapping.config import TimeSource
from mcaprl.recorder.mapping.runs import Recorded, Run

Floats = NDArray[np.float64]

TF, TF_STATIC = "/tf", "/tf_static"


class _Pose(NamedTuple):
    """Pose of a frame in its parent: position, and quaternion x y z w."""

    parent: str
    time_ns: int
    place: list[int]
    position: list[float]
    quaternion: list[float]
    is_static: bool


class _Edge(NamedTuple):
    """Poses of a frame in its parent: times (M,), positions (M, 3), quaternions (M, 4) x y z w.

    The (M, 2) places are those of the messages; see `Bag.places`.
    """

    parent: str
    times_ns: NDArray[np.int64]
    places: NDArray[np.int64]
    positions: Floats
    quaternions: Floats
    is_static: bool

    def at(self, rows: NDArray[np.int64]) -> _Edge:
        """Return the poses `rows`."""
        return self._replace(
            times_ns=self.times_ns[rows],
            places=self.places[rows],
            positions=self.positions[rows],
            quaternions=self.quaternions[rows],
        )


class Transforms:
    """Tree of the coordinate frames of a bag."""

    def __init__(self, bag: Bag, time: TimeSource = "log_time") -> None:
        """Read all transforms.

        Args:
            bag: Bag with `/tf`, `/tf_static` or both.
            time: Time of a transform; `header` is the stamp of each transform.
        """
        found: dict[str, list[_Pose]] = {}
        for topic in (TF, TF_STATIC):
            if topic in bag.topics and bag.topics[topic].count:
                for child, pose in _poses(bag, topic, time):
                    found.setdefault(child, []).append(pose)
        self._recorded = {child: _edge(child, poses) for child, poses in found.items()}
        self._edges = {
            child: edge.at(time_order(edge.times_ns)) for child, edge in self._recorded.items()
        }

    def streams(self, frame: str, fixed: str) -> dict[str, Recorded]:
        """Return the moving transforms between two frames, in the order of recording, by name.

        Raises:
            UsageError: No transforms connect the frames.
        """
        return {
            _name(child): self._recorded[child]
            for part in self._path(frame, fixed)
            for child in part
            if not self._recorded[child].is_static
        }

    def within(self, run: Run) -> Transforms:
        """Return the transforms of a run; a static transform is the last one of its recording."""
        found = copy(self)
        found._edges = {}
        for child, edge in self._recorded.items():
            if _name(child) in run.streams:
                found._edges[child] = edge.at(run.streams[_name(child)].rows)
            else:
                first, stop = np.searchsorted(edge.places[:, 0], run.files)
                found._edges[child] = edge.at(np.arange(first, stop)[-1:])
        return found

    def planar(
        self,
        frame: str,
        fixed: str,
        steps_ns: NDArray[np.int64],
        align: str,
        tolerance_s: float | None,
        gap_s: float = math.inf,
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
            gap_s: Longest gap, in seconds, across which a transform is interpolated or taken from a
                later message.

        Returns:
            (N, 3) x, y and yaw, NaN where missing; and (N,) age in seconds of the transform that is
            farthest in time, negative if that transform is later than the step.

        Raises:
            UsageError: No transforms connect the frames.
        """
        count = len(steps_ns)
        age_s = np.zeros(count)
        poses = []
        for part in self._path(frame, fixed):
            position, turn = np.zeros((count, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))
            for name in part:
                at, rotation, age = _at(self._edges[name], steps_ns, align, tolerance_s, gap_s)
                position, turn = at + _rotated(rotation, position), _product(rotation, turn)
                is_older = np.isnan(age) | (np.abs(age) > np.abs(age_s))
                age_s = np.where(is_older, age, age_s)
            poses.append((position, turn))
        (at, turn), (origin, back) = poses
        inverse = back * [-1.0, -1.0, -1.0, 1.0]
        position, rotation = _rotated(inverse, at - origin), _product(inverse, turn)
        return np.column_stack([position[:, :2], yaw_of(rotation)]), age_s

    def _path(self, frame: str, fixed: str) -> tuple[list[str], list[str]]:
        """Return the frames from each of two frames up to their common ancestor, without it."""
        above, below = self._chain(frame), self._chain(fixed)
        common = next((each for each in above if each in below), None)
        if common is None:
            known = sorted({*self._edges, *(edge.parent for edge in self._edges.values())})
            raise UsageError(
                f"/tf has no path from frame '{frame}' to '{fixed}'; frames:"
                f" {', '.join(known[:12])}"
            )
        return above[: above.index(common)], below[: below.index(common)]

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


def _name(child: str) -> str:
    return f"frame '{child}' in {TF}"


def _poses(bag: Bag, topic: str, time: TimeSource) -> Iterator[tuple[str, _Pose]]:
    """Yield each frame and its pose, in the order of recording."""
    fields = ["transforms", *(["publish_time"] if time == "publish_time" else [])]
    stream = bag.read(topic, fields)
    places = bag.places(topic)[stream.rows]
    times_ns = stream.columns.get("publish_time", stream.log_time_ns)
    is_static = topic == TF_STATIC
    for time_ns, place, transforms in zip(
        times_ns.tolist(), places.tolist(), stream.columns["transforms"], strict=True
    ):
        for each in transforms:
            stamp, pose = each.header.stamp, each.transform
            own_ns = stamp.sec * 10**9 + stamp.nanosec if time == "header" else time_ns
            at, turn = pose.translation, pose.rotation
            parent, child = (
                name.removeprefix("/") for name in (each.header.frame_id, each.child_frame_id)
            )
            position, quaternion = [at.x, at.y, at.z], [turn.x, turn.y, turn.z, turn.w]
            yield child, _Pose(parent, own_ns, place, position, quaternion, is_static)


def _edge(child: str, poses: list[_Pose]) -> _Edge:
    parents = sorted({pose.parent for pose in poses})
    if len(parents) > 1:
        raise UsageError(f"/tf gives frame '{child}' several parents: {', '.join(parents)}")
    poses = sorted(poses, key=lambda pose: pose.place)
    turns = np.array([pose.quaternion for pose in poses], np.float64)
    sizes = np.linalg.norm(turns, axis=1, keepdims=True)
    return _Edge(
        parent=parents[0],
        times_ns=np.array([pose.time_ns for pose in poses], np.int64),
        places=np.array([pose.place for pose in poses], np.int64),
        positions=np.array([pose.position for pose in poses], np.float64),
        quaternions=np.divide(turns, sizes, out=np.full_like(turns, np.nan), where=sizes > 0),
        is_static=all(pose.is_static for pose in poses),
    )


def _at(
    edge: _Edge,
    steps_ns: NDArray[np.int64],
    align: str,
    tolerance_s: float | None,
    gap_s: float,
) -> tuple[Floats, Floats, Floats]:
    """Return the pose of a frame in its parent at the times of steps: position, rotation, age."""
    if not len(edge.times_ns):
        nothing = np.full((len(steps_ns), 4), np.nan)
        return nothing[:, :3], nothing, nothing[:, 0]
    if edge.is_static:
        count = len(steps_ns)
        still = (np.tile(each[-1], (count, 1)) for each in (edge.positions, edge.quaternions))
        return (*still, np.zeros(count))  # type: ignore[return-value]
    if align == "nearest":
        match = nearest(edge.times_ns, steps_ns, tolerance_s, gap_s)
    else:
        match = last(edge.times_ns, steps_ns, tolerance_s)
    rows, is_none = np.maximum(match.rows, 0), match.rows == NONE
    positions, turns = edge.positions[rows], edge.quaternions[rows]
    age_s = match.age_s
    if align == "linear":
        after = np.minimum(rows + 1, len(edge.times_ns) - 1)
        span = np.maximum(edge.times_ns[after] - edge.times_ns[rows], 1)
        share = np.clip((steps_ns - edge.times_ns[rows]) / span, 0.0, 1.0)[:, np.newaxis]
        is_between = edge.times_ns[rows] != steps_ns
        is_none |= is_between & ((after == rows) | (span > gap_s * NS_PER_S))
        wait_s = (edge.times_ns[after] - steps_ns) / NS_PER_S
        if tolerance_s is not None:
            is_none |= is_between & (wait_s > tolerance_s)
        # As for fields, the age is that of the nearer one of the two poses.
        age_s = np.where(is_between & (wait_s < age_s), -wait_s, age_s)
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
