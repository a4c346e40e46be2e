"""Report of what a mapping reads from a bag, what it leaves out, and the digits that are lost."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from dataclasses import field as dataclass_field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import Problem
from mcaprl.recorder.format.metadata import Command
from mcaprl.texts import counted

Floats = NDArray[np.float64]

_COARSE = 0.1
"""Ratio of the spacing of float32 numbers to the change from step to step that is too large.

The changes between the steps then have errors of about 4 % (the spacing times sqrt(2 / 12)).
"""
_FINE = 0.01
"""Ratio after which an offset is good."""
_QUANTILE = 0.9
"""Quantile of the changes: neither long stops nor a few jumps determine it."""
_FLOAT64_NOISE = 1e-14
"""Changes below this share of the value are rounding errors of float64."""
_MOST_DIGITS = 17
_LARGEST = 1e38


class Rounding(NamedTuple):
    """Loss of digits of a quantity.

    Attributes:
        topic: Topic that contains the quantity.
        element: Name of the element that loses most.
        elements: Number of elements that lose digits.
        values: Number of different values of the element in the bag.
        kept: Number of different values as float32.
        change: Typical change of the element from step to step.
        offset: Value of `offset` that keeps the digits of the element; None if there is none.
        is_alone: Whether the quantity has only this element, so that it can have this offset.
    """

    topic: str
    element: str
    elements: int
    values: int
    kept: int
    change: float
    offset: float | None
    is_alone: bool

    def __str__(self) -> str:
        """Return what is lost."""
        more = f" ({self.elements} elements lose digits)" if self.elements > 1 else ""
        return (
            f"float32 is too coarse for {self.element}: {self.values} different values become"
            f" {self.kept}, and {self.change:.2g} is a typical change{more}"
        )

    def advice(self) -> str:
        """Return what to do."""
        if self.offset is None:
            return "use a difference or another field, because no `offset` can keep these digits"
        where = "" if self.is_alone else f" for {self.element} in a separate entry"
        return f"set `offset: {self.offset!r}`{where}; it is added before the values are rounded"


def needed_offset(values: Floats) -> float | None:
    """Return an offset to add to values (N,) so that float32 keeps their digits.

    The offset has as few digits as possible. It is None if float32 keeps the digits without it, or
    if no offset helps. Values that are not finite are ignored.
    """
    found = values[np.isfinite(values)]
    change = _change(np.diff(found))
    return _offset(found, change) if _excess([found], change) else None


def rounding_of(
    runs: Sequence[Floats], names: Sequence[str], topic: str, offset: float = 0.0
) -> Rounding | None:
    """Return the digits that a quantity loses as float32; None if it keeps them.

    Args:
        runs: (N, K) or (N,) values of each run, after scale and offset.
        names: Names of the K elements.
        topic: Topic that contains the quantity.
        offset: Offset that has been added.
    """
    tables = [each.reshape(len(each), -1) for each in runs if each.size]
    with np.errstate(over="ignore"):
        is_exact = all(np.array_equal(t.astype(np.float32), t, equal_nan=True) for t in tables)
    if is_exact:
        return None
    worst, worst_excess, count = "", 0.0, 0
    for k, name in enumerate(names):
        parts = [table[:, k][np.isfinite(table[:, k])] for table in tables]
        excess = _excess(parts, _change(np.concatenate([np.diff(part) for part in parts])))
        count += excess > 0
        if excess > worst_excess:
            worst, worst_excess, values = name, excess, np.concatenate(parts)
            change = _change(np.concatenate([np.diff(part) for part in parts]))
    if not count:
        return None
    further = _offset(values, change)
    return Rounding(
        topic,
        worst,
        count,
        len(np.unique(values)),
        len(np.unique(values.astype(np.float32))),
        change,
        None if further is None else offset + further,
        len(names) == 1,
    )


def _change(changes: Floats) -> float:
    """Return the size of a typical change that is not 0; 0 if there is none."""
    sizes = np.abs(changes[changes != 0])
    return float(np.quantile(sizes, _QUANTILE)) if len(sizes) else 0.0


def _spacing(size: float) -> float:
    return float(np.spacing(np.float32(min(size, _LARGEST))))


def _excess(parts: Sequence[Floats], change: float) -> float:
    """Return the ratio of float32's spacing to the change; 0 if digits are kept or are noise."""
    values = np.concatenate(parts)
    size = float(np.abs(values).max(initial=0.0))
    spacing = _spacing(size)
    if change == 0 or spacing <= _COARSE * change:
        return 0.0
    if (values == np.rint(values)).all():
        return spacing / change
    if change <= _FLOAT64_NOISE * size:
        return 0.0
    # Small changes around one value, as of a sensor at rest, are noise, but clocks rise.
    signs = np.concatenate([np.sign(np.diff(part)) for part in parts])
    is_rising = abs(signs.sum()) > 0.9 * np.abs(signs).sum()
    return spacing / change if is_rising or np.ptp(values) >= spacing else 0.0


