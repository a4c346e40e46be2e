"""Recovery of the valid part of a log."""

from __future__ import annotations

from pathlib import Path

from mcaprl.recorder.repair.recover import Recovery, recover_log


def recover(
    file: str | Path, out: str | Path, *, keep_unfinished: bool = False, overwrite: bool = False
) -> Recovery:
    """Write the valid part of a log that was cut off or damaged to a new log.

    Args:
        file: MCAP file, damaged or not; it is not changed.
        out: Path of the new log.
        keep_unfinished: Whether episodes without an end are kept, marked truncated, up to their
            last whole transition.
        overwrite: Whether an existing file is replaced.

    Returns:
        What was kept and what was lost.

    Raises:
        OutputExistsError: `out` exists.
        UsageError: `out` is the same file.
        LogError: Nothing can be kept, or `out` cannot be written.
    """
    return recover_log(file, out, keep_unfinished=keep_unfinished, overwrite=overwrite)
