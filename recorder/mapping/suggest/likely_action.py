"""Action that the commands of a bag are likely to be."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError, UsageError
from mcaprl.recorder.bags.bag import Bag, TopicInfo
from mcaprl.recorder.bags.overview import TopicOverview
from mcaprl.recorder.mapping.suggest.likely import (
    ELEMENTS,
    IMAGES,
    NUMBERS,
    is_counting,
    is_never_observed,
    kind_of,
    number_fields,
)

# If the name of a topic or type contains one of these words, the topic is likely to have commands,
# unless its name also contains one of the words of `_ANSWERS`.
_COMMANDS = ("cmd", "command", "action", "target", "setpoint", "ackermann", "control", "joy")
_ANSWERS = re.compile(
    r"state|status|feedback|result|mode|limit|info|event|ack(?!erm)|measured|actual|odom|estimat"
)
_TYPES = re.compile(
    r".*/(Twist|TwistStamped|AckermannDrive|AckermannDriveStamped|JointTrajectory|Joy|TrajectorySetpoint"
    r"|AttitudeTarget|PositionTarget|ActuatorControls|ActuatorMotors|Actuators|JointJog)"
)
_MAX_FIELDS, _MAX_VALUES, _MAX_NUMBER = 32, 16, 31
"""Number of elements of a command, number of different values of a discrete command, and largest
number of a discrete field."""
_DIGITS = 3
_FLOAT = np.finfo(np.float32)


class Command(NamedTuple):
    """Commands of a topic.

    Attributes:
        topic: Topic with the commands.
        paths: Path of each element.
        values: (N, K) values of the elements in all messages; NaN where there is none.
        texts: Different values of a text; empty if the command is numbers.
    """

    topic: TopicOverview
    paths: tuple[str, ...]
    values: NDArray[np.float64]
    texts: tuple[str, ...] = ()


def likelihood(info: TopicInfo) -> int:
    """Return how likely it is that a topic has commands, by its name and type; 0 if it has none."""
    name, kind = info.name.lower(), kind_of(info)
    score = 4 * any(word in name for word in _COMMANDS)
    score += 2 * any(word in kind.lower() for word in _COMMANDS)
    score += _TYPES.fullmatch(kind) is not None
    score += any(word in name for word in ("cmd", "command", "setpoint"))
    if is_never_observed(info) or kind in IMAGES or not score:
        return 0
    return max(1, score - 5) if _ANSWERS.search(name) else score


def command_of(bag: Bag, topics: Sequence[TopicOverview]) -> Command | None:
    """Return the most likely commands that can be read; None if there are none."""
    for topic in sorted(topics, key=lambda each: (-likelihood(each.info), -each.info.count)):
        if not likelihood(topic.info):
            return None
        try:
            found = _commands(bag, topic)
        except (LogError, UsageError):
            found = None
        if found is not None:
            return found
    return None


def _commands(bag: Bag, topic: TopicOverview) -> Command | None:
    info = topic.info
    numbers = [name for name in number_fields(info) if "[" not in name]
    arrays = [
        name
        for name, kind in info.fields.items()
        if kind.endswith("]") and kind.partition("[")[0] in ELEMENTS and "[" not in name
    ]
    columns = dict(bag.read(info.name, [*numbers, *arrays]).columns)
    found = {
        name: columns[name].astype(np.float64)
        for name in numbers
        if not is_counting(name, columns[name])
    }
    inner = _inner(bag, info)
    for name, column in [*((name, columns[name]) for name in arrays), *inner.items()]:
        if column.dtype.kind in "biuf" and column.ndim == 2:
            # `motors[:].q` becomes `motors[3].q`, and `positions` becomes `positions[3]`.
            path = name.replace("[:]", "[{}]") if "[:]" in name else f"{name}[{{}}]"
            elements = column.astype(np.float64).T[:_MAX_FIELDS]
            found |= {path.format(k): each for k, each in enumerate(elements)}
    # A Box action is float32.
    found = {
        name: np.where(np.abs(each) < _FLOAT.max, each, np.nan) for name, each in found.items()
    }
    chosen = _chosen(found)
    if chosen:
        values = np.column_stack([found[name] for name in chosen])
        return Command(topic, tuple(f"{info.name}.{name}" for name in chosen), values)
    return _texts(bag, topic)


def _inner(bag: Bag, info: TopicInfo) -> dict[str, NDArray[Any]]:
    """Return numbers in arrays of messages by path; of a trajectory, those of its first point."""
    found: dict[str, NDArray[Any]] = {}
    for name, kind in info.fields.items():
        if "[]." not in name or kind.partition("[")[0] not in NUMBERS:
            continue
        path = name.replace("[]", "[:]" if kind.count("[") == 1 else "[0]")
        try:
            found |= bag.read(info.name, [path]).columns
        except (LogError, UsageError):
            continue
    return found


def _chosen(columns: dict[str, NDArray[np.float64]]) -> list[str]:
    """Return the elements of a command: those that vary and are not NaN."""
    usable = [name for name, values in columns.items() if np.isfinite(values).mean() > 0.5]
    varying = [name for name in usable if np.nanmax(columns[name]) > np.nanmin(columns[name])]
    # The speed and the turn of a vehicle are a pair, even if one of them is constant.
    pair = [name for name in usable if re.fullmatch(r"(.*\.)?(linear\.x|angular\.z)", name)]
    found = [name for name in usable if name in varying or name in pair]
    return (found or usable[:2])[:_MAX_FIELDS]


def _texts(bag: Bag, topic: TopicOverview) -> Command | None:
    """Return the commands of a topic with a text, if it has few different values."""
    info = topic.info
    names = [name for name, kind in info.fields.items() if kind == "string" and "." not in name]
    if not names or not info.count:
        return None
    column = bag.read(info.name, names[:1]).columns[names[0]].tolist()
    texts = sorted({text for text in column if isinstance(text, str)})
    if not 0 < len(texts) <= _MAX_VALUES:
        return None
    return Command(topic, (f"{info.name}.{names[0]}",), np.empty((len(column), 0)), tuple(texts))


def action_spec(command: Command, bins: int | None, used: NDArray[np.float64]) -> dict[str, Any]:
    """Return the keys and values of the action in the mapping.

    Few whole numbers and texts become a discrete action. All others become a Box with limits from
    the data, or with `bins` a discrete action with quantile bins.

    Args:
        command: Commands of the bag.
        bins: Number of bins of each element; None for a Box.
        used: (M, K) commands of the transitions, from which the bins are made.
    """
    if command.texts:
        return {
            "field": command.paths[0],
            "names": {text: number for number, text in enumerate(command.texts)},
        }
    values = command.values[np.isfinite(command.values).all(axis=1)]
    if len(values) and (values == np.rint(values)).all():
        distinct = np.unique(values, axis=0)
        if 1 < len(distinct) <= _MAX_VALUES:
            return _discrete(command.paths, distinct)
    if bins is not None:
        finite = used[np.isfinite(used).all(axis=1)]
        return {
            "fields": list(command.paths),
            "edges": [quantile_edges(column, bins) for column in finite.T],
        }
    low, high = zip(*(box_limits(column) for column in values.T), strict=True)
    return {"fields": list(command.paths), "box": {"low": list(low), "high": list(high)}}


def _discrete(paths: tuple[str, ...], distinct: NDArray[np.float64]) -> dict[str, Any]:
    """Return an action of a field with numbers from 0, or else of named commands."""
    if len(paths) == 1 and distinct.min() >= 0 and distinct.max() <= _MAX_NUMBER:
        return {"field": paths[0]}
    names = {
        ", ".join(f"{number:g}" for number in command): [float(number) for number in command]
        for command in distinct
    }
    return {"fields": list(paths), "actions": names}


def box_limits(values: NDArray[np.float64]) -> tuple[float, float]:
    """Return limits that contain all values, rounded outward to three digits of the range."""
    low, high = float(values.min()), float(values.max())
    below = float(np.nextafter(np.float32(low), np.float32(-np.inf)))
    above = float(np.nextafter(np.float32(high), np.float32(np.inf)))
    if high - low < _FLOAT.tiny:
        return min(math.floor(low) - 1.0, below), max(math.ceil(high) + 1.0, above)
    unit = 10.0 ** (math.floor(math.log10(high - low)) - _DIGITS + 1)
    least, most = math.floor(low / unit), math.ceil(high / unit)
    # The limits are stored as float32, which must not cut the lowest and the highest value.
    lows, highs = (
        [_times(n, unit) for n in each] for each in ((least, least - 1), (most, most + 1))
    )
    return (
        next(each for each in [*lows, below] if float(np.float32(each)) <= low),
        next(each for each in [*highs, above] if float(np.float32(each)) >= high),
    )


def _times(count: int, unit: float) -> float:
    """Return a multiple of a power of ten as the nearest short number."""
    return float(f"{count * unit:.12g}")


def quantile_edges(values: NDArray[np.float64], bins: int) -> list[float]:
    """Return increasing edges of at most `bins` bins with similar numbers of values.

    Each edge is between two different values, so no bin is empty.

    >>> quantile_edges(np.array([0.0, 0, 0, 1, 1, 4, 4, 4]), 3)
    [0.5, 2.0]
    """
    distinct, counts = np.unique(values, return_counts=True)
    shares = np.cumsum(counts)[:-1] / max(len(values), 1)
    edges: set[float] = set()
    for k in range(1, bins):
        if len(shares):
            place = int(np.abs(shares - k / bins).argmin())
            edges.add(_between(float(distinct[place]), float(distinct[place + 1])))
    return sorted(edges)


def _between(low: float, high: float) -> float:
    """Return the shortest decimal number that is above `low`, and at most `high`."""
    for digits in range(1, 18):
        found = float(f"{(low + high) / 2:.{digits}g}")
        if low < found <= high:
            return found
    return high
