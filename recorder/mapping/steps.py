"""Steps of a bag: their quantities, actions and rewards, and the episodes that they form."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import UsageError
from mcaprl.recorder.mapping.actions import Actions, actions_of
from mcaprl.recorder.mapping.expression import Expression
from mcaprl.recorder.mapping.observe import Values, pose_of, values_of
from mcaprl.recorder.mapping.paths import as_numbers
from mcaprl.recorder.mapping.plan import Plan, Wanted
from mcaprl.recorder.mapping.segments import Marks, Segment, segments
from mcaprl.recorder.mapping.streams import Recorded, last_file, runs_of
from mcaprl.recorder.mapping.transforms import Transforms

NS_PER_S = 10**9
_MAX_STEPS = 50_000_000


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
    """Reader that returns the steps of a bag run by run; a run is the time between clock resets."""

    def __init__(self, plan: Plan) -> None:
        """Find the runs, and read the transforms if the mapping uses them.

        Raises:
            UsageError: The clocks of two topics were not reset together.
        """
        self._plan, self._mapping = plan, plan.mapping
        self._streams: dict[str, Recorded] = dict(plan.streams)
        self._transforms: dict[str, Transforms] = {
            topic: Transforms(plan.bag, plan.mapping.time, topic=topic, frames=frames)
            for topic, frames in plan.frames.items()
        }
        for keys, quantity, source, _ in plan.quantities.values():
            if quantity.transform is not None:
                transforms = self._transforms[source.topic]
                with plan.place.named(*keys):
                    self._streams |= transforms.streams(quantity.transform, quantity.in_)
        self._runs = runs_of(self._streams, plan.mapping.episodes.gap_s, plan.bag.paths)

    @property
    def count(self) -> int:
        """Number of runs."""
        return len(self._runs)

    def read(self, number: int) -> Steps:
        """Return the steps of one run; `number` is its index.

        Raises:
            UsageError: The mapping does not fit the messages.
        """
        plan, times_ns = self._plan, self._times(number)
        quantities = {
            name: self._values(wanted, number, times_ns) for name, wanted in plan.quantities.items()
        }
        actions = self._actions(number, times_ns)
        probs = np.full(len(times_ns), np.nan, np.float32)
        if plan.behavior_prob is not None:
            found = self._values(plan.behavior_prob, number, times_ns)
            probs = self._scalars(plan.behavior_prob, found).astype(np.float32)
        columns = {
            **plan.constants,
            **{
                name: values.values
                for name, values in quantities.items()
                if plan.quantities[name].quantity.image is None
            },
        }
        if actions.values.ndim == 1:
            columns["action"] = actions.values
        following = np.minimum(np.arange(len(times_ns)) + 1, max(len(times_ns) - 1, 0))
        conditions = self._conditions(("episodes",), plan.conditions, columns, following)
        reasons = self._conditions(("episodes", "reasons"), plan.reasons, columns, following)
        nothing = np.zeros(len(times_ns), bool)
        terminated = conditions.get("terminated", nothing)
        truncated = conditions.get("truncated", nothing) | conditions.get("end", nothing)
        # For rewards: a transition is terminal if the step that it leads to is terminal.
        columns |= {"terminated": terminated[following], "truncated": truncated[following]}
        gap_ns = self._mapping.episodes.gap_s * NS_PER_S
        marks = Marks(
            usable=self._usable(quantities, len(times_ns)),
            acted=~actions.missing,
            gap_before=np.diff(times_ns, prepend=times_ns[:1]) > gap_ns,
            begin=conditions.get("begin"),
            terminated=terminated,
            truncated=truncated,
        )
        with plan.place.named("reward"):
            rewards = plan.reward(columns, following)
        episodes = segments(marks, self._mapping.episodes.max_steps)
        return Steps(times_ns, quantities, actions, probs, rewards, episodes, reasons)

    def _times(self, number: int) -> NDArray[np.int64]:
        """Return the times of the steps of a run."""
        clock, topics = self._mapping.clock, self._runs[number]
        if clock.topic is not None:
            found: NDArray[np.int64] = np.unique(topics[clock.topic].times_ns)
            return found
        assert clock.rate_hz is not None, "the mapping was validated"
        found_ns = [run.times_ns for run in topics.values() if len(run.times_ns)]
        if not found_ns:
            return np.empty(0, np.int64)
        first, last = min(int(t[0]) for t in found_ns), max(int(t[-1]) for t in found_ns)
        # If the duration is a whole number of periods, rounding must not remove the last step.
        count = int((last - first) * clock.rate_hz / NS_PER_S + 1e-6) + 1
        if count > _MAX_STEPS:
            raise UsageError(
                f"{self._plan.place.of('clock', 'rate_hz')}: {count} steps between {first} and"
                f" {last} ns are too many: use another `time` or a lower rate"
            )
        since_ns: NDArray[np.int64] = np.rint(np.arange(count) * (NS_PER_S / clock.rate_hz)).astype(
            np.int64
        )
        since_ns += first
        return since_ns

    def _values(self, wanted: Wanted, number: int, times_ns: NDArray[np.int64]) -> Values:
        keys, quantity, source, is_during = wanted
        runs = self._runs[number]
        with self._plan.place.named(*keys):
            if quantity.transform is not None:
                transforms = self._transforms[source.topic]
                transforms = transforms.within(runs, last_file(self._streams, runs))
                return pose_of(quantity, transforms, times_ns)
            stream, run = self._plan.streams[source.topic], runs[source.topic]
            ends_ns = _ends(times_ns) if is_during else None
            return values_of(quantity, source, stream, run, times_ns, ends_ns)

    def _scalars(self, wanted: Wanted, found: Values) -> NDArray[np.float64]:
        """Return values as numbers, one for each step.

        Raises:
            UsageError: The values are texts or arrays.
        """
        with self._plan.place.named(*wanted.keys):
            numbers = as_numbers(found.values, str(wanted.source.path))
            if numbers.ndim > 1:
                raise UsageError(
                    f"{wanted.source.path} has {numbers.shape[1]} elements; choose one of them,"
                    f" such as {wanted.source.path}[0]"
                )
            return numbers

    def _actions(self, number: int, times_ns: NDArray[np.int64]) -> Actions:
        action = self._mapping.action
        found = [self._values(wanted, number, times_ns) for wanted in self._plan.commands]
        missing = np.logical_or.reduce([each.missing for each in found])
        columns = [
            # Only a single discrete field may be a text.
            each.values
            if action.field is not None and each.values.dtype.kind == "O"
            else self._scalars(wanted, each)
            for wanted, each in zip(self._plan.commands, found, strict=True)
        ]
        with self._plan.place.named("action"):
            return actions_of(action, columns, missing)

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
        for name, quantity in self._mapping.observation.items():
            if quantity.missing is None or quantity.image is not None:
                values = quantities[name]
                with np.errstate(invalid="ignore"):
                    is_stale = np.abs(values.age_s) > self._mapping.episodes.gap_s
                usable &= ~values.missing & ~is_stale
        return usable


def _ends(times_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the end of each step: the next step's time. The last step has the median duration."""
    if len(times_ns) < 2:
        return times_ns + NS_PER_S
    return np.append(times_ns[1:], times_ns[-1] + int(np.median(np.diff(times_ns))))
