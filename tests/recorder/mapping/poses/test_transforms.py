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
    found, age_s = transforms.pose("camera", "map", steps_ns, "last", None)
    # There is no pose before the first message.
    assert np.isnan(found[0]).all()
    np.testing.assert_allclose(
        found[1:], [[11.0, 0.0, 0.0], [11.0, 0.0, 0.0], [10.0, 5.0, math.pi / 2]], atol=1e-12
    )
    np.testing.assert_allclose(age_s[1:], [0, 1, 0])
    # The pose of the map in the camera frame is the inverse.
    back, _ = transforms.pose("map", "camera", steps_ns, "last", None)
    np.testing.assert_allclose(back[3], [-5, 10, -math.pi / 2], atol=1e-12)
    between, _ = transforms.pose("base", "map", steps_ns, "linear", None)
    np.testing.assert_allclose(between[2], [10, 2, math.pi / 4], atol=1e-12)
    near, _ = transforms.pose("base", "map", steps_ns[:1], "nearest", None)
    np.testing.assert_allclose(near[0], [10, 0, 0])
    late, _ = transforms.pose("base", "map", steps_ns, "last", 0.5)
    assert np.isnan(late[2]).all()


def test_a_pose_between_is_missing_if_one_of_two_messages_is_too_far() -> None:
    moving = [(time, [transform("map", "base", time, 0.0)]) for time in (0.0, 1.0, 100.0)]
    steps_ns = (np.array([0.4, 1.4, 99.8, 100.0]) * SECOND_NS).astype(np.int64)
    found, age_s = Transforms(bag(moving, [])).pose("base", "map", steps_ns, "linear", 0.7)
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
        _, age_s = transforms.pose("base", "map", steps_ns, align, None)
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
        found, _ = within.pose("camera", "base", steps_ns, "last", None)
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
        Transforms(bag(two, [])).pose("base", "a", STEPS_NS.astype(np.int64), "last", None)
    one = Transforms(bag([(0.0, [transform("map", "base", 0, 0)])], []))
    with pytest.raises(UsageError, match="no path from frame 'base' to 'odom'; frames: base, map"):
        one.pose("base", "odom", STEPS_NS.astype(np.int64), "last", None)
    circle = [(0.0, [transform("a", "b", 0, 0), transform("b", "a", 0, 0)])]
    with pytest.raises(UsageError, match="cycle"):
        Transforms(bag(circle, [])).pose("a", "c", STEPS_NS.astype(np.int64), "last", None)


def test_odd_frames_beside_the_path_harm_nobody() -> None:
    first = [
        transform("map", "base", 1.0, 2.0),
        # A cup that is picked up, a circle above the map, a frame without rotation, a frame in
        # itself, and frames without names.
        transform("table", "cup", 0, 0),
        transform("north", "map", 0, 0),
        transform("map", "north", 0, 0),
        transform("base", "bad", 0, 0, (0.0, 0.0)),
        transform("base", "base", 9, 9),
        transform("", "base", 9, 9),
        transform("base", "", 9, 9),
    ]
    found = Transforms(bag([(0.0, first), (0.5, [transform("hand", "cup", 0, 0)])], []))
    steps_ns = STEPS_NS.astype(np.int64)
    pose, _ = found.pose("base", "map", steps_ns, "last", None)
    assert pose.tolist() == [[1, 2, 0]] * 4
    with pytest.raises(UsageError, match="frame 'cup' several parents: hand, table"):
        found.streams("cup", "map")
    with pytest.raises(UsageError, match="frame 'bad' no valid pose in 'base'"):
        found.streams("bad", "map")
    with pytest.raises(UsageError, match="has a cycle at frame 'north'"):
        found.streams("base", "north")


def test_one_bad_quaternion_makes_one_pose_missing() -> None:
    turns = [(0.0, 1.0), (0.0, 0.0), (math.nan, 1.0), (0.0, 2.0)]
    moving = [(float(k), [transform("map", "base", k, 0, turn)]) for k, turn in enumerate(turns)]
    steps_ns = (np.arange(4) * SECOND_NS).astype(np.int64)
    found, _ = Transforms(bag(moving, [])).pose("base", "map", steps_ns, "last", None)
    np.testing.assert_array_equal(found[:, 0], [0, np.nan, np.nan, 3])


def in_space(parent: str, child: str, position: Any, quaternion: Any) -> Any:
    """Return a TransformStamped in space; the quaternion is x y z w."""
    found = transform(parent, child, 0, 0)
    found.transform.translation = SimpleNamespace(**dict(zip("xyz", position, strict=True)))
    found.transform.rotation = SimpleNamespace(**dict(zip("xyzw", quaternion, strict=True)))
    return found


