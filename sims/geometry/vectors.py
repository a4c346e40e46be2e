"""Compiled functions of vectors and rotations in three dimensions."""

from __future__ import annotations

import math
from typing import NamedTuple

from mcaprl.compiled import inlined


class Vector(NamedTuple):
    """Three coordinates; the name of the variable or field contains their unit."""

    x: float
    y: float
    z: float


class Quaternion(NamedTuple):
    """A rotation as a unit quaternion w + x i + y j + z k."""

    w: float
    x: float
    y: float
    z: float


@inlined
def plus(a: Vector, b: Vector) -> Vector:
    """Return a + b."""
    return Vector(a.x + b.x, a.y + b.y, a.z + b.z)


@inlined
def minus(a: Vector, b: Vector) -> Vector:
    """Return a - b."""
    return Vector(a.x - b.x, a.y - b.y, a.z - b.z)


@inlined
def times(factor: float, a: Vector) -> Vector:
    """Return the vector a multiplied by `factor`."""
    return Vector(factor * a.x, factor * a.y, factor * a.z)


@inlined
def dot(a: Vector, b: Vector) -> float:
    """Return the dot product."""
    return a.x * b.x + a.y * b.y + a.z * b.z


@inlined
def cross(a: Vector, b: Vector) -> Vector:
    """Return the cross product."""
    return Vector(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x)


@inlined
def norm(a: Vector) -> float:
    """Return the length."""
    return math.sqrt(dot(a, a))


@inlined
def product(p: Quaternion, q: Quaternion) -> Quaternion:
    """Return the rotation by q followed by the rotation by p."""
    return Quaternion(
        p.w * q.w - p.x * q.x - p.y * q.y - p.z * q.z,
        p.w * q.x + p.x * q.w + p.y * q.z - p.z * q.y,
        p.w * q.y - p.x * q.z + p.y * q.w + p.z * q.x,
        p.w * q.z + p.x * q.y - p.y * q.x + p.z * q.w,
    )


@inlined
def inverse(q: Quaternion) -> Quaternion:
    """Return the inverse rotation."""
    return Quaternion(q.w, -q.x, -q.y, -q.z)


@inlined
def unit(q: Quaternion) -> Quaternion:
    """Normalize a quaternion to length 1."""
    scale = 1.0 / math.sqrt(q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z)
    return Quaternion(scale * q.w, scale * q.x, scale * q.y, scale * q.z)


@inlined
def rotate(q: Quaternion, a: Vector) -> Vector:
    """Rotate a vector: a + 2 u x (u x a + w a), where u is the imaginary part of q."""
    axis = Vector(q.x, q.y, q.z)
    return plus(a, times(2.0, cross(axis, plus(cross(axis, a), times(q.w, a)))))
