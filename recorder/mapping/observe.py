"""Values of the mapped quantities at the times of the steps."""

from __future__ import annotations

import difflib
import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import UsageError
from mcaprl.recorder.bags.bag import Bag, TopicInfo
from mcaprl.recorder.bags.values import (
    NAMES,
    PARALLEL,
    Lack,
    as_array,
    element_of,
    path_text,
    steps_of,
    texts_of,
    without_lacks,
)
from mcaprl.recorder.mapping.align import (
    NONE,
    FieldPath,
    Floats,
    Matches,
    TopicStream,
    as_numbers,
    check_lacks,
    during,
    field_path,
    interpolated,
    last,
    nearest,
    padded,
    path_in,
    pooled,
    rows_of,
    topic_of,
    unknown_field,
)
from mcaprl.recorder.mapping.config import LARGEST, Quantity
from mcaprl.recorder.mapping.runs import Messages
from mcaprl.recorder.mapping.spatial import SCAN_LIMITS, beams
from mcaprl.recorder.mapping.transforms import Transforms, transform_topic, yaw_of


class Named(NamedTuple):
    """Values of M messages.

    Attributes:
        values: (M,) or (M, K) numbers, or (M,) texts.
        present: (M,) or (M, K) flags of the values that are updates; of the others, the values
            before are valid. None if all are.
    """

    values: NDArray[Any]
    present: NDArray[np.bool_] | None


def names_field(info: TopicInfo, path: FieldPath, quantity: Quantity) -> str:
    """Return the field with the names of a path's elements; empty if there are none."""
    if quantity.names and path.elements is not None:
        raise UsageError(f"{path}: `names` selects the elements; remove the index or slice")
    if quantity.names_from is not None:
        field = path_in(path.topic, quantity.names_from)
        if not info.may_have(field.field):
            raise UsageError(f"{path.topic} ({info.type_name}) has no field '{field.field}'")
        return path_text(field.steps)
    if quantity.names is not None and not quantity.names:
        return ""
    found = _beside(info, path)
    if quantity.names and not found:
        raise UsageError(
            f"{path} has no names beside it; set `names_from` to the field that contains them"
        )
    return found


def _beside(info: TopicInfo, path: FieldPath) -> str:
    """Return the array of names that the type has beside an array, or in a message around it.

    If the type does not show it, this is the path of the names that the messages contain.
    """
    steps = steps_of(path.field)
    kind = info.fields.get(path.field)
    if kind is None or info.encoding == "json":
        return f"{path.field}{NAMES}"
    if "[" not in kind:
        return ""
    for count in range(len(steps) - 1, -1, -1):
        for name in PARALLEL:
            field = path_text((*steps[:count], name))
            if info.fields.get(field, "").startswith("string["):
                return field
    return ""


def by_names(
    path: FieldPath,
    column: NDArray[Any],
    texts: NDArray[Any],
    wanted: str | list[str],
    *,
    is_whole: bool = True,
) -> Named:
    """Return the elements with the wanted names.

    Args:
        path: Path of the field, for error messages.
        column: (M, K) numbers, or (M,) arrays of numbers.
        texts: (M,) lists of the names of the elements; None where a message has none.
        wanted: Names, or one name.
        is_whole: Whether these are all messages, so that one of them must have each name.

    Returns:
        Numbers (M, K) of K names, with the messages that contain them; (M,) for one name.
    """
    names = [wanted] if isinstance(wanted, str) else wanted
    values = np.full((len(column), len(names)), np.nan)
    present = np.zeros(values.shape, bool)
    known: dict[str, None] = {}
    for each, rows in _orders(column, texts).items():
        known |= dict.fromkeys(each)
        places = {name: place for place, name in enumerate(each)}
        for number, name in enumerate(names):
            if name not in places:
                continue
            if each.count(name) > 1:
                raise UsageError(f"{path}: message {rows[0]} has the name '{name}' twice")
            values[rows, number] = _elements(path, column, rows, places[name])
            present[rows, number] = True
    for name, is_found in zip(names, present.T, strict=True):
        if is_whole and len(column) and not is_found.any():
            near = difflib.get_close_matches(name, known, n=3, cutoff=0.4) or list(known)[:8]
            what = f"nearest: {', '.join(near)}" if near else "no message has names"
            raise UsageError(f"{path}: no message has an element '{name}'; {what}")
    return Named(values[:, 0], present[:, 0]) if isinstance(wanted, str) else Named(values, present)


