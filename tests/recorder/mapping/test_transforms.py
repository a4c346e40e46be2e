"""Poses from `/tf`, compared with poses calculated by hand."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mcaprl.errors import UsageError
from mcaprl.recorder.mapping.config import parse_mapping
from mcaprl.recorder.mapping.read import MappedBag, read_open_bag
from mcaprl.recorder.mapping.runs import Run
from mcaprl.recorder.mapping.transforms import Transforms
from tests.support.memory_bag import SECOND_NS, MemoryBag

HALF = math.sqrt(0.5)


def transform(
    parent: str,
    child: str,
    x: float,
    y: float,
    quaternion: tuple[float, float] = (0.0, 1.0),
    stamp_s: int = 7,
) -> Any:
    """Return a TransformStamped with a rotation about z, given as z and w."""
    z, w = quaternion
    return SimpleNamespace(
        header=SimpleNamespace(frame_id=parent, stamp=SimpleNamespace(sec=stamp_s, nanosec=0)),
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


def test_ages_of_later_poses_are_negative() -> None:
    moving = [
        (time, [transform("map", "odom", time, 0.0), transform("odom", "base", 0.0, 0.0)])
        for time in (1.0, 9.0)
    ]
    transforms = Transforms(bag([*moving, (3.0, [transform("odom", "base", 0.0, 0.0)])], []))
    steps_ns = (np.array([0.0, 2.5, 8.0]) * SECOND_NS).astype(np.int64)
    for align, expected in (("nearest", [-1.0, 1.5, -1.0]), ("linear", [np.nan, 1.5, -1.0])):
        _, age_s = transforms.planar("base", "map", steps_ns, align, None)
        np.testing.assert_allclose(age_s, expected)


def read(bag: MemoryBag, **parts: Any) -> MappedBag:
    """Read the poses of `base` and the odometry, one step per second."""
    tree = {
        "clock": {"rate_hz": 1},
        "observation": {"p": {"transform": "base"}, "x": {"field": "/odom.data"}},
        "action": {"field": "/cmd.data"},
        **parts,
    }
    return read_open_bag(bag, parse_mapping(tree))


def test_a_static_transform_is_the_last_one_of_its_recording() -> None:
    class ThreeFiles(MemoryBag):
        def places(self, topic: str) -> Any:
            return np.array([[0, 0], [1, 0]])

    static = [[transform("base", "camera", x, 0.0)] for x in (1.0, 2.0)]
    transforms = Transforms(
        ThreeFiles({"/tf_static": ([0.0, 0.0], {"transforms": objects(static)})})
    )
    steps_ns = np.array([5 * SECOND_NS])
    for files, x in (((0, 1), 1.0), ((1, 2), 2.0), ((0, 2), 2.0), ((2, 3), math.nan)):
        within = transforms.within(Run(0, files, {}))
        found, _ = within.planar("camera", "base", steps_ns, "last", None)
        np.testing.assert_equal(found[0, 0], x)


def test_poses_are_those_of_the_run() -> None:
    times = [0.0, 1.0, 2.0, 3.0] * 2
    values = [0.0, 1.0, 2.0, 3.0, 1000.0, 1001.0, 1002.0, 1003.0]
    poses = [[transform("map", "base", value, 0.0)] for value in values]
    found = read(
        MemoryBag(
            {
                "/tf": (times, {"transforms": objects(poses)}),
                "/odom": (times, {"data": values}),
                "/cmd": (times, {"data": [0.0] * 8}),
            }
        )
    )
    assert found.dataset.observation_names == ("p_x", "p_y", "p_yaw", "x")
    assert found.dataset.observations[:, [0, 3]].tolist() == [
        [value, value] for value in (0, 1, 2, 1000, 1001, 1002)
    ]


def test_stamps_of_transforms_are_times() -> None:
    stamps = np.array([0, 1, 2, 3, 0, 1, 2, 3])
    log_times = (1000 + np.arange(8.0)).tolist()
    values = stamps + 10.0 * (np.arange(8) > 3)
    poses = [
        [transform("map", "base", value, 0.0, stamp_s=int(stamp))]
        for value, stamp in zip(values, stamps, strict=True)
    ]
    columns = {"data": values.tolist(), "header.stamp": stamps * SECOND_NS}
    nothing = {"data": [0.0] * 8, "header.stamp": stamps * SECOND_NS}
    found = read(
        MemoryBag(
            {
                "/tf": (log_times, {"transforms": objects(poses)}),
                "/odom": (log_times, columns),
                "/cmd": (log_times, nothing),
            }
        ),
        time="header",
    )
    assert found.report.clock_resets == 1
    assert found.dataset.observations[:, [0, 3]].tolist() == [
        [value, value] for value in (0, 1, 2, 10, 11, 12)
    ]


def test_a_pose_in_the_far_future_ends_an_episode() -> None:
    times = [float(k) for k in range(40)]
    at = [0.0, 1.0, 2.0, 39.0, 40.0]
    poses = [[transform("map", "base", time, 0.0)] for time in at]
    found = read(
        MemoryBag(
            {
                "/tf": (at, {"transforms": objects(poses)}),
                "/odom": (times, {"data": times}),
                "/cmd": (times, {"data": [0.0] * 40}),
            }
        ),
        observation={"p": {"transform": "base", "align": "nearest"}},
    )
    # With the default `gap_s` of 2, there are no steps between 2 s and 39 s.
    assert found.dataset.frames[:, 0].tolist() == [0, 1, 2]
    assert found.report.clock_steps == 5


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
