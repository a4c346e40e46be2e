"""Reading of a bag as a dataset, as a mapping specifies."""

from __future__ import annotations

import hashlib
import math
import warnings
from collections.abc import Iterable, Sequence
from collections.abc import Mapping as MappingOf
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import LogError, Problem, UnknownNameError
from mcaprl.recorder.bags.bag import Bag, OpenBag, copy_topics, matching_topics, open_bag
from mcaprl.recorder.bags.overview import instants_of, is_fresh
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.images import Storage
from mcaprl.recorder.dataset.labels import Labeled, Labels, joined_labels, labels_path
from mcaprl.recorder.mapping.actions import Actions
from mcaprl.recorder.mapping.align import NS_PER_S
from mcaprl.recorder.mapping.assemble import assembled, element_names, vector_names
from mcaprl.recorder.mapping.config import Mapping, Place, load_mapping
from mcaprl.recorder.mapping.observe import Values
from mcaprl.recorder.mapping.plan import Plan
from mcaprl.recorder.mapping.runs import Runs, Segment
from mcaprl.recorder.mapping.steps import StepReader, Steps
from mcaprl.recorder.mapping.summary import (
    FieldReport,
    MappingReport,
    Rounding,
    RunReport,
    rounding_of,
)
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
        required = plan.required
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


class MappedBag(NamedTuple):
    """A bag that was read with a mapping.

    Attributes:
        dataset: Transitions of the bag.
        report: Statistics of what was read and of what was left out.
    """

    dataset: Dataset
    report: MappingReport


def read_bag(
    data: str | Path | Sequence[str | Path],
    mapping: Mapping | str | Path | MappingOf[str, Any],
    *,
    changes: MappingOf[str, Any] | None = None,
    trust_code: bool = False,
    images: Storage = "auto",
    definitions: Sequence[str | Path] = (),
    to_label: bool = False,
) -> MappedBag:
    """Read the bag of `data` (see `open_bag`) as a dataset; see `mcaprl.open`.

    `changes` has values that replace those of the mapping's keys. With `to_label`, the mapping's
    own uses of labels are left out, and `labeled` of the origin is never empty.
    """
    place = Place()
    if not isinstance(mapping, Mapping):
        mapping, place = load_mapping(mapping)
    mapping = mapping.model_copy(update=dict(changes or {}))
    mapping = mapping.without_labels() if to_label else mapping
    others = [*mapping.definitions, *definitions]
    with closing(open_bag(data, definitions=others, strict=mapping.strict)) as bag:
        options: Any = {"trust_code": trust_code, "images": images, "to_label": to_label}
        found = read_open_bag(bag, mapping, place, **options)
    copy = partial(copy_topics, [path.absolute() for path in bag.paths], others)
    keep = tuple(mapping.keep)
    found.dataset.origin = replace(found.dataset.origin, copy_topics=copy, keep=keep)
    return found


def read_open_bag(
    bag: Bag,
    mapping: Mapping,
    place: Place | None = None,
    *,
    trust_code: bool = False,
    images: Storage = "auto",
    to_label: bool = False,
) -> MappedBag:
    """Read an open bag; see `read_bag`. In errors, `place` locates the keys of the mapping."""
    plan = Plan(bag, mapping, place or Place(), trust_code=trust_code)
    # Without the messages of images that cannot be decoded, steps use other messages, whose images
    # may be damaged as well.
    while (found := _read(plan, images, to_label)) is None:
        pass
    return found


def _read(plan: Plan, images: Storage, to_label: bool) -> MappedBag | None:
    """Read the bag of a plan; return None if images turned out to be unreadable."""
    plan.leave_out_images()
    bag, mapping, reader = plan.bag, plan.mapping, StepReader(plan)
    runs = [reader.read(number) for number in range(reader.count)]
    recordings = [run.recording for run in reader.runs.runs]
    kept = _kept(mapping, runs, recordings)
    labeled = _labeled(bag, runs, kept, recordings, to_label=to_label)
    labels = partial(joined_labels, labeled) if labeled else None
    if plan.labels:
        if labels is None:
            names = ", ".join(map(str, bag.paths))
            used = ", ".join(f"labels.{name}" for name in sorted(plan.labels))
            warnings.warn(
                f"{names} has no labels, which the mapping uses: {used}; see `mcaprl label`",
                stacklevel=5,
            )
        before, sizes = _spans(runs, kept), [len(run.times_ns) for run in runs]
        own = labels() if labels else Labels("")
        columns = own.rows_of(*before, sum(sizes))
        for number, rows in enumerate(np.split(np.arange(sum(sizes)), np.cumsum(sizes)[:-1])):
            part = {name: column[rows] for name, column in columns.items()}
            runs[number] = reader.divided(runs[number], part)
        kept = _kept(mapping, runs, recordings)
        if labels:
            labels = partial(own.divided, before, _spans(runs, kept), sum(sizes))
    report = _report(plan, reader.runs, runs, kept)
    if not any(kept):
        raise LogError(
            f"{', '.join(map(str, bag.paths))}: the mapping finds no episode of"
            f" {mapping.episodes.min_steps} or more steps: {report.why_empty()}"
        )
    dataset = assembled(plan, runs, kept, images)
    if dataset is None:
        return None
    problems = [problem for each in plan.images.values() for problem in each.problems()]
    report = replace(report, images=problems)
    if (commands := dataset.action_commands) is not None:
        report = replace(report, commands=commands.by_name(dataset.action_names))
    if isinstance(dataset.action_space, spaces.Box):
        report = replace(report, action_parts=list(dataset.action_labels))
    dataset.origin = replace(
        dataset.origin,
        mapping=dataset.robot["mapping"],
        report=report,
        labels=None if labels is None else (labels, dataset.episode_lengths),
        labeled=tuple(labeled),
    )
    return MappedBag(dataset, report)


