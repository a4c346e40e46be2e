"""Logs made of parts of other logs, with all their topics, metadata and attachments."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from mcaprl.files import check_log_name
from mcaprl.recorder.edit.join import merge_logs
from mcaprl.recorder.edit.piece import Bounds, Edited, filter_log, slice_log, split_log
from mcaprl.recorder.source import Paths


def merge(data: Paths, out: str | Path, *, shift: bool = False, overwrite: bool = False) -> Edited:
    """Join logs into one log.

    The episodes of the new log are in the order of their times. The logs must be finished, and have
    the same spaces, environment, names of observations and actions, and step duration. Other
    metadata fields are empty in the new log if they differ between the logs. If several logs
    contain a message with the same time and bytes, it is written once.

    Args:
        data: Two or more logs: files, folders or globs.
        out: Path of the new log.
        shift: Whether to delay a log whose episodes overlap in time with episodes of earlier logs.
            The log then begins after the earlier logs end. The timestamps inside its messages are
            delayed, too.
        overwrite: Whether an existing file is replaced.

    Raises:
        UsageError: There are fewer than two logs.
        OutputExistsError: `out` exists.
        SpaceError: The spaces differ.
        LogError: A log cannot be read. Or the environment, names or step duration differ. Or
            episodes of two logs overlap in time, and `shift` is not set.
    """
    return merge_logs(data, check_log_name(out), shift=shift, overwrite=overwrite)


def split(
    data: str | Path,
    out: str | Path,
    *,
    episodes: int | None = None,
    ratio: Sequence[float] | None = None,
    seed: int | None = None,
    overwrite: bool = False,
) -> list[Edited]:
    """Divide the episodes of a log among several new logs.

    A message is copied with the episode during which or after which it was logged. Messages that
    remain valid for later episodes, such as the static scene, are copied to each new log that needs
    them.

    Args:
        data: Path of the log.
        out: New folder of the logs, which are named `NAME-00000.mcap`, `NAME-00001.mcap` and so on.
        episodes: Number of episodes of each new log; the last one may have fewer.
        ratio: Relative number of episodes of each new log, such as (8, 1, 1).
        seed: Seed of a random assignment of episodes to logs; None to assign them in their order.
        overwrite: Whether an existing folder is replaced.

    Raises:
        UsageError: Not exactly one of `episodes` and `ratio` is given, or a log would be empty.
        OutputExistsError: `out` exists.
        LogError: The log cannot be read, is not finished, or has no episodes.
    """
    return split_log(data, out, episodes=episodes, ratio=ratio, seed=seed, overwrite=overwrite)


def filter(
    expression: str, data: str | Path, out: str | Path, *, overwrite: bool = False
) -> Edited:
    """Copy the episodes for which an expression is true to a new log.

    The expression is a condition such as `"length > 100 and reason != 'crash'"`. It can use
    numbers, strings, operators, and these columns of the table of episodes: `episode` (its index,
    from 0), `length`, `total_reward`, `terminated`, `truncated`, `reason`, `policy`, `epsilon`,
    `seed` (NaN if there was none), `options`, `start_s` (time since the start of the first
    episode) and `duration_s`.

    Args:
        expression: Condition on an episode.
        data: Path of the log.
        out: Path of the new log.
        overwrite: Whether an existing file is replaced.

    Raises:
        UsageError: The expression is not a condition, or names an unknown column.
        OutputExistsError: `out` exists.
        NoEpisodesError: The expression is true for no episode.
        LogError: The log cannot be read, or is not finished.
    """
    return filter_log(expression, data, check_log_name(out), overwrite=overwrite)


def slice(
    data: str | Path,
    out: str | Path,
    *,
    steps: Bounds | None = None,
    time: Bounds | None = None,
    overwrite: bool = False,
) -> Edited:
    """Copy the part of a log between two steps or times to a new log.

    An episode that is only partly in the range becomes a shorter episode. If its beginning is
    missing, its steps are numbered from 0, and it has no seed. If its end is missing, it is
    truncated with the reason `interrupted`.

    Args:
        data: Path of the log; with `time`, any finished MCAP file.
        out: Path of the new log.
        steps: Half-open range (start, stop) of transitions, counted from 0 over all episodes. A
            bound of None is the start or end of the log.
        time: Half-open range (start, stop) in seconds since the first message of the log. A bound
            of None is the start or end of the log.
        overwrite: Whether an existing file is replaced.

    Raises:
        UsageError: Not exactly one of `steps` and `time` is given, or the range is empty.
        OutputExistsError: `out` exists.
        NoEpisodesError: The range has no complete transition.
        LogError: The log cannot be read, or is not finished.
    """
    return slice_log(data, check_log_name(out), steps=steps, time=time, overwrite=overwrite)