def _orders(column: NDArray[Any], texts: NDArray[Any]) -> dict[tuple[str, ...], list[int]]:
    """Return the messages with each order of the names.

    Messages whose names are not those of the elements are left out.
    """
    found: dict[tuple[str, ...], list[int]] = {}
    length = column.shape[1] if column.ndim > 1 else None
    for row, names in enumerate(texts):
        listed = _flat_texts(names)
        if listed is None:
            continue
        if len(listed) == (_length(column[row]) if length is None else length):
            found.setdefault(tuple(listed), []).append(row)
    return found


def _flat_texts(value: Any) -> list[str] | None:
    """Return a string, an array of strings, or an array of such arrays as one list."""
    if isinstance(value, str):
        return [value]
    found = texts_of(value)
    if found is None and isinstance(value, list):
        parts = [texts_of(each) for each in value]
        return None if None in parts else [text for part in parts for text in part or ()]
    return found


def _length(value: Any) -> int:
    """Return the number of numbers in a value, which may be an array of arrays; -1 if unknown."""
    flat = _flat(value)
    return -1 if flat is None else len(flat)


def _flat(value: Any) -> Floats | None:
    found = None if value is None else as_array(value)
    if found is not None:
        return found.reshape(-1)
    # The lengths of the inner arrays differ.
    if not isinstance(value, list):
        return None
    parts = [np.empty(0) if each is None else as_array(each) for each in value]
    return (
        None
        if any(part is None for part in parts)
        else np.concatenate([np.ravel(part) for part in parts if part is not None] or [np.empty(0)])
    )


def _elements(path: FieldPath, column: NDArray[Any], rows: list[int], place: int) -> Any:
    if column.dtype.kind != "O":
        return column[rows, place] if column.ndim > 1 else column[rows]
    found = []
    for row in rows:
        flat = _flat(column[row])
        if flat is None:
            rows_of(column[[row]], str(path))
        found.append(np.nan if flat is None else flat[place])
    return found


def check_order(path: FieldPath, column: NDArray[Any], texts: NDArray[Any]) -> None:
    """Check that the names of the elements that a path selects do not change.

    Names of which a message has another number than it has elements are not those of the elements.

    Args:
        path: Path of the field.
        column: Values of the whole field.
        texts: (M,) names of its elements.
    """
    orders: dict[tuple[str, ...], int] = {}
    length = column.shape[1] if column.ndim > 1 else None
    last: Any = None
    if texts.dtype.kind != "O":
        # All messages have empty arrays of names.
        return
    for row, names in enumerate(texts):
        count = _length(column[row]) if length is None else length
        # Nearly always, the names are those of the message before.
        if count < 1 or (length is not None and names == last):
            continue
        last = names
        listed = _flat_texts(names)
        if listed is None or len(listed) != count:
            return
        if path.elements is not None:
            found = element_of(listed, path.elements)
            listed = [] if isinstance(found, Lack) else _flat_texts(found) or []
        if listed:
            # An element that omits the field has no name here.
            known = next(iter(orders), ())
            if len(known) == len(listed):
                listed = [name or old for name, old in zip(listed, known, strict=True)]
            orders.setdefault(tuple(listed), row)
    if len(orders) > 1:
        (one, first), (other, second) = list(orders.items())[:2]
        wanted = _listed(dict.fromkeys([*one, *other]))
        raise UsageError(
            f"{path}: the names of the elements change: [{_listed(one)}] in message {first},"
            f" [{_listed(other)}] in message {second}: select them by `names: [{wanted}]`"
        )


def _listed(names: Collection[str]) -> str:
    return ", ".join(list(names)[:12]) + (", ..." if len(names) > 12 else "")


_QUATERNION = ("x", "y", "z", "w")
_ANGLES = ("roll", "pitch", "yaw")


class Values(NamedTuple):
    """A quantity at N steps.

    Attributes:
        values: (N,) or (N, K) numbers, NaN where missing, or (N,) texts; for images, (N,)
            indexes of their messages.
        missing: (N,) bool: whether there is no value.
        age_s: (N,) age of the value in seconds, NaN where missing.
        unscaled: Numbers of the messages, before `scale`, `offset`, `clip` and `missing`; None for
            images and texts.
    """

    values: NDArray[Any]
    missing: NDArray[np.bool_]
    age_s: NDArray[np.float64]
    unscaled: NDArray[np.float64] | None = None


