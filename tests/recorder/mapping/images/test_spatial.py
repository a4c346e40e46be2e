"""Scans, point clouds and occupancy grids against numbers by hand, slow loops and rosbags."""

from __future__ import annotations

import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import mcaprl
from mcaprl.errors import LogError, UsageError
from mcaprl.recorder.bags.bag import TopicInfo, open_bag
from mcaprl.recorder.mapping.config import Place, Quantity, parse_mapping
from mcaprl.recorder.mapping.live import LiveEpisodes, LiveSteps, Topics
from mcaprl.recorder.mapping.plan import Plan
from mcaprl.recorder.mapping.robot import Robot
from mcaprl.recorder.mapping.spatial import (
    beams,
    cloud_points,
    fields_of,
    grid_image,
    grid_of,
    range_image,
    top_image,
)
from tests.support.stream_bag import FOXGLOVE_GRID, Sent, StreamBag

INF, NAN = math.inf, math.nan
TYPES = {
    "/scan": "sensor_msgs/msg/LaserScan",
    "/points": "sensor_msgs/msg/PointCloud2",
    "/map": "nav_msgs/msg/OccupancyGrid",
    "/cmd": "geometry_msgs/msg/Twist",
}


def read(sent: list[Sent], observation: dict[str, Any]) -> mcaprl.Dataset:
    """Return the transitions of messages, one step each second."""
    from mcaprl.recorder.mapping.config import Place
    from mcaprl.recorder.mapping.read import read_open_bag

    mapping = parse_mapping(
        {
            "clock": {"rate_hz": 1},
            "observation": observation,
            "action": {"fields": ["/cmd.linear.x"], "box": {"low": -1, "high": 1}},
        }
    )
    commands = [Sent(each.time_ns, "/cmd", {"linear": {"x": 0.0}}) for each in sent]
    bag: Any = StreamBag(TYPES, [*sent, *commands])
    return read_open_bag(bag, mapping, Place(), images="memory").dataset


def scan(k: int, ranges: list[float], low: float = 0.1, high: float = 30.0) -> Sent:
    return Sent(k * 10**9, "/scan", {"ranges": ranges, "range_min": low, "range_max": high})


def test_a_scan_by_hand() -> None:
    """0 and NaN are nothing, -inf is near, inf and 31 m are no returns."""
    rows = [[0, NAN, 2, 5, INF, INF, 31], [-INF, 1, NAN, 0, 3, 2, 30], [NAN, 0, 9, NAN, 0, 4, 4]]
    sent = [scan(k, row) for k, row in enumerate(rows)]
    found = read(sent, {"scan": {"scan": "/scan", "to": 3, "missing": 30.0}})
    # Seven beams in three sectors: 0 and 1, 2 and 3, 4 to 6.
    wanted: Any = [[30, 2, 30], [0.1, 30, 2], [30, 9, 4]]
    assert found.observations.tolist() == np.float32(wanted[:2]).tolist()
    assert found.next_observations[-1].tolist() == wanted[-1]
    every = read(sent, {"scan": {"scan": "/scan", "missing": 30.0}})
    assert every.observations[0].tolist() == [30, 30, 2, 5, 30, 30, 30]


