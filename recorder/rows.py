"""Rows that wait to be written: what the environment gives, copied into preallocated columns.

The columns know no "present row" of their own: a row is found by the step it belongs to. So there
is one counter, the wrapper's, and a step counts only when all of it is in place.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import SpaceError
from mcaprl.recorder.log_writer import LogWriter
from mcaprl.recorder.spaces import Leaf, observation_leaves

Writer = Callable[[int, NDArray[Any]], None]
"""Puts a leaf's value at a step."""
Converter = Callable[[Any], NDArray[Any]]
"""Takes a leaf's value out of an observation, in the dtype and shape that its space declares."""


class StepColumns:
    """The rows of `/rl/step` that are not yet on disk, all of one episode."""

    def __init__(self, log: LogWriter) -> None:
        """Preallocate a chunk of them."""
        self._log = log
        self._rows = log.step_rows()
        payload = self._rows["payload"]
        self.fields = {name: payload[name] for name in payload.dtype.names or ()}
        self._reward, self._prob = self.fields["reward"], self.fields["behavior_prob"]
        self._action, self._action_leaf = self.fields["action"], log.action

    def begin(self, episode: int, start_ns: int, step_ns: int) -> None:
        """Begin an episode: `start_ns` is the log_time of its first row."""
        self._episode, self._start_ns, self._step_ns = episode, start_ns, step_ns
        self._first_step, self._total_reward = 0, 0.0

    @property
    def full_at(self) -> int:
        """The first step for whose observation there is no row."""
        return self._first_step + len(self._rows)

    def make_room(self, step: int) -> None:
        """Write all rows before the transition that leads to `step`.

        That one stays behind, for its episode may end there and be marked so.
        """
        keep = step - self._first_step - 1
        self._write(keep)
        self._rows["payload"][0] = self._rows["payload"][keep]

    def act(self, step: int, action: Any, behavior_prob: float) -> None:
        """Put the action that is taken at `step`, and its probability.

        Raises:
            SpaceError: the action is not one of the action space's.
        """
        row = step - self._first_step
        if type(action) in (int, np.int64) and not self._action_leaf.shape:
            self._action[row] = action
        else:
            self._action[row] = _flat(as_declared(action, self._action_leaf))
        self._prob[row] = behavior_prob

    def reward(self, step: int, reward: float) -> None:
        """Put what the action at `step` brought."""
        self._reward[step - self._first_step] = reward

    def writer(self, leaf: Leaf) -> Writer:
        """A function that puts observations of a leaf."""
        column = self.fields[leaf.name]

        def write(step: int, value: NDArray[Any]) -> None:
            column[step - self._first_step] = _flat(value)

        return write

    def end(self, steps: int, terminated: bool, truncated: bool) -> None:
        """Mark the last transition and the final row, and write all.

        Args:
            steps: transitions of the episode, 1 or more.
            terminated: of the last one.
            truncated: likewise.
        """
        final, fields = steps - self._first_step, self.fields
        assert final >= 1, "the last transition stays in memory"
        fields["terminated"][final - 1], fields["truncated"][final - 1] = terminated, truncated
        fields["action"][final], fields["reward"][final] = 0, 0.0
        fields["behavior_prob"][final], fields["final"][final] = math.nan, True
        self._write(final + 1)
        for name in ("terminated", "truncated", "final"):
            fields[name][: final + 1] = False

    def total_reward(self, steps: int) -> float:
        """What the first `steps` transitions brought, added up in order."""
        return add_up(self._reward[: steps - self._first_step], self._total_reward)

    def _write(self, count: int) -> None:
        rows = self._rows[:count]
        steps = np.arange(self._first_step, self._first_step + count)
        rows["log_time"] = self._start_ns + steps * self._step_ns
        self.fields["episode"][:count] = self._episode
        self.fields["step"][:count] = steps
        self._total_reward = self.total_reward(self._first_step + count)
        self._log.write_steps(rows)
        self._first_step += count


class ImageColumn:
    """The pictures of one topic that are not yet on disk."""

    def __init__(
        self, log: LogWriter, topic: str, shape: tuple[int, ...], encoding: str | None
    ) -> None:
        """Announce the topic; see `LogWriter.add_image_topic`."""
        assert encoding is not None, f"{topic} has no images"
        self._log = log
        self._rows = log.add_image_topic(topic, shape, encoding)
        self._column = self._rows["payload"]["data"]
        self._first_step = 0

    def begin(self, start_ns: int, step_ns: int) -> None:
        """Begin an episode: `start_ns` is the log_time of its first picture."""
        self._start_ns, self._step_ns, self._first_step = start_ns, step_ns, 0

    @property
    def full_at(self) -> int:
        """The first step for whose picture there is no row."""
        return self._first_step + len(self._rows)

    def put(self, step: int, picture: NDArray[Any]) -> None:
        """Put the picture at `step`, of any shape with as many bytes."""
        self._column[step - self._first_step] = picture.reshape(-1)

    def flush(self, stop: int) -> None:
        """Write all pictures before step `stop`."""
        rows = self._rows[: stop - self._first_step]
        steps = np.arange(self._first_step, stop)
        rows["log_time"] = self._start_ns + steps * self._step_ns
        self._log.write_images(rows)
        self._first_step = stop


def converters(space: spaces.Space[Any]) -> list[Converter]:
    """For each leaf, the function that takes its value out of an observation."""
    return [_converter(leaf) for leaf in observation_leaves(space)]


def writers(
    space: spaces.Space[Any], columns: StepColumns, images: Mapping[Leaf, ImageColumn]
) -> list[Writer]:
    """For each leaf, the function that puts its value at a step."""
    return [
        images[leaf].put if leaf in images else columns.writer(leaf)
        for leaf in observation_leaves(space)
    ]


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


def add_up(rewards: NDArray[np.float64], start: float = 0.0) -> float:
    """The sum in order, the same on every machine; `sum` and `np.sum` add in other ways."""
    if not len(rewards):
        return start
    with np.errstate(all="ignore"):
        return float(np.add.accumulate(np.concatenate([[start], rewards]))[-1])


def _converter(leaf: Leaf) -> Converter:
    shape, dtype, path = leaf.shape, leaf.dtype, leaf.path

    def convert(observation: Any) -> NDArray[Any]:
        value = observation
        if path:
            try:
                value = leaf.of(observation)
            except (KeyError, IndexError, TypeError) as error:
                raise SpaceError(f"{_where(leaf)} is missing") from error
        if type(value) is np.ndarray and value.dtype is dtype and value.shape == shape:
            return value
        return as_declared(value, leaf)

    return convert


def _where(leaf: Leaf) -> str:
    role = "action" if leaf.name == "action" else "observation"
    return role + "".join(f"['{key}']" for key in leaf.path)


def _flat(value: NDArray[Any]) -> NDArray[Any]:
    return value if value.ndim <= 1 else value.reshape(-1)
