"""The mapping file: which fields of a bag are observations, actions, rewards and ends."""

from __future__ import annotations

import difflib
import keyword
import math
from collections.abc import Iterator
from collections.abc import Mapping as MappingOf
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    ValidationError,
    model_validator,
)

from mcaprl.errors import UsageError
from mcaprl.files import read_yaml
from mcaprl.limits import MAX_IMAGE_PIXELS
from mcaprl.recorder.format.spaces import MAX_ACTIONS
from mcaprl.recorder.mapping.expression import Expression

TimeSource = Literal["log_time", "publish_time", "header"]
Alignment = Literal["last", "nearest", "linear"]
_EXPRESSION_NAMES = ("action", "terminated", "truncated")
"""Names in expressions that are not quantities."""
Positive = Annotated[float, Field(gt=0)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
LARGEST = 3.4028234663852886e38
"""Largest number of float32, in which observations and actions are stored."""
Stored = Annotated[float, Field(ge=-LARGEST, le=LARGEST, allow_inf_nan=False)]
CommandValue = int | Finite | str
PosePart = Literal["x", "y", "z", "roll", "pitch", "yaw", "qx", "qy", "qz", "qw"]
As = Literal["yaw", "count", "depth", "intensity", "range", "height", "density"]
_Count = Annotated[int, Field(ge=1, le=2**16)]
_MAX_RATE_HZ, _MAX_STACK = 1e9, 1024


class _Part(BaseModel):
    """A part of the mapping; unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Stamp(_Part):
    """Time of a message in one of its fields."""

    field: str = Field(
        description="Path of the field, such as `/imu.timestamp`, or its path in the message."
    )
    unit: Literal["s", "ms", "us", "ns"] = Field(
        default="s", description="Unit of a number; a ROS or protobuf time needs none."
    )


def _form(value: Any) -> str:
    return "<name>" if isinstance(value, str) else "<field>"


MessageTime = Annotated[
    Annotated[TimeSource, Tag("<name>")] | Annotated[Stamp, Tag("<field>")], Discriminator(_form)
]
"""Time of a message; errors have no position for the alternatives, whose tags have brackets."""


class Clock(_Part):
    """Times of the steps: a fixed rate, or the messages of a topic."""

    rate_hz: Annotated[float, Field(gt=0, le=_MAX_RATE_HZ)] | None = Field(
        default=None, description="Steps per second."
    )
    topic: str | None = Field(default=None, description="Topic with one message for each step.")
    time: MessageTime | None = Field(
        default=None, description="Time of the topic's messages, if not that of the mapping."
    )

    @model_validator(mode="after")
    def _has_one(self) -> Clock:
        if (self.rate_hz is None) == (self.topic is None):
            raise ValueError("give either rate_hz or topic")
        if self.topic is None and self.time is not None:
            raise ValueError("time is for a clock with a topic")
        return self


class Quantity(_Part):
    """A named quantity: a field, an image or a transform, aligned with the steps."""

    field: str | None = Field(
        default=None,
        description="Path of a field, such as `/odom.twist.twist.linear.x`, `/scan.ranges[::10]`,"
        " `/low.motors[3].q` or, for a vector, `/low.motors[0:12].q`. With `grid`, the name of a"
        " field of the grid.",
    )
    names: str | list[str] | None = Field(
        default=None,
        description="Names of the elements to select, such as joints. Each element has the value of"
        " the last message that contains its name. Names of arrays in arrays are joined, as in"
        " `hip/position`. One name without brackets selects a number. Without `names`, the names"
        " must not change; `[]` selects by position, whatever the names are.",
    )
    names_from: str | None = Field(
        default=None,
        description="Field of the message that contains the names, such as `joint_names` or"
        " `items[:].id`. By default, it is found next to the field.",
    )
    elements: list[str] = Field(
        default=[],
        description="Names of the elements of a vector, in their order, such as `[forward, left]`,"
        " for the names of the observation: `NAME_forward`. Unlike `names`, they select nothing."
        " Default: their indexes, or `names`.",
    )
    pad: _Count | None = Field(
        default=None,
        description="Number of elements to which an array of any length is cut, or filled with the"
        " number in `missing`.",
    )
    pool: Literal["min", "max", "mean"] | None = Field(
        default=None,
        description="How an array of any length is reduced to `to` elements, as scans are: each is"
        " the `min`, `max` or `mean` of one of `to` equal sectors. NaN is ignored; `mean` ignores"
        " infinite elements, too.",
    )
    to: _Count | None = Field(default=None, description="Number of sectors of `pool`.")
    image: str | None = Field(
        default=None,
        description="Topic of images (Image, CompressedImage) or of a video (CompressedVideo,"
        " FFMPEGPacket).",
    )
    scan: str | None = Field(
        default=None,
        description="Topic of lidar scans (LaserScan). A beam that is NaN or below `range_min`,"
        " such as 0, has no value; above `range_max`, it is infinite; -infinity, too near to be"
        " measured (REP 117), becomes `range_min`. `to` reduces the beams to sectors, by default by"
        " `pool: min`; `missing: 30.0` replaces the beams and sectors that have no value or are"
        " infinite.",
    )
    cloud: str | None = Field(
        default=None,
        description="Topic of point clouds (PointCloud2), which become images of `size`; see `as`."
        " Points that are not finite, or at the origin, are left out.",
    )
    grid: str | None = Field(
        default=None,
        description="Topic of grids (OccupancyGrid, foxglove.Grid), which become images (uint8, 0"
        " if free, 255 if occupied). A pixel has the largest known value of the cells in it. As in"
        " a bird's-eye view of a cloud, the first row has the largest x, the first column the"
        " largest y. `field` is the name of one of the fields of a foxglove.Grid, by default of the"
        " only one; its values are scaled by `range`.",
    )
    size: tuple[_Count, _Count] | None = Field(
        default=None,
        description="Width and height, pixels, of the image of a cloud or grid. Default for a grid:"
        " its number of cells.",
    )
    x_m: tuple[Finite, Finite] | None = Field(
        default=None,
        description="Lowest and highest x, meters, of a bird's-eye view, in the frame of the"
        " points, or of the window of a grid, in the grid's frame. Default for a grid: all of it.",
    )
    y_m: tuple[Finite, Finite] | None = Field(
        default=None, description="Lowest and highest y, meters, as `x_m`."
    )
    z_m: tuple[Finite, Finite] | None = Field(
        default=None,
        description="Lowest and highest z, meters, of the points in a bird's-eye view.",
    )
    azimuth_deg: tuple[Finite, Finite] = Field(
        default=(-180.0, 180.0),
        description="Lowest and highest azimuth of a range image, degrees; 0 is x, 90 is y. Left is"
        " the highest one.",
    )
    elevation_deg: tuple[Finite, Finite] | None = Field(
        default=None,
        description="Lowest and highest elevation of a range image, degrees, from below.",
    )
    unknown: Annotated[float, Field(ge=0, le=100)] = Field(
        default=50.0,
        description="Percent of occupancy of unknown and missing cells of a grid: those with NaN,"
        " or a value outside of `range`, such as -1.",
    )
    outside: Annotated[float, Field(ge=0, le=100)] | None = Field(
        default=None,
        description="Percent of occupancy outside of a grid. Default: that of `unknown`.",
    )
    around: Annotated[list[str], Field(min_length=1, max_length=3)] | None = Field(
        default=None,
        description="Names of the quantities with the robot's pose in the frame of a grid: x, y"
        " (meters) and, to turn the image so that ahead is up, yaw (radians). `x_m` and `y_m` are"
        " then measured from the robot; without them, a pixel is as large as a cell, and the robot"
        " is in the middle. A pixel has the cell at its center. Like observed ones, these"
        " quantities are needed at each step.",
    )
    transform: str | None = Field(
        default=None,
        description="Frame whose pose is looked up in the transforms. A leading `/` of a frame is"
        " ignored.",
    )
    in_: str = Field(default="map", alias="in", description="Frame in which the pose is given.")
    parts: Annotated[list[PosePart], Field(min_length=1)] = Field(
        default=["x", "y", "yaw"],
        description="Parts of the pose, in this order: `x`, `y`, `z` in meters; `roll`, `pitch`,"
        " `yaw` in radians, about the fixed axes x, y, z in this order (REP 103), with a yaw of 0"
        " if the pitch is 90 degrees up or down; `qx`, `qy`, `qz`, `qw`, the unit quaternion with"
        " qw >= 0.",
    )
    tf: str | None = Field(
        default=None,
        description="Topic of the transforms, such as `/robot1/tf`; `/robot1/tf_static` is used,"
        " too. Default: `/tf`, or else the only topic of transforms in the bag.",
    )
    as_: As | None = Field(
        default=None,
        alias="as",
        description="`yaw` converts a quaternion to its angle about z, radians; `count` counts the"
        " messages so far on the topic that `field` names, for example a topic of events. For"
        " images: `depth` are distances, `intensity` is brightness or temperature. Without it,"
        " images of 16 bits per pixel (`mono16`, PNG) and of floats are depth. For clouds: `range`"
        " is an image of distances like depth, seen from the sensor; seen from above, `height` has"
        " the highest point of each cell (uint8, 0 if there is none, 1 to 255 between the limits of"
        " `z_m`), `density` the number of points (uint8).",
    )
    align: Alignment = Field(
        default="last",
        description="`last`: last message up to the step's time; `nearest`: nearest message;"
        " `linear`: linear interpolation. `nearest` and `linear` also use messages after the step.",
    )
    tolerance_s: Positive | None = Field(
        default=None, description="Age in seconds beyond which a value is missing."
    )
    time: MessageTime | None = Field(
        default=None, description="Time of the messages, if not that of the mapping."
    )
    missing: Stored | None = Field(
        default=None,
        description="Number that replaces missing values, and each element that is NaN or infinite."
        " Without it, a step is left out if an observed value or element is missing.",
    )
    scale: Finite = Field(default=1.0, description="Factor of the value.")
    offset: Finite = Field(default=0.0, description="Number added after scaling.")
    clip: tuple[float, float] | None = Field(
        default=None,
        description="Lowest and highest value. Infinite values are clipped, too; NaN is missing."
        " The cells of a grid are clipped before they are scaled by `range`.",
    )
    wrap_angle: bool = Field(default=False, description="Whether to wrap radians into [-pi, pi).")
    unit: str = Field(
        default="",
        description="Unit of the numbers in the messages, before `scale`, such as `m`, `m/s` or"
        " `rad`. Viewers then show them in this unit, as `NAME_m_s` of `/telemetry`. Default: the"
        " unit of common ROS types, of transforms, scans and `as: yaw`.",
    )
    undistort: str | None = Field(
        default=None,
        description="Topic of the camera's calibration (CameraInfo, foxglove.CameraCalibration), by"
        " which images are rectified before all else, as by `image_proc`.",
    )
    crop: tuple[int, int, _Count, _Count] | None = Field(
        default=None, description="Left, top, width and height of the cropped image, pixels."
    )
    resize: tuple[_Count, _Count] | None = Field(
        default=None, description="Width and height, pixels."
    )
    gray: bool = Field(default=False, description="Whether to convert colors to gray.")
    range_m: tuple[Finite, Finite] | None = Field(
        default=None,
        description="Depths in meters that become 0 and 255; without it, depth stays in meters.",
    )
    range: tuple[Finite, Finite] | None = Field(
        default=None,
        description="Values of an image with `as: intensity` that become 0 and 255; without it,"
        " values of 16 bits and floats stay as they are, in float32. For a grid, those of its"
        " cells: by default 0 and 100 of an OccupancyGrid, 0 and 255 of uint8; other fields of a"
        " foxglove.Grid need it.",
    )

    @model_validator(mode="after")
    def _has_one_source(self) -> Quantity:
        sources = ("field", "image", "transform", "scan", "cloud", "grid")
        given = [name for name in sources if getattr(self, name)]
        if given == ["field", "grid"]:
            # This is one of the fields of a grid.
            given = ["grid"]
        if len(given) != 1:
            raise ValueError(f"give one of {', '.join(sources)}")
        for name in ("undistort", "crop", "resize", "range_m", "range", "gray"):
            is_range = name == "range_m" and self.as_ == "range"
            is_range |= name == "range" and given == ["grid"]
            if getattr(self, name) and given != ["image"] and not is_range:
                raise ValueError(f"{name} is for images only")
        if self.as_ is not None and self.as_ not in _AS[given[0]]:
            raise ValueError(f"as: {self.as_} is not for {given[0]}")
        self._check_space(given[0])
        for name in ("parts", "tf"):
            # A saved mapping has the default values of all keys.
            default = type(self).model_fields[name].default
            if getattr(self, name) != default and given != ["transform"]:
                raise ValueError(f"{name} is for transforms only")
        if len(set(self.parts)) < len(self.parts):
            raise ValueError("parts has a part twice")
        if self.pixels is not None and self.align == "linear":
            raise ValueError("images cannot be interpolated: use last or nearest")
        if self.range is not None and self.as_ != "intensity" and self.grid is None:
            raise ValueError("range is for images with `as: intensity`; for depth, use range_m")
        if self.range_m is not None and self.as_ == "intensity":
            raise ValueError("range_m is for depth; with `as: intensity`, use range")
        if any(ends is not None and ends[0] == ends[1] for ends in (self.range, self.range_m)):
            raise ValueError("range and range_m need two different values")
        if self.resize is not None and math.prod(self.resize) > MAX_IMAGE_PIXELS:
            raise ValueError(f"resize is limited to {MAX_IMAGE_PIXELS} pixels")
        if self.clip is not None and not (_are_stored(*self.clip) and self.clip[0] < self.clip[1]):
            raise ValueError("clip must be the lowest value, then the highest value")
        self._check_elements(is_field=given == ["field"] and self.as_ is None)
        return self

    @property
    def pixels(self) -> str | None:
        """Topic whose messages become images; None if they are numbers."""
        return self.image or self.cloud or self.grid

    def _check_space(self, given: str) -> None:
        """Check the keys of clouds and grids."""
        kind = self.as_ if given == "cloud" else given
        uses = {
            "size": ("range", "height", "density", "grid"),
            "x_m": ("height", "density", "grid"),
            "y_m": ("height", "density", "grid"),
            "z_m": ("height", "density"),
            "azimuth_deg": ("range",),
            "elevation_deg": ("range",),
            "unknown": ("grid",),
            "outside": ("grid",),
            "around": ("grid",),
        }
        if given == "cloud" and kind is None:
            raise ValueError("cloud needs `as`: range, height or density")
        for name, kinds in uses.items():
            value = getattr(self, name)
            is_given = value != type(self).model_fields[name].default
            if is_given and kind not in kinds:
                raise ValueError(f"{name} is for {' and '.join(kinds)} of clouds and grids only")
            is_needed = given == "cloud" and (name != "z_m" or kind == "height")
            if value is None and kind in kinds and is_needed:
                raise ValueError(f"cloud with `as: {kind}` needs `{name}`")
            if name.endswith(("_m", "_deg")) and value is not None and not value[0] < value[1]:
                raise ValueError(f"{name} must be the lowest value, then the highest value")
        if (self.x_m is None) != (self.y_m is None):
            raise ValueError("give both x_m and y_m")
        if self.around is not None and self.size is None:
            raise ValueError("around needs `size`")
        if self.azimuth_deg[1] - self.azimuth_deg[0] > 360:
            raise ValueError("azimuth_deg is limited to 360 degrees")
        if self.size is not None and math.prod(self.size) > MAX_IMAGE_PIXELS:
            raise ValueError(f"size is limited to {MAX_IMAGE_PIXELS} pixels")

    def _check_elements(self, *, is_field: bool) -> None:
        for name in ("names", "names_from", "pad", "pool", "to"):
            is_scan = self.scan is not None and name in ("pool", "to")
            if getattr(self, name) is not None and not is_field and not is_scan:
                raise ValueError(f"{name} is for a `field` without `as` only")
        if self.scan is not None and self.to is not None and self.pool is None:
            return
        if (self.pool is None) != (self.to is None):
            raise ValueError("give both pool and to")
        if sum(bool(each) for each in (self.names, self.pad, self.pool)) > 1:
            raise ValueError("give one of names, pad and pool")
        if self.pad is not None and self.missing is None:
            raise ValueError("pad needs `missing`, the number that fills the array")
        if self.elements and (not is_field or self.names):
            raise ValueError("elements is for a `field` without `as` and without `names`")
        _check_names(self.elements, None)
        _check_names(self.names, self.names_from)


_AS: dict[str, tuple[As, ...]] = {
    "field": ("yaw", "count"),
    "image": ("depth", "intensity"),
    "cloud": ("range", "height", "density"),
    "transform": (),
    "scan": (),
    "grid": (),
}
"""Values of `as` by the source of a quantity."""


def _are_stored(*numbers: float) -> bool:
    """Return whether float32 can represent the numbers, which may be infinite."""
    return all(math.isinf(each) or abs(each) <= LARGEST for each in numbers)


def _check_names(names: str | list[str] | None, names_from: str | None) -> None:
    if isinstance(names, list) and len(set(names)) < len(names):
        raise ValueError(f"the name '{max(names, key=names.count)}' is given twice")
    if names_from is not None and not names:
        raise ValueError("names_from needs `names`")


class Limits(_Part):
    """Limits of continuous actions."""

    low: float | list[float] | None = Field(
        default=None,
        description="Lowest value of each element of the command, or of all of them; without it,"
        " the lowest of the transitions, with a warning.",
    )
    high: float | list[float] | None = Field(
        default=None,
        description="Highest value of each element of the command, or of all of them; without it,"
        " the highest of the transitions, with a warning.",
    )

    @model_validator(mode="after")
    def _are_in_order(self) -> Limits:
        low, high = (each if isinstance(each, list) else [each] for each in self.ends)
        if min(len(low), len(high)) != 1 and len(low) != len(high):
            raise ValueError(f"low has {len(low)} entries, but high has {len(high)}")
        count = max(len(low), len(high))
        low, high = (each * (count // len(each)) for each in (low, high))
        for number, (least, most) in enumerate(zip(low, high, strict=True)):
            # Gymnasium needs finite numbers between the limits.
            is_open = least < math.inf and most > -math.inf
            if not (_are_stored(least, most) and least <= most and is_open):
                raise ValueError(
                    f"low must not be above high: entry {number} is {least:g}, {most:g}"
                )
        return self

    @property
    def ends(self) -> tuple[float | list[float], float | list[float]]:
        """Lowest and highest values; infinite where the mapping has none."""
        low = -math.inf if self.low is None else self.low
        return low, math.inf if self.high is None else self.high


class Action(_Part):
    """The action of each step: a discrete field, or a command with `actions`, `edges` or `box`."""

    field: str | None = Field(
        default=None, description="Path of an integer, boolean or string field."
    )
    fields: list[str] = Field(
        default=[],
        description="Paths of the fields of a continuous command. A path may select several"
        " elements, such as `/cmd.position` or `/cmd.position[0:14]`.",
    )
    expressions: list[str] = Field(
        default=[],
        description="Elements of a continuous command as expressions of the quantities, such as"
        " `next(x) - x`; see `reward`. A step without a value of all of them has no action.",
    )
    names: dict[str, Annotated[int, Field(ge=0)]] | list[str] = Field(
        default={},
        description="Number of each action by its name; for a string field, the names are the"
        " values of the field. For `fields`, a list: names of the elements to select, such as"
        " joints; see the entries of observation.",
    )
    names_from: str | None = Field(
        default=None, description="Field of the message that contains the names of the elements."
    )
    actions: dict[str, list[Finite]] = Field(
        default={}, description="Named commands. The action is the nearest named command."
    )
    edges: list[list[Finite]] = Field(
        default=[],
        description="Bin edges of each element of the command, increasing. An action is a"
        " combination of bins, one for each element.",
    )
    bins: list[list[str]] = Field(
        default=[],
        description="With `edges`: names of the bins of each element, such as `[[slow, fast],"
        " [right, left]]`. An action is then called `slow, left`. Default: the limits of the bins.",
    )
    box: Limits | None = Field(
        default=None,
        description="Limits of a Box action; commands are clipped to them. `{}` takes the limits"
        " from the data.",
    )
    relative_to: str | None = Field(
        default=None,
        description="With `box`: name of the observed quantity that `bc` subtracts from the"
        " command to learn, in the same units, such as the measured positions of the joints."
        " Policies, drivers and logs have absolute commands all the same. The quantity has an"
        " element for each element of the command, or for each one that is not in `absolute`.",
    )
    absolute: list[str] = Field(
        default=[],
        description="With `relative_to`: names of the elements of the command that stay absolute,"
        " such as a gripper.",
    )
    units: list[str] = Field(
        default=[],
        description="With `box`: unit of each element of the command, such as `m/s`. Default: those"
        " of common types of messages, such as Twist and AckermannDrive.",
    )
    representatives: (
        dict[str, CommandValue | list[CommandValue]] | list[CommandValue | list[CommandValue]]
    ) = Field(
        default={},
        description="Command of each discrete action, by the name of the action, or as"
        " a list in the order of the actions; several fields have a list of values. Default: the"
        " named command, the value of the `field`, or with `edges` the median of the logged"
        " commands of the action, field by field. For an action that was never logged, it is the"
        " median of each field's bin, or else the middle of the bin, or the edge of an open bin.",
    )
    far: Positive = Field(
        default=0.25,
        description="Distance to the nearest named command above which a command is counted as far."
        " The difference in each field is divided by the field's range in the named commands. The"
        " largest of these ratios is the distance.",
    )
    align: Literal["during", "last", "nearest"] = Field(
        default="during",
        description="`during`: last command before the next step; `last`: last command up to the"
        " step's time; `nearest`: command nearest to the step's time.",
    )
    tolerance_s: Positive | None = Field(
        default=None, description="Age in seconds beyond which the command is missing."
    )
    time: MessageTime | None = Field(
        default=None, description="Time of the messages, if not that of the mapping."
    )

    @model_validator(mode="after")
    def _has_one_kind(self) -> Action:
        given = [name for name in ("field", "fields", "expressions") if getattr(self, name)]
        if len(given) != 1:
            raise ValueError("give either field or fields, or expressions")
        kinds = [bool(self.actions), bool(self.edges), self.box is not None]
        if given != ["field"] and sum(kinds) != 1:
            raise ValueError(f"{given[0]} need one of actions, edges and box")
        if given == ["field"] and any(kinds):
            raise ValueError("use actions, edges and box with `fields`, not with `field`")
        if self.selected is not None and given != ["fields"]:
            raise ValueError("a list of names is for `fields`")
        _check_names(self.selected, self.names_from)
        if self.relative_to is not None and self.box is None:
            raise ValueError("relative_to is for a command with box")
        if self.absolute and self.relative_to is None:
            raise ValueError("absolute is for a command with relative_to")
        if self.units and self.box is None:
            raise ValueError("units are for a command with box")
        if self.representatives and self.box is not None:
            raise ValueError("representatives are for discrete actions, not for box")
        least = len(self.fields or self.expressions)
        for name, length in self._lengths():
            # The elements of a field are counted when the bag is known.
            if length < least or (self.expressions and length > least):
                raise ValueError(f"{name} needs {least} entries, one for each of {given[0]}")
        if any(sorted(set(each)) != each for each in self.edges):
            raise ValueError("edges must rise")
        if self.bins and [len(each) - 1 for each in self.bins] != list(map(len, self.edges)):
            raise ValueError("bins need one name more than edges, for each element of the command")
        if any(len(set(each)) < len(each) for each in self.bins):
            raise ValueError("bins of an element need different names")
        count = math.prod(len(each) + 1 for each in self.edges)
        if count > MAX_ACTIONS:
            raise ValueError(f"edges have {count} combinations; at most {MAX_ACTIONS} are possible")
        return self

    @property
    def numbers(self) -> dict[str, int]:
        """Number of each discrete action by its name."""
        return self.names if isinstance(self.names, dict) else {}

    @property
    def selected(self) -> list[str] | None:
        """Names of the selected elements of `fields`; None if they are not selected by name."""
        return self.names if isinstance(self.names, list) else None

    def _lengths(self) -> list[tuple[str, int]]:
        """Return the number of elements that each command, the edges and the limits have."""
        found = [(f"the command '{name}'", len(each)) for name, each in self.actions.items()]
        if self.edges:
            found.append(("edges", len(self.edges)))
        if self.units:
            found.append(("units", len(self.units)))
        for name in ("low", "high"):
            limit = getattr(self.box, name, None)
            if isinstance(limit, list):
                found.append((name, len(limit)))
        return found

    def check_count(self, count: int) -> None:
        """Check that commands, edges and limits have an entry for each of `count` elements."""
        for name, length in self._lengths():
            if length != count:
                raise UsageError(
                    f"{name} needs {count} entries, one for each element of the command, not"
                    f" {length}"
                )


class Episodes(_Part):
    """Begin and end of the episodes; each condition is an expression, see `reward`."""

    per: Literal["recording"] | None = Field(
        default=None,
        description="`recording`: at most one episode for each recording (a file, or the parts of a"
        " split bag), its longest one. Without it, a recording may have several.",
    )
    begin: str | None = Field(
        default=None,
        description="Condition whose rising edge begins an episode. Without it, an episode begins"
        " at the next step with an observation and an action.",
    )
    end: str | None = Field(default=None, description="Condition that truncates the episode.")
    terminated: str | None = Field(default=None, description="Condition of a terminal state.")
    truncated: str | None = Field(default=None, description="Condition that truncates the episode.")
    reasons: dict[str, str] = Field(
        default={},
        description="Conditions by end reason. The first condition that is true at the end of an"
        " episode determines the reason of the episode.",
    )
    gap_s: Positive = Field(
        default=2.0,
        description="Longest gap, in seconds, in an observed topic within an episode. No value is"
        " interpolated, or taken from a later message, across a longer gap.",
    )
    max_steps: Annotated[int, Field(ge=1)] | None = Field(
        default=None, description="Number of steps after which an episode is truncated."
    )
    min_steps: Annotated[int, Field(ge=1)] = Field(
        default=2, description="Minimum number of steps; shorter episodes are dropped."
    )


class Meta(_Part):
    """Facts that a bag does not contain."""

    env_id: str = Field(
        default="", description="Gymnasium id of an environment that simulates the robot."
    )
    policy: str = Field(default="", description="Name of the policy that acted.")


class Drive(_Part):
    """What a policy may command when it drives the robot; it does not change what is learned."""

    stop: str | list[CommandValue] | None = Field(
        default=None,
        description="Command that stops the robot: a value for each element of the command, or the"
        " name of an action. Default: 0 for each number, which must be within the limits of a"
        " `box`, unless it is a velocity, an acceleration or a force by its message type.",
    )
    low: list[Finite] | Finite | None = Field(
        default=None,
        description="Lowest value of each element of the command, or of all of them; lower values"
        " are raised to it. Default: the limits of the `box`, or none.",
    )
    high: list[Finite] | Finite | None = Field(
        default=None,
        description="Highest value of each element of the command, or of all of them; higher values"
        " are lowered to it.",
    )
    max_change: list[Positive] | Positive | None = Field(
        default=None,
        description="Largest change of each element of the command in a second, or of all of them."
        " The stop command is not limited. Default: no limit.",
    )
    timeout_s: Positive | None = Field(
        default=None,
        description="Age in seconds of an observed value beyond which the robot stops. Default:"
        " `tolerance_s` of the quantity, or else `gap_s`.",
    )
    restart: bool = Field(
        default=False,
        description="Whether the robot drives on with the next episode after a terminal state."
        " Without it, it stops until the program is started again.",
    )


class Mapping(_Part):
    """Mapping of a bag's topics to transitions."""

    time: MessageTime = Field(
        default="log_time",
        description="Time of a message: `log_time`, `publish_time`, `header`, or a field with its"
        " unit, such as `{field: timestamp, unit: us}`.",
    )
    clock: Clock = Field(description="Times of the steps.")
    observation: dict[str, Quantity] = Field(description="Observed quantities by name.")
    stack: Annotated[int, Field(ge=1, le=_MAX_STACK)] = Field(
        default=1, description="Number of observations that are stacked, the oldest first."
    )
    fields: dict[str, Quantity] = Field(
        default={}, description="Quantities that are used in expressions but not observed."
    )
    action: Action = Field(description="Action of each step.")
    reward: str = Field(
        default="0",
        description="Expression that can use the names of quantities, `next(NAME)` for the value at"
        " the next step, `action`, and labels such as `labels.success` (docs/bags.md); or, if the"
        " mapping is trusted, a Python function `module:function`.",
    )
    episodes: Episodes = Field(default=Episodes(), description="Begin and end of the episodes.")
    behavior_prob: Quantity | None = Field(
        default=None,
        description="Probability of the action under the policy that acted, above 0 and at most 1."
        " Its `align` is that of the action by default.",
    )
    behavior_log_prob: Quantity | None = Field(
        default=None,
        description="Natural logarithm of the probability of the action, or of its density in the"
        " action's own units, which a `box` has; instead of `behavior_prob`.",
    )
    drive: Drive = Field(
        default=Drive(), description="What a policy may command when it drives the robot."
    )
    keep: list[str] = Field(
        default=[],
        description="Topics of the bag that `convert` and `annotate` copy into the log beside"
        " `/rl/*`, with their times, such as `[/camera/depth, /tf, /odom]`; `/camera/*` are all"
        " that begin so. Viewers show them. The argument `keep_topics` of both replaces this list.",
    )
    meta: Meta = Field(default=Meta(), description="Facts that the bag does not contain.")
    strict: bool = Field(
        default=False,
        description="Whether a message that cannot be decoded is an error; without it, the message"
        " is left out and reported.",
    )
    definitions: list[str] = Field(
        default=[],
        description="Folders or files with definitions (`.msg`, `.srv`, `.action`, `.idl`) of ROS"
        " types that the bag lacks, as in a rosbag2 database of a distribution before Iron. Paths"
        " are relative to the mapping file.",
    )

    @model_validator(mode="after")
    def _names_are_words(self) -> Mapping:
        if not self.observation:
            raise ValueError("observation has no entry")
        for name in (*self.observation, *self.fields):
            if not name.isidentifier():
                raise ValueError(f"'{name}' cannot be used in expressions: use letters, digits, _")
            if name in _EXPRESSION_NAMES or keyword.iskeyword(name):
                raise ValueError(f"'{name}' has another meaning in expressions: use another name")
        both = set(self.observation) & set(self.fields)
        if both:
            raise ValueError(f"'{min(both)}' is both in observation and in fields")
        for name, quantity in self.observation.items():
            for each in quantity.around or ():
                if each not in self.quantities or self.quantities[each].pixels is not None:
                    raise ValueError(f"around of {name}: no quantity with numbers is named {each}")
        if self.behavior_prob is not None and self.behavior_log_prob is not None:
            raise ValueError("give either behavior_prob or behavior_log_prob")
        if self.behavior_prob is not None and self.action.box is not None:
            raise ValueError("the actions of a box have densities: use behavior_log_prob")
        if self.behavior is not None and (
            self.behavior[1].field is None or self.behavior[1].grid is not None
        ):
            raise ValueError(f"{self.behavior[0]} must be a field")
        return self

    def without_labels(self) -> Mapping:
        """Return the mapping without conditions, reasons and a reward that use labels.

        It is the mapping of the robot itself, which has no labels, and of the episodes to label.
        """

        def uses(text: str | None) -> bool:
            # Other errors are those of the whole mapping.
            with suppress(UsageError):
                return text is not None and bool(Expression(text).labels)
            return False

        names = ("begin", "end", "terminated", "truncated")
        changes: dict[str, Any] = {n: None for n in names if uses(getattr(self.episodes, n))}
        reasons = {name: text for name, text in self.episodes.reasons.items() if not uses(text)}
        if len(reasons) < len(self.episodes.reasons):
            changes["reasons"] = reasons
        found: dict[str, Any] = {}
        if changes:
            found["episodes"] = self.episodes.model_copy(update=changes)
        if uses(self.reward):
            found["reward"] = "0"
        return self.model_copy(update=found) if found else self

    @property
    def behavior(self) -> tuple[str, Quantity] | None:
        """Key and quantity of the probability or log density; None if unknown."""
        keys = ("behavior_prob", "behavior_log_prob")
        given = ((key, getattr(self, key)) for key in keys)
        return next(((key, found) for key, found in given if found is not None), None)

    @property
    def quantities(self) -> dict[str, Quantity]:
        """All named quantities, beginning with the observed quantities."""
        return {**self.observation, **self.fields}


MAPPING_SECTIONS: dict[str, type[BaseModel]] = {
    "The file": Mapping,
    "clock": Clock,
    "time, if it is a field": Stamp,
    "An entry of observation or fields, behavior_prob and behavior_log_prob": Quantity,
    "action": Action,
    "action.box": Limits,
    "episodes": Episodes,
    "drive": Drive,
    "meta": Meta,
}
"""Pydantic models of the parts of a mapping, by section title of the reference documentation."""


class Place:
    """Line numbers of the keys of a mapping file, for error messages."""

    def __init__(self, path: str = "mapping", tree: Any = None) -> None:
        """Store the path of the file and its YAML tree. If the tree is None, keys have no line."""
        self.path, self._tree = path, tree

    @contextmanager
    def named(self, *keys: Any) -> Iterator[None]:
        """Add the position of a key to errors of the `with` block that have no position yet."""
        try:
            yield
        except UsageError as error:
            if str(error).startswith(self.path):
                raise
            raise UsageError(f"{self.of(*keys)}: {error}") from error

    def of(self, *keys: Any) -> str:
        """Return `FILE:LINE: key.key`.

        For a missing key, LINE is that of the closest existing parent.
        """
        tree: Any = self._tree
        line = None
        for key in keys:
            try:
                lines = getattr(tree, "lc")  # noqa: B009
                row, _ = lines.key(key) if isinstance(tree, dict) else lines.item(key)
                tree, line = tree[key], row + 1
            except (AttributeError, KeyError, IndexError, TypeError):
                break
        where = self.path if line is None else f"{self.path}:{line}"
        return f"{where}: {'.'.join(map(str, keys))}" if keys else where


def load_mapping(source: str | Path | MappingOf[str, Any]) -> tuple[Mapping, Place]:
    """Read and validate a mapping; return it with the positions of its keys."""
    if not isinstance(source, str | Path):
        return parse_mapping(source), Place()
    path = Path(source)
    tree = read_yaml(path, "bags", with_lines=True)
    place = Place(str(path), tree)
    if not isinstance(tree, dict):
        raise UsageError(f"{path}: a mapping has keys and values, such as `clock: {{rate_hz: 10}}`")
    found = parse_mapping(tree, place)
    folder = path.parent.absolute()
    paths = [str(folder / each) for each in found.definitions]
    for number, each in enumerate(paths):
        if not Path(each).exists():
            raise UsageError(f"{place.of('definitions', number)}: {each} does not exist")
    return found.model_copy(update={"definitions": paths}), place


def parse_mapping(tree: MappingOf[str, Any], place: Place | None = None) -> Mapping:
    """Validate the keys and values of a mapping."""
    place = place or Place()
    try:
        return Mapping.model_validate(tree)
    except ValidationError as error:
        texts = [_text(found, place) for found in error.errors()]
        raise UsageError("; ".join(texts)) from error


def _text(error: Any, place: Place) -> str:
    keys = tuple(key for key in error["loc"] if str(key)[:1] != "<")
    if error["type"] == "extra_forbidden":
        known = _keys_of(keys[:-1])
        near = difflib.get_close_matches(str(keys[-1]), known, n=3, cutoff=0.4) or known
        return f"{place.of(*keys)}: unknown key; nearest: {', '.join(near)}"
    if error["type"] == "missing":
        return f"{place.of(*keys)}: this key is missing"
    return f"{place.of(*keys)}: {error['msg'].removeprefix('Value error, ')}"


def _keys_of(parents: tuple[Any, ...]) -> list[str]:
    """Return the keys that a part of the mapping may have."""
    model: Any = Mapping
    for key in parents:
        field = model.model_fields.get(key) if hasattr(model, "model_fields") else None
        model = _model_in(field.annotation) if field is not None else model
    fields = getattr(model, "model_fields", {})
    return [found.alias or name for name, found in fields.items()]


def _model_in(annotation: Any) -> Any:
    """Return the model in an annotation such as `dict[str, Quantity]`."""
    if isinstance(annotation, type) and issubclass(annotation, _Part):
        return annotation
    parts = map(_model_in, getattr(annotation, "__args__", ()))
    return next((part for part in parts if part is not None), None)