def slow_sectors(ranges: list[float], low: float, high: float, count: int) -> list[float]:
    found = []
    for k in range(count):
        first = k * len(ranges) // count
        stop = max(first + 1, (k + 1) * len(ranges) // count)
        kept = []
        for each in ranges[first:stop]:
            if each == -INF:
                kept.append(low if low < high else 0.0)
            elif math.isnan(each) or each < (low if low < high else 0.0):
                continue
            else:
                kept.append(INF if low < high and each > high else each)
        best = min(kept, default=INF)
        found.append(7.5 if math.isinf(best) else best)
    return found


beam = st.one_of(
    st.floats(0, 40, width=32), st.sampled_from([0.0, NAN, INF, -INF, -1.0, 29.5, 31.0])
)


@settings(max_examples=60)
@given(st.lists(beam, min_size=1, max_size=40), st.integers(1, 12), st.booleans())
def test_sectors_equal_a_slow_reference(ranges: list[float], count: int, has_limits: bool) -> None:
    low, high = (0.5, 30.0) if has_limits else (0.0, 0.0)
    sent = [scan(k, ranges, low, high) for k in range(3)]
    found = read(sent, {"scan": {"scan": "/scan", "to": count, "missing": 7.5}})
    wanted = np.array(slow_sectors(ranges, low, high, count), np.float32)
    assert found.observations.reshape(2, -1)[0].tolist() == wanted.tolist()


def test_unknown_limits_are_not_used() -> None:
    row = np.array([0.0, -INF, 50.0, NAN])
    (found,) = beams([row], [None], [None])
    assert found is not None
    assert found.tolist()[:3] == [0.0, 0.0, 50.0]
    assert math.isnan(found[3])


DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


@st.composite
def clouds(draw: st.DrawFn) -> tuple[dict[str, Any], list[list[float]]]:
    """Return a cloud with padding and fields in any order, and all its points."""
    height, width = draw(st.integers(1, 4)), draw(st.integers(0, 5))
    names = draw(st.permutations(["x", "y", "z", "intensity", "ring"]))
    order, at, fields = draw(st.sampled_from("<>")), 0, []
    for name in names:
        at += draw(st.integers(0, 3))
        number = draw(st.sampled_from([7, 7, 8, *DATATYPES]))
        fields.append((name, at, number))
        at += np.dtype(DATATYPES[number]).itemsize
    step = at + draw(st.integers(0, 5))
    row_step = width * step + draw(st.integers(0, 9))
    data, points = bytearray(draw(st.binary(min_size=1, max_size=1)) * (height * row_step)), []
    for row in range(height):
        for column in range(width):
            point = {}
            for name, offset, number in fields:
                dtype = np.dtype(order + DATATYPES[number])
                values = st.integers(-9, 9) if dtype.kind != "u" else st.integers(0, 9)
                odd = st.sampled_from([NAN, INF, 0.0, 1.25, -7.5])
                value = np.array(draw(odd if dtype.kind == "f" else values)).astype(dtype)
                place = row * row_step + column * step + offset
                data[place : place + dtype.itemsize] = value.tobytes()
                point[name] = float(value)
            points.append([point[axis] for axis in "xyz"])
    message = {
        **{"height": height, "width": width, "point_step": step, "row_step": row_step},
        **{"is_bigendian": order == ">", "is_dense": False, "data": np.frombuffer(data, np.uint8)},
        "fields": [
            {"name": name, "offset": offset, "datatype": number, "count": 1}
            for name, offset, number in fields
        ],
    }
    return message, points


def flat(message: dict[str, Any]) -> dict[str, Any]:
    """Return a message as `cloud_points` gets it."""
    fields = message["fields"]
    parts = {f"fields[:].{key}": [each[key] for each in fields] for key in fields[0]}
    return {**message, **parts, "data": bytes(message["data"])}


@settings(max_examples=80)
@given(clouds())
def test_points_equal_those_that_were_packed(
    cloud: tuple[dict[str, Any], list[list[float]]],
) -> None:
    message, points = cloud
    wanted = [each for each in points if all(map(math.isfinite, each)) and any(each)]
    assert cloud_points(flat(message)).tolist() == wanted


def cloud_of(points: Any, height: int = 1) -> dict[str, Any]:
    """Return a cloud of float32 points."""
    data = np.asarray(points, np.float32).tobytes()
    fields = [
        {"name": axis, "offset": 4 * k, "datatype": 7, "count": 1} for k, axis in enumerate("xyz")
    ]
    width = len(points) // height
    sizes = {"height": height, "width": width, "point_step": 12, "row_step": 12 * width}
    return {**sizes, "is_bigendian": False, "fields": fields, "data": np.frombuffer(data, np.uint8)}


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"point_step": 0}, "0 bytes for each point"),
        ({"point_step": 8, "row_step": 8}, "field z is outside"),
        ({"width": 9, "row_step": 108}, "do not match"),
        ({"height": 2, "row_step": 4}, "do not match"),
        ({"width": 2**31, "height": 2**20}, "can be read"),
        ({"fields[:].name": ["x", "y", "h"]}, "without the field z"),
        ({"fields[:].datatype": [7, 7, 99]}, "unknown datatype 99"),
    ],
)
def test_damaged_clouds_are_clear_errors(change: dict[str, Any], expected: str) -> None:
    with pytest.raises(LogError, match=expected):
        cloud_points({**flat(cloud_of([[1, 2, 3], [4, 5, 6]])), **change})


def test_a_range_image_by_hand() -> None:
    """Four columns of 90 degrees from the back on the left, two rows: up and down."""
    quantity = Quantity.model_validate(
        {"cloud": "/points", "as": "range", "size": [4, 2], "elevation_deg": [-45, 45]}
    )
    points = np.array(
        [[1, 0.1, 0.1], [3, 0.1, 0.1], [0, -2, -0.5], [-1, -1e-9, 0.2], [0, 0, 5], [-2, 0, 0.2]]
    )
    found = range_image(quantity, points)
    wanted = np.zeros((2, 4))
    # Just left of ahead: azimuth 0 to 90; the nearer point wins.
    wanted[0, 1] = math.hypot(1, 0.1, 0.1)
    # To the right, below: azimuth -90 begins the last column.
    wanted[1, 3] = math.hypot(2, 0.5)
    # At the back: 180 degrees is the first column, and just beyond it the last one.
    wanted[0, 0], wanted[0, 3] = math.hypot(2, 0.2), math.hypot(1, 0.2)
    np.testing.assert_allclose(found, wanted, rtol=1e-6)


def slow_top(quantity: Quantity, points: Any) -> list[list[int]]:
    assert quantity.size
    assert quantity.x_m
    assert quantity.y_m
    assert quantity.z_m
    width, height = quantity.size
    (x0, x1), (y0, y1), (z0, z1) = quantity.x_m, quantity.y_m, quantity.z_m
    found = [[0] * width for _ in range(height)]
    for x, y, z in points:
        if x0 <= x <= x1 and y0 <= y <= y1 and z0 <= z <= z1:
            row = min(height - 1, math.floor((x1 - x) * (height / (x1 - x0))))
            column = min(width - 1, math.floor((y1 - y) * (width / (y1 - y0))))
            code = 1 + round(254 * (z - z0) / (z1 - z0))
            before = found[row][column]
            is_count = quantity.as_ == "density"
            found[row][column] = min(before + 1, 255) if is_count else max(before, code)
    return found


coordinate = st.integers(-60, 60).map(lambda each: each / 8)
point = st.tuples(coordinate, coordinate, coordinate)


@settings(max_examples=60)
@given(st.lists(point, max_size=30), st.sampled_from(["height", "density"]), st.integers(1, 7))
def test_birds_eye_views_equal_a_slow_reference(points: Any, kind: str, count: int) -> None:
    limits = {"x_m": [-2, 6], "y_m": [-4, 4], "z_m": [-1, 2]}
    quantity = Quantity.model_validate({"cloud": "/p", "as": kind, "size": [count, 4], **limits})
    found = top_image(quantity, np.array(points, float).reshape(-1, 3))
    assert found.tolist() == slow_top(quantity, points)


