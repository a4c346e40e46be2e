"""Buffers that copy the values of an open episode at each step and write whole columns.

At each step, only values are copied. Times, counters, constants and the message layout are filled
in when a chunk is written. Buffers have no row counter: their first value belongs to the first step
that is not on disk. Only the recorder counts steps, after it has stored all values of a step. If an
error interrupts a step, the step is not counted and its values are dropped.

Each topic has one array with the message fields of each environment, and a row for each step of the
vector environment, so that a step writes adjacent memory. The array is a ring buffer: row r is at
position r modulo its length. When an episode ends, its rows are copied to message records.
"""

from __future__ import annotations

import math
import warnings
from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from io import BytesIO
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import SpaceError
from mcaprl.recorder.format.log_writer import LogTopics
from mcaprl.recorder.format.messages import EpisodeSummary, add_up
from mcaprl.recorder.format.schema import StepRows, TopicRows, part_of
from mcaprl.recorder.format.spaces import Leaf
from mcaprl.recorder.record.recordable import RecordedSpace, as_array

Store = Callable[[Any], None]
"""Function that stores a copy of a value.

Raises:
    SpaceError: The value does not belong to its space.
"""
Converter = Callable[[Any], NDArray[Any]]
"""Function that reads a leaf's value from an observation, in the declared dtype and shape."""


class Arrays:
    """A byte buffer for arrays that have the same dtype and size."""

    def __init__(self, dtype: np.dtype[Any], size: int) -> None:
        """Create an empty buffer of arrays of `size` numbers."""
        self._dtype, self._bytes_each = dtype, dtype.itemsize * size
        self._waiting = BytesIO()

    def append(self, value: NDArray[Any]) -> None:
        """Store a copy of an array that has the dtype and size of this buffer."""
        self._waiting.write(value.tobytes())

    def store(self, leaf: Leaf) -> Store:
        """Return a function that stores values of a leaf."""
        append, shape, dtype = self.append, leaf.shape, leaf.dtype
        take: Callable[[Any], object] = self._waiting.write

        def store_value(value: Any) -> None:
            try:
                if value.dtype is dtype and value.shape == shape:
                    take(value)
                    return
            except (AttributeError, TypeError, ValueError):
                # The value is not an array, or it is not contiguous in memory.
                pass
            append(as_declared(value, leaf))

        return store_value

    def put(self, column: NDArray[Any]) -> None:
        """Copy the first values to a column, and keep them in the buffer."""
        if len(column):
            waiting = np.frombuffer(self._waiting.getbuffer(), self._dtype, column.size)
            column[:] = waiting.reshape(column.shape)

    def drop(self, count: int | None = None) -> None:
        """Drop the first `count` values, by default all values."""
        rest = b"" if count is None else self._waiting.getvalue()[count * self._bytes_each :]
        self._waiting.seek(0)
        self._waiting.truncate()
        self._waiting.write(rest)


class Integers:
    """A buffer of 64-bit integers."""

    def __init__(self) -> None:
        """Create an empty buffer."""
        self._waiting = array("q")
        # Function that stores an integer; raises TypeError or OverflowError for other values.
        self.append: Store = self._waiting.append

    def store(self, leaf: Leaf) -> Store:
        """Return a function that stores values of a leaf."""
        append = self.append

        def store_value(value: Any) -> None:
            try:
                append(value)
            except (TypeError, OverflowError):
                append(as_declared(value, leaf).item())

        return store_value

    def put(self, column: NDArray[Any]) -> None:
        """Copy the first values to a column, and keep them in the buffer."""
        column[:] = self._waiting[: len(column)]

    def drop(self, count: int | None = None) -> None:
        """Drop the first `count` values, by default all values."""
        del self._waiting[:count]


