"""Reading of a bag as a dataset, as a mapping specifies."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from collections.abc import Mapping as MappingOf
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import LogError
from mcaprl.recorder.bags.bag import Bag, open_bag
from mcaprl.recorder.bags.overview import is_fresh
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.mapping.actions import Actions
from mcaprl.recorder.mapping.assemble import assembled, vector_names
from mcaprl.recorder.mapping.blame import Blame
from mcaprl.recorder.mapping.config import Mapping, Place, load_mapping
from mcaprl.recorder.mapping.plan import Plan
from mcaprl.recorder.mapping.segments import Segment
from mcaprl.recorder.mapping.steps import StepReader, Steps
from mcaprl.recorder.mapping.summary import FieldReport, MappingReport, RunReport


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
    trust_code: bool = False,
) -> MappedBag:
    """Read a bag as a dataset.

    Args:
        data: MCAP file, rosbag2 folder, ROS 1 bag, or several; see `bags.bag.open_bag`.
        mapping: Mapping, path of a mapping file, or its keys and values.
        trust_code: Whether `reward` may name a function of a Python module, which is imported.

    Raises:
        UsageError: The mapping does not fit the bag; the message names file, line and key.
        LogError: The bag cannot be read, or has no episode.
        MissingExtraError: The packages of the `bags` extra are not installed.
    """
    place = Place()
    if not isinstance(mapping, Mapping):
        mapping, place = load_mapping(mapping)
    with closing(open_bag(data)) as bag:
        return read_open_bag(bag, mapping, place, trust_code=trust_code)


def read_open_bag(
    bag: Bag, mapping: Mapping, place: Place | None = None, *, trust_code: bool = False
) -> MappedBag:
    """Read an open bag; see `read_bag`. In errors, `place` locates the keys of the mapping."""
    plan = Plan(bag, mapping, place or Place(), trust_code=trust_code)
    reader = StepReader(plan)
    runs = [reader.read(number) for number in range(reader.count)]
    least = mapping.episodes.min_steps
    kept = [[each for each in run.episodes if each.length >= least] for run in runs]
    report = _report(plan, runs, kept)
    if not any(kept):
        raise LogError(
            f"{', '.join(map(str, bag.paths))}: the mapping finds no episode of {least} or"
            f" more steps: {report.why_empty()}"
        )
    return MappedBag(assembled(plan, runs, kept), report)


def _report(plan: Plan, runs: list[Steps], kept: list[list[Segment]]) -> MappingReport:
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
        dropped=[e.length for e in found if e.length < plan.mapping.episodes.min_steps],
        ends=_counts(each.reason or "condition" for episodes in kept for each in episodes),
        clock_resets=len(runs) - 1,
        fields=fields,
        missing_actions=_share(np.concatenate([each.missing for each in actions])),
        far_actions=_share(np.concatenate([each.far for each in actions])[rows]),
        action_counts=_action_counts(actions, rows),
        runs=[_run(plan, *each) for each in zip(runs, kept, strict=True)],
        elements=vector_names(plan, runs),
        causes=[] if any(kept) else _causes(plan, runs, blame),
    )


def _fields(plan: Plan, runs: list[Steps], blame: Blame | None = None) -> dict[str, FieldReport]:
    """Return statistics of each quantity at the steps that are within a stretch of data."""
    gap_s, found = plan.mapping.episodes.gap_s, dict[str, FieldReport]()
    is_data = np.concatenate([_is_data(plan, run, gap_s) for run in runs])
    for name, wanted in plan.quantities.items():
        values = [run.quantities[name] for run in runs]
        missing = np.concatenate([each.missing for each in values])[is_data]
        ages_s = np.concatenate([each.age_s for each in values])[is_data]
        prevents = 0.0 if blame is None else blame.alone.get(name, 0.0)
        found[name] = FieldReport.of(wanted.source.topic, missing, ages_s, prevents)
    return found


def _is_data(plan: Plan, run: Steps, gap_s: float) -> NDArray[np.bool_]:
    """Return (N,) whether any observed value or command is recent; between two drives, none is."""
    ages_s = np.array([np.abs(run.quantities[name].age_s) for name in plan.mapping.observation])
    with np.errstate(invalid="ignore"):
        found: NDArray[np.bool_] = np.asarray((ages_s <= gap_s).any(axis=0))
    for command in plan.commands:
        found |= is_fresh(plan.bag.times(command.source.topic), run.times_ns, gap_s)
    return found if bool(found.any()) else np.ones(len(found), bool)


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