def test_forward_is_up_and_left_is_left() -> None:
    quantity = Quantity.model_validate(
        {"cloud": "/p", "as": "density", "size": [2, 2], "x_m": [0, 2], "y_m": [-1, 1]}
    )
    found = top_image(quantity, np.array([[1.5, 0.5, 9], [1.5, 0.6, -9], [0.5, -0.5, 0]]))
    assert found.tolist() == [[2, 0], [0, 1]]


def grid_message(
    rows: Any, cell_m: float = 1.0, x: float = 0.0, y: float = 0.0, yaw: float = 0.0
) -> Any:
    cells = np.array(rows, np.int8)
    turn = {"z": math.sin(yaw / 2), "w": math.cos(yaw / 2)}
    origin = {"position": {"x": x, "y": y}, "orientation": turn}
    info = {"width": cells.shape[1], "height": cells.shape[0], "resolution": cell_m}
    return {"info": {**info, "origin": origin}, "data": cells.reshape(-1)}


def flat_grid(message: Any) -> dict[str, Any]:
    info = message["info"]
    place, turn = info["origin"]["position"], info["origin"]["orientation"]
    return {
        **{f"info.{key}": info[key] for key in ("width", "height", "resolution")},
        **{f"info.origin.position.{axis}": place[axis] for axis in "xy"},
        **{f"info.origin.orientation.{axis}": turn.get(axis, 0.0) for axis in "xyzw"},
        "data": message["data"],
    }


def image_of_grid(keys: dict[str, Any], message: dict[str, Any], *pose: float) -> Any:
    around = {"around": ["pose"]} if pose else {}
    quantity = Quantity.model_validate({"grid": "/map", **around, **keys})
    where = np.array(pose) if pose else None
    return grid_image(quantity, grid_of(quantity, message), where).tolist()


def test_a_grid_by_hand() -> None:
    """Rows of a message go along y, its columns along x; in the image, x is up and y left."""
    message = flat_grid(grid_message([[0, 100, -1], [20, -1, -1]], x=-1))
    assert image_of_grid({}, message) == [[127, 127], [127, 255], [51, 0]]
    window = {"x_m": [-2, 2], "y_m": [0, 4], "size": [2, 2], "unknown": 40}
    # Pixels of 2 m: the largest known cell in each, 102 where none is known.
    assert image_of_grid(window, message) == [[102, 255], [102, 51]]
    # The grid is turned by 90 degrees to the left about (-1, 0): its x is y.
    turned = flat_grid(grid_message([[0, 100, -1], [20, -1, -1]], x=-1, yaw=math.pi / 2))
    window = {"x_m": [-3, -1], "y_m": [0, 3], "size": [3, 2], "unknown": 0}
    assert image_of_grid(window, turned) == [[0, 255, 0], [0, 0, 51]]
    # Finer pixels than cells.
    fine = {"x_m": [0, 0.5], "y_m": [0.5, 1.5], "size": [4, 2], "unknown": 100}
    assert image_of_grid(fine, message) == [[255, 255, 255, 255]] * 2


ROBOT: dict[str, Any] = {"size": [3, 2], "x_m": [0, 2], "y_m": [-1.5, 1.5]}


def test_a_grid_around_the_robot_by_hand() -> None:
    """The map has 3 x 3 cells of 1 m from (10, 20): 5 is the one around (11.5, 21.5)."""
    message = flat_grid(grid_message([[1, 2, 3], [4, 5, 6], [7, 8, -1]], x=10, y=20))
    code = {each: round(each * 2.55) for each in range(101)}

    def percents(keys: dict[str, Any], *pose: float) -> Any:
        found = image_of_grid({"unknown": 50, "outside": 100, **keys}, message, *pose)
        return [[next(p for p, c in code.items() if c == each) for each in row] for row in found]

    # From x = 10 on and y = 20 to 23; the first row is the far one, the first column the left one.
    assert percents(ROBOT, 10, 21.5) == [[8, 5, 2], [7, 4, 1]]
    # The same place, but ahead is y: left is smaller x.
    assert percents(ROBOT, 11.5, 20.0, math.pi / 2) == [[4, 5, 6], [1, 2, 3]]
    # Ahead is smaller x, and there are no more cells; left is smaller y.
    assert percents(ROBOT, 11, 21.5, math.pi) == [[100, 100, 100], [1, 4, 7]]
    # Without limits, pixels are cells, and the robot is in the middle one.
    assert percents({"size": [3, 3]}, 12.5, 22.5) == [[100] * 3, [100, 50, 6], [100, 8, 5]]
    assert percents({"size": [1, 1]}, 11.9, 21.1, 0.3) == [[5]]
    # The turned map has its rows along y: those of 1 at x = 9.5, those of 4 at x = 8.5.
    message = flat_grid(grid_message([[1, 2, 3], [4, 5, 6]], x=10, y=20, yaw=math.pi / 2))
    assert percents({"size": [3, 3]}, 9.5, 21.5) == [[100] * 3, [3, 2, 1], [6, 5, 4]]
    # Without `outside`, it is as unknown as what is not known.
    assert image_of_grid({"size": [1, 1], "unknown": 20}, message, 0, 0) == [[51]]
    window = {"size": [1, 1], "outside": 20, "x_m": [0, 1], "y_m": [0, 1]}
    assert image_of_grid(window, message) == [[51]]


