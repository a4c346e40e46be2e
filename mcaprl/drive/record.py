"""Log of a drive: episodes as in a recording of this package, beside the robot's topics.

The rows are those that the mapping makes of the robot's topics: an episode ends where it would end
in a bag, its rewards are computed by the same expressions, and an action is that of the command
that was published. So the next training reads the log as it is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.base_policy import BasePolicy
from mcaprl.drive.commands import Commands
from mcaprl.errors import UsageError
from mcaprl.recorder.bags.source import Definition
from mcaprl.recorder.format.log_writer import LogWriter, Message
from mcaprl.recorder.format.messages import EpisodeSummary, add_up
from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.format.schema import ImageRows
from mcaprl.recorder.format.spaces import observation_leaves
from mcaprl.recorder.mapping.align import NS_PER_S
from mcaprl.recorder.mapping.assemble import observed_names, relation
from mcaprl.recorder.mapping.live import Ending, EpisodeState, LiveStep, Topics, joined
from mcaprl.recorder.mapping.plan import Plan
from mcaprl.recorder.mapping.robot import Robot
from mcaprl.recorder.mapping.runs import END_OF_DATA, GAP

_MOST_ROWS = 1024  # Number of steps of an open episode above which the older ones are written
_BUFFER_BYTES, _BUFFER_NS = 2**18, int(NS_PER_S)
"""Size and age at which messages of the robot's topics are written."""


class _Row(NamedTuple):
    """One step of an episode."""

    step: LiveStep
    observation: Any
    action: Any
    behavior: float


