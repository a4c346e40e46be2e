"""Atomic replacement of files: after a kill, `path` has either its old or its new content."""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mcaprl.errors import LogError, McaprlError

if sys.platform != "win32":
    import fcntl


def try_lock(descriptor: int) -> bool:
    """Lock an open file or folder for this process; return False if another one has locked it.

    The lock is advisory and ends when the file is closed. Systems without `flock`, such as Windows
    and some network file systems, have no locks.
    """
    if sys.platform != "win32":
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        except OSError:
            pass
    return True


@contextmanager
def locked_folder(folder: Path, error_type: type[McaprlError] = LogError) -> Iterator[None]:
    """Create a folder if it is missing, and lock it against other writers.

    Raises:
        McaprlError: Another process is writing to the folder, or it cannot be created.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError as error:
        raise error_type(f"cannot write {folder}: {error.strerror or error}") from error
    try:
        if not try_lock(descriptor):
            raise error_type(
                f"{folder} is being written by another process: wait for its end, or choose another"
                " folder"
            )
        yield
    finally:
        os.close(descriptor)


@contextmanager
def replacing(
    path: Path, error_type: type[McaprlError] | None = None, *, concurrent: bool = False
) -> Iterator[Path]:
    """Yield a temporary path in the same folder; move the file written there to `path` at the end.

    The folder is created, and the content is on the disk before the move. If the body raises,
    `path` is left as it was. The temporary file is removed in either case.

    Args:
        path: File to create or replace.
        error_type: Type raised in place of an OSError; None lets the OSError pass.
        concurrent: Whether several processes may replace `path` at the same time.

    Raises:
        McaprlError: The file cannot be written, and `error_type` is given.
        OSError: The file cannot be written, and `error_type` is None.
    """
    process = f".{os.getpid()}" if concurrent else ""
    unfinished = path.with_name(f"{path.name}{process}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield unfinished
            with unfinished.open("rb+") as file:
                os.fsync(file.fileno())
            os.replace(unfinished, path)
        finally:
            unfinished.unlink(missing_ok=True)
    except OSError as error:
        if error_type is None:
            raise
        raise error_type(f"cannot write {path}: {error.strerror or error}") from error


def write_atomically(
    path: Path, content: bytes, error_type: type[McaprlError] | None = None
) -> None:
    """Write a file with `replacing`."""
    with replacing(path, error_type) as unfinished:
        unfinished.write_bytes(content)


def json_text(value: Any) -> str:
    """Return indented JSON; NaN and infinities, which JSON does not have, become null."""
    return json.dumps(_finite(value), indent=2)


def write_json(path: Path, value: Any, error_type: type[McaprlError] | None = None) -> None:
    """Write `json_text` of a value with `replacing`."""
    write_atomically(path, f"{json_text(value)}\n".encode(), error_type)


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _finite(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
