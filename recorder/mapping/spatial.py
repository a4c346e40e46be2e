"""Lidar scans, point clouds and grids as arrays of a fixed size.

Seen from above, x points up and y to the left, as a robot looks forward (REP 103): the first row of
an image has the largest x, the first column the largest y.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError, UsageError
from mcaprl.limits import MAX_IMAGE_PIXELS
from mcaprl.recorder.bags.bag import TopicInfo
from mcaprl.recorder.bags.values import Lack
from mcaprl.recorder.mapping.config import Quantity
from mcaprl.recorder.mapping.image_pixels import Pixels, one_line
from mcaprl.texts import shortened

Floats = NDArray[np.float64]

SCAN_LIMITS: Final = ("range_min", "range_max")
_NAME, _OFFSET = "fields[:].name", "fields[:].offset"
_CLOUD: Final = (
    *("height", "width", "point_step", "row_step", "is_bigendian"),
    *(_NAME, _OFFSET, "fields[:].datatype", "data"),
)
_FOXGLOVE_CLOUD: Final = ("point_stride", _NAME, _OFFSET, "fields[:].type", "data")
_POSE: Final = (
    *(f"position.{axis}" for axis in "xy"),
    *(f"orientation.{axis}" for axis in "xyzw"),
)
_GRID: Final = (
    *("info.width", "info.height", "info.resolution"),
    *(f"info.origin.{name}" for name in _POSE),
    "data",
)
_FOXGLOVE_GRID: Final = (
    *("column_count", "cell_size.x", "cell_size.y", "row_stride", "cell_stride"),
    *(_NAME, _OFFSET, "fields[:].type", *(f"pose.{name}" for name in _POSE), "data"),
)
# Datatypes of sensor_msgs/PointField and of foxglove.PackedElementField.
_ROS_TYPES: Final = dict(enumerate(("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"), 1))
_FOXGLOVE_TYPES: Final = dict(enumerate(("u1", "i1", "u2", "i2", "u4", "i4", "f4", "f8"), 1))
_BLOCK: Final = 1 << 20
"""Cells of a grid that are scaled at a time."""
_OUTSIDE: Final = -2
"""Pixel without a cell."""
_CODE: Final = 2.55
"""Code of one percent."""
_REFUSED: Final = {
    "CompressedPointCloud": "Draco-compressed clouds cannot be read: republish them raw, with"
    " `ros2 run point_cloud_transport republish`",
    "CompressedPointCloud2": "compressed clouds (Draco) cannot be read: republish them raw, with"
    " `ros2 run point_cloud_transport republish`",
    "CustomMsg": "the custom clouds of Livox cannot be read: set `xfer_format` to 0 in the driver,"
    " which then sends PointCloud2",
}


def why_refused(info: TopicInfo) -> str:
    """Return why clouds of a type cannot be read; empty if they are not known to be unreadable."""
    kind = info.type_name.replace("/", ".").rpartition(".")[2]
    if kind == "CustomMsg" and "livox" not in info.type_name:
        return ""
    return _REFUSED.get(kind, "")


def fields_of(info: TopicInfo, quantity: Quantity) -> tuple[str, ...]:
    """Return the fields of a message that an image of a cloud or grid needs.

    Raises:
        UsageError: The topic has neither clouds nor grids.
    """
    if why := why_refused(info):
        raise UsageError(f"{info.name} has {info.type_name}: {why}")
    is_grid = quantity.grid is not None
    wanted = (_GRID, _FOXGLOVE_GRID) if is_grid else (_CLOUD, _FOXGLOVE_CLOUD)
    known = {name.replace("[]", "[:]") for name in info.fields}
    for fields in wanted:
        if known.issuperset(fields):
            if fields is _GRID and quantity.field is not None:
                raise UsageError(f"{info.name} has {info.type_name}, without fields: remove field")
            return fields
    expected = "sensor_msgs/PointCloud2 or foxglove.PointCloud"
    if is_grid:
        expected = "nav_msgs/OccupancyGrid or foxglove.Grid"
    raise UsageError(f"{info.name} has {info.type_name}: expected {expected}")


def image_of(quantity: Quantity, message: dict[str, Any]) -> Pixels:
    """Return the image of a cloud or grid.

    Args:
        quantity: Quantity with `cloud` or `grid`.
        message: Values of the fields that `fields_of` returned; but for those of OccupancyGrid,
            `data` are bytes.

    Raises:
        LogError: The message is damaged.
    """
    try:
        if quantity.grid is not None:
            return Pixels(grid_image(quantity, grid_of(quantity, message)), "grid")
        points = cloud_points(message)
    except (TypeError, ValueError, OverflowError) as error:
        raise LogError(f"the message is damaged: {error}") from error
    if quantity.as_ == "range":
        return Pixels(range_image(quantity, points), "cloud", 1.0)
    return Pixels(top_image(quantity, points), "cloud")


def beams(
    ranges: Sequence[Floats | None], lows: Sequence[Any], highs: Sequence[Any]
) -> list[Floats | None]:
    """Return the beams of scans, in meters, without what is not measured.

    NaN is a beam without a measurement, and so is one below `range_min`, such as 0; above
    `range_max`, nothing was hit: infinity. -infinity, an object too near to be measured (REP 117),
    becomes `range_min`. Limits that are not positive and in order are unknown, and not used.

    Args:
        ranges: M arrays of ranges; None where a message has none.
        lows: (M,) `range_min` of the messages.
        highs: (M,) `range_max` of the messages.
    """
    return [
        None if row is None else _beams(row, low, high)
        for row, low, high in zip(ranges, lows, highs, strict=True)
    ]


def _beams(row: Floats, low: Any, high: Any) -> Floats:
    low, high = (float(each) if each is not None else np.nan for each in (low, high))
    if not 0 <= low < high:
        low, high = 0.0, np.inf
    is_near = row == -np.inf
    found = np.where(row < low, np.nan, np.where(row > high, np.inf, row))
    return np.where(is_near, low, found)


def cloud_points(message: dict[str, Any]) -> Floats:
    """Return the points (N, 3) of a cloud in its own frame, meters.

    Points that are not finite, or at the origin, are no returns: they are left out.
    """
    is_ros, data = "point_step" in message, message["data"]
    step = int(message["point_step" if is_ros else "point_stride"])
    if step < 1:
        raise LogError(f"a cloud of {step} bytes for each point")
    if is_ros:
        height, width = int(message["height"]), int(message["width"])
        row_step = int(message["row_step"]) if height > 1 else width * step
    else:
        height, width, row_step = 1, len(data) // step, len(data)
    if min(height, width) < 0 or height * width > MAX_IMAGE_PIXELS:
        raise LogError(f"a cloud of {width} x {height} points; {MAX_IMAGE_PIXELS} can be read")
    if not height * width:
        return np.empty((0, 3))
    # The padding of the last row may be missing.
    if row_step < width * step or (height - 1) * row_step + width * step > len(data):
        raise LogError(
            f"a cloud of {width} x {height} points of {step} bytes, with {row_step} bytes per row,"
            f" has {len(data)} bytes, which do not match"
        )
    found, strides = np.empty((height * width, 3)), (row_step, step)
    for k, axis in enumerate("xyz"):
        found[:, k] = _packed(message, axis, (height, width), strides, "cloud").reshape(-1)
    return found[np.isfinite(found).all(axis=1) & found.any(axis=1)]


def _packed(
    message: dict[str, Any], name: str, shape: tuple[int, int], strides: tuple[int, int], what: str
) -> NDArray[Any]:
    """Return a view (H, W) of a field of packed elements; the strides fit in the data."""
    is_ros = "fields[:].datatype" in message
    order = ">" if is_ros and message["is_bigendian"] else "<"
    types = message["fields[:].datatype" if is_ros else "fields[:].type"]
    layout = zip(message[_NAME], message[_OFFSET], types, strict=True)
    places = {str(each): (offset, kind) for each, offset, kind in layout}
    if name not in places:
        raise LogError(f"a {what} without the field {name}, but with {_listed(places)}")
    offset, number = map(int, places[name])
    kind = (_ROS_TYPES if is_ros else _FOXGLOVE_TYPES).get(number)
    if kind is None:
        raise LogError(f"the field {one_line(name)} of a {what} has the unknown datatype {number}")
    dtype = np.dtype(order + kind)
    if offset < 0 or offset + dtype.itemsize > strides[1]:
        raise LogError(
            f"the field {one_line(name)} is outside of the {strides[1]} bytes of each element"
        )
    return np.ndarray(shape, dtype, message["data"], offset, strides)


def _listed(names: Iterable[str]) -> str:
    return shortened(" ".join(", ".join(names).split()), 80) or "none"


def _cells(distance: Floats, span: float, count: int) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Return the cells of distances from an edge, and which are within the span, both ends too."""
    inside = (distance >= 0) & (distance <= span)
    places = np.floor(np.where(inside, distance, 0.0) * (count / span)).astype(np.intp)
    return np.minimum(places, count - 1), inside


