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
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.mapping.actions import Actions
from mcaprl.recorder.mapping.assemble import assembled
from mcaprl.recorder.mapping.config import Mapping, Place, load_mapping
from mcaprl.recorder.mapping.plan import Plan
from mcaprl.recorder.mapping.segments import Segment
from mcaprl.recorder.mapping.steps import StepReader, Steps
from mcaprl.recorder.mapping.summary import FieldReport, MappingReport


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
    definitions: Sequence[str | Path] = (),
) -> MappedBag:
    """Read a bag as a dataset.

    Args:
        data: MCAP file, rosbag2 folder, ROS 1 bag, or several; see `bags.bag.open_bag`.
        mapping: Mapping, path of a mapping file, or its keys and values.
        trust_code: Whether `reward` may name a function of a Python module, which is imported.
        definitions: Files and folders with definitions of ROS types that the bag lacks, in addition
            to those of the mapping.

    Raises:
        UsageError: The mapping does not fit the bag; the message names file, line and key.
        LogError: The bag cannot be read, or has no episode.
        MissingExtraError: The packages of the `bags` extra are not installed.
    """
    place = Place()
    if not isinstance(mapping, Mapping):
        mapping, place = load_mapping(mapping)
    with closing(open_bag(data, definitions=[*mapping.definitions, *definitions])) as bag:
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
    fields = {}
    for name, wanted in plan.quantities.items():
        values = [run.quantities[name] for run in runs]
        missing = np.concatenate([each.missing for each in values])
        ages_s = np.concatenate([each.age_s for each in values])
        fields[name] = FieldReport.of(wanted.source.topic, missing, ages_s)
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
    )


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
