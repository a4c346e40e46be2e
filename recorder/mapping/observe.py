"""Values of the mapped quantities at the times of the steps."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import UsageError
from mcaprl.recorder.bags.bag import Bag
from mcaprl.recorder.mapping.align import NONE, Matches, during, interpolated, last, nearest
from mcaprl.recorder.mapping.config import Quantity
from mcaprl.recorder.mapping.paths import FieldPath, as_numbers, field_path, topic_of
from mcaprl.recorder.mapping.rotations import yaw_of
from mcaprl.recorder.mapping.streams import Run, TopicStream
from mcaprl.recorder.mapping.transforms import Transforms, transform_topic

_QUATERNION = ("x", "y", "z", "w")
_ANGLES = ("roll", "pitch", "yaw")


class Values(NamedTuple):
    """A quantity at N steps.

    Attributes:
        values: (N,) or (N, K) numbers, NaN where missing, or (N,) texts; for images, (N,)
            indexes of their messages.
        missing: (N,) bool: whether there is no value.
        age_s: (N,) age of the value in seconds, NaN where missing.
    """

    values: NDArray[Any]
    missing: NDArray[np.bool_]
    age_s: NDArray[np.float64]


class Source(NamedTuple):
    """Topic and fields that contain a quantity.

    Attributes:
        topic: Topic that contains the quantity.
        fields: Fields to read; empty for images and transforms.
        path: Path of the field; None for images and transforms.
    """

    topic: str
    fields: tuple[str, ...]
    path: FieldPath | None


def source_of(bag: Bag, quantity: Quantity) -> Source:
    """Resolve the topic and fields of a quantity.

    Raises:
        UsageError: There is no such topic or field.
    """
    if quantity.image is not None:
        return Source(topic_of(bag, quantity.image), (), None)
    if quantity.transform is not None:
        return Source(transform_topic(bag, quantity.tf), (), None)
    assert quantity.field is not None, "the mapping was validated"
    if quantity.as_ == "count":
        return Source(topic_of(bag, quantity.field), (), None)
    path = field_path(bag, quantity.field)
    if quantity.as_ == "yaw":
        fields = tuple(f"{path.field}.{axis}" for axis in _QUATERNION)
        known = bag.topics[path.topic].fields
        if known and not set(fields) <= set(known):
            raise UsageError(f"{path} is not a quaternion with x, y, z and w")
        return Source(path.topic, fields, path)
    return Source(path.topic, (path.field,), path)


def pose_of(quantity: Quantity, transforms: Transforms, steps_ns: NDArray[np.int64]) -> Values:
    """Return the pose of a frame at the times of steps."""
    assert quantity.transform is not None, "the quantity is a transform"
    found, age_s = transforms.pose(
        quantity.transform,
        quantity.in_,
        steps_ns,
        quantity.align,
        quantity.tolerance_s,
        quantity.parts,
    )
    return _shaped(quantity, found, np.isnan(age_s), age_s)


def values_of(
    quantity: Quantity,
    source: Source,
    stream: TopicStream,
    run: Run,
    steps_ns: NDArray[np.int64],
    ends_ns: NDArray[np.int64] | None = None,
) -> Values:
    """Return a field or an image at the times of steps.

    Args:
        quantity: Quantity of the mapping.
        source: Topic and fields of the quantity.
        stream: Messages of the topic.
        run: Messages of the topic between two resets of the clock.
        steps_ns: (N,) times of the steps.
        ends_ns: (N,) ends of the steps. If given, each step uses the last message before its end;
            if None, `quantity.align` applies.

    Raises:
        UsageError: A field is not a number.
    """
    if quantity.as_ == "count":
        counts = np.searchsorted(run.times_ns, steps_ns, side="right").astype(np.float64)
        nothing = np.zeros(len(counts), bool)
        return _shaped(quantity, counts, nothing, nothing.astype(np.float64))
    if quantity.image is not None:
        match = _match(quantity, run, steps_ns, ends_ns)
        rows = _rows(run, match)
        return Values(rows, rows == NONE, match.age_s)
    column = _column(quantity, source, stream)
    if column.dtype.kind == "O":
        match = _match(quantity, run, steps_ns, ends_ns)
        rows = _rows(run, match)
        texts = np.full(len(rows), None, object)
        texts[rows != NONE] = column[rows[rows != NONE]]
        return Values(texts, rows == NONE, match.age_s)
    if quantity.align == "linear" and ends_ns is None:
        column = _unwrapped(quantity, column[run.rows])
        found, match = interpolated(run.times_ns, column, steps_ns, quantity.tolerance_s)
    else:
        match = _match(quantity, run, steps_ns, ends_ns)
        rows = _rows(run, match)
        found = np.full((len(rows), *column.shape[1:]), np.nan)
        found[rows != NONE] = column[rows[rows != NONE]]
    return _shaped(quantity, found, match.rows == NONE, match.age_s)


def _match(
    quantity: Quantity,
    run: Run,
    steps_ns: NDArray[np.int64],
    ends_ns: NDArray[np.int64] | None,
) -> Matches:
    if ends_ns is not None:
        return during(run.times_ns, steps_ns, ends_ns, quantity.tolerance_s)
    align = nearest if quantity.align == "nearest" else last
    return align(run.times_ns, steps_ns, quantity.tolerance_s)


def _rows(run: Run, match: Matches) -> NDArray[np.int64]:
    """Return the index in the topic of each step's message.

    For a step without a message, the index is `NONE`.
    """
    rows = np.full(len(match.rows), NONE)
    rows[match.rows != NONE] = run.rows[match.rows[match.rows != NONE]]
    return rows


def _column(quantity: Quantity, source: Source, stream: TopicStream) -> NDArray[Any]:
    """Return the field's column: numbers (M,) or (M, K), or texts (M,)."""
    assert source.path is not None, "the quantity is a field"
    if quantity.as_ == "yaw":
        parts = [as_numbers(stream.columns[name], str(source.path)) for name in source.fields]
        return yaw_of(np.column_stack(parts))
    column = stream.columns[source.path.field]
    if column.dtype.kind == "O" and all(isinstance(value, str) for value in column.tolist()):
        return column
    return source.path.select(as_numbers(column, str(source.path)))


def _unwrapped(quantity: Quantity, column: NDArray[np.float64]) -> NDArray[np.float64]:
    """Remove jumps of 2 pi from angles, because interpolation across a jump would be wrong."""
    is_angle = quantity.as_ == "yaw" or quantity.wrap_angle
    return np.unwrap(column, axis=0) if is_angle and len(column) else column


def _shaped(
    quantity: Quantity,
    found: NDArray[np.float64],
    missing: NDArray[np.bool_],
    age_s: NDArray[np.float64],
) -> Values:
    """Scale, wrap and clip values, and replace missing values."""
    found = found * quantity.scale + quantity.offset
    if quantity.wrap_angle or (quantity.as_ == "yaw" and quantity.align == "linear"):
        wrapped = (found + math.pi) % (2 * math.pi) - math.pi
        is_angle = quantity.transform is None or np.isin(quantity.parts, _ANGLES)
        found = np.where(is_angle, wrapped, found)
    if quantity.clip is not None:
        found = np.clip(found, *quantity.clip)
    has_gap = ~np.isfinite(found)
    missing = missing | (has_gap.any(axis=1) if found.ndim > 1 else has_gap)
    if quantity.missing is not None:
        found = np.where(np.isfinite(found), found, quantity.missing)
    return Values(found, missing, age_s)
