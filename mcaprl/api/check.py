"""Validation of complete files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcaprl.api.data import Paths
from mcaprl.api.ranges import check_least
from mcaprl.errors import LogError, UsageError
from mcaprl.problem import Problem
from mcaprl.recorder.dataset.open import find_logs
from mcaprl.recorder.repair.check import check_log


@dataclass(frozen=True)
class CheckResult:
    """Result of `check`.

    Attributes:
        files: Files that were read.
        missing: Problems with paths that contain no logs.
        problems: All problems, in the order of the paths.
    """

    files: tuple[Path, ...]
    missing: tuple[Problem, ...]
    problems: tuple[Problem, ...]

    @property
    def ok(self) -> bool:
        """Whether there are no problems."""
        return not self.problems

    def to_json(self) -> dict[str, Any]:
        """Return what `check --json` prints."""
        return {"ok": self.ok, "problems": [problem.to_json() for problem in self.problems]}


def check(data: Paths, *, threads: int = 1) -> CheckResult:
    """Read logs completely; validate structure, CRCs, indexes, episodes and metadata.

    Args:
        data: File, folder or glob of logs, or several of them. A path without logs is
            reported as a problem.
        threads: Number of threads that decompress chunks.

    Raises:
        UsageError: `data` is empty, or `threads` is below 1.
    """
    check_least(1, threads=threads)
    names: Sequence[str | Path] = [data] if isinstance(data, str | Path) else data
    if not names:
        raise UsageError("no data: the list of files is empty")
    files: list[Path] = []
    missing: list[Problem] = []
    problems: list[Problem] = []
    for name in names:
        try:
            found = find_logs(name)
        except LogError as error:
            missing.append(
                Problem(str(error), "searching for logs", next="check the path", file=str(name))
            )
            problems.append(missing[-1])
            continue
        files += found
        problems += [problem for path in found for problem in check_log(path, threads=threads)]
    return CheckResult(tuple(files), tuple(missing), tuple(problems))