def range_image(quantity: Quantity, points: Floats) -> NDArray[np.float32]:
    """Return the distances (H, W) of the nearest point in each direction, meters; 0 without one.

    The first row has the largest elevation above the plane of x and y, the first column the largest
    azimuth, which is 0 at x and 90 degrees at y.
    """
    assert quantity.size, "validated"
    assert quantity.elevation_deg, "validated"
    (width, height), (low, high) = quantity.size, quantity.elevation_deg
    right, left = quantity.azimuth_deg
    x, y, z = points.T
    flat = np.hypot(x, y)
    columns, is_column = _cells((left - np.degrees(np.arctan2(y, x))) % 360, left - right, width)
    rows, is_row = _cells(high - np.degrees(np.arctan2(z, flat)), high - low, height)
    inside = is_row & is_column
    found = np.full((height, width), np.inf)
    np.minimum.at(found, (rows[inside], columns[inside]), np.hypot(flat, z)[inside])
    return np.where(np.isfinite(found), found, 0.0).astype(np.float32)


def top_image(quantity: Quantity, points: Floats) -> NDArray[np.uint8]:
    """Return a bird's-eye grid (H, W) of the points between the limits.

    With `as: density`, a cell has the number of its points, at most 255. With `as: height`, it is 0
    if it is empty, or else 1 to 255: where its highest point is between the limits of z.
    """
    assert quantity.size, "validated"
    assert quantity.x_m, "validated"
    assert quantity.y_m, "validated"
    width, height = quantity.size
    (x_low, x_high), (y_low, y_high) = quantity.x_m, quantity.y_m
    z_low, z_high = quantity.z_m or (-np.inf, np.inf)
    x, y, z = points.T
    rows, is_row = _cells(x_high - x, x_high - x_low, height)
    columns, is_column = _cells(y_high - y, y_high - y_low, width)
    inside = is_row & is_column & (z >= z_low) & (z <= z_high)
    cells = (rows * width + columns)[inside]
    if quantity.as_ == "density":
        counts = np.bincount(cells, minlength=height * width)
        return np.minimum(counts, 255).astype(np.uint8).reshape(height, width)
    found = np.zeros(height * width, np.uint8)
    codes = 1 + np.rint(254 * (z[inside] - z_low) / (z_high - z_low))
    np.maximum.at(found, cells, codes.astype(np.uint8))
    return found.reshape(height, width)