def slow_grid(
    quantity: Quantity, rows: Any, cell_m: tuple[float, float], x: float, y: float, yaw: float
) -> Any:
    assert quantity.size
    assert quantity.x_m
    assert quantity.y_m
    width, height = quantity.size
    (x0, x1), (y0, y1) = quantity.x_m, quantity.y_m
    inside: dict[tuple[int, int], list[int]] = {}
    for j, row in enumerate(rows):
        for i, value in enumerate(row):
            u, v = (i + 0.5) * cell_m[0], (j + 0.5) * cell_m[1]
            px = x + math.cos(yaw) * u - math.sin(yaw) * v
            py = y + math.sin(yaw) * u + math.cos(yaw) * v
            if x0 <= px <= x1 and y0 <= py <= y1:
                r = min(height - 1, math.floor((x1 - px) * (height / (x1 - x0))))
                c = min(width - 1, math.floor((y1 - py) * (width / (y1 - y0))))
                inside.setdefault((r, c), []).append(value)
    found = []
    for r in range(height):
        for c in range(width):
            values = inside.get((r, c))
            if values is None:
                px = x1 - (r + 0.5) * (x1 - x0) / height - x
                py = y1 - (c + 0.5) * (y1 - y0) / width - y
                i = math.floor((math.cos(yaw) * px + math.sin(yaw) * py) / cell_m[0])
                j = math.floor((-math.sin(yaw) * px + math.cos(yaw) * py) / cell_m[1])
                is_cell = 0 <= i < len(rows[0]) and 0 <= j < len(rows)
                values = [rows[j][i]] if is_cell else []
            best = max((each for each in values if 0 <= each <= 100), default=50)
            found.append(round(best * 2.55))
    return np.array(found).reshape(height, width).tolist()


@settings(max_examples=60)
@given(
    st.integers(1, 6).flatmap(
        lambda count: st.lists(
            st.lists(st.integers(-3, 103), min_size=count, max_size=count), min_size=1, max_size=6
        )
    ),
    # Angles and places at which no center is on an edge.
    st.sampled_from([0.0, 0.3, -2.0]),
    st.sampled_from([0.37, -1.23]),
    st.tuples(st.integers(1, 9), st.integers(1, 9)),
)
def test_grids_equal_a_slow_reference(
    rows: Any, yaw: float, x: float, size: tuple[int, int]
) -> None:
    window = {"x_m": [-1.5, 2.5], "y_m": [-2, 1.7], "size": size}
    quantity = Quantity.model_validate({"grid": "/map", **window})
    grid = grid_of(quantity, flat_grid(grid_message(rows, 0.41, x, -0.61, yaw)))
    found = grid_image(quantity, grid)
    assert found.tolist() == slow_grid(quantity, rows, (0.41, 0.41), x, -0.61, yaw)


def test_damaged_grids_are_clear_errors() -> None:
    quantity, message = Quantity.model_validate({"grid": "/map"}), flat_grid(grid_message([[0, 1]]))
    for change in ({"info.width": 3}, {"info.resolution": NAN}, {"info.resolution": 0.0}):
        with pytest.raises(LogError, match="a grid"):
            grid_of(quantity, {**message, **change})


def layers(
    fields: list[tuple[str, int, int]],
    data: bytes,
    columns: int,
    strides: tuple[int, int],
    cell_m: tuple[float, float] = (1.0, 1.0),
    *pose: float,
) -> dict[str, Any]:
    """Return the fields of a foxglove.Grid: names, offsets and types; bytes per row and cell."""
    x, y, yaw = pose or (0.0, 0.0, 0.0)
    place = {"position.x": x, "position.y": y, "orientation.x": 0.0, "orientation.y": 0.0}
    place |= {"orientation.z": math.sin(yaw / 2), "orientation.w": math.cos(yaw / 2)}
    return {
        **{"column_count": columns, "cell_size.x": cell_m[0], "cell_size.y": cell_m[1]},
        **{"row_stride": strides[0], "cell_stride": strides[1], "data": data},
        **{f"pose.{name}": value for name, value in place.items()},
        **{f"fields[:].{key}": [each[k] for each in fields] for k, key in enumerate(_KEYS)},
    }


_KEYS = ("name", "offset", "type")
COST, HEIGHT = ("cost", 0, 1), ("height", 1, 4)
# Rows of two cells of 3 bytes, and 1 byte of padding: cost (uint8) and height (int16).
TWO = struct.pack("<BhBhxBhBhx", 0, -200, 51, 0, 254, 300, 255, 100)


