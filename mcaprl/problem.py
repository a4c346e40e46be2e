"""Defects and notes that `check`, `recover`, `verify` and `info` report."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, Protocol, TypeVar

Severity = Literal["problem", "note"]
LISTED = 10
"""Maximum number of listed findings of one kind; further findings are only counted."""
# Descriptions contain texts from the file. Without a limit, a file could have any number of kinds.
_MAX_KINDS = 100
_OTHERS = "other findings"
_NUMBER = re.compile(r"-?\d[\d.,]*")


@dataclass(frozen=True)
class Problem:
    """Defect of a log or a dataset, or note about it.

    Attributes:
        what: Description of the defect.
        where: Place in the file or dataset: a byte, a topic, an episode.
        effect: Consequence; empty if `what` implies it.
        next: Action that the user can take; empty if there is none.
        file: Path of the file; empty for a dataset.
        severity: `problem` for a defect, `note` for a possibly intended property.
    """

    what: str
    where: str
    effect: str = ""
    next: str = ""
    file: str = ""
    severity: Severity = "problem"

    def __str__(self) -> str:
        """Return the line that the command line prints."""
        file = f"{self.file}: " if self.file else ""
        effect = f": {self.effect}" if self.effect else ""
        action = f"; {self.next}" if self.next else ""
        return f"{file}{self.what} ({self.where}){effect}{action}"

    def to_json(self) -> dict[str, str]:
        """Return the fields that `check --json` has for each problem."""
        return {"file": self.file, "what": self.what, "where": self.where, "next": self.next}


class Finding(Protocol):
    """Defect or note with a description; `Shortlist` accepts any such object."""

    @property
    def what(self) -> str:
        """Description. Findings whose descriptions differ only in numbers are of the same kind."""


F = TypeVar("F", bound=Finding)


class Shortlist(list[F]):
    """List that stores the first findings of each kind and counts the others."""

    def __init__(self, found: Iterable[F] = ()) -> None:
        """Start with some findings."""
        super().__init__()
        self._counts: Counter[str] = Counter()
        self.extend(found)

    def append(self, finding: F) -> None:
        """Count a finding, and store it if it is one of the first of its kind."""
        kind = _NUMBER.sub("#", finding.what)
        if kind not in self._counts and len(self._counts) >= _MAX_KINDS:
            kind = _OTHERS
        self._counts[kind] += 1
        if self._counts[kind] <= LISTED:
            super().append(finding)

    def extend(self, found: Iterable[F]) -> None:
        """Store or count findings."""
        for finding in found:
            self.append(finding)

    @property
    def total(self) -> int:
        """Number of all findings."""
        return self._counts.total()

    def rest(self) -> list[Problem]:
        """Return a problem for each kind with unlisted findings. It states the number of them."""
        return [
            Problem(f"{count - LISTED} more findings of the kind: {kind}", "not listed")
            for kind, count in self._counts.items()
            if count > LISTED
        ]