class Grid(NamedTuple):
    """Values of the cells of a map.

    Attributes:
        cells: (H, W) codes from 0 to 255; -1 where the value is unknown.
        cell_m: (2,) edges of a cell along its rows and columns, meters.
        place: (2,) x and y of the corner of the first cell, meters.
        yaw: Angle of the rows to x, radians.
    """

    cells: NDArray[np.int16]
    cell_m: Floats
    place: Floats
    yaw: float


def grid_of(quantity: Quantity, message: dict[str, Any]) -> Grid:
    """Return a grid in its frame; if all of it is wanted, along its own axes.

    Raises:
        LogError: The message is damaged.
    """
    is_ros, place, yaw = "info.width" in message, np.zeros(2), 0.0
    sizes = ("info.resolution",) * 2 if is_ros else ("cell_size.x", "cell_size.y")
    try:
        values = _occupancy(message) if is_ros else layer_of(message, quantity.field)
        cell_m = np.array([_number(message[name]) for name in sizes])
        if quantity.x_m is not None or quantity.around is not None:
            origin = "info.origin." if is_ros else "pose."
            pose = np.array([_number(message[origin + name]) for name in _POSE])
            if not is_ros:
                # Protobuf may omit a pose, or a part of it, that is the origin.
                for part in (pose[:2], pose[2:]):
                    if np.isnan(part).all():
                        part[:] = 0.0
            place, yaw = pose[:2], _yaw(*pose[2:].tolist())
    except (TypeError, ValueError, OverflowError) as error:
        raise LogError(f"the message is damaged: {error}") from error
    if not ((cell_m > 0) & (cell_m < np.inf)).all():
        raise LogError(f"a grid with cells of {cell_m[0]:g} x {cell_m[1]:g} m")
    if not np.isfinite([*place, yaw]).all():
        raise LogError("the origin of a grid is not finite")
    limits = quantity.range or ((0.0, 100.0) if is_ros else (0.0, 255.0))
    if not is_ros and quantity.range is None and values.dtype != np.uint8:
        raise LogError(
            f"a grid of {values.dtype.name}: set `range: [LOW, HIGH]`, the values that become 0 and"
            " 255"
        )
    return Grid(_codes(values, quantity.clip, limits), cell_m, place, yaw)