def test_layers_by_hand() -> None:
    message = layers([COST, HEIGHT], TWO, 2, (7, 3), (1.0, 2.0), 10.0, 20.0, 0.0)
    # As from above: the far row is the second column, the left column is the second row.
    assert image_of_grid({"field": "cost"}, message) == [[255, 51], [254, 0]]
    # A costmap of 255, which is unknown, and of 254, which is occupied.
    keys = {"field": "cost", "range": [0, 254], "unknown": 40}
    assert image_of_grid(keys, message) == [[102, 51], [255, 0]]
    # -200 cm and 300 cm are outside of the range; clipped, they are its ends.
    height = {"field": "height", "range": [-100, 100]}
    assert image_of_grid(height, message) == [[255, 127], [127, 127]]
    assert image_of_grid({**height, "clip": [-100, 100]}, message) == [[255, 127], [255, 0]]
    assert image_of_grid({**height, "range": [100, -155]}, message) == [[0, 100], [127, 127]]
    # The padding of the last row may be missing, and so may the pose.
    plain = {each: None if each.startswith("pose.") else value for each, value in message.items()}
    plain["data"] = TWO[:-1]
    window = {"x_m": [0, 2], "y_m": [2, 4], "size": [1, 2], "field": "cost"}
    assert image_of_grid(window, plain) == [[255], [254]]
    assert image_of_grid({**window, "y_m": [22, 24]}, message) == [[127], [127]]
    window |= {"x_m": [10, 12], "y_m": [22, 24]}
    assert image_of_grid(window, message) == [[255], [254]]
    # Around a robot at the corner of all cells: pixels are as large as cells, 1 m by 2 m.
    around = {"size": [2, 2], "field": "cost", "outside": 0}
    assert image_of_grid(around, message, 11, 22) == [[255, 51], [254, 0]]
    # Ahead is y, left is smaller x: the robot looks from the second row at nothing.
    ahead = {**around, "x_m": [-2, 2], "y_m": [-1, 1]}
    assert image_of_grid(ahead, message, 11, 22, math.pi / 2) == [[254, 255], [0, 51]]


FORMS = "BbHhIifd"
"""Letters of struct for the types 1 to 8 of foxglove.PackedElementField."""


@settings(max_examples=60)
@given(st.data())
def test_layers_equal_a_slow_reference(data: st.DataObject) -> None:
    """Values of all types at any offset, one by one; then as an occupancy of these percents."""
    kind, columns, rows = (data.draw(st.integers(1, most)) for most in (8, 4, 4))
    form = FORMS[kind - 1]
    width, before, after = (struct.calcsize(form), *data.draw(st.tuples(*[st.integers(0, 3)] * 2)))
    step, padding = before + width + after, data.draw(st.integers(0, 3))
    strides = (columns * step + padding, step)
    packed = data.draw(st.binary(min_size=rows * strides[0], max_size=rows * strides[0]))
    keys: dict[str, Any] = {
        "range": data.draw(st.sampled_from([(0, 100), (50.5, -20), (-9e8, 9e8)]))
    }
    if data.draw(st.booleans()):
        keys["clip"] = (-5, 30)
    pose = (0.37, -0.61, data.draw(st.sampled_from([0.0, 0.3, -2.0])))
    window = {"x_m": [-1.5, 2.5], "y_m": [-2, 1.7], "size": [4, 3]}
    quantity = Quantity.model_validate({"grid": "/g", **window, **keys})
    message = layers([("v", before, kind)], packed, columns, strides, (0.41, 0.73), *pose)
    percents, (low, high) = list[list[float]](), keys["range"]
    for row in range(rows):
        percents.append([])
        for column in range(columns):
            at = row * strides[0] + column * step + before
            (value,) = struct.unpack_from(f"<{form}", packed, at)
            if "clip" in keys and not math.isnan(value):
                value = min(max(value, -5), 30)
            percents[-1].append(100 * (value - low) / (high - low))
    codes = [[round(each * 2.55) if 0 <= each <= 100 else -1 for each in row] for row in percents]
    grid = grid_of(quantity, message)
    assert grid.cells.tolist() == codes
    assert grid_image(quantity, grid).tolist() == slow_grid(quantity, percents, (0.41, 0.73), *pose)


def test_large_layers_are_scaled_in_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    packed = bytes(range(200))
    message = layers([("v", 0, 1)], packed, 10, (10, 1))
    monkeypatch.setattr("mcaprl.recorder.mapping.spatial._BLOCK", 25)
    found = grid_of(Quantity(grid="/g"), message).cells
    assert found.tolist() == np.arange(200).reshape(20, 10).tolist()


