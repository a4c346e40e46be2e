"""What `check`, `recover`, `verify` and `info` report about a log or a dataset."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Severity = Literal["problem", "note"]


@dataclass(frozen=True)
class Problem:
    """Something in a log or a dataset that is wrong, or that its user should know.

    Attributes:
        what: Description of the defect.
        where: Place in the file or dataset: a byte, a topic, an episode.
        effect: Consequence; empty if `what` says it.
        next: Action that the user can take; empty if there is none.
        file: Path of the file; empty for a dataset.
        severity: `problem` for a defect, `note` for what may be intended.
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
