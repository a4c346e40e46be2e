"""Every error a user can meet. A message says what is wrong, where, and what to do.

McaprlError
├── UsageError            the request itself cannot be meant           (exit code 2)
│   ├── UnknownNameError    no sim, policy, observation... of that name
│   ├── OutputExistsError   the output path is taken
│   └── MissingExtraError   an optional dependency is not installed
├── LogError              a log cannot be read or written as asked     (exit code 1)
│   ├── NotMcapError        the file is no MCAP file
│   ├── NoStepsError        the file has no `/rl/step` topic, or no finished episode
│   │   └── NoEpisodesError   it has the topic, but no finished episode (yet)
│   └── CorruptLogError     the file's bytes contradict each other
├── SpaceError            spaces that cannot be logged or do not agree (exit code 1)
├── PolicyError           a saved policy cannot be used                (exit code 1)
├── TrainingError         learning cannot go on                        (exit code 1)
└── ReportError           a picture or report cannot be written        (exit code 1)
"""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Iterable
from types import ModuleType
from typing import ClassVar


class McaprlError(Exception):
    """Base of all errors that a user's data or request can cause."""

    exit_code: ClassVar[int] = 1


class UsageError(McaprlError):
    """The request cannot be carried out as it was put."""

    exit_code = 2


class UnknownNameError(UsageError):
    """No such name; the message lists the nearest ones, or all when there are few."""

    def __init__(
        self, kind: str, name: str, known: Iterable[str], others: Iterable[str] = ()
    ) -> None:
        """Say which `kind` of thing `name` was meant to be.

        Args:
            kind: such as `policy`.
            name: that is not known.
            known: names that are, to be listed.
            others: more of them, too many to list.
        """
        names, more = sorted(known), sorted(others)
        near = difflib.get_close_matches(name, [*names, *more], n=3, cutoff=0.5)
        hint = f"did you mean {' or '.join(near)}? " if near else ""
        super().__init__(f"unknown {kind} '{name}': {hint}known: {', '.join(names)}")
        self._arguments = (kind, name, names, more)

    def __reduce__(self) -> tuple[type[UnknownNameError], tuple[str, str, list[str], list[str]]]:
        """Make it again in another process, which cannot be done from the message alone."""
        return type(self), self._arguments


class OutputExistsError(UsageError):
    """The output path exists and may not be replaced."""


class MissingExtraError(UsageError):
    """An optional dependency is not installed."""


class LogError(McaprlError):
    """A log cannot be read or written as asked."""


class NotMcapError(LogError):
    """The file is no MCAP file."""


class NoStepsError(LogError):
    """The file holds no transitions: no `/rl/step` topic, or no finished episode."""


class NoEpisodesError(NoStepsError):
    """The file is a log, but no episode of it is finished."""


class CorruptLogError(LogError):
    """The file's bytes contradict each other: a CRC, a length or an index is wrong."""


class SpaceError(McaprlError):
    """Spaces that cannot be logged, or that do not agree with each other."""


class PolicyError(McaprlError):
    """A saved policy cannot be loaded, or does not fit what it is asked to drive."""


class TrainingError(McaprlError):
    """Learning cannot go on."""


class ReportError(McaprlError):
    """A picture or report cannot be written."""


def import_extra(module: str, extra: str) -> ModuleType:
    """Import an optional dependency.

    Args:
        module: the module's import name, such as `"torch"`.
        extra: the extra of `mcaprl` that installs it, such as `"offline"`.

    Raises:
        MissingExtraError: it is not installed; the message has the pip line that mends it.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] != module.split(".")[0]:
            raise
        raise MissingExtraError(
            f"{module.split('.')[0]} is not installed: pip install 'mcaprl[{extra}]'"
        ) from error