class DriveLog:
    """Writer of the log of a drive."""

    def __init__(
        self,
        path: str | Path,
        plan: Plan,
        robot: Robot,
        policy: BasePolicy,
        commands: Commands,
        *,
        is_late: bool,
        overwrite: bool = False,
    ) -> None:
        """Create the file; `is_late` is that of the episodes."""
        assert policy.observation_space is not None, "trained policies have spaces"
        assert policy.action_space is not None, "trained policies have spaces"
        found = commands.described
        self._plan, self._policy, self._is_late = plan, policy, is_late
        metadata = LogMetadata(
            observation_space=policy.observation_space,
            action_space=policy.action_space,
            env_id=plan.mapping.meta.env_id,
            observation_names=observed_names(plan.mapping, robot.shapes),
            action_meanings=found.meanings,
            action_commands=policy.action_commands,
            action_part_names=found.names,
            action_units=found.units if any(found.units) else (),
            relative_to=relation(plan, found.names, robot.shapes),
            step_duration_ns=robot.step_ns,
            policy=policy.name,
            robot=robot.to_json(),
        )
        self._log = LogWriter(path, metadata, overwrite=overwrite)
        leaves = observation_leaves(metadata.observation_space)
        self._vectors = [leaf for leaf in leaves if leaf.encoding is None]
        self._images = [
            (leaf, self._log.image_rows(leaf.topic, leaf.shape, leaf.encoding))
            for leaf in leaves
            if leaf.encoding is not None
        ]
        self._rows = self._log.step_rows()
        self._topics = Topics(robot.topics)
        self._channels: dict[str, int] = {}
        self._messages: list[Message] = []
        self._size, self._first_ns = 0, 0
        self._recent: list[_Row] = []
        self._open: list[_Row] = []
        self._written, self._total, self._episode, self._start_ns = 0, 0.0, 0, 0

    def add(self, topic: str, message: Any, time_ns: int) -> None:
        """Add a message of one of the robot's topics, which may be encoded."""
        is_encoded = isinstance(message, bytes)
        data = message if is_encoded else self._topics.decoders[topic].encode(message)
        if topic not in self._channels:
            self._channels[topic] = self._channel(topic, self._topics.definitions[topic])
        self._first_ns = time_ns if not self._messages else self._first_ns
        self._messages.append((self._channels[topic], time_ns, data))
        self._size += len(data)
        if self._size > _BUFFER_BYTES or time_ns - self._first_ns > _BUFFER_NS:
            self._write_messages()

    def see(self, step: LiveStep, state: EpisodeState, action: Any, behavior: float) -> None:
        """Add a step, whose command was chosen; `behavior` is NaN if unknown."""
        late = int(self._is_late)
        self._recent = [*self._recent, _Row(step, state.observation, action, behavior)][-2 - late :]
        if len(self._recent) <= late:
            return
        now = self._recent[-1 - late]
        if state.ended is not None:
            if state.ended.steps_ago == late:
                self._open.append(now)
            self._end(state.ended, now.step.gap_ns)
        if state.began:
            self._open = [now]
            self._start_ns = now.step.time_ns
        elif state.is_open and state.ended is None:
            self._open.append(now)
            self._write_old()

    def close(self, last_ns: int | None) -> None:
        """End the open episode, and finish the file; `last_ns` is the time of the last message."""
        if self._log.mcap.closed:
            return
        try:
            if self._open and self._recent[-1] is not self._open[-1]:
                self._open += self._recent[-1:] if self._recent[-1].step.frame is not None else []
            if self._open:
                self._end(Ending(0, False, True, END_OF_DATA), last_ns)
            self._write_messages()
            self._log.close()
        finally:
            self._log.mcap.abandon()

    def _channel(self, topic: str, definition: Definition) -> int:
        mcap, name = self._log.mcap, definition.type_name
        if (definition.encoding, definition.schema_encoding) == ("cdr", "ros2msg"):
            return mcap.add_channel(topic, name, definition.schema.decode(errors="replace"))
        return mcap.add_topic(topic, definition.encoding, definition.described)

    def _write_messages(self) -> None:
        self._log.sink.write_messages(self._messages)
        self._messages, self._size = [], 0

    def _end(self, ending: Ending, last_ns: int | None) -> None:
        """Write the rest of an episode, without what a bag would not have."""
        rows = self._open
        self._open = []
        if ending.reason in (GAP, END_OF_DATA) and last_ns is not None:
            # Steps before a gap end with the first one at or after the last message.
            late = [k for k, row in enumerate(rows) if row.step.time_ns >= last_ns]
            rows = rows[: late[0] + 1] if late else rows
        length = self._written + len(rows) - 1
        if rows and length >= max(self._plan.mapping.episodes.min_steps, 1):
            self._write_messages()
            self._write(rows, ending)
            self._episode += 1
        self._written, self._total = 0, 0.0

    def _write_old(self) -> None:
        """Write the rows that no later message can remove from the episode."""
        least = self._plan.mapping.episodes.min_steps + 1
        if len(self._open) < _MOST_ROWS + least:
            return
        until_ns = self._open[-1].step.time_ns - self._plan.mapping.episodes.gap_s * NS_PER_S
        old = [row for row in self._open[:-least] if row.step.time_ns < until_ns]
        if len(old) > 1:
            self._write(old, None)
            self._open = self._open[len(old) - 1 :]

    def _write(self, rows: Sequence[_Row], ending: Ending | None) -> None:
        """Write the transitions between rows; with an ending, the last one is the final record."""
        rewards = self._rewards(rows, ending)
        count = len(rows) if ending is not None else len(rows) - 1
        times_ns = np.array([row.step.time_ns for row in rows[:count]])
        self._total = add_up(rewards, self._total)
        for first in range(0, count, len(self._rows)):
            part = rows[first : min(first + len(self._rows), count)]
            where = slice(len(part))
            numbers = self._written + first + np.arange(len(part))
            self._rows.number(where, self._episode, numbers)
            for leaf in self._vectors:
                self._rows.put(leaf.name, where, np.stack([leaf.of(r.observation) for r in part]))
            acted = slice(min(len(part), len(rows) - 1 - first))
            self._rows.put("action", acted, np.array([row.action for row in part[acted]]))
            self._rows.put("reward", acted, rewards[first : first + len(part)])
            self._rows.put(self._log.behavior.name, acted, [row.behavior for row in part[acted]])
            if ending is not None and first + len(part) == count:
                if len(part) > 1:
                    self._rows.put("terminated", len(part) - 2, ending.terminated)
                    self._rows.put("truncated", len(part) - 2, ending.truncated)
                self._rows.finish(np.array([len(part) - 1]))
            if first + len(part) < count or ending is None:
                self._put(part, times_ns[first : first + len(part)])
                continue
            self._log.write_episodes([self._summary(rows, ending)], log_lines=True)
            self._put(part, times_ns[first:])
        self._written += len(rows) - 1

    def _put(self, rows: Sequence[_Row], times_ns: NDArray[np.int64]) -> None:
        """Write the images of some rows, and then the rows."""
        for leaf, images in self._images:
            _write_images(images, [leaf.of(row.observation) for row in rows], times_ns)
        self._rows.write(slice(len(rows)), times_ns)

    def _rewards(self, rows: Sequence[_Row], ending: Ending | None) -> NDArray[np.float64]:
        """Return the reward of each row but the last."""
        columns = joined([row.step.columns for row in rows])
        if np.ndim(rows[0].action) == 0:
            columns["action"] = np.array([row.action for row in rows])
        following = np.minimum(np.arange(len(rows)) + 1, len(rows) - 1)
        for name in ("terminated", "truncated"):
            flags = np.zeros(len(rows), np.bool_)
            flags[-1] = ending is not None and not ending.reason and getattr(ending, name)
            columns[name] = flags[following]
        with self._plan.place.named("reward"):
            found = self._plan.reward(columns, following)[: len(rows) - 1]
        if not np.isfinite(found).all():
            raise UsageError(
                f"{self._plan.place.of('reward')}: the reward is not finite: set `missing` for the"
                " quantities in it"
            )
        return found

    def _summary(self, rows: Sequence[_Row], ending: Ending) -> EpisodeSummary:
        return EpisodeSummary(
            episode=self._episode,
            length=self._written + len(rows) - 1,
            total_reward=self._total,
            terminated=ending.terminated,
            truncated=ending.truncated,
            start_time_ns=self._start_ns,
            end_time_ns=rows[-1].step.time_ns,
            reason=self._reason(rows, ending),
            policy=self._policy.name,
            epsilon=math.nan,
        )

    def _reason(self, rows: Sequence[_Row], ending: Ending) -> str:
        """Return the first reason of the mapping that is true at the end, or that of the ending."""
        last = rows[-1]
        later = [row for row in self._recent if row.step.time_ns > last.step.time_ns]
        after = [row for row in later if row.step.columns][:1]
        columns = joined([row.step.columns for row in (last, *after)])
        if np.ndim(last.action) == 0:
            columns["action"] = np.array([row.action for row in (last, *after)])
        following = np.full(1 + len(after), len(after))
        for name, expression in self._plan.reasons.items():
            with self._plan.place.named("episodes", "reasons", name):
                value = expression.evaluate(columns, following).astype(np.float64)[0]
            if value and not math.isnan(value):
                return name
        return ending.reason or ("terminated" if ending.terminated else "truncated")


def _write_images(
    rows: ImageRows, images: Sequence[NDArray[Any]], times_ns: NDArray[np.int64]
) -> None:
    data = np.stack([np.ascontiguousarray(each).view(np.uint8).reshape(-1) for each in images])
    rows.write_columns(times_ns, {"data": data})