def _occupancy(message: dict[str, Any]) -> NDArray[np.float32]:
    """Return the cells (H, W) of an OccupancyGrid, percent; NaN where it is unknown."""
    width, height = int(message["info.width"]), int(message["info.height"])
    data = np.asarray(message["data"], np.int16)
    if min(width, height) < 1 or width * height > MAX_IMAGE_PIXELS or width * height != data.size:
        raise LogError(f"a grid of {width} x {height} cells has {data.size} of them")
    known = np.where((data < 0) | (data > 100), np.float32(np.nan), data.astype(np.float32))
    return known.reshape(height, width)


def layer_of(message: dict[str, Any], name: str | None = None) -> NDArray[Any]:
    """Return the values (H, W) of a field of a foxglove.Grid, by default of its only one.

    Raises:
        LogError: The message is damaged, or has not one field.
    """
    width, data = int(message["column_count"]), message["data"]
    row_step, step = int(message["row_stride"]), int(message["cell_stride"])
    # The padding of the last row may be missing.
    height = -(-len(data) // max(row_step, 1))
    if not 0 < width * height <= MAX_IMAGE_PIXELS:
        raise LogError(f"a grid of {width} x {height} cells; 1 to {MAX_IMAGE_PIXELS} can be read")
    if step < 1 or row_step < width * step or (height - 1) * row_step + width * step > len(data):
        raise LogError(
            f"a grid of {width} columns of {step} bytes, with {row_step} bytes per row, has"
            f" {len(data)} bytes, which do not match"
        )
    names = [str(each) for each in message[_NAME]]
    if name is None and len(names) != 1:
        raise LogError(f"the grid has the fields {_listed(names)}: choose one of them by `field`")
    return _packed(message, name or names[0], (height, width), (row_step, step), "grid")


def _codes(
    values: NDArray[Any], clip: tuple[float, float] | None, limits: tuple[float, float]
) -> NDArray[np.int16]:
    """Return codes from 0 to 255 of values (H, W) between the limits; -1 of all others."""
    found = np.empty(values.shape, np.int16)
    rows = max(1, _BLOCK // values.shape[1])
    with np.errstate(all="ignore"):
        for k in range(0, len(values), rows):
            block = values[k : k + rows].astype(np.float64)
            if clip is not None:
                block = np.clip(block, *clip)
            percent = 100 * (block - limits[0]) / (limits[1] - limits[0])
            is_known = (percent >= 0) & (percent <= 100)
            found[k : k + rows] = np.where(is_known, np.rint(percent * _CODE), -1)
    return found


def grid_image(quantity: Quantity, grid: Grid, pose: Floats | None = None) -> NDArray[np.uint8]:
    """Return the codes (H, W) of a window of a grid, as of an occupancy: 0 if free, 255 if not.

    A pixel has the largest known code of the cells whose centers are in it; if there are no centers
    in it, that of the cell at its center. A pixel without a known cell has the code of `unknown`,
    or without any cell that of `outside`.

    Args:
        quantity: Quantity with `grid`.
        grid: The grid.
        pose: (2,) or (3,) x, y and yaw of the robot, around which the window is. A pixel then has
            the cell at its center.
    """
    (cells, cell_m, place, yaw), size = grid, quantity.size
    height, width = cells.shape
    x_m, y_m = quantity.x_m or (0.0, width * cell_m[0]), quantity.y_m or (0.0, height * cell_m[1])
    if pose is not None:
        heading = float(pose[2]) if len(pose) > 2 else 0.0
        place, yaw = (place - pose[:2]) @ _turn(heading), yaw - heading
        if size is not None and quantity.x_m is None:
            half = np.array(size[::-1]) * cell_m / 2
            x_m, y_m = zip(-half, half, strict=True)
    (columns, rows), turn = size or (height, width), _turn(yaw)
    # Centers of the pixels, in cells.
    xs = x_m[1] - (np.arange(rows) + 0.5) * (x_m[1] - x_m[0]) / rows
    ys = y_m[1] - (np.arange(columns) + 0.5) * (y_m[1] - y_m[0]) / columns
    centers = np.stack(np.meshgrid(xs, ys, indexing="ij"), axis=-1).reshape(-1, 2)
    u, v = np.floor((centers - place) @ turn / cell_m).T
    is_cell = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    found = np.full(rows * columns, _OUTSIDE, np.int16)
    found[is_cell] = cells[v[is_cell].astype(np.intp), u[is_cell].astype(np.intp)]
    if pose is None:
        _put_largest(found.reshape(rows, columns), grid, turn, x_m, y_m)
    outside = quantity.unknown if quantity.outside is None else quantity.outside
    unknown, outside = np.rint(np.array([quantity.unknown, outside]) * _CODE)
    found = np.where(found == _OUTSIDE, outside, np.where(found < 0, unknown, found))
    return found.astype(np.uint8).reshape(rows, columns)


def _put_largest(
    found: NDArray[np.int16],
    grid: Grid,
    turn: Floats,
    x_m: tuple[float, float],
    y_m: tuple[float, float],
) -> None:
    """Put the largest code of the cells with a center in a pixel into the pixels (H, W)."""
    (rows, columns), (height, width) = found.shape, grid.cells.shape
    cells, cell_m, place = grid[:3]
    # The cells that may be in the window.
    corners = np.array([[x, y] for x in x_m for y in y_m])
    ends = (corners - place) @ turn / cell_m
    (u0, v0), (u1, v1) = (
        np.clip(each, 0, (width, height)).astype(int)
        for each in (np.floor(ends.min(axis=0)), np.ceil(ends.max(axis=0)))
    )
    inner = np.stack(np.meshgrid(np.arange(u0, u1), np.arange(v0, v1)), axis=-1).reshape(-1, 2)
    x, y = (((inner + 0.5) * cell_m) @ turn.T + place).T
    row, is_row = _cells(x_m[1] - x, x_m[1] - x_m[0], rows)
    column, is_column = _cells(y_m[1] - y, y_m[1] - y_m[0], columns)
    inside = is_row & is_column
    pixels, values = (row * columns + column)[inside], cells[v0:v1, u0:u1].reshape(-1)[inside]
    # What is at a pixel's center counts only if no cell's center is in it.
    found.reshape(-1)[pixels] = -1
    np.maximum.at(found.reshape(-1), pixels, values)


def _turn(yaw: float) -> Floats:
    return np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])


def _number(value: Any) -> float:
    return np.nan if value is None or isinstance(value, Lack) else float(value)


def _yaw(x: float, y: float, z: float, w: float) -> float:
    return float(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))