def _offset(values: Floats, change: float) -> float | None:
    """Return the offset with the fewest digits after which float32 keeps the digits of values."""
    low, high = float(values.min()), float(values.max())
    center = low + (high - low) / 2
    first = int(np.floor(np.log10(max(abs(low), abs(high)))))
    best = None
    for digits in range(-first, _MOST_DIGITS - first):
        nearest = round(center, digits)
        spacing = _spacing(max(high - nearest, nearest - low))
        if spacing <= _FINE * change:
            return -nearest
        if best is None and spacing <= _COARSE * change:
            best = -nearest
    return best


_LISTED = 20
_MUCH = 0.1
"""Share of missing or dropped steps above which a problem is reported."""


@dataclass(frozen=True)
class FieldReport:
    """Statistics of a quantity over the steps of the clock.

    Attributes:
        topic: Topic that contains the quantity.
        missing: Share of the steps without a value.
        median_age_s: Median age of the value at its step, seconds; NaN if no step has a value.
        max_age_s: Largest age, seconds; NaN if no step has a value.
        elements: Indexes of the elements that are missing at steps at which others are not.
        prevents: Share of the time that only this quantity prevents from being part of an episode,
            because it is missing, or older than `gap_s`.
    """

    topic: str
    missing: float
    median_age_s: float
    max_age_s: float
    elements: tuple[int, ...] = ()
    prevents: float = 0.0

    @classmethod
    def of(
        cls,
        topic: str,
        missing: NDArray[np.bool_],
        ages_s: NDArray[np.float64],
        values: Sequence[NDArray[Any]] = (),
        prevents: float = 0.0,
    ) -> FieldReport:
        """Summarize flags `missing`, ages `ages_s` and `values` of N steps."""
        known = np.abs(ages_s[np.isfinite(ages_s)])
        median, largest = (np.nan, np.nan)
        if len(known):
            median, largest = float(np.median(known)), float(known.max())
        share = float(missing.mean()) if len(missing) else 1.0
        return cls(topic, share, median, largest, _missing_elements(values), prevents)

    @property
    def short(self) -> str:
        """Missing share, median and largest age in seconds, such as `0.0% 0.012 0.11`."""
        ages = (
            "" if np.isnan(self.median_age_s) else f" {self.median_age_s:.3f} {self.max_age_s:.3f}"
        )
        return f"{self.missing:.1%}{ages}"

    def __str__(self) -> str:
        """Return the statistics as text for a table."""
        age = (
            ""
            if np.isnan(self.median_age_s)
            else (f", {self.median_age_s:.3f} s old (median), at most {self.max_age_s:.3f} s")
        )
        prevents = f", alone prevents {self.prevents:.1%} of the time" if self.prevents else ""
        return f"{self.topic}, missing {self.missing:.1%}{self.which}{age}{prevents}"

    @property
    def which(self) -> str:
        """Which elements are missing, as text; empty if it is the whole value."""
        if not self.elements:
            return ""
        some = ", ".join(map(str, self.elements[:8]))
        word = "element" if len(self.elements) == 1 else "elements"
        return f" ({word} {some}{', ...' if len(self.elements) > 8 else ''})"


