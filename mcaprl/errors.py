"""Errors caused by data or by a user's request, and the problems that checks report.

They name arguments of Python functions as `overwrite=True` or `episodes=N`, and as `episodes=` for
any value. The command line prints arguments as options, such as `--overwrite` or `--episodes N`.

McaprlError
├── UsageError            the request is invalid                       (exit code 2)
│   ├── UnknownNameError    a sim, policy, observation... is unknown
│   ├── OutputExistsError   the output path exists
│   └── MissingExtraError   an optional dependency is not installed
├── LogError              a log cannot be read or written              (exit code 1)
│   ├── NotMcapError        the file is not an MCAP file
│   ├── NoStepsError        the file has no `/rl/step` topic, or no finished episode
│   │   └── NoEpisodesError   the file has the topic, but no finished episode
│   └── CorruptLogError     the file is damaged
├── SpaceError            spaces that cannot be logged or do not agree (exit code 1)
├── PolicyError           a saved policy cannot be used                (exit code 1)
├── TrainingError         training cannot continue                     (exit code 1)
├── ClusterError          a Ray cluster cannot be used                 (exit code 1)
└── ReportError           a figure, video or report cannot be written  (exit code 1)
"""

from __future__ import annotations

import difflib
import importlib
import re
from collections import Counter
from collections.abc import Iterable
from contextvars import ContextVar
from dataclasses import dataclass
from importlib.util import find_spec
from types import ModuleType
from typing import ClassVar, Final, Literal, Protocol, TypeVar

BAG_HINT: Final = (
    "a robot's bag needs a mapping: convert it by `mcaprl convert BAG OUT.mcap --mapping FILE`;"
    " `mcaprl convert --suggest BAG > FILE` drafts one"
)
"""What to do with the bag of a robot that is passed where a log is expected."""


class McaprlError(Exception):
    """Base class of all errors caused by data or by a user's request."""

    exit_code: ClassVar[int] = 1

    def __str__(self) -> str:
        """Return the message as one line, also if it quotes a message of a library."""
        return " ".join(line.strip() for line in super().__str__().split("\n"))


class UsageError(McaprlError):
    """The request is invalid."""

    exit_code = 2


class UnknownNameError(UsageError):
    """A name is unknown; the message lists the known names and suggests similar ones."""

    def __init__(
        self, kind: str, name: str, known: Iterable[str], others: Iterable[str] = ()
    ) -> None:
        """Compose the message.

        Args:
            kind: Kind of the named thing, such as `policy`.
            name: Unknown name.
            known: Known names, which the message lists.
            others: More known names. The message does not list them, but suggests similar ones.
        """
        names, more = sorted(known), sorted(others)
        near = difflib.get_close_matches(name, [*names, *more], n=3, cutoff=0.5)
        hint = f"did you mean {' or '.join(near)}? " if near else ""
        super().__init__(f"unknown {kind} '{name}': {hint}known: {', '.join(names) or 'none'}")
        self.kind = kind
        self._arguments = (kind, name, names, more)

    def __reduce__(self) -> tuple[type[UnknownNameError], tuple[str, str, list[str], list[str]]]:
        """Return the constructor's arguments. By default, pickle would pass the message instead."""
        return type(self), self._arguments


class OutputExistsError(UsageError):
    """The output path exists and must not be replaced."""


class MissingExtraError(UsageError):
    """An optional dependency is not installed."""


class LogError(McaprlError):
    """A log cannot be read or written."""


class NotMcapError(LogError):
    """The file is not an MCAP file."""


class NoStepsError(LogError):
    """The file contains no transitions: no `/rl/step` topic, or no finished episode."""


class NoEpisodesError(NoStepsError):
    """The file is a log, but has no finished episode."""


class CorruptLogError(LogError):
    """The file is damaged: a CRC, a length or an index is wrong."""


class SpaceError(McaprlError):
    """Spaces cannot be logged, or do not match."""


class PolicyError(McaprlError):
    """A saved policy cannot be loaded, or does not fit the environment or dataset."""


class TrainingError(McaprlError):
    """Training cannot continue."""


class ClusterError(McaprlError):
    """A Ray cluster cannot be reached, or its workers cannot run the task."""


class ReportError(McaprlError):
    """A figure, video or report cannot be written."""


def import_extra(module: str, extra: str) -> ModuleType:
    """Import an optional dependency.

    Args:
        module: Import name of the module, such as `"torch"`.
        extra: Extra of `mcaprl` that installs the module, such as `"offline"`.

    Raises:
        MissingExtraError: The module is not installed; the message has the pip command.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] != module.split(".")[0]:
            raise
        raise MissingExtraError(
            f"{module.split('.')[0]} is not installed: pip install 'mcaprl[{extra}]'"
        ) from error


is_help: Final = ContextVar("is_help", default=False)
"""Whether only the help of a command is printed, which needs no extra."""


def require_extra(extra: str, *packages: str) -> None:
    """Check without importing them that the packages of an extra are installed.

    Raises:
        MissingExtraError: One is missing, and not only help is printed.
    """
    for name in packages:
        if find_spec(name) is None and not is_help.get():
            raise MissingExtraError(f"{name} is not installed: pip install 'mcaprl[{extra}]'")


Severity = Literal["problem", "note"]
LISTED = 10  # Maximum number of listed findings of one kind; further findings are only counted
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