class StepColumns:
    """The rows of `/rl/step` of one episode that are not on disk yet."""

    def __init__(self, log: LogTopics) -> None:
        """Preallocate a chunk of rows."""
        self._rows = log.step_rows()
        self._fields = self._rows.fields
        self._rewards, self._behavior = array("d"), array("d")
        self._behavior_name = log.behavior.name
        self._waiting: dict[str, Arrays | Integers] = {}
        # Function that stores an action of any type.
        # Fast function that stores an action; raises TypeError or OverflowError for actions that
        # only `store_action` accepts.
        self.store_action = self.take_action = self.store(log.action)
        actions = self._waiting[log.action.name]
        if isinstance(actions, Integers):
            self.take_action = actions.append
        # Function that stores a reward of any numeric type.
        self.store_reward: Store = self._rewards.append

    def store_behavior(self, value: float) -> None:
        """Store the behavior of the latest action; earlier ones without a value get NaN."""
        unknown = len(self._rewards) - len(self._behavior)
        if unknown:
            self._behavior.extend([math.nan] * unknown)
        self._behavior.append(value)

    def store(self, leaf: Leaf) -> Store:
        """Return a function that stores values of a leaf."""
        is_integer = leaf.shape == () and leaf.dtype == np.int64
        waiting = Integers() if is_integer else Arrays(leaf.dtype, leaf.size)
        self._waiting[leaf.name] = waiting
        return waiting.store(leaf)

    def begin(self, episode: int, start_ns: int, step_ns: int) -> None:
        """Begin an episode whose first row has the log_time `start_ns`."""
        self._episode, self._start_ns, self._step_ns = episode, start_ns, step_ns
        self._first_step, self._total_reward = 0, 0.0
        self._drop(None)

    @property
    def full_at(self) -> int:
        """First step whose observation does not fit into the rows."""
        return self._first_step + len(self._rows)

    def make_room(self, step: int) -> None:
        """Write all rows before the transition to `step`, which may end the episode."""
        count = step - self._first_step - 1
        self._total_reward = self.total_reward(step - 1)
        self._fill(count, count)
        self._number(count)
        self._write(count)
        self._drop(count)

    def end(self, steps: int, terminated: bool, truncated: bool) -> None:
        """Set the end flags of the last transition, fill the final row, and write all rows."""
        final = steps - self._first_step
        assert final >= 1, "the last transition stays in memory"
        self._fill(final, final + 1)
        self._number(final + 1)
        self._rows.put("terminated", final - 1, terminated)
        self._rows.put("truncated", final - 1, truncated)
        self._rows.finish(final)
        self._write(final + 1)

    def total_reward(self, steps: int) -> float:
        """Return the sum of the first `steps` rewards, added in order."""
        rewards = np.array(self._rewards[: steps - self._first_step])
        return add_up(rewards, self._total_reward)

    def _fill(self, actions: int, observations: int) -> None:
        """Copy the stored values into the rows."""
        known = self._behavior[:actions]
        self._fields["reward"][:actions] = self._rewards[:actions]
        self._fields[self._behavior_name][: len(known)] = known
        self._fields[self._behavior_name][len(known) : actions] = math.nan
        for name, waiting in self._waiting.items():
            count = actions if name == "action" else observations
            waiting.put(self._fields[name][:count])

    def _number(self, count: int) -> None:
        self._rows.number(slice(count), self._episode, self._steps(count))

    def _write(self, count: int) -> None:
        times_ns = self._start_ns + self._steps(count) * self._step_ns
        self._rows.write(slice(count), times_ns)
        self._first_step += count

    def _steps(self, count: int) -> NDArray[np.int64]:
        return np.arange(self._first_step, self._first_step + count)

    def _drop(self, count: int | None) -> None:
        del self._rewards[:count], self._behavior[:count]
        for waiting in self._waiting.values():
            waiting.drop(count)


class ImageColumn:
    """The images of one topic that are not on disk yet."""

    def __init__(
        self, log: LogTopics, topic: str, shape: tuple[int, ...], encoding: str | None
    ) -> None:
        """Add the topic to the log. For the arguments, see `LogTopics.image_rows`."""
        self._rows = log.image_rows(topic, shape, encoding)
        self._images = Arrays(np.dtype(np.uint8), self._rows.fields["data"].shape[-1])
        self._first_step = 0

    def store(self, leaf: Leaf) -> Store:
        """Return a function that stores the images of a leaf."""
        return self._images.store(leaf)

    def begin(self, start_ns: int, step_ns: int) -> None:
        """Begin an episode whose first image has the log_time `start_ns`."""
        self._start_ns, self._step_ns, self._first_step = start_ns, step_ns, 0
        self._images.drop()

    @property
    def full_at(self) -> int:
        """First step whose image does not fit into the rows."""
        return self._first_step + len(self._rows)

    def append(self, image: NDArray[Any]) -> None:
        """Store the image of the next step; its dtype must have as many bytes as the space's."""
        self._images.append(image)

    def flush(self, stop: int) -> None:
        """Write all images before step `stop`."""
        steps = np.arange(self._first_step, stop)
        self._images.put(self._rows.fields["data"][: len(steps)])
        self._rows.write(slice(len(steps)), self._start_ns + steps * self._step_ns)
        self._images.drop(len(steps))
        self._first_step = stop