class Source(NamedTuple):
    """Topic and fields that contain a quantity.

    Attributes:
        topic: Topic that contains the quantity.
        fields: Fields to read; empty for images and transforms.
        path: Path of the field; None for images and transforms.
        names: Field with the names of the elements; empty if they have none.
        unlisted: Error if no message has the field; None if the type lists it.
        cache: Columns that were read, and the values that were made of them for all runs.
    """

    topic: str
    fields: tuple[str, ...]
    path: FieldPath | None
    names: str = ""
    unlisted: UsageError | None = None
    cache: list[tuple[Any, Named]] | None = None


def source_of(bag: Bag, quantity: Quantity) -> Source:
    """Resolve the topic and fields of a quantity."""
    if quantity.pixels is not None:
        return Source(topic_of(bag, quantity.pixels), (), None)
    if quantity.scan is not None:
        return _scan_source(bag, topic_of(bag, quantity.scan))
    if quantity.transform is not None:
        return Source(transform_topic(bag, quantity.tf), (), None)
    assert quantity.field is not None, "the mapping was validated"
    if quantity.as_ == "count":
        return Source(topic_of(bag, quantity.field), (), None)
    path = field_path(bag, quantity.field)
    info = bag.topics[path.topic]
    if quantity.as_ == "yaw":
        fields = tuple(
            path_in(path.topic, path_text((*path.steps, axis))).field for axis in _QUATERNION
        )
        if not all(map(info.may_have, fields)):
            raise UsageError(f"{path} is not a quaternion with x, y, z and w")
        return Source(path.topic, fields, path, cache=[])
    names = names_field(info, path, quantity)
    is_unlisted = bool(info.fields) and not info.lists(path.field)
    return Source(
        path.topic,
        (path.field, *([names] if names else [])),
        path,
        names,
        unknown_field(bag, path) if is_unlisted else None,
        [],
    )


def _scan_source(bag: Bag, topic: str) -> Source:
    info = bag.topics[topic]
    if not info.may_have("ranges"):
        raise UsageError(f"{topic} has {info.type_name}, not LaserScan: it has no `ranges`")
    limits = [name for name in SCAN_LIMITS if info.lists(name)]
    return Source(topic, ("ranges", *limits), FieldPath(topic, "ranges", None), cache=[])


def scan_columns(fields: Sequence[str], columns: Sequence[Any], path: FieldPath) -> list[Any]:
    """Return the beams of M scans by the columns of `Source.fields`."""
    found = dict(zip(fields, columns, strict=True))
    unknown = [None] * len(columns[0])
    ranges = columns[0]
    if isinstance(ranges, np.ndarray) and ranges.ndim == 1:
        ranges = rows_of(without_lacks(ranges.tolist()), str(path))
    limits = [[as_number(each) for each in found.get(name, unknown)] for name in SCAN_LIMITS]
    return beams([None if row is None else np.atleast_1d(row) for row in ranges], *limits)


def as_number(value: Any) -> float | None:
    """Return a number, or None if there is none."""
    return float(value) if isinstance(value, int | float | np.number) else None


def pose_of(
    quantity: Quantity, transforms: Transforms, steps_ns: NDArray[np.int64], gap_s: float
) -> Values:
    """Return the pose of a frame at the times of steps; see `values_of`."""
    assert quantity.transform is not None, "the quantity is a transform"
    found, age_s = transforms.pose(
        quantity.transform,
        quantity.in_,
        steps_ns,
        quantity.align,
        quantity.tolerance_s,
        quantity.parts,
        gap_s,
    )
    return shaped(quantity, found, np.isnan(age_s), age_s)


def place_of(names: Sequence[str], quantities: Mapping[str, Values]) -> Floats:
    """Return the robot's x, y and, if it is known, yaw (N, 2 or 3) at N steps; see `around`."""
    parts = [quantities[name].values for name in names]
    count = sum(math.prod(part.shape[1:]) for part in parts)
    if count not in (2, 3) or any(part.dtype.kind == "O" for part in parts):
        raise UsageError(
            f"around: {', '.join(names)} must be 2 or 3 numbers, x, y and yaw, not {count} values"
        )
    return np.column_stack(parts)


