"""Cause of the time that cannot be part of an episode: which quantity prevents it, and why."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mcaprl.recorder.bags.overview import instants_of, is_fresh
from mcaprl.recorder.mapping.align import NS_PER_S
from mcaprl.recorder.mapping.observe import Values
from mcaprl.recorder.mapping.plan import Plan
from mcaprl.recorder.mapping.steps import Steps
from mcaprl.texts import counted

_LISTED, _MAX_CAUSES = 8, 3
_SIMILAR = 0.5
"""Share of the largest effect above which other quantities are named, too."""
ACTION = "the action"


class Blame:
    """The quantities that prevent episodes, and the reasons.

    A quantity prevents an instant, if its last message is older than `gap_s`, and a step, if it has
    no value. Quantities with `missing` prevent nothing.

    Attributes:
        alone: Share of the instants and steps that only this quantity prevents, by name.
    """

    def __init__(self, plan: Plan, runs: list[Steps]) -> None:
        """Find what each required quantity and the action prevent."""
        self._plan, self._runs = plan, runs
        required = [
            name
            for name, quantity in plan.mapping.observation.items()
            if quantity.missing is None or quantity.image is not None
        ]
        self._topics = {name: plan.quantities[name].source.topic for name in required}
        # Of several topics of commands, the one with the fewest messages; none for expressions.
        commands = [command.source.topic for command in plan.commands]
        self._topics[ACTION] = min(commands, key=lambda each: len(plan.bag.times(each)), default="")
        self._times = {
            topic: np.sort(self._times_of(topic)) for topic in {*self._topics.values()} if topic
        }
        self._stale = self._prevented_instants()
        self._missing = {name: self._missing_values(name) for name in self._topics}
        self.alone = {
            name: max(_alone(self._stale, name), _alone(self._missing, name))
            for name in self._topics
        }

    def _times_of(self, topic: str) -> NDArray[np.int64]:
        stream = self._plan.streams.get(topic)
        return self._plan.bag.times(topic) if stream is None else stream.times_ns

    def _prevented_instants(self) -> dict[str, NDArray[np.bool_]]:
        # A static frame has few messages, and is valid at all times.
        moving = {
            name: topic
            for name, topic in self._topics.items()
            if topic and (name == ACTION or self._is_field(name))
        }
        instants_ns = instants_of(list(self._times.values()))
        limits = dict.fromkeys(self._topics, self._plan.mapping.episodes.gap_s)
        limits[ACTION] = self._plan.mapping.action.tolerance_s or math.inf
        return {
            name: ~is_fresh(self._times[topic], instants_ns, limits[name])
            for name, topic in moving.items()
        }

    def _is_field(self, name: str) -> bool:
        return self._plan.quantities[name].quantity.transform is None

    def _missing_values(self, name: str) -> NDArray[np.bool_]:
        found = [
            run.actions.missing if name == ACTION else run.quantities[name].missing
            for run in self._runs
        ]
        return np.concatenate([np.empty(0, bool), *found])

    def causes(self) -> dict[str, str]:
        """Return why the worst quantities prevent episodes, in one line for each name."""
        if not any(map(len, self._times.values())):
            return {"": "the topics have no messages"}
        for reason_of in (self._without_times, self._apart):
            # The topic with the fewest messages is named first.
            known = [name for name, topic in self._topics.items() if topic]
            names = sorted(known, key=lambda name: len(self._times[self._topics[name]]))
            found = {name: reason_of(name, self._times[self._topics[name]]) for name in names}
            if any(found.values()):
                most = 1 if reason_of == self._apart else _MAX_CAUSES
                certain = [name for name, text in found.items() if text][:most]
                return {name: f"{self._label(name)} {found[name]}" for name in certain}
        return {name: self._with_steps(name) for name in self._worst()}

    @property
    def usable_steps(self) -> int:
        """Number of steps that nothing prevents."""
        return int((~np.any(list(self._missing.values()), axis=0)).sum())

    def _label(self, name: str) -> str:
        topic = self._topics[name]
        if name == ACTION:
            return f"{topic} of the action" if topic else ACTION
        return f"{name} ({topic})"

    def _worst(self) -> list[str]:
        """Return the names of the quantities with the largest effects."""
        effect = self.alone
        # If several quantities prevent the same time, none of them does so alone.
        if not any(effect.values()):
            effect = {name: max(self._share(name)) for name in self._topics}
        most = max(effect.values())
        found = [name for name, share in effect.items() if share and share >= _SIMILAR * most]
        return sorted(found, key=lambda name: -effect[name])[:_MAX_CAUSES]

    def _share(self, name: str) -> tuple[float, float]:
        """Return the shares of the instants and of the steps that a quantity prevents."""
        parts = (self._stale.get(name, np.empty(0, bool)), self._missing[name])
        stale, missing = (float(each.mean()) if len(each) else 0.0 for each in parts)
        return stale, missing

    def _without_times(self, name: str, times_ns: NDArray[np.int64]) -> str:
        if not len(times_ns):
            return "has no messages"
        if name in self._stale and len(times_ns) == 1 and name != ACTION:
            return "has one message only: set `missing`, or remove it"
        if len(times_ns) > 1 and times_ns[0] == times_ns[-1]:
            return f"has {len(times_ns)} messages with the same time: use another `time`"
        return ""

    def _apart(self, name: str, times_ns: NDArray[np.int64]) -> str:
        """Return that a topic and another one do not overlap in time; empty if they do."""
        slack_ns = self._plan.mapping.episodes.gap_s * NS_PER_S
        for other in self._stale:
            theirs = self._times[self._topics[other]]
            if not len(theirs):
                continue
            is_late = theirs[-1] + slack_ns < times_ns[0]
            # The last command stays valid, unless the mapping limits its age.
            if is_late or (name != ACTION and times_ns[-1] + slack_ns < theirs[0]):
                start_ns = min(times_ns[0], theirs[0])
                return (
                    f"has messages {_span(times_ns, start_ns)}, and {self._topics[other]}"
                    f" {_span(theirs, start_ns)}: they do not overlap in time"
                )
        return ""

    def _with_steps(self, name: str) -> str:
        label, (stale, missing) = self._label(name), self._share(name)
        if stale >= missing:
            gap_s = self._plan.mapping.episodes.gap_s
            return (
                f"{label} is older than gap_s ({gap_s:g} s) during {stale:.0%} of the time:"
                f" {self._pause(name)}: set `missing`, raise `gap_s`, or remove it"
            )
        if name == ACTION:
            pause = f": {self._pause(name)}" if self._topics[name] else ""
            return f"{label} has no value at {missing:.0%} of the steps{pause}"
        if elements := _not_finite([run.quantities[name] for run in self._runs]):
            return (
                f"{label} is not finite at {missing:.0%} of the steps ({elements}): set `clip` to"
                " bound infinite values, or `missing`"
            )
        return (
            f"{label} has no value at {missing:.0%} of the steps: set `missing` or a larger"
            " `tolerance_s`, or remove it"
        )

    def _pause(self, name: str) -> str:
        """Return when a topic has messages, in seconds since the first message of any topic."""
        times_ns = self._times[self._topics[name]]
        every = [each for each in self._times.values() if len(each)]
        start_ns, end_ns = min(each[0] for each in every), max(each[-1] for each in every)
        gap_s = np.diff(times_ns).max(initial=0) / NS_PER_S
        return (
            f"it has {counted(len(times_ns), 'message')} {_span(times_ns, start_ns)} of"
            f" {(end_ns - start_ns) / NS_PER_S:.2f} s, with a longest gap of {gap_s:.3g} s"
        )


def _alone(prevented: dict[str, NDArray[np.bool_]], name: str) -> float:
    """Return the share of the time that only this quantity prevents."""
    if name not in prevented or not len(prevented[name]):
        return 0.0
    count = np.sum(list(prevented.values()), axis=0)
    return float((prevented[name] & (count == 1)).mean())


def _span(times_ns: NDArray[np.int64], start_ns: np.int64) -> str:
    first, last = ((int(t) - int(start_ns)) / NS_PER_S for t in (times_ns[0], times_ns[-1]))
    return f"from {first:.2f} to {last:.2f} s"


def _not_finite(found: list[Values]) -> str:
    """Return the elements that are not finite although there is a message; empty if all are."""
    values = np.concatenate([each.values[~np.isnan(each.age_s)] for each in found])
    is_wrong = ~np.isfinite(values) if values.dtype.kind == "f" else np.zeros(values.shape, bool)
    if not is_wrong.any():
        return ""
    example = f"{values[is_wrong][0]:g}"
    if values.ndim == 1:
        return f"the value is {example}"
    numbers = np.flatnonzero(is_wrong.any(axis=0)).tolist()
    more = f" and {len(numbers) - _LISTED} more" if len(numbers) > _LISTED else ""
    names = ", ".join(map(str, numbers[:_LISTED]))
    return f"elements {names}{more} of {values.shape[1]}, for example {example}"
