"""Infos of an environment: the values of each info are messages on a topic `/rl/info/<name>`.

A message has the log_time of the observation that the environment returned with the info. No
message is written if the info is missing. Scalars are messages of std_msgs; arrays are flattened to
the field `data` of `mcaprl_msgs/msg/Info...`. The channel's metadata contains the name and the
shape of the info. In the topic, dots of the name become slashes, and characters other than letters,
digits and `_` become `_`. If the name has such characters, starts or ends with a dot, or has two
successive dots, the CRC-32 of the name is appended to the topic.
"""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import CorruptLogError
from mcaprl.files import as_type, parse_json
from mcaprl.recorder.format.reading import McapReader, Topic

INFO_TOPICS = "/rl/info/"  # Prefix of the topic names of infos
# A string, because NumPy imports `np.ma` when it is first used.
Masked: TypeAlias = "np.ma.MaskedArray[Any, Any]"


def read_infos(reader: McapReader, times_ns: NDArray[np.int64]) -> dict[str, Masked]:
    """Read the infos of a log, masked (F, *shape) by dotted name, for log_times (F,)."""
    channels = [one for one in reader.channels.values() if one.topic.startswith(INFO_TOPICS)]
    found: dict[str, Masked] = {}
    if not channels or not len(times_ns):
        return found
    order = np.argsort(times_ns, kind="stable")
    for topic in sorted({channel.topic for channel in channels}):
        metadata = next(one.metadata for one in channels if one.topic == topic)
        name = metadata.get("info", topic.removeprefix(INFO_TOPICS).replace("/", "."))
        messages = Topic(reader, topic)
        # A part of a larger log has all topics of that log, but some may have no messages.
        if len(messages):
            found[name] = _read(messages, metadata.get("shape", "[]"), times_ns, order)
    return found


def shape_of(text: str, topic: str) -> tuple[int, ...]:
    """Return the shape of an info in the metadata of its channel."""
    try:
        shape: tuple[int, ...] = as_type(tuple[int, ...], parse_json(text), "shape")
    except ValueError as error:
        raise CorruptLogError(f"{topic}: the shape of the info is damaged: {error}") from error
    if any(size < 0 for size in shape):
        raise CorruptLogError(f"{topic}: the shape of the info is damaged: {shape}")
    return shape


def is_exact(stored: NDArray[Any], values: NDArray[Any]) -> bool:
    """Return whether two arrays, possibly of different dtypes, have exactly the same values."""
    kinds = {kind_of(stored.dtype), kind_of(values.dtype)}
    if len(kinds) > 1:
        return False
    if stored.dtype == values.dtype:
        return True
    if stored.dtype.kind == values.dtype.kind == "f":
        return np.array_equal(stored, values, equal_nan=True)
    # Python compares integers and floats exactly; NumPy would round the integers.
    return bool(stored.tolist() == values.tolist())


def kind_of(dtype: np.dtype[Any]) -> str:
    """Return `number` for integers and floats, and NumPy's kind code for all other dtypes."""
    return "number" if dtype.kind in "iuf" else dtype.kind


def _read(
    topic: Topic, shape_text: str, times_ns: NDArray[np.int64], order: NDArray[np.int64]
) -> Masked:
    shape = shape_of(shape_text, topic.name)
    values = topic.read(("data",))["data"]
    if topic.fields["data"].kind == "O":
        values = values.astype(str)
    elif topic.kinds.get("data", "").startswith("bool"):
        values = values != 0
    try:
        values = values.reshape(len(values), *shape)
    except ValueError as error:
        raise CorruptLogError(f"{topic.name}: messages do not have shape {shape}") from error
    places = np.searchsorted(times_ns, topic.times, sorter=order)
    frames = order[np.minimum(places, len(order) - 1)]
    # Skip infos of unfinished episodes, whose observations are not in `times_ns`.
    known = times_ns[frames] == topic.times
    every = np.zeros((len(times_ns), *shape), values.dtype)
    is_missing = np.ones(every.shape, bool)
    every[frames[known]], is_missing[frames[known]] = values[known], False
    return np.ma.MaskedArray(every, is_missing)