def _kept(mapping: Mapping, runs: Sequence[Steps], recordings: list[int]) -> list[list[Segment]]:
    """Return the episodes of each run that are not left out; `recordings` has that of each run."""
    least = mapping.episodes.min_steps
    kept = [[each for each in run.episodes if each.length >= least] for run in runs]
    return _longest(kept, recordings) if mapping.episodes.per == "recording" else kept


def _spans(runs: Sequence[Steps], kept: Sequence[Sequence[Segment]]) -> tuple[list[int], list[int]]:
    """Return the first row and the length of each episode among the steps of all runs."""
    offsets = np.cumsum([0, *(len(run.times_ns) for run in runs)]).tolist()
    pairs = [(at, each) for at, some in zip(offsets, kept, strict=False) for each in some]
    return [at + each.first for at, each in pairs], [each.length for _, each in pairs]


def _labeled(
    bag: Bag,
    runs: Sequence[Steps],
    kept: Sequence[Sequence[Segment]],
    recordings: list[int],
    *,
    to_label: bool,
) -> list[Labeled]:
    """Return the episodes of each recording to which labels belong, if there are any."""
    if not isinstance(bag, OpenBag):
        return []
    if not to_label and not any(labels_path(name).is_file() for name in bag.names):
        return []
    found = []
    for number, name in enumerate(bag.names):
        times = [
            run.times_ns[each.first : each.last + 1]
            for run, some, recording in zip(runs, kept, recordings, strict=True)
            for each in some
            if recording == number
        ]
        lengths = np.array([len(each) - 1 for each in times], np.int64)
        every = np.concatenate([np.empty(0, np.int64), *times])
        digest = hashlib.sha256(lengths.tobytes() + every.tobytes()).hexdigest()
        lock = bag.paths[bag.recordings.index(number)]
        checksum = bag.checksum(number)
        found.append(Labeled(name, lock, checksum, lengths, partial(_same, every), digest))
    return found


def _same(values: NDArray[np.int64]) -> NDArray[np.int64]:
    return values


def _longest(kept: list[list[Segment]], recordings: list[int]) -> list[list[Segment]]:
    """Keep only the longest episode of each recording; `recordings` has the one of each run."""
    best: dict[int, Segment] = {}
    for recording, episodes in zip(recordings, kept, strict=True):
        for each in episodes:
            if recording not in best or each.length > best[recording].length:
                best[recording] = each
    return [
        [each for each in episodes if each is best[recording]]
        for recording, episodes in zip(recordings, kept, strict=True)
    ]


def _report(
    plan: Plan, found_runs: Runs, runs: list[Steps], kept: list[list[Segment]]
) -> MappingReport:
    blame = Blame(plan, runs)
    fields = _fields(plan, runs, blame)
    offsets = np.cumsum([0, *(len(run.times_ns) for run in runs)]).tolist()
    taken = [
        offset + np.arange(each.first, each.last)
        for offset, episodes in zip(offsets, kept, strict=False)
        for each in episodes
    ]
    rows = np.concatenate(taken) if taken else np.empty(0, np.int64)
    actions = [run.actions for run in runs]
    found = [each for run in runs for each in run.episodes]
    return MappingReport(
        clock_steps=offsets[-1],
        steps=len(rows),
        episodes=len(taken),
        dropped=_dropped(found, kept),
        ends=_counts(each.reason or "condition" for episodes in kept for each in episodes),
        recordings=len(set(plan.bag.recordings)),
        clock_resets=len(runs) - len({run.recording for run in found_runs.runs}),
        left_out=_left_out(plan, found_runs),
        fields=fields,
        missing_actions=_share(np.concatenate([each.missing for each in actions])),
        far_actions=_share(np.concatenate([each.far for each in actions])[rows]),
        action_counts=_action_counts(actions, rows),
        runs=[_run(plan, *each) for each in zip(runs, kept, strict=True)],
        elements=vector_names(plan, runs),
        causes=[] if any(kept) else _causes(plan, runs, blame),
        rounded=_rounded(plan, runs),
    )


