"""Processes that the tests have started, on systems with /proc."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path


def descendants() -> Iterator[int]:
    """Yield this process and all processes that it started, each after its parent."""
    parents = [os.getpid()]
    while parents:
        parent = parents.pop()
        yield parent
        # Each thread of a process can start processes. A process or thread may have ended.
        with suppress(OSError):
            for path in Path(f"/proc/{parent}/task").glob("*/children"):
                with suppress(OSError):
                    parents += map(int, path.read_text().split())


def titled(text: str) -> list[int]:
    """Return the descendants with this text in their command line, the oldest first."""
    found = []
    for process in descendants():
        with suppress(OSError):
            if text.encode() in Path(f"/proc/{process}/cmdline").read_bytes():
                found.append(process)
    return sorted(found)


def open_files() -> Iterator[tuple[int, str]]:
    """Yield each open file of the descendants, as a process and what the file's link shows."""
    for process in descendants():
        with suppress(OSError):
            for path in Path(f"/proc/{process}/fd").iterdir():
                with suppress(OSError):
                    yield process, os.readlink(path)