def values_of(
    quantity: Quantity,
    source: Source,
    stream: TopicStream,
    run: Messages,
    steps_ns: NDArray[np.int64],
    ends_ns: NDArray[np.int64] | None = None,
    gap_s: float = math.inf,
) -> Values:
    """Return a field or an image at the times of steps.

    Args:
        quantity: Quantity of the mapping.
        source: Topic and fields of the quantity.
        stream: Messages of the topic.
        run: Messages of the topic in one run.
        steps_ns: (N,) times of the steps.
        ends_ns: (N,) ends of the steps. If given, each step uses the last message before its end;
            if None, `quantity.align` applies.
        gap_s: Longest gap, in seconds, across which a value is interpolated or taken from a later
            message.
    """
    if quantity.as_ == "count":
        counts = np.searchsorted(run.times_ns, steps_ns, side="right").astype(np.float64)
        nothing = np.zeros(len(counts), bool)
        return shaped(quantity, counts, nothing, nothing.astype(np.float64))
    if quantity.pixels is not None:
        match = _match(quantity, run, steps_ns, ends_ns, gap_s)
        rows = _rows(run, match)
        places = np.where(rows == NONE, NONE, stream.rows[rows]) if len(stream.rows) else rows
        return Values(places, rows == NONE, match.age_s)
    updates = _updates(quantity, source, stream)
    if updates.values.dtype.kind == "O":
        run = _within(run, updates.present)
        match = _match(quantity, run, steps_ns, ends_ns, gap_s)
        rows = _rows(run, match)
        texts = np.full(len(rows), None, object)
        texts[rows != NONE] = updates.values[rows[rows != NONE]]
        return Values(texts, np.array([text is None for text in texts], bool), match.age_s)
    if updates.present is None or updates.present.ndim == 1:
        part = _within(run, updates.present)
        found, match = _aligned(quantity, updates.values, part, steps_ns, ends_ns, gap_s)
        return shaped(quantity, found, match.rows == NONE, match.age_s)
    # Each element is in other messages than the others.
    parts = [
        _aligned(quantity, column, _within(run, present), steps_ns, ends_ns, gap_s)
        for column, present in zip(updates.values.T, updates.present.T, strict=True)
    ]
    found = np.column_stack([values for values, _ in parts])
    missing = np.any([match.rows == NONE for _, match in parts], axis=0)
    ages_s = np.stack([match.age_s for _, match in parts])
    oldest = np.nan_to_num(np.abs(ages_s), nan=-1.0).argmax(axis=0)
    age_s = ages_s[oldest, np.arange(len(steps_ns))]
    return shaped(quantity, found, missing, age_s)


def _within(run: Messages, present: NDArray[np.bool_] | None) -> Messages:
    """Return the messages of a run that are updates of a field."""
    if present is None:
        return run
    kept = present[run.rows]
    return run._replace(times_ns=run.times_ns[kept], rows=run.rows[kept])


def _aligned(
    quantity: Quantity,
    column: NDArray[np.float64],
    run: Messages,
    steps_ns: NDArray[np.int64],
    ends_ns: NDArray[np.int64] | None,
    gap_s: float,
) -> tuple[NDArray[np.float64], Matches]:
    """Return the values at the steps, NaN where missing, and their messages."""
    if quantity.align == "linear" and ends_ns is None:
        values = _unwrapped(quantity, _finite(quantity, column[run.rows]))
        # What is between infinite values is missing.
        with np.errstate(invalid="ignore", over="ignore"):
            return interpolated(run.times_ns, values, steps_ns, quantity.tolerance_s, gap_s)
    match = _match(quantity, run, steps_ns, ends_ns, gap_s)
    rows = _rows(run, match)
    found = np.full((len(rows), *column.shape[1:]), np.nan)
    found[rows != NONE] = column[rows[rows != NONE]]
    return found, match


def _finite(quantity: Quantity, column: NDArray[np.float64]) -> NDArray[np.float64]:
    """Clip infinite values, because interpolation between them would be NaN."""
    if quantity.clip is None or not quantity.scale:
        return column
    ends = (np.array(quantity.clip) - quantity.offset) / quantity.scale
    return np.where(np.isinf(column), np.clip(column, ends.min(), ends.max()), column)


def _match(
    quantity: Quantity,
    run: Messages,
    steps_ns: NDArray[np.int64],
    ends_ns: NDArray[np.int64] | None,
    gap_s: float,
) -> Matches:
    if ends_ns is not None:
        return during(run.times_ns, steps_ns, ends_ns, quantity.tolerance_s)
    if quantity.align == "nearest":
        return nearest(run.times_ns, steps_ns, quantity.tolerance_s, gap_s)
    return last(run.times_ns, steps_ns, quantity.tolerance_s)


def _rows(run: Messages, match: Matches) -> NDArray[np.int64]:
    """Return the index in the stream of each step's message.

    For a step without a message, the index is `NONE`.
    """
    rows = np.full(len(match.rows), NONE)
    rows[match.rows != NONE] = run.rows[match.rows[match.rows != NONE]]
    return rows