def _missing_elements(values: Sequence[NDArray[Any]]) -> tuple[int, ...]:
    """Return the indexes of the elements that are missing where others are not."""
    found: set[int] = set()
    for each in values:
        if each.ndim == 2 and each.dtype.kind == "f":
            is_gap = ~np.isfinite(each)
            found |= set(np.flatnonzero(is_gap[~is_gap.all(axis=1)].any(axis=0)).tolist())
    return tuple(sorted(found))


def _dropped(lengths: list[int]) -> str:
    return f"{len(lengths)}, at most {counted(max(lengths), 'step')}" if lengths else "none"


def _listed(commands: dict[str, Command | None]) -> str:
    """Return the first commands with the names of their actions."""
    texts = [
        f"{name}: {'unknown' if command is None else ', '.join(map(_short, command))}"
        for name, command in itertools.islice(commands.items(), _LISTED)
    ]
    more = len(commands) - len(texts)
    return "; ".join([*texts, *([f"and {more} more"] if more else [])])


def _short(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value:g}"


@dataclass(frozen=True)
class RunReport:
    """Result for a recording, or for the part of it between two resets of the clock.

    Attributes:
        first_ns: Time of the first step; 0 if there are no steps.
        clock_steps: Number of steps of the clock.
        steps: Number of transitions.
        episodes: Number of episodes.
        fields: Statistics of each quantity, by name.
    """

    first_ns: int
    clock_steps: int
    steps: int
    episodes: int
    fields: dict[str, FieldReport]


