"""Fuzz of all inputs: changed files are read, or refused with an error of this package.

    python -m tests.support.damage.fuzz TARGET FOLDER CASES [FIRST] [--all]

Reads CASES changed inputs of a target (a key of `TARGETS`), from the case FIRST on, in a process of
bounded memory. The number of a case determines its change. A case fails if another exception is
raised, if a message has several lines, if NumPy warns of a calculation, or if it takes too much
memory or time. The changed input of the last case stays in FOLDER. With `--all`, failures are
counted by their place; without it, the first one ends the program.
"""

from __future__ import annotations

import argparse
import faulthandler
import random
import resource
import shutil
import signal
import sys
import traceback
import warnings
from collections import Counter
from pathlib import Path

import numpy as np

from mcaprl.errors import McaprlError
from tests.support.damage.changed import changed
from tests.support.damage.targets import TARGETS, Example
from tests.support.paths import ROOT

_LIMIT_BYTES = 3 << 30
_GROWTH_BYTES = 1 << 30
"""Memory that all cases together may take."""
_TIME_S = 60


def main() -> None:
    """Try the cases; the last line of the output has their number and that of the refused ones."""
    parser = argparse.ArgumentParser()
    parser.add_argument("target", choices=TARGETS)
    parser.add_argument("folder", type=Path)
    parser.add_argument("cases", type=int)
    parser.add_argument("first", type=int, nargs="?", default=0)
    parser.add_argument("--all", action="store_true")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    for kind in (RuntimeWarning, np.exceptions.ComplexWarning):
        warnings.simplefilter("error", kind)
    (given.folder / "examples").mkdir(parents=True)
    examples = TARGETS[given.target](given.folder / "examples")
    for example in examples:
        reason = _refusal(example, given.folder / "work")
        assert not reason, f"the valid example {example.folder} is refused: {reason}"
    _limit_memory()
    before, refused, failures = _peak_bytes(), 0, Counter[str]()
    for number in range(given.first, given.first + given.cases):
        chance = random.Random(f"{given.target} {number}")
        example = chance.choice(examples)
        print(f"case {number}", flush=True)
        try:
            refused += _tried(example, given.folder / "work", chance, before)
        except Exception as error:
            print(f"case {number} of {given.target!r} ({example.folder.name}) failed", flush=True)
            traceback.print_exc()
            if not given.all:
                sys.exit(1)
            failures[_place(error)] += 1
            before = max(before, _peak_bytes())
    for place, count in failures.most_common():
        print(f"FAILED {count} {place}")
    print(f"{given.cases} cases, {refused} refused")


def _tried(example: Example, work: Path, chance: random.Random, before: int) -> bool:
    """Read an example with a change, in bounded time and memory; return whether it is refused."""
    signal.alarm(_TIME_S)
    faulthandler.dump_traceback_later(_TIME_S - 5)
    try:
        reason = _refusal(example, work, chance)
        grown = _peak_bytes() - before
        assert grown < _GROWTH_BYTES, f"memory grew by {grown >> 20} MiB"
        return reason != ""
    finally:
        signal.alarm(0)
        faulthandler.cancel_dump_traceback_later()


def _refusal(example: Example, work: Path, chance: random.Random | None = None) -> str:
    """Copy an example, change one of its files, and read it; return why it was refused."""
    shutil.rmtree(work, ignore_errors=True)
    shutil.copytree(example.folder, work)
    if chance is not None:
        path = chance.choice(sorted(path for path in work.glob(example.files) if path.is_file()))
        with warnings.catch_warnings(action="ignore"):
            path.write_bytes(changed(path.read_bytes(), chance))
    reason = ""
    for call in example.calls:
        try:
            call(work)
        except McaprlError as error:
            reason = str(error)
            assert "\n" not in reason, f"several lines: {reason!r}"
    return reason


def _limit_memory() -> None:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    _, most = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + _LIMIT_BYTES, most))


def _peak_bytes() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10


def _place(error: Exception) -> str:
    """Return the type of an error, and the last line of this package that it passed."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [each for each in frames if each.filename.startswith(str(ROOT / "mcaprl"))]
    last = (own or frames)[-1]
    return f"{type(error).__name__} {last.filename}:{last.lineno} {str(error)[:90]!r}"


if __name__ == "__main__":
    main()
