"""Rotations as unit quaternions (N, 4) x y z w."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_LOCK = 1e-6
"""Cosine of the pitch below which roll and yaw cannot be distinguished."""


def unit(quaternions: Floats) -> Floats:
    """Return quaternions of length 1; NaN for quaternions of length 0 or with infinite numbers."""
    with np.errstate(over="ignore", invalid="ignore"):
        sizes = np.linalg.norm(quaternions, axis=1, keepdims=True)
    is_valid = (sizes > 0) & np.isfinite(sizes)
    nothing = np.full_like(quaternions, np.nan)
    found: Floats = np.divide(quaternions, sizes, out=nothing, where=is_valid)
    return found


def euler_of(quaternions: Floats) -> Floats:
    """Return (N, 3) roll, pitch and yaw in radians; NaN for invalid quaternions.

    The rotation is that about the fixed axes x, y, z in this order, as in REP 103, so its matrix is
    Rz(yaw) Ry(pitch) Rx(roll). If the pitch is 90 degrees up or down, only the sum or difference of
    roll and yaw is known, and yaw is 0.
    """
    x, y, z, w = unit(quaternions).T
    # The first column of the matrix, and its elements [1, 1], [1, 2], [2, 1] and [2, 2].
    forward = (1 - 2 * (y * y + z * z), 2 * (w * z + x * y), 2 * (x * z - w * y))
    middle, above = 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    below, last = 2 * (w * x + y * z), 1 - 2 * (x * x + y * y)
    level = np.hypot(forward[0], forward[1])
    is_locked = level < _LOCK
    roll = np.where(is_locked, np.arctan2(-above, middle), np.arctan2(below, last))
    yaw = np.where(is_locked, 0.0, np.arctan2(forward[1], forward[0]))
    return np.column_stack([roll, np.arctan2(-forward[2], level), yaw])


def yaw_of(quaternions: Floats) -> Floats:
    """Return the (N,) yaw in radians, see `euler_of`; NaN for invalid quaternions."""
    return euler_of(quaternions)[:, 2]


def upper(quaternions: Floats) -> Floats:
    """Return the quaternion with w >= 0 of each rotation, because q and -q are the same rotation.

    If w is 0, the first number that is not 0 is positive.
    """
    ordered = quaternions[:, [3, 0, 1, 2]]
    first = np.take_along_axis(ordered, (ordered != 0).argmax(axis=1)[:, np.newaxis], axis=1)
    # Adding 0 turns -0.0 into 0.0.
    return np.where(first < 0, -quaternions, quaternions) + 0.0


def rotated(quaternions: Floats, vectors: Floats) -> Floats:
    """Rotate vectors (N, 3)."""
    axis, w = quaternions[:, :3], quaternions[:, 3:]
    across = 2 * np.cross(axis, vectors)
    return vectors + w * across + np.cross(axis, across)


def product(first: Floats, second: Floats) -> Floats:
    """Return the rotation by `second`, followed by the rotation by `first`."""
    axis, w = first[:, :3], first[:, 3:]
    other, v = second[:, :3], second[:, 3:]
    vector = w * other + v * axis + np.cross(axis, other)
    return np.hstack([vector, w * v - (axis * other).sum(axis=1, keepdims=True)])


def between(first: Floats, second: Floats, share: Floats) -> Floats:
    """Interpolate along the shorter arc (slerp); `share` (N, 1) is 0 at `first`, 1 at `second`."""
    cosine = (first * second).sum(axis=1, keepdims=True)
    second, cosine = np.where(cosine < 0, -second, second), np.abs(cosine).clip(max=1.0)
    angle = np.arccos(cosine)
    with np.errstate(invalid="ignore", divide="ignore"):
        weights = [np.sin((1 - share) * angle), np.sin(share * angle)] / np.sin(angle)
    close = np.broadcast_to(angle < 1e-6, weights[0].shape)
    low, high = np.where(close, 1 - share, weights[0]), np.where(close, share, weights[1])
    return low * first + high * second