@dataclass(frozen=True)
class MappingReport:
    """Result of reading a bag with a mapping.

    Attributes:
        clock_steps: Number of steps of the clock.
        steps: Number of transitions.
        episodes: Number of episodes.
        dropped: Number of transitions of each episode that was left out, because it is too short or
            not the longest of its recording.
        ends: Number of episodes by end reason; `condition` counts the episodes that a condition of
            the mapping ended.
        recordings: Number of recordings: files, or split bags with their parts.
        clock_resets: Number of times that the clock of a recording was reset.
        left_out: Messages that were not used: damaged ones, and those with impossible times.
        fields: Statistics of each quantity, by name.
        missing_actions: Share of the steps of the clock without an action.
        far_actions: Share of the transitions whose command is far from every named action, or
            beyond the limits of the Box.
        action_counts: Number of transitions of each discrete action, by name or number.
        action_parts: Elements of a Box action, with their limits and units.
        images: Problems of the images: messages that were left out, and guesses of their meaning.
        rounded: Digits that observed quantities and the action lose as float32, by name.
        commands: Command of each discrete action, by name or number of the action.
        runs: Result for each recording; several for a recording whose clock was reset.
        elements: Names of the elements of the observed vector.
        causes: Reasons why there are no episodes, if there are none.
    """

    clock_steps: int
    steps: int
    episodes: int
    dropped: list[int]
    ends: dict[str, int]
    recordings: int
    clock_resets: int
    left_out: list[Problem]
    fields: dict[str, FieldReport]
    missing_actions: float
    far_actions: float
    action_counts: dict[str, int]
    action_parts: list[str] = dataclass_field(default_factory=list)
    images: list[Problem] = dataclass_field(default_factory=list)
    rounded: dict[str, Rounding] = dataclass_field(default_factory=dict)
    commands: dict[str, Command | None] = dataclass_field(default_factory=dict)
    runs: list[RunReport] = dataclass_field(default_factory=list)
    elements: list[str] = dataclass_field(default_factory=list)
    causes: list[str] = dataclass_field(default_factory=list)

    def to_json(self) -> dict[str, Any]:
        """Return the report as JSON types; ages that are not finite become None."""
        found = asdict(self)
        for part in (found, *found["runs"]):
            for each in part["fields"].values():
                for name in ("median_age_s", "max_age_s"):
                    each[name] = each[name] if np.isfinite(each[name]) else None
        found["rounded"] = {name: each._asdict() for name, each in self.rounded.items()}
        return {
            **found,
            "left_out": [each.to_json() for each in self.left_out],
            "images": [each.to_json() for each in self.images],
        }

    def problems(self) -> list[Problem]:
        """Return problems that reduce the quality or the number of the transitions."""
        found = [*self.left_out]
        found += [
            Problem(
                f"{name} is missing at {each.missing:.0%} of the steps{each.which}",
                each.topic,
                next="set `missing` or a larger `tolerance_s`, or remove the quantity",
            )
            for name, each in self.fields.items()
            if each.missing > _MUCH
        ]
        found += [
            Problem(str(each), each.topic, next=each.advice()) for each in self.rounded.values()
        ]
        found += [
            Problem(
                f"{name} alone prevents {field.prevents:.0%} of the time: it is missing, or older"
                " than `gap_s`",
                field.topic,
                next="set `missing`, raise `gap_s`, or remove the quantity",
            )
            for name, field in self.fields.items()
            if field.prevents > _MUCH >= field.missing
        ]
        if self.missing_actions > _MUCH:
            what = f"{self.missing_actions:.0%} of the steps have no action"
            found.append(Problem(what, "action", next="check the topic and `align`"))
        if self.far_actions > _MUCH:
            what = f"{self.far_actions:.0%} of the commands are"
            if self.action_parts:
                what = f"{what} beyond the limits of {', '.join(self.action_parts)}"
                found.append(Problem(what, "action", next="set wider limits in `box`"))
            else:
                what = f"{what} far from every named action"
                found.append(Problem(what, "action", next="name more commands, or use `edges`"))
        if sum(self.dropped) > _MUCH * (self.steps + sum(self.dropped)):
            episodes = counted(len(self.dropped), "short episode")
            what = f"{episodes} with {counted(sum(self.dropped), 'step')} left out"
            found.append(Problem(what, "episodes", next="check `gap_s`, the ends and `min_steps`"))
        return [*found, *self.images]

    def rows(self) -> list[tuple[str, str]]:
        """Return the rows of a table: name and text of each result."""
        ends = ", ".join(f"{count} {reason}" for reason, count in self.ends.items())
        rows = [
            ("steps", f"{self.steps} of {self.clock_steps} steps of the clock"),
            ("episodes", str(self.episodes)),
            ("ends", ends or "none"),
            ("episodes left out", _dropped(self.dropped)),
            ("recordings", str(self.recordings)),
            ("resets of the clock", str(self.clock_resets)),
        ]
        rows += [(name, str(each)) for name, each in self.fields.items()]
        rows.append(("steps without action", f"{self.missing_actions:.1%}"))
        if self.action_counts:
            actions = ", ".join(f"{count} {name}" for name, count in self.action_counts.items())
            rows.append(("actions", actions))
        if self.action_parts:
            rows.append(("action", ", ".join(self.action_parts)))
        if self.commands:
            rows.append(("commands", _listed(self.commands)))
        far = "commands beyond the limits" if self.action_parts else "far commands"
        return [*rows, (far, f"{self.far_actions:.1%}")]

    def why_empty(self) -> str:
        """Return why there are no episodes, in one line."""
        causes = "; ".join(self.causes)
        if self.dropped:
            longest = counted(max(self.dropped), "step")
            short = f"the longest of {counted(len(self.dropped), 'episode')} has {longest}"
            return f"{short}; {causes}" if causes else short
        if self.clock_steps and self.missing_actions == 1.0:
            return f"no step has an action: {causes}"
        return causes or "the topics have no messages"
