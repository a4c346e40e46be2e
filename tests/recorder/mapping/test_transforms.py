"""Poses from `/tf`, compared with poses calculated by hand."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mcaprl.errors import UsageError
from mcaprl.recorder.mapping.transforms import Transforms
from tests.support.memory_bag import SECOND_NS, MemoryBag

HALF = math.sqrt(0.5)


def transform(
    parent: str, child: str, x: float, y: float, quaternion: tuple[float, float] = (0.0, 1.0)
) -> Any:
    """Return a TransformStamped with a rotation about z, given as z and w."""
    z, w = quaternion
    return SimpleNamespace(
        header=SimpleNamespace(frame_id=parent, stamp=SimpleNamespace(sec=7, nanosec=0)),
        child_frame_id=child,
        transform=SimpleNamespace(
            translation=SimpleNamespace(x=x, y=y, z=0.0),
            rotation=SimpleNamespace(x=0.0, y=0.0, z=z, w=w),
        ),
    )


def bag(moving: list[tuple[float, list[Any]]], static: list[Any]) -> MemoryBag:
    times = [time for time, _ in moving]
    return MemoryBag(
        {
            "/tf": (times, {"transforms": objects([each for _, each in moving])}),
            "/tf_static": ([0.0], {"transforms": objects([static])}),
        }
    )


def objects(values: list[Any]) -> Any:
    column = np.empty(len(values), object)
    column[:] = values
    return column


STEPS_NS = np.array([0.5, 1.0, 2.0, 3.0]) * SECOND_NS


def test_chains_of_moving_and_static_frames() -> None:
    moving = [
        (1.0, [transform("map", "base", 10.0, 0.0)]),
        (3.0, [transform("map", "base", 10.0, 4.0, (HALF, HALF))]),
    ]
    transforms = Transforms(bag(moving, [transform("base", "camera", 1.0, 0.0)]))
    steps_ns = STEPS_NS.astype(np.int64)
    found, age_s = transforms.planar("camera", "map", steps_ns, "last", None)
    # There is no pose before the first message.
    assert np.isnan(found[0]).all()
    np.testing.assert_allclose(
        found[1:], [[11.0, 0.0, 0.0], [11.0, 0.0, 0.0], [10.0, 5.0, math.pi / 2]], atol=1e-12
    )
    np.testing.assert_allclose(age_s[1:], [0, 1, 0])
    # The pose of the map in the camera frame is the inverse.
    back, _ = transforms.planar("map", "camera", steps_ns, "last", None)
    np.testing.assert_allclose(back[3], [-5, 10, -math.pi / 2], atol=1e-12)
    between, _ = transforms.planar("base", "map", steps_ns, "linear", None)
    np.testing.assert_allclose(between[2], [10, 2, math.pi / 4], atol=1e-12)
    near, _ = transforms.planar("base", "map", steps_ns[:1], "nearest", None)
    np.testing.assert_allclose(near[0], [10, 0, 0])
    late, _ = transforms.planar("base", "map", steps_ns, "last", 0.5)
    assert np.isnan(late[2]).all()


def test_a_pose_between_is_missing_if_one_of_two_messages_is_too_far() -> None:
    moving = [(time, [transform("map", "base", time, 0.0)]) for time in (0.0, 1.0, 100.0)]
    steps_ns = (np.array([0.4, 1.4, 99.8, 100.0]) * SECOND_NS).astype(np.int64)
    found, age_s = Transforms(bag(moving, [])).planar("base", "map", steps_ns, "linear", 0.7)
    np.testing.assert_allclose(found[:, 0], [0.4, np.nan, np.nan, 100.0])
    assert np.isnan(age_s).tolist() == [False, True, True, False]


def test_wrong_trees_are_clear_errors() -> None:
    two = [(0.0, [transform("a", "base", 0, 0)]), (1.0, [transform("b", "base", 0, 0)])]
    with pytest.raises(UsageError, match="gives frame 'base' several parents: a, b"):
        Transforms(bag(two, []))
    one = Transforms(bag([(0.0, [transform("map", "base", 0, 0)])], []))
    with pytest.raises(UsageError, match="no path from frame 'base' to 'odom'; frames: base, map"):
        one.planar("base", "odom", STEPS_NS.astype(np.int64), "last", None)
    circle = [(0.0, [transform("a", "b", 0, 0), transform("b", "a", 0, 0)])]
    with pytest.raises(UsageError, match="cycle"):
        Transforms(bag(circle, [])).planar("a", "c", STEPS_NS.astype(np.int64), "last", None)