def observation_store(
    recorded: RecordedSpace, columns: StepColumns, images: Mapping[Leaf, ImageColumn]
) -> Store:
    """Return a function that stores the recorded part of observations."""
    leaves = recorded.leaves
    stores = [
        images[leaf].store(leaf) if leaf in images else columns.store(leaf) for leaf in leaves
    ]
    if not leaves[0].path:
        return stores[0]
    parts = [
        (_part(leaf, path), store)
        for leaf, path, store in zip(leaves, recorded.paths, stores, strict=True)
    ]

    def store_all(observation: Any) -> None:
        for part, store in parts:
            store(part(observation))

    return store_all


def converters(recorded: RecordedSpace, count: int | None = None) -> list[Converter]:
    """Return a function per leaf that reads its value from an observation or `count` of them."""
    batch = () if count is None else (count,)
    return [
        converter(replace(leaf, shape=(*batch, *leaf.shape)), path)
        for leaf, path in zip(recorded.leaves, recorded.paths, strict=True)
    ]


def converter(leaf: Leaf, path: tuple[str | int, ...] = ()) -> Converter:
    """Return the function that reads a leaf's value at a path in an observation, or an action."""
    shape, dtype, part = leaf.shape, leaf.dtype, _part(leaf, path)

    def convert(observation: Any) -> NDArray[Any]:
        value = part(observation)
        if type(value) is np.ndarray and value.dtype is dtype and value.shape == shape:
            return value
        return as_declared(value, leaf)

    return convert


def as_declared(value: Any, leaf: Leaf) -> NDArray[Any]:
    """Convert a value to its space's dtype and shape: floats with a warning, others exactly."""
    where = _where(leaf)
    try:
        array = as_array(value)
        with np.errstate(all="ignore"):
            cast = array.astype(leaf.dtype)
    except (TypeError, ValueError, OverflowError, RuntimeError) as error:
        raise SpaceError(f"{where} is {value!r:.60}; its space declares {leaf.dtype}") from error
    if not leaf.shape and array.size == 1:
        cast, array = cast.reshape(()), array.reshape(())
    if array.shape != leaf.shape:
        raise SpaceError(f"{where} has shape {array.shape}; its space declares {leaf.shape}")
    if array.dtype == leaf.dtype:
        return cast
    if array.dtype.kind == leaf.dtype.kind == "f":
        # Lists have no dtype, so their conversion causes no warning.
        if array.ndim and hasattr(value, "dtype"):
            warnings.warn(
                f"{where} is {array.dtype}; it is converted to {leaf.dtype}, as its space declares",
                stacklevel=2,
            )
    elif not np.array_equal(cast, array):
        raise SpaceError(f"{where} is {value!r:.60}; its space declares {leaf.dtype}")
    return cast


def reward_number(reward: Any) -> float:
    """Convert a reward that is an array of one number to a float."""
    array = as_array(reward)
    if array.size != 1 or array.dtype.kind not in "biuf":
        raise SpaceError(
            f"the reward is {reward!r:.60}: it must be a single number; combine several rewards"
            " with a wrapper, such as LinearReward of mo-gymnasium"
        )
    return float(array.item())


def _part(leaf: Leaf, path: tuple[str | int, ...]) -> Callable[[Any], Any]:
    """Return a function that reads a leaf's value from an observation without converting it."""

    def part(observation: Any) -> Any:
        try:
            for key in path:
                observation = observation[key]
            return observation
        except (KeyError, IndexError, TypeError) as error:
            raise SpaceError(f"{_where(leaf)} is missing") from error

    return part


def _where(leaf: Leaf) -> str:
    role = "action" if leaf.name == "action" else "observation"
    return role + "".join(f"['{key}']" for key in leaf.path)


# Limits of the initial capacity: number of rows, and number of bytes per environment. The capacity
# doubles when an episode needs more.
_FIRST_CAPACITY = 512
_FIRST_BYTES = 2**20

Rows = TypeVar("Rows", bound=TopicRows)


