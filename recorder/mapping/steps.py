"""Steps of a bag: their times, quantities, actions and rewards, and the episodes that they form.

A *stretch* is a part of a run without a gap. Steps exist only within stretches: from the first
message on, up to the first step at or after the last message, which is the last step that has a new
message. No value is interpolated, or taken from a later message, across a gap.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import UsageError
from mcaprl.recorder.format.behavior import PROBABILITY, BehaviorField, behavior_field
from mcaprl.recorder.mapping.actions import Actions, CommandPart, actions_of, unit_of
from mcaprl.recorder.mapping.align import NS_PER_S, as_numbers, time_order
from mcaprl.recorder.mapping.expression import Expression
from mcaprl.recorder.mapping.observe import Values, pose_of, values_of
from mcaprl.recorder.mapping.plan import Plan, Wanted
from mcaprl.recorder.mapping.runs import (
    Marks,
    Messages,
    Recorded,
    Run,
    Runs,
    Segment,
    runs_of,
    segments,
)
from mcaprl.recorder.mapping.transforms import Transforms

_Times = NDArray[np.int64]

_SIDES: tuple[Literal["left", "right"], ...] = ("left", "right")
_STEPS_PER_MESSAGE, _FEW_STEPS = 1000, 10_000
"""Largest number of steps at a fixed rate for each message, and beside those."""


class Ticks(NamedTuple):
    """Times of the N steps of a run.

    Attributes:
        times_ns: (N,) times.
        gap_before: (N,) whether there is a gap between the step and the one before it.
        gap_after: Whether there is a gap after the last step.
    """

    times_ns: _Times
    gap_before: NDArray[np.bool_]
    gap_after: bool

    @classmethod
    def of(cls, times: Sequence[_Times], parts: Sequence[Stretch], gap_s: float) -> Ticks:
        """Return the steps of all stretches; `times` has those of each stretch."""
        times_ns = np.concatenate([np.empty(0, np.int64), *times])
        gap_before = np.diff(times_ns, prepend=times_ns[:1]) > gap_s * NS_PER_S
        starts = np.cumsum([0, *map(len, times)])[:-1]
        gap_before[starts[starts < len(times_ns)]] = True
        is_gap = bool(parts) and parts[-1].stop_ns - 1 - parts[-1].last_ns > gap_s * NS_PER_S
        return cls(times_ns, gap_before, is_gap)

    @property
    def ends_ns(self) -> _Times:
        """(N,) end of each step: the next step's time.

        The last step before a gap has the median duration.
        """
        durations, is_inner = np.diff(self.times_ns), ~self.gap_before[1:]
        typical = int(np.median(durations[is_inner])) if is_inner.any() else int(NS_PER_S)
        until = np.append(np.where(is_inner, durations, typical), typical)
        found: _Times = self.times_ns + until[: len(self.times_ns)]
        return found


class Stretch(NamedTuple):
    """Part of a run without a gap.

    Attributes:
        first_ns: Time of the first message, from which on there are steps.
        last_ns: Time of the last message. The last step is the first one at or after it, which is
            the last one that has a new message.
        stop_ns: Time of the next stretch, or of the end of the run, before which all steps are.
    """

    first_ns: int
    last_ns: int
    stop_ns: int


def stretches(
    required: Sequence[_Times], observed: Sequence[_Times], used: Sequence[_Times], gap_s: float
) -> list[Stretch]:
    """Return the stretches of a run.

    A gap is an interval longer than `gap_s` without a message of a required stream, also at the
    begin and the end of the run, or, if no stream is required, without any message.

    Args:
        required: (M,) times of each stream that a step needs, not descending.
        observed: (M,) times of each stream that is observed, not descending.
        used: (M,) times of all streams, not descending.
        gap_s: Longest interval that is not a gap.
    """
    used = [each for each in used if len(each)]
    if not used or not all(len(each) for each in required):
        return []
    first, stop = min(int(each[0]) for each in used), max(int(each[-1]) for each in used) + 1
    gaps: list[tuple[int, int]] = []
    for times_ns in required or [np.sort(np.concatenate(used))]:
        if times_ns[0] - first > gap_s * NS_PER_S:
            gaps.append((first - 1, int(times_ns[0])))
        after = np.flatnonzero(np.diff(times_ns) > gap_s * NS_PER_S)
        gaps += zip(times_ns[after].tolist(), times_ns[after + 1].tolist(), strict=True)
        if stop - times_ns[-1] > gap_s * NS_PER_S + 1:
            gaps.append((int(times_ns[-1]), stop))
    found, start = list[Stretch](), first
    for low, high in sorted(gaps):
        if start <= low:
            found.append(Stretch(start, low, high))
        elif found:
            found[-1] = found[-1]._replace(stop_ns=max(found[-1].stop_ns, high))
        start = max(start, high)
    if start < stop:
        last = max((int(each[-1]) for each in observed if len(each)), default=stop)
        found.append(Stretch(start, last if required else stop - 1, stop))
    return found


def distinct(streams: dict[str, Messages], clock: str, recorded: Mapping[str, Recorded]) -> None:
    """Make the times of a clock's messages distinct, in place.

    Of messages with equal times, as those of a simulation whose clock is slow, each one but the
    first gets a time that is one nanosecond later than that of the one before it. Messages of other
    streams with the same time get the time of the last clock message that was recorded before them.
    """
    ticks = streams[clock]
    is_same = np.diff(ticks.times_ns, prepend=ticks.times_ns[:1] - 1) == 0
    if not is_same.any():
        return
    count = np.arange(len(is_same))
    nth = count - np.maximum.accumulate(np.where(is_same, 0, count))
    tick_places = recorded[clock].places[ticks.rows]
    for name, messages in streams.items():
        if name == clock:
            times_ns = np.maximum.accumulate(ticks.times_ns + nth - count) + count
        else:
            places = np.concatenate([tick_places, recorded[name].places[messages.rows]])
            every_ns = np.concatenate([ticks.times_ns, messages.times_ns])
            order = np.lexsort((places[:, 1], places[:, 0], every_ns))
            passed = np.empty(len(order), np.int64)
            passed[order] = np.cumsum(order < len(is_same))
            low, high = (
                np.searchsorted(ticks.times_ns, messages.times_ns, side) for side in _SIDES
            )
            later = passed[len(is_same) :] - low - 1
            times_ns = messages.times_ns + np.where(high > low, np.maximum(later, 0), 0)
        by_time = time_order(times_ns)
        streams[name] = Messages(times_ns[by_time], messages.rows[by_time])


def ticks_of_topic(times_ns: _Times, parts: Sequence[Stretch], gap_s: float) -> Ticks:
    """Return one step for each message of a clock with the times (M,)."""
    found = []
    for part in parts:
        first, last, stop = np.searchsorted(times_ns, part)
        found.append(times_ns[first : min(last + 1, stop)])
    return Ticks.of(found, parts, gap_s)


def ticks_at_rate(rate_hz: float, parts: Sequence[Stretch], messages: int, gap_s: float) -> Ticks:
    """Return steps at a fixed rate, beginning at the first message of each stretch."""
    period_ns = NS_PER_S / rate_hz
    # If a duration is a whole number of periods, rounding must not add or remove a step.
    until = [math.ceil((last - first) / period_ns - 1e-6) for first, last, _ in parts]
    within = [math.floor((stop - 1 - first) / period_ns + 1e-6) for first, _, stop in parts]
    counts = [min(pair) + 1 for pair in zip(until, within, strict=True)]
    most = _STEPS_PER_MESSAGE * messages + _FEW_STEPS
    if sum(counts) > most:
        raise UsageError(
            f"{sum(counts)} steps are too many for {messages} messages: use a rate at which there"
            f" are at most {most}"
        )
    found = []
    for k, (part, count) in enumerate(zip(parts, counts, strict=True)):
        times_ns = part.first_ns + np.rint(np.arange(count) * period_ns).astype(np.int64)
        found.append(times_ns[times_ns < parts[k + 1].first_ns] if k + 1 < len(parts) else times_ns)
    return Ticks.of(found, parts, gap_s)


class Steps(NamedTuple):
    """The N steps between two resets of the clock.

    Attributes:
        times_ns: (N,) times.
        quantities: Values of each quantity by name.
        actions: Action of each step.
        behavior: (N,) probability or log density of the action; NaN if unknown.
        rewards: (N,) reward of each step's action; may depend on the next step.
        episodes: Episodes that the steps form.
        reasons: (N,) flags by end reason: whether the condition of this reason is true.
        ticks: Times of the steps, and gaps between them.
        columns: Columns of expressions by name.
    """

    times_ns: NDArray[np.int64]
    quantities: dict[str, Values]
    actions: Actions
    behavior: NDArray[np.float32]
    rewards: NDArray[np.float64]
    episodes: list[Segment]
    reasons: dict[str, NDArray[np.bool_]]
    ticks: Ticks
    columns: Mapping[str, NDArray[Any]]


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
            topic: Transforms(plan.bag, plan.transform_time(topic), topic=topic, frames=frames)
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
        """Return the steps of one run, as `divided` without labels; `number` is its index."""
        plan, run = self._plan, self.runs.runs[number]
        ticks = self._ticks(run)
        times_ns = ticks.times_ns
        quantities = {
            name: self._values(wanted, run, ticks) for name, wanted in plan.quantities.items()
        }
        columns = {
            **plan.constants,
            **{
                name: values.values
                for name, values in quantities.items()
                if plan.quantities[name].quantity.pixels is None
            },
        }
        actions = self._actions(run, ticks, columns, _following(len(times_ns)))
        behavior = self._behavior(run, ticks, behavior_field(actions.space))
        if actions.values.ndim == 1:
            columns["action"] = actions.values
        rewards = np.empty(0)
        found = Steps(times_ns, quantities, actions, behavior, rewards, [], {}, ticks, columns)
        return self.divided(found)

    def divided(self, steps: Steps, labels: Mapping[str, NDArray[Any]] | None = None) -> Steps:
        """Return the steps of a run with their rewards and episodes.

        Args:
            steps: Steps.
            labels: (N,) columns of the labels of the steps. None if the labels are not known yet:
                conditions that use them are left out, and rewards are 0.
        """
        plan, times_ns, ticks = self._plan, steps.times_ns, steps.ticks
        columns, following = {**steps.columns, **(labels or {})}, _following(len(times_ns))
        given = [plan.conditions, plan.reasons]
        if labels is None:
            given = [{k: e for k, e in each.items() if not e.labels} for each in given]
        conditions = self._conditions(("episodes",), given[0], columns, following)
        reasons = self._conditions(("episodes", "reasons"), given[1], columns, following)
        nothing = np.zeros(len(times_ns), bool)
        terminated = conditions.get("terminated", nothing)
        truncated = conditions.get("truncated", nothing) | conditions.get("end", nothing)
        # For rewards: a transition is terminal if the step that it leads to is terminal.
        columns |= {"terminated": terminated[following], "truncated": truncated[following]}
        marks = Marks(
            usable=self._usable(steps.quantities, len(times_ns)),
            acted=~steps.actions.missing,
            gap_before=ticks.gap_before,
            gap_after=ticks.gap_after,
            begin=conditions.get("begin"),
            terminated=terminated,
            truncated=truncated,
        )
        if labels is None and plan.labels:
            rewards = np.zeros(len(times_ns))
        else:
            with plan.place.named("reward"):
                rewards = plan.reward(columns, following)
        episodes = segments(marks, self._mapping.episodes.max_steps)
        return steps._replace(rewards=rewards, episodes=episodes, reasons=reasons)

    def _behavior(self, run: Run, ticks: Ticks, field: BehaviorField) -> NDArray[np.float32]:
        """Return the probabilities or log densities of the actions; NaN if unknown."""
        wanted = self._plan.behavior
        if wanted is None:
            return np.full(len(ticks.times_ns), np.nan, np.float32)
        values = self._scalars(wanted, self._values(wanted, run, ticks))
        is_prob = wanted.keys == (PROBABILITY.name,)
        found = field.column(values, None) if is_prob else field.column(None, values)
        assert found is not None
        return found

    def _ticks(self, run: Run) -> Ticks:
        """Return the times of the steps of a run."""
        plan, mapping = self._plan, self._mapping
        if plan.clock is not None:
            distinct(run.streams, plan.clock, self._streams)
        parts = stretches(
            [each for name in plan.required for each in self._of(name, run)],
            [each for name in plan.observed for each in self._of(name, run)],
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
            commands.append(
                command_part(wanted, found, plan.bag.topics[wanted.source.topic].type_name)
            )
        for place, expression in enumerate(plan.expressions):
            with plan.place.named("action", "expressions", place):
                values = expression.evaluate(columns, following).astype(np.float64)
            commands.append(
                CommandPart(
                    expression.text,
                    values,
                    np.isnan(values),
                    path=expression.text,
                    label=expression.text,
                )
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
        for name in self._plan.required:
            values = quantities[name]
            with np.errstate(invalid="ignore"):
                is_stale = np.abs(values.age_s) > self._mapping.episodes.gap_s
            usable &= ~values.missing & ~is_stale
        return usable


def _following(count: int) -> NDArray[np.int64]:
    """Return the (N,) row after each row, which of the last one is itself."""
    return np.minimum(np.arange(count) + 1, max(count - 1, 0))


def command_part(wanted: Wanted, found: Values, type_name: str) -> CommandPart:
    """Return a field of the command, named by the last part of its path."""
    path, names = wanted.source.path, wanted.quantity.names
    assert path is not None, "commands are fields"
    whole = path._replace(elements=None) if isinstance(path.elements, slice) else path
    word = str(whole).rpartition(".")[2]
    label = str(path).removeprefix(wanted.source.topic).lstrip(".")
    return CommandPart(
        word,
        found.values,
        found.missing,
        tuple(names or ()),
        str(path),
        label,
        unit_of(type_name, label),
    )