@pytest.mark.parametrize(
    ("change", "keys", "expected"),
    [
        ({}, {}, "has the fields cost, height: choose one of them by `field`"),
        ({}, {"field": "speed"}, "without the field speed, but with cost, height"),
        ({}, {"field": "height"}, "a grid of int16: set `range: .LOW, HIGH.`"),
        ({"fields[:].name": []}, {}, "the grid has the fields none"),
        ({"fields[:].type": [9, 4]}, {"field": "cost"}, "unknown datatype 9"),
        ({"fields[:].offset": [0, 2]}, {"field": "height"}, "outside of the 3 bytes"),
        ({"fields[:].offset": [-1, 0]}, {"field": "cost"}, "outside of the 3 bytes"),
        ({"fields[:].offset": [0]}, {"field": "cost"}, "the message is damaged"),
        ({"column_count": 0}, {"field": "cost"}, "a grid of 0 x 2 cells"),
        ({"column_count": 2**32 - 1}, {"field": "cost"}, "64000000 can be read"),
        ({"column_count": 3}, {"field": "cost"}, "3 columns of 3 bytes, with 7 bytes per row"),
        ({"cell_stride": 0}, {"field": "cost"}, "which do not match"),
        ({"row_stride": 0}, {"field": "cost"}, "with 0 bytes per row"),
        ({"row_stride": 13}, {"field": "cost"}, "has 14 bytes, which do not match"),
        ({"data": b""}, {"field": "cost"}, "a grid of 2 x 0 cells"),
        ({"cell_size.y": 0.0}, {"field": "cost"}, "cells of 1 x 0 m"),
        ({"cell_size.x": None}, {"field": "cost"}, "cells of nan x 1 m"),
        ({"pose.position.x": INF}, {"field": "cost", "around": ["p"], "size": [1, 1]}, "origin"),
    ],
)
def test_damaged_layers_are_one_clear_line(
    change: dict[str, Any], keys: dict[str, Any], expected: str
) -> None:
    quantity = Quantity.model_validate({"grid": "/g", **keys})
    message = {**layers([COST, HEIGHT], TWO, 2, (7, 3)), **change}
    with pytest.raises(LogError, match=expected) as error:
        grid_of(quantity, message)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        ("foxglove_msgs/msg/CompressedPointCloud", "Draco"),
        ("foxglove.CompressedPointCloud", "Draco"),
        ("point_cloud_interfaces/msg/CompressedPointCloud2", "Draco"),
        ("livox_ros_driver2/msg/CustomMsg", "Livox.*xfer_format"),
        ("livox_ros_driver/CustomMsg", "Livox"),
        ("sensor_msgs/msg/LaserScan", "expected sensor_msgs/PointCloud2"),
    ],
)
def test_other_clouds_are_refused_by_name(kind: str, expected: str) -> None:
    info = TopicInfo("/points", kind, "cdr", 1, 0, 0, {"data": "uint8[]"}, {})
    cloud = {"cloud": "/points", "as": "range", "size": [4, 2], "elevation_deg": [-45, 45]}
    with pytest.raises(UsageError, match=f"/points has .*{expected}") as error:
        fields_of(info, Quantity.model_validate(cloud))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ({"cloud": "/p"}, "needs `as`"),
        ({"cloud": "/p", "as": "range", "size": [2, 2]}, "needs `elevation_deg`"),
        ({"cloud": "/p", "as": "height", "size": [2, 2], "x_m": [0, 1], "y_m": [0, 1]}, "`z_m`"),
        ({"cloud": "/p", "as": "depth"}, "as: depth is not for cloud"),
        ({"grid": "/m", "z_m": [0, 1]}, "z_m is for height and density"),
        ({"grid": "/m", "x_m": [0, 1]}, "both x_m and y_m"),
        ({"grid": "/m", "x_m": [1, 0], "y_m": [0, 1]}, "lowest value"),
        ({"scan": "/s", "as": "yaw"}, "as: yaw is not for scan"),
        ({"scan": "/s", "pad": 3, "missing": 0}, "pad is for"),
        ({"scan": "/s", "size": [2, 2]}, "size is for"),
        ({"grid": "/m", "align": "linear"}, "cannot be interpolated"),
        ({"scan": "/s", "grid": "/m"}, "give one of"),
        ({"grid": "/m", "around": ["pose"]}, "around needs `size`"),
        ({"image": "/i", "outside": 0}, "outside is for grid"),
        ({"cloud": "/p", "field": "x"}, "give one of"),
        ({"scan": "/s", "range": [0, 1]}, "range is for images only"),
        ({"grid": "/g", "range": [1, 1]}, "two different values"),
    ],
)
def test_wrong_keys(keys: dict[str, Any], expected: str) -> None:
    with pytest.raises(ValueError, match=expected):
        Quantity.model_validate(keys)


CLOUD = {"as": "height", "size": [4, 4], "x_m": [0, 8], "y_m": [-4, 4], "z_m": [-1, 1]}


def write_bag(path: Path) -> tuple[Path, list[Any]]:
    """Write scans, organized clouds and grids with rosbags; return the points, too."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    types: Any = store.types
    random, clouds = np.random.default_rng(0), list[Any]()
    stamp = types["builtin_interfaces/msg/Time"](sec=0, nanosec=0)
    header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="lidar")
    vector = types["geometry_msgs/msg/Vector3"]
    pose = types["geometry_msgs/msg/Pose"](
        position=types["geometry_msgs/msg/Point"](x=-1.0, y=-1.0, z=0.0),
        orientation=types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
    )
    field = types["sensor_msgs/msg/PointField"]
    fields = [field(name=axis, offset=4 * k, datatype=7, count=1) for k, axis in enumerate("xyz")]
    with Writer(path, version=9) as writer:
        channels = {
            topic: writer.add_connection(topic, kind, typestore=store)
            for topic, kind in TYPES.items()
        }
        for step in range(12):
            points = random.uniform(-1, 9, (2, 30, 3)).astype(np.float32)
            points[0, :3] = [np.nan, 0, 1]
            clouds.append(points)
            ranges = random.uniform(0.5, 20, 40).astype(np.float32)
            ranges[5] = np.inf
            messages = {
                "/scan": types[TYPES["/scan"]](
                    header=header,
                    **dict.fromkeys(("angle_min", "angle_max", "angle_increment"), 0.1),
                    **dict.fromkeys(("time_increment", "scan_time"), 0.0),
                    **{"range_min": 0.1, "range_max": 25.0, "ranges": ranges},
                    intensities=np.zeros(0, np.float32),
                ),
                "/points": types[TYPES["/points"]](
                    header=header,
                    **{"height": 2, "width": 30, "fields": fields, "is_bigendian": False},
                    **{"point_step": 12, "row_step": 360, "is_dense": False},
                    data=np.frombuffer(points.tobytes(), np.uint8),
                ),
                "/map": types[TYPES["/map"]](
                    header=header,
                    info=types["nav_msgs/msg/MapMetaData"](
                        **{"map_load_time": stamp, "resolution": 0.5, "width": 6, "height": 4},
                        origin=pose,
                    ),
                    data=random.integers(-1, 101, 24).astype(np.int8),
                ),
                "/cmd": types[TYPES["/cmd"]](
                    linear=vector(x=step / 20, y=0.0, z=0.0), angular=vector(x=0.0, y=0.0, z=0.1)
                ),
            }
            for topic, message in messages.items():
                data = store.serialize_cdr(message, message.__msgtype__)
                writer.write(channels[topic], 10**9 + step * 10**8, data)
    return path, clouds


@pytest.mark.parametrize("storage", ["memory", "mapped"])
def test_a_bag_of_rosbags(tmp_path: Path, storage: Any) -> None:
    """The bag's points, as rosbags got them, give the same images."""
    path, clouds = write_bag(tmp_path / "bag")
    observation = {
        "beams": {"scan": "/scan", "to": 8, "missing": 25.0},
        "cloud": {"cloud": "/points", **CLOUD},
        "near": {"cloud": "/points", "as": "range", "size": [8, 4], "elevation_deg": [-60, 60]},
        "map": {"grid": "/map", "size": [5, 5], "x_m": [-1, 1], "y_m": [-1, 1]},
    }
    mapping = {
        "clock": {"rate_hz": 10},
        "observation": observation,
        "action": {"fields": ["/cmd.linear.x"], "box": {"low": -1, "high": 1}},
    }
    data = mcaprl.open(path, mapping=mapping, images=storage)
    images: Any = data.observations
    assert images["state"].shape == (11, 8)
    quantity = Quantity.model_validate(observation["cloud"])
    for step, points in enumerate(clouds[:11]):
        rows = points.reshape(-1, 3)
        finite = rows[np.isfinite(rows).all(axis=1)].astype(float)
        assert images["cloud"][step][..., 0].tolist() == slow_top(quantity, finite)
    assert images["near"][0].shape == (4, 8, 1)
    assert images["near"][0].dtype == np.float32
    assert images["map"][0].shape == (5, 5, 1)
    assert images["map"][0].dtype == np.uint8