def matrix(position: Any, quaternion: Any) -> Any:
    """Return the (4, 4) matrix of a pose."""
    x, y, z, w = np.array(quaternion) / np.linalg.norm(quaternion)
    found = np.eye(4)
    found[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    found[:3, 3] = position
    return found


def test_poses_in_space_agree_with_matrices() -> None:
    random = np.random.default_rng(1)
    poses = [(random.normal(size=3), random.normal(size=4)) for _ in range(4)]
    names = [("map", "odom"), ("odom", "base"), ("base", "arm"), ("map", "dock")]
    edges = [in_space(*pair, *pose) for pair, pose in zip(names, poses, strict=True)]
    parts = ["qw", "qx", "qy", "qz", "z", "y", "x", "yaw", "pitch", "roll"]
    steps_ns = np.array([SECOND_NS])
    found, _ = Transforms(bag([(0.0, edges)], [])).pose(
        "/arm", "/dock", steps_ns, "last", None, parts
    )
    odom, base, arm, dock = (matrix(*pose) for pose in poses)
    expected = np.linalg.inv(dock) @ odom @ base @ arm
    w, x, y, z = found[0, :4]
    assert w >= 0
    np.testing.assert_allclose(matrix(found[0, [6, 5, 4]], [x, y, z, w]), expected, atol=1e-12)
    turn = expected[:3, :3]
    angles = [
        math.atan2(turn[1, 0], turn[0, 0]),
        -math.asin(turn[2, 0]),
        math.atan2(turn[2, 1], turn[2, 2]),
    ]
    np.testing.assert_allclose(found[0, 7:], angles, atol=1e-12)


def robots(*names: str, types: dict[str, str] | None = None) -> MemoryBag:
    """Return a bag whose robot k drives at k meters per second, with transforms on `NAME/tf`."""
    times = [0.0, 1.0, 2.0, 3.0]
    topics: dict[str, Any] = {
        "/odom": (times, {"data": times}),
        "/cmd": (times, {"data": [0.0] * 4}),
    }
    for speed, name in enumerate(names, start=1):
        poses = [[transform("odom", "base", speed * time, 0.0)] for time in times]
        static = [[transform("/map", "odom", 100.0 * speed, 0.0)]]
        topics[f"{name}/tf"] = (times, {"transforms": objects(poses)})
        topics[f"{name}/tf_static"] = ([0.0], {"transforms": objects(static)})
    return MemoryBag(topics, types=types)


def test_transforms_of_several_robots() -> None:
    one = read(robots("/robot1")).dataset
    assert one.observations[:, 0].tolist() == [100, 101, 102]
    poses = {
        "p": {"transform": "base", "tf": "/robot1/tf", "parts": ["x"]},
        "q": {"transform": "/base", "in": "/map", "tf": "/robot2/tf_static", "parts": ["yaw", "x"]},
    }
    two = read(robots("/robot1", "/robot2"), observation=poses).dataset
    assert two.observation_names == ("p_x", "q_yaw", "q_x")
    assert two.observations.tolist() == [[100, 0, 200], [101, 0, 202], [102, 0, 204]]
    # If the bag has `/tf`, it is the default.
    assert read(robots("", "/robot1")).dataset.observations[2, 0] == 102
    with pytest.raises(
        UsageError, match="choose one with `tf`; topics of transforms: /r1/tf, /r2/"
    ):
        read(robots("/r1", "/r2"))
    wrong = {"p": {"transform": "base", "tf": "/r3/tf"}}
    with pytest.raises(UsageError, match="no topic /r3/tf; topics of transforms: /r1/tf"):
        read(robots("/r1"), observation=wrong)
    wrong = {"p": {"transform": "base", "tf": "/odom"}}
    with pytest.raises(UsageError, match=r"/odom \(memory\) has no transforms; topics of transf"):
        read(robots("/r1"), observation=wrong)


def test_parts_are_for_transforms() -> None:
    for wrong, text in (
        ({"field": "/odom.data", "parts": ["x"]}, "parts is for transforms only"),
        ({"field": "/odom.data", "tf": "/tf"}, "tf is for transforms only"),
        ({"transform": "base", "parts": ["x", "x"]}, "parts has a part twice"),
        ({"transform": "base", "parts": []}, "at least 1 item"),
        ({"transform": "base", "parts": ["w"]}, "'x', 'y', 'z', 'roll'"),
    ):
        with pytest.raises(UsageError, match=text):
            read(robots(""), observation={"p": wrong})


def test_only_angles_of_a_pose_are_wrapped() -> None:
    moving = [[transform("map", "base", 10.0, 20.0, (1.0, 0.0))]] * 2
    found = read(
        MemoryBag(
            {
                "/tf": ([0.0, 1.0], {"transforms": objects(moving)}),
                "/odom": ([0.0, 1.0], {"data": [0.0, 1.0]}),
                "/cmd": ([0.0, 1.0], {"data": [0.0, 0.0]}),
            }
        ),
        observation={"p": {"transform": "base", "wrap_angle": True}},
        episodes={"min_steps": 1},
    )
    np.testing.assert_allclose(found.dataset.observations, [[10, 20, -math.pi]], rtol=1e-6)


def test_only_poses_of_used_frames_are_stored() -> None:
    # The parent of `odom` is unknown at the first poses of `odom`'s child, and others come later.
    moving = [
        (0.0, [transform("map", "odom", 1.0, 0.0), transform("map", "ball", 0.0, 0.0)]),
        (1.0, [transform("odom", "base", 1.0, 0.0), transform("map", "ball", 0.0, 0.0)]),
    ]
    found = Transforms(bag(moving, [transform("base", "arm", 1.0, 0.0)]), frames=["/arm", "map"])
    pose, _ = found.pose("arm", "map", np.array([SECOND_NS]), "last", None)
    assert pose.tolist() == [[3, 0, 0]]
    with pytest.raises(KeyError):
        found.streams("ball", "map")