class OpenRows(Generic[Rows]):
    """Values of one topic for all open episodes.

    Attributes:
        capacity: Number of rows in the array, a power of 2.
        row_bytes: Length of a message record.
    """

    def __init__(self, chunk: Rows, environments: int, fields: Sequence[str]) -> None:
        """Allocate the array."""
        self._chunk, self._fields, self.row_bytes = chunk, fields, chunk.itemsize
        self._records, dtype = chunk.from_field(fields)
        first = max(2, min(_FIRST_CAPACITY, _FIRST_BYTES // self.row_bytes))
        self._use(np.empty((2 ** (first.bit_length() - 1), environments), dtype))

    def make_room(self, count: int, row: int) -> None:
        """Grow the array until `count` rows fit, and keep the rows up to `row`."""
        kept = np.arange(max(row - self.capacity + 1, 0), row + 1)
        capacity = self.capacity
        while capacity < count:
            capacity *= 2
        old, old_places = self._rows, kept % self.capacity
        self._use(np.empty((capacity, *old.shape[1:]), old.dtype))
        self._items[kept % capacity] = self._items_of(old)[old_places]

    def put(self, field: str, row: int, values: Any, environments: Any = ...) -> None:
        """Set a field in one row to values (K, *shape), or a scalar, of all or K environments."""
        column = self._columns[field]
        if column.ndim > 2:
            values = values.reshape(-1, column.shape[-1])
        column[row % self.capacity, environments] = values

    def write(
        self,
        environments: Sequence[int],
        firsts: Sequence[int],
        counts: Sequence[int],
        starts_ns: NDArray[np.int64],
        step_ns: int,
    ) -> None:
        """Write K environments' rows from `firsts`, one environment after the other."""
        for which, steps in self._chunks(environments, firsts, counts):
            self._chunk.write(slice(len(steps)), starts_ns[which] + steps * step_ns)

    def _use(self, rows: NDArray[Any]) -> None:
        """Use this array, (capacity, N)."""
        self._rows, self.capacity = rows, len(rows)
        self._columns = {name: rows[name] for name in self._fields}
        self._items = self._items_of(rows)

    def _items_of(self, rows: NDArray[Any]) -> NDArray[np.void]:
        """Return a view of the bytes that the message records have as well."""
        return part_of(rows, slice(0, self._records.itemsize))

    def _chunks(
        self, environments: Sequence[int], firsts: Sequence[int], counts: Sequence[int]
    ) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
        """Copy rows to message records by chunks; yield each row's environment and step."""
        # Environments share a chunk if all their rows fit.
        parts: list[_Part] = []
        used, most = 0, len(self._chunk)
        for position, first in enumerate(firsts):
            step, count = 0, counts[position]
            if used + count > most and used:
                yield _rows_of(parts)
                parts, used = [], 0
            while step < count:
                place = (first + step) % self.capacity
                size = min(count - step, most - used, self.capacity - place)
                source = self._items[place : place + size, environments[position]]
                self._records[used : used + size] = source
                parts.append((position, step, size))
                step, used = step + size, used + size
                if used == most:
                    yield _rows_of(parts)
                    parts, used = [], 0
        if parts:
            yield _rows_of(parts)


class OpenSteps(OpenRows[StepRows]):
    """Rows of `/rl/step` of all open episodes."""

    def end(
        self,
        environments: Sequence[int],
        firsts: Sequence[int],
        summaries: Sequence[EpisodeSummary],
        step_ns: int,
    ) -> None:
        """Write the rows of ended episodes, with their numbers and end flags."""
        numbers, lengths, starts, terminated, truncated = (
            np.array([getattr(summary, name) for summary in summaries])
            for name in ("episode", "length", "start_time_ns", "terminated", "truncated")
        )
        chunk = self._chunk
        for which, steps in self._chunks(environments, firsts, (lengths + 1).tolist()):
            left = lengths[which] - steps
            last, where = np.flatnonzero(left == 1), slice(len(steps))
            chunk.number(where, numbers[which], steps)
            chunk.put("terminated", last, terminated[which[last]])
            chunk.put("truncated", last, truncated[which[last]])
            chunk.finish(np.flatnonzero(left == 0))
            chunk.write(where, starts[which] + steps * step_ns)


_Part = tuple[int, int, int]
"""Position of an environment, step of its first row in a chunk, and number of rows."""


def _rows_of(parts: list[_Part]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the position and the step of each row of a chunk."""
    positions, first_steps, sizes = np.array(parts, np.int64).T
    shift = first_steps - (np.cumsum(sizes) - sizes)
    return np.repeat(positions, sizes), np.arange(sizes.sum()) + np.repeat(shift, sizes)