def test_they_are_suggested(tmp_path: Path) -> None:
    path, _ = write_bag(tmp_path / "bag")
    text = mcaprl.suggest_mapping(path)
    assert "scan: /scan" in text
    assert "cloud: /points" in text
    assert "grid: /map" in text
    (tmp_path / "mapping.yaml").write_text(text)
    assert len(mcaprl.open(path, mapping=tmp_path / "mapping.yaml")) > 5
    # The lines of clouds and grids are comments that can be used as they are.
    lines = [
        line.replace("  # ", "  ", 1) if "cloud:" in line or "grid:" in line else line
        for line in text.splitlines()
    ]
    (tmp_path / "mapping.yaml").write_text("\n".join(lines))
    found: Any = mcaprl.open(path, mapping=tmp_path / "mapping.yaml").observations
    assert {each.shape[1:] for name, each in found.items() if name != "state"} == {
        (84, 84, 1),
    }


def test_clouds_of_foxglove(tmp_path: Path) -> None:
    """The numbers of the types differ from those of ROS; strides may have padding."""
    foxglove = pytest.importorskip("foxglove")
    from foxglove.messages import PackedElementField, PackedElementFieldNumericType, PointCloud

    context, path = foxglove.Context(), tmp_path / "points.mcap"
    points = foxglove.channels.PointCloudChannel("/points", context=context)
    number = {"type": "object", "properties": {"speed": {"type": "number"}}}
    commands = foxglove.Channel("/cmd", schema=number, context=context)
    kind = PackedElementFieldNumericType
    fields = [
        PackedElementField(name="z", offset=0, type=kind.Int16),
        PackedElementField(name="x", offset=2, type=kind.Float32),
        PackedElementField(name="y", offset=6, type=kind.Float64),
    ]
    dtype = np.dtype([("z", "<i2"), ("x", "<f4"), ("y", "<f8"), ("pad", "V3")])
    with foxglove.open_mcap(path, context=context):
        for step in range(10):
            rows = np.zeros(2, dtype)
            rows["x"], rows["y"], rows["z"] = [7.5, step], [3.5, -0.5], [1, -1]
            cloud = PointCloud(point_stride=17, fields=fields, data=rows.tobytes())
            points.log(cloud, log_time=10**18 + step * 10**8)
            commands.log({"speed": step / 10}, log_time=10**18 + step * 10**8)
    mapping = {
        "clock": {"rate_hz": 10},
        "observation": {"cloud": {"cloud": "/points", **CLOUD}},
        "action": {"fields": ["/cmd.speed"], "box": {"low": -1, "high": 1}},
    }
    found: Any = mcaprl.open(path, mapping=mapping).observations
    for step in range(9):
        want = slow_top(
            Quantity.model_validate({"cloud": "/points", **CLOUD}),
            [(7.5, 3.5, 1), (step, -0.5, -1)],
        )
        assert found[step][..., 0].tolist() == want


LAYER = {"grid": "/g", "field": "cost", "range": [0, 100], "unknown": 20}
LAYERED: dict[str, Any] = {
    "whole": LAYER,
    "ahead": {**LAYER, "size": [3, 2], "around": ["x", "y", "yaw"], "outside": 100},
}


def cells(step: int) -> Any:
    """Return the bytes of 2 rows of 3 cells of cost (int16) and flag (uint8)."""
    found = np.zeros((2, 3), [("cost", "<i2"), ("flag", "u1")])
    found["cost"] = [[step, 20, -1], [40, 50, 101]]
    return found.tobytes()


