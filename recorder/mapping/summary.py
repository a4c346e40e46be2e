"""Report of what a mapping reads from a bag, and of what it leaves out."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from dataclasses import field as dataclass_field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.problem import Problem
from mcaprl.texts import counted

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
        prevents: Share of the time that only this quantity prevents from being part of an episode,
            because it is missing, or older than `gap_s`.
    """

    topic: str
    missing: float
    median_age_s: float
    max_age_s: float
    prevents: float = 0.0

    @classmethod
    def of(
        cls,
        topic: str,
        missing: NDArray[np.bool_],
        ages_s: NDArray[np.float64],
        prevents: float = 0.0,
    ) -> FieldReport:
        """Summarize flags `missing` and ages `ages_s` of N steps."""
        known = np.abs(ages_s[np.isfinite(ages_s)])
        median, largest = (np.nan, np.nan)
        if len(known):
            median, largest = float(np.median(known)), float(known.max())
        share = float(missing.mean()) if len(missing) else 1.0
        return cls(topic, share, median, largest, prevents)

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
        return f"{self.topic}, missing {self.missing:.1%}{age}{prevents}"


def _dropped(lengths: list[int]) -> str:
    return f"{len(lengths)}, at most {counted(max(lengths), 'step')}" if lengths else "none"


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
        dropped: Number of transitions of each episode that was too short.
        ends: Number of episodes by end reason; `condition` counts the episodes that a condition of
            the mapping ended.
        clock_resets: Number of times that the clock went back by more than `gap_s`.
        fields: Statistics of each quantity, by name.
        missing_actions: Share of the steps of the clock without an action.
        far_actions: Share of the transitions whose command is far from every named action, or
            beyond the limits of the Box.
        action_counts: Number of transitions of each discrete action, by name or number.
        runs: Result for each recording; several for a recording whose clock was reset.
        elements: Names of the elements of the observed vector.
        causes: Reasons why there are no episodes, if there are none.
    """

    clock_steps: int
    steps: int
    episodes: int
    dropped: list[int]
    ends: dict[str, int]
    clock_resets: int
    fields: dict[str, FieldReport]
    missing_actions: float
    far_actions: float
    action_counts: dict[str, int]
    runs: list[RunReport] = dataclass_field(default_factory=list)
    elements: list[str] = dataclass_field(default_factory=list)
    causes: list[str] = dataclass_field(default_factory=list)

    def to_json(self) -> dict[str, Any]:
        """Return the report as JSON types; ages that are not finite become None."""
        found = asdict(self)
        for part in (found, *found["runs"]):
            for field in part["fields"].values():
                for name in ("median_age_s", "max_age_s"):
                    field[name] = field[name] if np.isfinite(field[name]) else None
        return found

    def problems(self) -> list[Problem]:
        """Return problems that reduce the quality or the number of the transitions."""
        found = [
            Problem(
                f"{name} is missing at {field.missing:.0%} of the steps",
                field.topic,
                next="set `missing` or a larger `tolerance_s`, or remove the quantity",
            )
            for name, field in self.fields.items()
            if field.missing > _MUCH
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
            what = f"{self.far_actions:.0%} of the commands are far from every named action"
            found.append(Problem(what, "action", next="name more commands, or use `edges`"))
        if sum(self.dropped) > _MUCH * (self.steps + sum(self.dropped)):
            episodes = counted(len(self.dropped), "short episode")
            what = f"{episodes} with {counted(sum(self.dropped), 'step')} left out"
            found.append(Problem(what, "episodes", next="check `gap_s`, the ends and `min_steps`"))
        return found

    def rows(self) -> list[tuple[str, str]]:
        """Return the rows of a table: name and text of each result."""
        ends = ", ".join(f"{count} {reason}" for reason, count in self.ends.items())
        rows = [
            ("steps", f"{self.steps} of {self.clock_steps} steps of the clock"),
            ("episodes", str(self.episodes)),
            ("ends", ends or "none"),
            ("episodes left out", _dropped(self.dropped)),
            ("resets of the clock", str(self.clock_resets)),
        ]
        rows += [(name, str(field)) for name, field in self.fields.items()]
        rows.append(("steps without action", f"{self.missing_actions:.1%}"))
        if self.action_counts:
            actions = ", ".join(f"{count} {name}" for name, count in self.action_counts.items())
            rows.append(("actions", actions))
        return [*rows, ("far commands", f"{self.far_actions:.1%}")]

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
