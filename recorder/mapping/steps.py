"""Steps of a bag: their quantities, actions and rewards, and the episodes that they form.

Steps exist only within the stretches of a run; see `clock`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import UsageError
from mcaprl.recorder.mapping.actions import Actions, CommandPart, actions_of
from mcaprl.recorder.mapping.clock import (
    Ticks,
    distinct,
    stretches,
    ticks_at_rate,
    ticks_of_topic,
)
from mcaprl.recorder.mapping.config import Stamp, TimeSource
from mcaprl.recorder.mapping.expression import Expression
from mcaprl.recorder.mapping.observe import Values, pose_of, values_of
from mcaprl.recorder.mapping.paths import as_numbers
from mcaprl.recorder.mapping.plan import Plan, Wanted
from mcaprl.recorder.mapping.poses.transforms import Transforms
from mcaprl.recorder.mapping.runs import (
    Recorded,
    Run,
    Runs,
    runs_of,
)
from mcaprl.recorder.mapping.segments import Marks, Segment, segments

NS_PER_S = 10**9


class Steps(NamedTuple):
    """The N steps between two resets of the clock.

    Attributes:
        times_ns: (N,) times.
        quantities: Values of each quantity by name.
        actions: Action of each step.
        probs: (N,) probability of the action; NaN if unknown.
        rewards: (N,) reward of each step's action; may depend on the next step.
        episodes: Episodes that the steps form.
        reasons: (N,) flags by end reason: whether the condition of this reason is true.
    """

    times_ns: NDArray[np.int64]
    quantities: dict[str, Values]
    actions: Actions
    probs: NDArray[np.float32]
    rewards: NDArray[np.float64]
    episodes: list[Segment]
    reasons: dict[str, NDArray[np.bool_]]


class StepReader:
    """Reader that returns the steps of a bag run by run.

    Attributes:
        runs: Runs of the bag, and the messages that were left out.
    """

    def __init__(self, plan: Plan) -> None:
        """Find the runs, and read the transforms if the mapping uses them."""
        self._plan, self._mapping = plan, plan.mapping
        self._streams: dict[str, Recorded] = {**plan.streams}
        self._transforms: dict[str, Transforms] = {
            topic: Transforms(plan.bag, self._transform_time(topic), topic=topic, frames=frames)
            for topic, frames in plan.frames.items()
        }
        # Names of the streams of each transform.
        self._frames: dict[str, list[str]] = {}
        for name, (keys, quantity, source, *_) in plan.quantities.items():
            if quantity.transform is not None:
                transforms = self._transforms[source.topic]
                with plan.place.named(*keys):
                    found = transforms.streams(quantity.transform, quantity.in_)
                    self._streams |= found
                    self._frames[name] = list(found)
        self.runs: Runs = runs_of(
            self._streams, plan.mapping.episodes.gap_s, plan.bag.paths, plan.bag.recordings
        )

    @property
    def count(self) -> int:
        """Number of runs."""
        return len(self.runs.runs)

    def read(self, number: int) -> Steps:
        """Return the steps of one run; `number` is its index."""
        plan, run = self._plan, self.runs.runs[number]
        ticks = self._ticks(run)
        times_ns = ticks.times_ns
        quantities = {
            name: self._values(wanted, run, ticks) for name, wanted in plan.quantities.items()
        }
        probs = np.full(len(times_ns), np.nan, np.float32)
        if plan.behavior_prob is not None:
            found = self._values(plan.behavior_prob, run, ticks)
            probs = self._scalars(plan.behavior_prob, found).astype(np.float32)
        columns = {
            **plan.constants,
            **{
                name: values.values
                for name, values in quantities.items()
                if plan.quantities[name].quantity.image is None
            },
        }
        following = np.minimum(np.arange(len(times_ns)) + 1, max(len(times_ns) - 1, 0))
        actions = self._actions(run, ticks, columns, following)
        if actions.values.ndim == 1:
            columns["action"] = actions.values
        conditions = self._conditions(("episodes",), plan.conditions, columns, following)
        reasons = self._conditions(("episodes", "reasons"), plan.reasons, columns, following)
        nothing = np.zeros(len(times_ns), bool)
        terminated = conditions.get("terminated", nothing)
        truncated = conditions.get("truncated", nothing) | conditions.get("end", nothing)
        # For rewards: a transition is terminal if the step that it leads to is terminal.
        columns |= {"terminated": terminated[following], "truncated": truncated[following]}
        marks = Marks(
            usable=self._usable(quantities, len(times_ns)),
            acted=~actions.missing,
            gap_before=ticks.gap_before,
            gap_after=ticks.gap_after,
            begin=conditions.get("begin"),
            terminated=terminated,
            truncated=truncated,
        )
        with plan.place.named("reward"):
            rewards = plan.reward(columns, following)
        episodes = segments(marks, self._mapping.episodes.max_steps)
        return Steps(times_ns, quantities, actions, probs, rewards, episodes, reasons)

    def _transform_time(self, topic: str) -> TimeSource:
        """Return the time of the transforms of a topic."""
        times = {
            wanted.quantity.time or self._mapping.time
            for wanted in self._plan.quantities.values()
            if wanted.quantity.transform is not None and wanted.source.topic == topic
        }
        time = times.pop()
        if times or isinstance(time, Stamp):
            raise UsageError(
                f"{self._plan.place.of('observation')}: all transforms of {topic} need the same"
                " time: log_time, publish_time or header (the stamp of each transform)"
            )
        return time

    def _ticks(self, run: Run) -> Ticks:
        """Return the times of the steps of a run."""
        plan, mapping = self._plan, self._mapping
        if plan.clock is not None:
            distinct(run.streams, plan.clock, self._streams)
        parts = stretches(
            [each for name in self._required() for each in self._of(name, run)],
            [each for name in mapping.observation for each in self._of(name, run)],
            [each.times_ns for each in run.streams.values()],
            mapping.episodes.gap_s,
        )
        if plan.clock is not None:
            ticks_ns = run.streams[plan.clock].times_ns
            return ticks_of_topic(ticks_ns, parts, mapping.episodes.gap_s)
        assert mapping.clock.rate_hz is not None, "the mapping was validated"
        count = sum(len(each.times_ns) for each in run.streams.values())
        with plan.place.named("clock", "rate_hz"):
            return ticks_at_rate(mapping.clock.rate_hz, parts, count, mapping.episodes.gap_s)

    def _of(self, name: str, run: Run) -> list[NDArray[np.int64]]:
        """Return the times of the messages of a quantity, for each of its streams."""
        wanted = self._plan.quantities[name]
        names = self._frames.get(name, [wanted.stream])
        return [run.streams[each].times_ns for each in names]

    def _required(self) -> list[str]:
        """Return the names of the observed quantities without which there is no step."""
        found = self._mapping.observation.items()
        return [name for name, each in found if each.missing is None or each.image is not None]

    def _values(
        self,
        wanted: Wanted,
        run: Run,
        ticks: Ticks,
    ) -> Values:
        quantity, gap_s = wanted.quantity, self._mapping.episodes.gap_s
        with self._plan.place.named(*wanted.keys):
            if quantity.transform is not None:
                transforms = self._transforms[wanted.source.topic].within(run)
                return pose_of(quantity, transforms, ticks.times_ns, gap_s)
            stream, messages = self._plan.streams[wanted.stream], run.streams[wanted.stream]
            ends_ns = ticks.ends_ns if wanted.is_during else None
            return values_of(
                quantity, wanted.source, stream, messages, ticks.times_ns, ends_ns, gap_s
            )

    def _scalars(self, wanted: Wanted, found: Values) -> NDArray[np.float64]:
        """Return values as numbers, one for each step."""
        with self._plan.place.named(*wanted.keys):
            numbers = as_numbers(found.values, str(wanted.source.path))
            if numbers.ndim > 1:
                assert wanted.source.path is not None, "only fields have elements"
                raise UsageError(
                    f"{wanted.source.path} has {numbers.shape[1]} elements; choose one of them,"
                    f" such as {wanted.source.path.first}"
                )
            return numbers

    def _actions(
        self,
        run: Run,
        ticks: Ticks,
        columns: dict[str, NDArray[Any]],
        following: NDArray[np.int64],
    ) -> Actions:
        action, plan = self._mapping.action, self._plan
        commands = []
        for wanted in plan.commands:
            found = self._values(wanted, run, ticks)
            # Only a single discrete field may be a text, and only other fields have elements.
            if action.field is None:
                with plan.place.named(*wanted.keys):
                    numbers = as_numbers(found.values, str(wanted.source.path))
                found = found._replace(values=numbers)
            elif found.values.dtype.kind != "O":
                found = found._replace(values=self._scalars(wanted, found))
            commands.append(_command(wanted, found))
        for place, expression in enumerate(plan.expressions):
            with plan.place.named("action", "expressions", place):
                values = expression.evaluate(columns, following).astype(np.float64)
            commands.append(
                CommandPart(expression.text, values, np.isnan(values), path=expression.text)
            )
        with plan.place.named("action"):
            return actions_of(action, commands)

    def _conditions(
        self,
        keys: tuple[str, ...],
        expressions: dict[str, Expression],
        columns: dict[str, NDArray[Any]],
        following: NDArray[np.int64],
    ) -> dict[str, NDArray[np.bool_]]:
        found = {}
        for name, expression in expressions.items():
            with self._plan.place.named(*keys, name):
                values = expression.evaluate(columns, following).astype(np.float64)
            # A condition on a missing value (NaN) is false.
            found[name] = np.nan_to_num(values, nan=0.0) != 0
        return found

    def _usable(self, quantities: dict[str, Values], count: int) -> NDArray[np.bool_]:
        """Return a mask of the steps that have all observations, each at most `gap_s` old."""
        usable = np.ones(count, bool)
        for name in self._required():
            values = quantities[name]
            with np.errstate(invalid="ignore"):
                is_stale = np.abs(values.age_s) > self._mapping.episodes.gap_s
            usable &= ~values.missing & ~is_stale
        return usable


def _command(wanted: Wanted, found: Values) -> CommandPart:
    """Return a field of the command, named by the last part of its path."""
    path, names = wanted.source.path, wanted.quantity.names
    assert path is not None, "commands are fields"
    whole = path._replace(elements=None) if isinstance(path.elements, slice) else path
    word = str(whole).rpartition(".")[2]
    return CommandPart(word, found.values, found.missing, tuple(names or ()), str(path))