def write_protobuf(path: Path) -> None:
    foxglove = pytest.importorskip("foxglove")
    from foxglove import messages

    context, kinds = foxglove.Context(), messages.PackedElementFieldNumericType
    grids = foxglove.channels.GridChannel("/g", context=context)
    number = {name: {"type": "number"} for name in ("x", "yaw", "speed")}
    state = foxglove.Channel(
        "/state", schema={"type": "object", "properties": number}, context=context
    )
    fields = [
        messages.PackedElementField(name="cost", offset=0, type=kinds.Int16),
        messages.PackedElementField(name="flag", offset=2, type=kinds.Uint8),
    ]
    turn = messages.Quaternion(z=math.sqrt(0.5), w=math.sqrt(0.5))
    with foxglove.open_mcap(path, context=context):
        for step in range(6):
            grid = messages.Grid(
                pose=messages.Pose(position=messages.Vector3(x=10, y=20), orientation=turn),
                column_count=3,
                cell_size=messages.Vector2(x=1, y=1),
                row_stride=9,
                cell_stride=3,
                fields=fields,
                data=cells(step),
            )
            grids.log(grid, log_time=10**18 + step * 10**8)
            state.log({"x": 9.5, "yaw": 0.0, "speed": 0.1}, log_time=10**18 + step * 10**8)


def write_ros(path: Path) -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    state = "float64 x\nfloat64 yaw\nfloat64 speed\n"
    texts = {"foxglove_msgs/msg/Grid": FOXGLOVE_GRID, "my_msgs/msg/State": state}
    for kind, text in texts.items():
        store.register(get_types_from_msg(text, kind))
    types: Any = store.types
    field, geometry = types["foxglove_msgs/msg/PackedElementField"], "geometry_msgs/msg/"
    pose = types[f"{geometry}Pose"](
        position=types[f"{geometry}Point"](x=10.0, y=20.0, z=0.0),
        orientation=types[f"{geometry}Quaternion"](x=0.0, y=0.0, z=0.5**0.5, w=0.5**0.5),
    )
    with Writer(path, version=9) as writer:
        grids, states = (
            writer.add_connection(topic, kind, typestore=store)
            for topic, kind in zip(("/g", "/state"), texts, strict=True)
        )
        for step in range(6):
            grid = types["foxglove_msgs/msg/Grid"](
                timestamp=types["builtin_interfaces/msg/Time"](sec=0, nanosec=0),
                **{"frame_id": "map", "pose": pose, "column_count": 3},
                cell_size=types["foxglove_msgs/msg/Vector2"](x=1.0, y=1.0),
                **{"row_stride": 9, "cell_stride": 3},
                fields=[field(name="cost", offset=0, type=4), field(name="flag", offset=2, type=1)],
                data=np.frombuffer(cells(step), np.uint8),
            )
            state = types["my_msgs/msg/State"](x=9.5, yaw=0.0, speed=0.1)
            for channel, message in ((grids, grid), (states, state)):
                data = store.serialize_cdr(message, message.__msgtype__)
                writer.write(channel, 10**9 + step * 10**8, data)


@pytest.mark.parametrize("write", [write_protobuf, write_ros])
def test_layers_of_a_bag(tmp_path: Path, write: Any) -> None:
    """The grid is turned by 90 degrees about (10, 20): its rows go along y, its columns down x."""
    path = tmp_path / ("bag.mcap" if write is write_protobuf else "bag")
    write(path)
    tree = {
        "clock": {"rate_hz": 10},
        "observation": LAYERED,
        "fields": {
            "x": {"field": "/state.x"},
            "y": {"field": "/state.x", "offset": 12},
            "yaw": {"field": "/state.yaw"},
        },
        "action": {"fields": ["/state.speed"], "box": {"low": -1, "high": 1}},
    }
    data = mcaprl.open(path, mapping=tree)
    found: Any = data.observations
    robot = Robot.from_json(data.robot, "robot")
    plan = Plan(Topics(robot.topics), robot.mapping, Place(), trust_code=False)
    live, episodes = LiveSteps(plan, robot.shapes), LiveEpisodes(plan)
    with open_bag(path) as bag:
        messages = list(bag.messages())
    for step in range(5):
        # A driver sees the same.
        for each in messages[2 * step : 2 * step + 2]:
            live.push(each.topic, each.message, each.log_time_ns)
        seen: Any = episodes.see(live.step(messages[2 * step].log_time_ns), acts=True).observation
        for name in LAYERED:
            assert np.array_equal(seen[name], found[name][step]), name
        # Unknown, as -1 and 101 are, is 20 percent: 51.
        first = round(step * 2.55)
        assert found["whole"][step][..., 0].tolist() == [[51, 51], [127, 51], [102, first]]
        # Around (9.5, 21.5), the middle cell of the first row: ahead is x, left is larger y.
        assert found["ahead"][step][..., 0].tolist() == [[255, 255, 255], [51, 51, first]]
    wrong = {**tree, "observation": {"g": {"grid": "/g"}}}
    with pytest.raises(LogError, match="the fields cost, flag: choose one of them by `field`"):
        mcaprl.open(path, mapping=wrong)
    # The suggestion chooses the first field, and its range in the middle message.
    with pytest.warns(UserWarning, match="no action yet"):
        text = mcaprl.suggest_mapping(path)
    assert "grid: /g, size: [84, 84], field: cost, range: [-1, 101]" in text


def test_occupancy_has_no_fields() -> None:
    bag: Any = StreamBag(TYPES, [])
    quantity = Quantity.model_validate({"grid": "/map", "field": "data"})
    with pytest.raises(UsageError, match="OccupancyGrid, without fields: remove field"):
        fields_of(bag.topics["/map"], quantity)
    scaled = {"range": [0, 50], "clip": [0, 50]}
    message = flat_grid(grid_message([[25, 100, -1]]))
    assert image_of_grid(scaled, message) == [[127], [255], [127]]
