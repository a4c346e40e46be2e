"""Reading of a bag as a dataset, as a mapping specifies."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from collections.abc import Mapping as MappingOf
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import LogError
from mcaprl.problem import Problem
from mcaprl.recorder.bags.bag import Bag, open_bag
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.images import Storage
from mcaprl.recorder.mapping.actions import Actions
from mcaprl.recorder.mapping.assemble import assembled, element_names, vector_names
from mcaprl.recorder.mapping.blame import Blame
from mcaprl.recorder.mapping.config import Mapping, Place, load_mapping
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
) -> MappedBag:
    """Read the bag of `data` (see `open_bag`) as a dataset; see `mcaprl.open`.

    `changes` has values that replace those of the mapping's keys.
    """
    place = Place()
    if not isinstance(mapping, Mapping):
        mapping, place = load_mapping(mapping)
    mapping = mapping.model_copy(update=dict(changes or {}))
    others = [*mapping.definitions, *definitions]
    with closing(open_bag(data, definitions=others, strict=mapping.strict)) as bag:
        return read_open_bag(bag, mapping, place, trust_code=trust_code, images=images)


def read_open_bag(
    bag: Bag,
    mapping: Mapping,
    place: Place | None = None,
    *,
    trust_code: bool = False,
    images: Storage = "auto",
) -> MappedBag:
    """Read an open bag; see `read_bag`. In errors, `place` locates the keys of the mapping."""
    plan = Plan(bag, mapping, place or Place(), trust_code=trust_code)
    # Without the messages of images that cannot be decoded, steps use other messages, whose images
    # may be damaged as well.
    while (found := _read(plan, images)) is None:
        pass
    return found


def _read(plan: Plan, images: Storage) -> MappedBag | None:
    """Read the bag of a plan; return None if images turned out to be unreadable."""
    plan.leave_out_images()
    bag, mapping, reader = plan.bag, plan.mapping, StepReader(plan)
    runs = [reader.read(number) for number in range(reader.count)]
    least = mapping.episodes.min_steps
    kept = [[each for each in run.episodes if each.length >= least] for run in runs]
    recordings = [run.recording for run in reader.runs.runs]
    if mapping.episodes.per == "recording":
        kept = _longest(kept, recordings)
    report = _report(plan, reader.runs, runs, kept)
    if not any(kept):
        raise LogError(
            f"{', '.join(map(str, bag.paths))}: the mapping finds no episode of {least} or"
            f" more steps: {report.why_empty()}"
        )
    dataset = assembled(plan, runs, kept, images)
    if dataset is None:
        return None
    problems = [problem for each in plan.images.values() for problem in each.problems()]
    report = replace(report, images=problems)
    if (commands := dataset.action_commands) is not None:
        report = replace(report, commands=commands.by_name(dataset.action_names))
    tree = mapping.model_dump(mode="json", by_alias=True)
    if commands is not None and None not in commands.commands:
        tree["action"]["representatives"] = commands.to_json()["commands"]
    if isinstance(space := dataset.action_space, spaces.Box):
        found = {"low": space.low.tolist(), "high": space.high.tolist()}
        given = {name: each for name, each in tree["action"]["box"].items() if each is not None}
        tree["action"]["box"] = {**found, **given}
        report = replace(report, action_parts=list(dataset.action_labels))
    dataset.origin = replace(dataset.origin, mapping=_json_of(tree), report=report)
    return MappedBag(dataset, report)


def _json_of(tree: Any) -> Any:
    """Return keys and values with infinite numbers as texts, because JSON lacks them."""
    if isinstance(tree, dict):
        return {key: _json_of(each) for key, each in tree.items()}
    if isinstance(tree, list):
        return [_json_of(each) for each in tree]
    return str(tree) if isinstance(tree, float) and math.isinf(tree) else tree


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
    return found


def _rounded(plan: Plan, runs: list[Steps]) -> dict[str, Rounding]:
    """Return the digits that observed quantities, and a Box action, lose as float32."""
    found = {}
    for name, quantity in plan.mapping.observation.items():
        parts = [run.quantities[name] for run in runs]
        values = [each.values[~each.missing] for each in parts]
        if quantity.image is None and all(each.dtype.kind == "f" for each in values):
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