def _updates(quantity: Quantity, source: Source, stream: TopicStream) -> Named:
    """Return the field's column: numbers (M,) or (M, K), or texts (M,), and which are updates."""
    columns, cache = stream.columns, source.cache if source.cache is not None else []
    if not cache or cache[0][0] is not columns:
        cache[:] = [(columns, _new_updates(quantity, source, stream))]
    return cache[0][1]


def _new_updates(quantity: Quantity, source: Source, stream: TopicStream) -> Named:
    path = source.path
    assert path is not None, "the quantity is a field"
    absent = [stream.absent[name] for name in source.fields if name in stream.absent]
    if quantity.as_ == "yaw":
        parts = [as_numbers(stream.columns[name], str(path)) for name in source.fields]
        if any(part.ndim > 1 for part in parts):
            raise UsageError(f"{path} is not one quaternion; choose one of them by an index")
        present = ~np.logical_or.reduce(absent) if absent else None
        return Named(yaw_of(np.column_stack(parts)), present)
    if quantity.scan is not None:
        rows = scan_columns(source.fields, [stream.columns[name] for name in source.fields], path)
        present = ~stream.absent["ranges"] if "ranges" in stream.absent else None
        if quantity.to is not None:
            return Named(pooled(rows, quantity.pool or "min", quantity.to), present)
        return Named(as_numbers(without_lacks(rows), str(path)), present)
    column = stream.columns[path.field]
    present = ~stream.absent[path.field] if path.field in stream.absent else None
    if source.unlisted is not None and present is not None and not present.any():
        raise source.unlisted
    if source.names and quantity.names:
        return by_names(path, column, stream.columns[source.names], quantity.names)
    optional = quantity.missing is not None
    if column.dtype.kind == "O":
        check_lacks(path, column.tolist(), optional=optional)
        column = without_lacks(column)
    if source.names:
        check_order(path, column, stream.columns[source.names])
    column = path.select(column, optional=optional)
    if column.dtype.kind == "O" and _are_texts(column):
        return Named(column, present)
    return Named(_vector(quantity, path, column), present)


def _are_texts(column: NDArray[Any]) -> bool:
    """Return whether all values are strings, except missing ones."""
    values = [value for value in column.tolist() if value is not None]
    return bool(values) and all(isinstance(value, str) for value in values)


def _vector(quantity: Quantity, path: FieldPath, column: NDArray[Any]) -> NDArray[np.float64]:
    """Return a column as numbers, with arrays of equal length."""
    if quantity.pad is None and quantity.pool is None:
        found = as_numbers(column, str(path), is_filled=path.is_bounded)
    else:
        rows = list(column) if column.ndim > 1 else rows_of(column, str(path))
        if any(row is not None and np.ndim(row) == 0 for row in rows):
            raise UsageError(f"{path} is not an array: remove `pad` or `pool`")
        if quantity.pool is None:
            found = padded(rows, quantity.pad or 0)
        else:
            found = pooled(rows, quantity.pool, quantity.to or 0)
    if found.ndim > 1 and not found.shape[1] and len(found):
        raise UsageError(f"{path}: no elements; the field has 0 elements in all messages")
    return found


def _unwrapped(quantity: Quantity, column: NDArray[np.float64]) -> NDArray[np.float64]:
    """Remove jumps of 2 pi from angles, because interpolation across a jump would be wrong."""
    is_angle = quantity.as_ == "yaw" or quantity.wrap_angle
    return np.unwrap(column, axis=0) if is_angle and len(column) else column


def shaped(
    quantity: Quantity,
    found: NDArray[np.float64],
    missing: NDArray[np.bool_],
    age_s: NDArray[np.float64],
) -> Values:
    """Scale, wrap and clip values, and replace missing values."""
    unscaled = found
    found = found * quantity.scale + quantity.offset
    if quantity.wrap_angle or (quantity.as_ == "yaw" and quantity.align == "linear"):
        wrapped = (found + math.pi) % (2 * math.pi) - math.pi
        is_angle = quantity.transform is None or np.isin(quantity.parts, _ANGLES)
        found = np.where(is_angle, wrapped, found)
    if quantity.clip is not None:
        found = np.clip(found, *quantity.clip)
    # Observations are float32, in which larger numbers are infinite.
    has_gap = is_missing = ~(np.abs(found) <= LARGEST)
    if found.ndim > 1:
        # If a number replaces missing elements, a vector is missing only as a whole.
        over = np.any if quantity.missing is None else np.all
        has_gap = over(has_gap, axis=1)
    missing = missing | has_gap
    if quantity.missing is not None:
        found = np.where(is_missing, quantity.missing, found)
    return Values(found, missing, age_s, unscaled)
