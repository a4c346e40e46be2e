"""Values that wait to be written: what the environment gives, copied and kept in order.

Per step a value costs little more than its copy: all else (times, counters, constants, the layout
of a message) is done by whole columns when a chunk is written. A list knows no "present row" of its
own: its values belong to the steps from the first one that is not on disk, and a step counts only
when all of it is in place. So there is one counter, the recorder's; what was kept beyond it is
forgotten.
"""

from __future__ import annotations

import math
import warnings
from array import array
from collections.abc import Callable, Mapping
from io import BytesIO
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import SpaceError
from mcaprl.recorder.format.episode_summary import add_up
from mcaprl.recorder.format.log_writer import LogTopics
from mcaprl.recorder.format.spaces import Leaf, observation_leaves

Keeper = Callable[[Any], None]
"""Keeps a copy of a value.

Raises:
    SpaceError: it is not one of its space's.
"""
Converter = Callable[[Any], NDArray[Any]]
"""Takes a leaf's value out of an observation, in the dtype and shape that its space declares."""


class Arrays:
    """Arrays of one dtype and size that wait, as bytes."""

    def __init__(self, dtype: np.dtype[Any], size: int) -> None:
        """Begin with none; `size` is the numbers in each."""
        self._dtype, self._bytes_each = dtype, dtype.itemsize * size
        self._waiting = BytesIO()

    def append(self, value: NDArray[Any]) -> None:
        """Keep a copy of an array of so many bytes."""
        self._waiting.write(value.tobytes())

    def keeper(self, leaf: Leaf) -> Keeper:
        """A function that keeps values of a leaf."""
        append, shape, dtype = self.append, leaf.shape, leaf.dtype
        take: Callable[[Any], object] = self._waiting.write

        def keep(value: Any) -> None:
            try:
                if value.dtype is dtype and value.shape == shape:
                    take(value)
                    return
            except (AttributeError, TypeError, ValueError):
                # No array, or one that does not lie in memory as C has it.
                pass
            append(as_declared(value, leaf))

        return keep

    def put(self, column: NDArray[Any]) -> None:
        """Put the first values into a column; they stay."""
        if len(column):
            waiting = np.frombuffer(self._waiting.getbuffer(), self._dtype, column.size)
            column[:] = waiting.reshape(column.shape)

    def forget(self, count: int | None = None) -> None:
        """Drop the first values, or all."""
        rest = b"" if count is None else self._waiting.getvalue()[count * self._bytes_each :]
        self._waiting.seek(0)
        self._waiting.truncate()
        self._waiting.write(rest)


class Integers:
    """64-bit integers that wait.

    Attributes:
        append: keeps what is one; raises TypeError or OverflowError for anything else.
    """

    def __init__(self) -> None:
        """Begin with none."""
        self._waiting = array("q")
        self.append: Keeper = self._waiting.append

    def keeper(self, leaf: Leaf) -> Keeper:
        """A function that keeps values of a leaf."""
        append = self.append

        def keep(value: Any) -> None:
            try:
                append(value)
            except (TypeError, OverflowError):
                append(as_declared(value, leaf).item())

        return keep

    def put(self, column: NDArray[Any]) -> None:
        """Put the first values into a column; they stay."""
        column[:] = self._waiting[: len(column)]

    def forget(self, count: int | None = None) -> None:
        """Drop the first values, or all."""
        del self._waiting[:count]


class StepColumns:
    """What of `/rl/step` is not yet on disk, all of one episode.

    Attributes:
        take_action: keeps an action, or raises TypeError or OverflowError for one that only
            `keep_action` keeps: a call less for the many that are integers.
        keep_action: keeps an action.
        keep_reward: keeps what it brought, a number of any type.
    """

    def __init__(self, log: LogTopics) -> None:
        """Preallocate a chunk of rows."""
        self._rows = log.step_rows()
        self._fields = self._rows.fields
        self._rewards, self._probs = array("d"), array("d")
        self._waiting: dict[str, Arrays | Integers] = {}
        self.keep_action = self.take_action = self.keeper(log.action)
        actions = self._waiting[log.action.name]
        if isinstance(actions, Integers):
            self.take_action = actions.append
        self.keep_reward: Keeper = self._rewards.append

    def keep_behavior_prob(self, prob: float) -> None:
        """Keep the probability of the action that was kept last; of others it is not known."""
        unknown = len(self._rewards) - len(self._probs)
        if unknown:
            self._probs.extend([math.nan] * unknown)
        self._probs.append(prob)

    def keeper(self, leaf: Leaf) -> Keeper:
        """A function that keeps values of a leaf."""
        is_integer = leaf.shape == () and leaf.dtype == np.int64
        waiting = Integers() if is_integer else Arrays(leaf.dtype, leaf.size)
        self._waiting[leaf.name] = waiting
        return waiting.keeper(leaf)

    def begin(self, episode: int, start_ns: int, step_ns: int) -> None:
        """Begin an episode: `start_ns` is the log_time of its first row."""
        self._episode, self._start_ns, self._step_ns = episode, start_ns, step_ns
        self._first_step, self._total_reward = 0, 0.0
        self._forget(None)

    @property
    def full_at(self) -> int:
        """The first step for whose observation there is no row."""
        return self._first_step + len(self._rows)

    def make_room(self, step: int) -> None:
        """Write all rows before the transition that leads to `step`.

        That one stays behind, for its episode may end there and be marked so.
        """
        count = step - self._first_step - 1
        self._total_reward = self.total_reward(step - 1)
        self._fill(count, count)
        self._number(count)
        self._write(count)
        self._forget(count)

    def end(self, steps: int, terminated: bool, truncated: bool) -> None:
        """Mark the last transition and the final row, and write all.

        Args:
            steps: transitions of the episode, 1 or more.
            terminated: of the last one.
            truncated: likewise.
        """
        final = steps - self._first_step
        assert final >= 1, "the last transition stays in memory"
        self._fill(final, final + 1)
        self._number(final + 1)
        self._rows.put("terminated", final - 1, terminated)
        self._rows.put("truncated", final - 1, truncated)
        self._rows.finish(final)
        self._write(final + 1)

    def total_reward(self, steps: int) -> float:
        """What the first `steps` transitions brought, added up in order."""
        rewards = np.array(self._rewards[: steps - self._first_step])
        return add_up(rewards, self._total_reward)

    def _fill(self, actions: int, observations: int) -> None:
        """Put what waits into the rows."""
        probs = self._probs[:actions]
        self._fields["reward"][:actions] = self._rewards[:actions]
        self._fields["behavior_prob"][: len(probs)] = probs
        self._fields["behavior_prob"][len(probs) : actions] = math.nan
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

    def _forget(self, count: int | None) -> None:
        del self._rewards[:count], self._probs[:count]
        for waiting in self._waiting.values():
            waiting.forget(count)


