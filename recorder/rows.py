"""Rows that wait to be written: what the environment gives, copied into preallocated columns."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import SpaceError
from mcaprl.recorder.log_writer import STEPS_PER_CHUNK, LogWriter
from mcaprl.recorder.spaces import Leaf, observation_leaves


class StepColumns:
    """The rows of `/rl/step` that are not yet on disk, all of one episode."""

    def __init__(self, log: LogWriter) -> None:
        """Preallocate a chunk of them."""
        self._log = log
        self._rows = log.step_rows(STEPS_PER_CHUNK)
        payload = self._rows["payload"]
        self.fields = {name: payload[name] for name in payload.dtype.names or ()}
        self._reward, self._prob = self.fields["reward"], self.fields["behavior_prob"]
        self._action = _ActionColumn(log.action, self.fields["action"])
        self.row = -1

    def begin(self, episode: int, start_ns: int, step_ns: int) -> None:
        """Begin an episode: `start_ns` is the log_time of its first row."""
        self._episode, self._start_ns, self._step_ns = episode, start_ns, step_ns
        self._first_step, self.row = 0, -1

    def next_row(self) -> None:
        """Go to the next row; write the others when the last one is reached."""
        self.row += 1
        if self.row == len(self._rows):
            # One whole transition stays behind, for its episode may end here and be marked so.
            self._write(self.row - 1)
            self._rows["payload"][0] = self._rows["payload"][self.row - 1]
            self.row = 1

    def step_back(self) -> None:
        """Leave the present row again; nothing was put there."""
        self.row -= 1

    def act(self, action: Any, behavior_prob: float) -> None:
        """Put the action that is taken at the present row, and its probability."""
        self._action.put(self.row, action)
        self._prob[self.row] = behavior_prob

    def reward(self, reward: float) -> None:
        """Put what the action brought."""
        self._reward[self.row] = reward

    def end(self, terminated: bool, truncated: bool) -> None:
        """Mark the last transition and the final row, and write all."""
        final, fields = self.row, self.fields
        fields["terminated"][final - 1], fields["truncated"][final - 1] = terminated, truncated
        fields["action"][final], fields["reward"][final] = 0, 0.0
        fields["behavior_prob"][final], fields["final"][final] = math.nan, True
        self._write(final + 1)
        for name in ("terminated", "truncated", "final"):
            fields[name][: final + 1] = False
        self.clear()

    def clear(self) -> None:
        """Forget the rows."""
        self.row = -1

    def _write(self, count: int) -> None:
        rows = self._rows[:count]
        steps = np.arange(self._first_step, self._first_step + count)
        rows["log_time"] = self._start_ns + steps * self._step_ns
        self.fields["episode"][:count] = self._episode
        self.fields["step"][:count] = steps
        self._log.write_steps(rows)
        self._first_step += count


class _ActionColumn:
    """Stores actions, whichever of an int, a NumPy scalar or an array an agent gives."""

    def __init__(self, leaf: Leaf, column: NDArray[Any]) -> None:
        self._leaf, self._column = leaf, column

    def put(self, row: int, action: Any) -> None:
        if not self._leaf.shape:
            self._column[row] = (
                action if isinstance(action, int) else int(np.asarray(action).item())
            )
            return
        values = np.asarray(action)
        if values.shape != self._leaf.shape:
            raise SpaceError(
                f"action of shape {values.shape}; the action space has {self._leaf.shape}"
            )
        self._column[row] = values.reshape(-1)


class ImageColumn:
    """The pictures of one topic that are not yet on disk."""

    def __init__(
        self, log: LogWriter, topic: str, shape: tuple[int, ...], encoding: str | None
    ) -> None:
        """Announce the topic; see `LogWriter.add_image_topic`."""
        assert encoding is not None, f"{topic} has no images"
        self._log = log
        self._rows = log.add_image_topic(topic, shape, encoding)
        self.column = self._rows["payload"]["data"]
        self.row = -1

    def next_row(self, time_ns: int) -> None:
        """Go to the next row, whose log_time is `time_ns`; write those that fill a chunk."""
        if self.row + 1 == len(self._rows):
            self.flush()
        self.row += 1
        self._rows["log_time"][self.row] = time_ns

    def step_back(self) -> None:
        """Leave the present row again; nothing was put there."""
        self.row -= 1

    def flush(self) -> None:
        """Write all rows."""
        self._log.write_images(self._rows[: self.row + 1])
        self.clear()

    def clear(self) -> None:
        """Forget the rows."""
        self.row = -1


def leaf_writers(
    space: spaces.Space[Any], columns: StepColumns, images: Mapping[Leaf, ImageColumn]
) -> list[Callable[[Any], None]]:
    """A function for each leaf that copies its part of an observation into the present row."""
    writers = []
    for leaf in observation_leaves(space):
        image = images.get(leaf)
        if image is not None:
            writers.append(_leaf_writer(leaf, image, image.column))
        else:
            writers.append(_leaf_writer(leaf, columns, columns.fields[leaf.name]))
    return writers


def _leaf_writer(
    leaf: Leaf, cursor: StepColumns | ImageColumn, column: NDArray[Any]
) -> Callable[[Any], None]:
    shape, dtype, path = leaf.shape, leaf.dtype, leaf.path
    flat = len(shape) == 1

    def write(observation: Any) -> None:
        value = leaf.of(observation) if path else observation
        if type(value) is not np.ndarray or value.dtype is not dtype or value.shape != shape:
            value = _as_declared(value, leaf)
        column[cursor.row] = value if flat else value.reshape(column.shape[1:])

    return write


def _as_declared(value: Any, leaf: Leaf) -> NDArray[Any]:
    """An observation in the form that its space declares.

    Raises:
        SpaceError: it has another shape.
    """
    array = np.asarray(value)
    where = "".join(f"['{key}']" for key in leaf.path)
    if array.shape != leaf.shape:
        raise SpaceError(
            f"observation{where} has shape {array.shape}; its space declares {leaf.shape}"
        )
    if array.dtype != leaf.dtype and leaf.shape:
        warnings.warn(
            f"observation{where} is {array.dtype}, its space declares {leaf.dtype}: logged as"
            f" {leaf.dtype}",
            stacklevel=2,
        )
    return array.astype(leaf.dtype)
