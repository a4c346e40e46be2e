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
        keep_unfinished: Whether unfinished episodes are kept up to their last complete
            transition, marked truncated.
        overwrite: Whether an existing file is replaced.

    Returns:
        Summary of kept and lost data.

    Raises:
        OutputExistsError: `out` exists.
        UsageError: `file` and `out` are the same file.
        LogError: Nothing can be kept, or `out` cannot be written.
    """
    return recover_log(file, out, keep_unfinished=keep_unfinished, overwrite=overwrite)