class ImageColumn:
    """The pictures of one topic that are not yet on disk."""

    def __init__(
        self, log: LogTopics, topic: str, shape: tuple[int, ...], encoding: str | None
    ) -> None:
        """Announce the topic; see `LogTopics.add_image_topic`."""
        self._rows = log.image_rows(topic, shape, encoding)
        self._images = Arrays(np.dtype(np.uint8), self._rows.fields["data"].shape[-1])
        self._first_step = 0

    def keeper(self, leaf: Leaf) -> Keeper:
        """A function that keeps the pictures of a leaf."""
        return self._images.keeper(leaf)

    def begin(self, start_ns: int, step_ns: int) -> None:
        """Begin an episode: `start_ns` is the log_time of its first picture."""
        self._start_ns, self._step_ns, self._first_step = start_ns, step_ns, 0
        self._images.forget()

    @property
    def full_at(self) -> int:
        """The first step for whose picture there is no row."""
        return self._first_step + len(self._rows)

    def append(self, image: NDArray[Any]) -> None:
        """Keep the next step's picture, of any dtype with as many bytes."""
        self._images.append(image)

    def flush(self, stop: int) -> None:
        """Write all pictures before step `stop`."""
        steps = np.arange(self._first_step, stop)
        self._images.put(self._rows.fields["data"][: len(steps)])
        self._rows.write(slice(len(steps)), self._start_ns + steps * self._step_ns)
        self._images.forget(len(steps))
        self._first_step = stop


def observation_keeper(
    space: spaces.Space[Any], columns: StepColumns, images: Mapping[Leaf, ImageColumn]
) -> Keeper:
    """A function that keeps observations of a space."""
    leaves = observation_leaves(space)
    keepers = [
        images[leaf].keeper(leaf) if leaf in images else columns.keeper(leaf) for leaf in leaves
    ]
    if not leaves[0].path:
        return keepers[0]
    parts = [(_part(leaf), keep) for leaf, keep in zip(leaves, keepers, strict=True)]

    def keep_all(observation: Any) -> None:
        for part, keep in parts:
            keep(part(observation))

    return keep_all


def converters(space: spaces.Space[Any]) -> list[Converter]:
    """For each leaf, the function that takes its value out of an observation."""
    return [_converter(leaf) for leaf in observation_leaves(space)]


def as_declared(value: Any, leaf: Leaf) -> NDArray[Any]:
    """A value in the dtype and shape that its space declares.

    Floats may lose digits, with a warning; any other change is refused.

    Raises:
        SpaceError: it has another shape, or does not fit.
    """
    where = _where(leaf)
    try:
        array = np.asarray(value)
        with np.errstate(all="ignore"):
            cast = array.astype(leaf.dtype)
    except (TypeError, ValueError, OverflowError) as error:
        raise SpaceError(f"{where} is {value!r:.60}; its space declares {leaf.dtype}") from error
    if not leaf.shape and array.size == 1:
        cast, array = cast.reshape(()), array.reshape(())
    if array.shape != leaf.shape:
        raise SpaceError(f"{where} has shape {array.shape}; its space declares {leaf.shape}")
    if array.dtype == leaf.dtype:
        return cast
    if array.dtype.kind == leaf.dtype.kind == "f":
        # A list of floats claims no dtype of its own.
        if array.ndim and isinstance(value, np.ndarray):
            warnings.warn(
                f"{where} is {array.dtype}, its space declares {leaf.dtype}: logged as such",
                stacklevel=2,
            )
    elif not np.array_equal(cast, array):
        raise SpaceError(f"{where} is {value!r:.60}, which its space's {leaf.dtype} cannot hold")
    return cast


def _converter(leaf: Leaf) -> Converter:
    shape, dtype, part = leaf.shape, leaf.dtype, _part(leaf)

    def convert(observation: Any) -> NDArray[Any]:
        value = part(observation)
        if type(value) is np.ndarray and value.dtype is dtype and value.shape == shape:
            return value
        return as_declared(value, leaf)

    return convert


def _part(leaf: Leaf) -> Callable[[Any], Any]:
    """A function that takes a leaf's value out of an observation, as it is."""

    def part(observation: Any) -> Any:
        try:
            return leaf.of(observation)
        except (KeyError, IndexError, TypeError) as error:
            raise SpaceError(f"{_where(leaf)} is missing") from error

    return part


def _where(leaf: Leaf) -> str:
    role = "action" if leaf.name == "action" else "observation"
    return role + "".join(f"['{key}']" for key in leaf.path)