def _fields(plan: Plan, runs: list[Steps], blame: Blame | None = None) -> dict[str, FieldReport]:
    """Return statistics of each quantity at the steps."""
    found = dict[str, FieldReport]()
    for name, wanted in plan.quantities.items():
        values = [run.quantities[name] for run in runs]
        missing = np.concatenate([each.missing for each in values])
        ages_s = np.concatenate([each.age_s for each in values])
        prevents = 0.0 if blame is None else blame.alone.get(name, 0.0)
        found[name] = FieldReport.of(
            wanted.source.topic, missing, ages_s, [each.values for each in values], prevents
        )
    return found


def _run(plan: Plan, run: Steps, kept: list[Segment]) -> RunReport:
    return RunReport(
        first_ns=int(run.times_ns[0]) if len(run.times_ns) else 0,
        clock_steps=len(run.times_ns),
        steps=sum(each.length for each in kept),
        episodes=len(kept),
        fields=_fields(plan, [run]),
    )


def _causes(plan: Plan, runs: list[Steps], blame: Blame) -> list[str]:
    """Return why there are no episodes."""
    episodes = plan.mapping.episodes
    named = [
        name
        for name in ("begin", "end", "terminated", "truncated")
        if getattr(episodes, name) is not None
    ]
    if blame.usable_steps < episodes.min_steps or not named or any(run.episodes for run in runs):
        return list(blame.causes().values())
    begins = "`begin` never becomes true" if "begin" in named else ""
    ends = " or ".join(f"`{name}`" for name in named if name != "begin")
    ends = f"{ends} is always true" if ends else ""
    reasons = ", or ".join(each for each in (begins, ends) if each)
    return [f"{blame.usable_steps} steps have all values, but no episode begins: {reasons}"]


def _dropped(found: list[Segment], kept: list[list[Segment]]) -> list[int]:
    """Return the lengths of the episodes that are not kept."""
    known = {id(each) for episodes in kept for each in episodes}
    return [each.length for each in found if id(each) not in known]


def _left_out(plan: Plan, runs: Runs) -> list[Problem]:
    """Return one problem for each kind of messages that were not used, by topic."""
    found = []
    for name, stream in plan.streams.items():
        count = len(plan.bag.times(stream.topic))
        if stream.failures:
            row, time_ns, reason = stream.failures[0]
            found.append(
                Problem(
                    f"{len(stream.failures)} of {counted(count, 'message')} cannot be decoded and"
                    f" are left out; the first is message {row} at {time_ns} ns: {reason}",
                    stream.topic,
                    next="a mapping with `strict: true` refuses such bags",
                )
            )
        if stream.bad_stamps:
            what = f"{stream.bad_stamps} of {counted(count, 'message')} have no valid stamp"
            found.append(Problem(f"{what}, and are left out", name, next="use another `time`"))
    for name, outliers in runs.outliers.items():
        what = f"{counted(outliers, 'message')} left out: times far from those around them"
        found.append(Problem(what, name, next="use another `time` if they are valid"))
    found += [
        Problem(
            "the clock goes back by less than `gap_s`, that of other topics does not; the messages"
            " were sorted by time",
            name,
            next="set a smaller `gap_s`, use another `time`, or split the bag",
        )
        for name in runs.mixed
    ]
    try:
        matching_topics(plan.bag.topics, plan.mapping.keep)
    except UnknownNameError as error:
        remedy = "correct or remove it, because the bag cannot be converted to a log"
        found.append(Problem(str(error), plan.place.of("keep"), next=remedy))
    return found


def _rounded(plan: Plan, runs: list[Steps]) -> dict[str, Rounding]:
    """Return the digits that observed quantities, and a Box action, lose as float32."""
    found = {}
    for name, quantity in plan.mapping.observation.items():
        parts = [run.quantities[name] for run in runs]
        values = [each.values[~each.missing] for each in parts]
        if quantity.pixels is None and all(each.dtype.kind == "f" for each in values):
            names = element_names(name, quantity, math.prod(values[0].shape[1:]))
            topic = plan.quantities[name].source.topic
            found[name] = rounding_of(values, names, topic, quantity.offset)
    if plan.mapping.action.box is not None:
        commands = [run.actions.commands[~run.actions.missing] for run in runs]
        topic = plan.commands[0].source.topic if plan.commands else "action"
        rounding = rounding_of(commands, runs[0].actions.fields, topic)
        # An action has no key `offset`.
        found["action"] = rounding and rounding._replace(offset=None)
    return {name: each for name, each in found.items() if each is not None}


def _counts(names: Iterable[str]) -> dict[str, int]:
    found: dict[str, int] = {}
    for name in names:
        found[name] = found.get(name, 0) + 1
    return found


def _share(flags: NDArray[np.bool_]) -> float:
    return float(flags.mean()) if len(flags) else 0.0


def _action_counts(actions: list[Actions], rows: NDArray[np.int64]) -> dict[str, int]:
    if not isinstance(actions[0].space, spaces.Discrete):
        return {}
    values = np.concatenate([each.values for each in actions])[rows]
    counts = np.bincount(values, minlength=len(actions[0].meanings))
    names = actions[0].meanings or tuple(map(str, range(len(counts))))
    return dict(zip(names, counts.tolist(), strict=True))
