"""Copies of selected episodes of a log, written to one new log or to several."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError, NoEpisodesError, UsageError
from mcaprl.files import replacing, replacing_folder
from mcaprl.recorder.edit.source import Edited, FinishedLog
from mcaprl.recorder.format.episode_summary import EpisodeSummary
from mcaprl.recorder.format.selected_copy import Source, copy_selected
from mcaprl.recorder.mapping.expression import Column, Expression
from mcaprl.texts import counted

_NS_PER_S = 10**9
# Expressions compare numbers as float64, which cannot represent all integers above this limit.
_LARGEST_EXACT = 2**53


def filter_log(
    expression: str, path: str | Path, out: str | Path, *, overwrite: bool = False
) -> Edited:
    """Copy the episodes for which an expression is true; see `mcaprl.filter`."""
    condition = Expression(expression)
    if condition.uses_next:
        raise UsageError(f"'{expression}': next(...) has no meaning for episodes")
    log = FinishedLog(path)
    table = episode_columns(log.summaries(), condition.names)
    holds = condition.evaluate(table, np.arange(len(log.lengths)))
    if not condition.is_condition(table):
        raise UsageError(f"'{expression}' is not a condition: compare it, as in 'length > 10'")
    # A condition on a missing value (NaN) is false.
    chosen = np.flatnonzero(np.nan_to_num(holds.astype(np.float64)))
    if not len(chosen):
        raise NoEpisodesError(
            f"{path}: '{expression}' is true for no episode ({len(log.lengths)} in the log)"
        )
    with replacing(Path(out), LogError, overwrite=overwrite) as unfinished:
        return _copy_episodes(log, chosen, unfinished, Path(out))


def split_log(
    path: str | Path,
    out: str | Path,
    *,
    episodes: int | None = None,
    ratio: Sequence[float] | None = None,
    seed: int | None = None,
    overwrite: bool = False,
) -> list[Edited]:
    """Copy the episodes of a log to several logs in a folder; see `mcaprl.split`."""
    log, out = FinishedLog(path), Path(out)
    log.need_steps()
    parts = _parts(len(log.lengths), episodes, ratio)
    order = np.arange(len(log.lengths))
    if seed is not None:
        np.random.default_rng(seed).shuffle(order)
    found = []
    with replacing_folder(out, overwrite=overwrite) as folder:
        for number, (start, stop) in enumerate(parts):
            name = f"{Path(str(log.path)).stem}-{number:05d}.mcap"
            chosen = np.sort(order[start:stop])
            found.append(_copy_episodes(log, chosen, folder / name, out / name))
    return found


def episode_columns(
    summaries: Sequence[EpisodeSummary], names: frozenset[str]
) -> dict[str, Column]:
    """Return the columns that a filter can use, by name, with one row per episode.

    Args:
        summaries: Summaries of the episodes.
        names: Names that the filter uses.

    Raises:
        UsageError: The filter uses `seed`, and a seed is too large to be compared exactly.
    """
    seeds = [summary.seed for summary in summaries]
    largest = max((seed for seed in seeds if seed is not None), default=0)
    if "seed" in names and largest > _LARGEST_EXACT:
        raise UsageError(f"seed {largest} is too large to compare; select by `episode` instead")
    starts, ends = (
        np.array([getattr(summary, name) for summary in summaries], np.int64)
        for name in ("start_time_ns", "end_time_ns")
    )
    return {
        "episode": np.arange(len(summaries)),
        "length": np.array([summary.length for summary in summaries], np.int64),
        "total_reward": np.array([summary.total_reward for summary in summaries], np.float64),
        "terminated": np.array([summary.terminated for summary in summaries], np.bool_),
        "truncated": np.array([summary.truncated for summary in summaries], np.bool_),
        "reason": np.array([summary.reason for summary in summaries], object),
        "policy": np.array([summary.policy for summary in summaries], object),
        "epsilon": np.array([summary.epsilon for summary in summaries], np.float64),
        "seed": np.array([np.nan if seed is None else seed for seed in seeds], np.float64),
        "options": np.array([summary.options for summary in summaries], object),
        "start_s": (starts - starts[0]) / _NS_PER_S,
        "duration_s": (ends - starts) / _NS_PER_S,
    }


def _copy_episodes(log: FinishedLog, chosen: NDArray[np.int64], target: Path, out: Path) -> Edited:
    spans = log.spans_of(chosen)
    ids = {id_: id_ for id_ in log.reader.channels}
    source = Source(log.reader, ids, spans, also=log.states(spans))
    copied = copy_selected([source], target, log.top_level)
    steps = int(log.lengths[chosen].sum())
    return Edited(out, len(chosen), steps, copied.messages, copied.whole, copied.rewritten)


def _parts(
    count: int, episodes: int | None, ratio: Sequence[float] | None
) -> list[tuple[int, int]]:
    """Divide `count` episodes into parts, and return the start and stop index of each part.

    Raises:
        UsageError: `episodes` and `ratio` are both given or both missing, a value is invalid, or a
            part would be empty.
    """
    if (episodes is None) == (ratio is None):
        raise UsageError("give either the episodes of each part or the ratio of the parts")
    if episodes is not None:
        if episodes < 1:
            raise UsageError(f"episodes is {episodes}, expected 1 or more")
        return [(start, min(start + episodes, count)) for start in range(0, count, episodes)]
    assert ratio is not None
    shares = np.array(ratio, np.float64)
    if not (len(shares) > 1 and np.isfinite(shares).all() and (shares > 0).all()):
        raise UsageError("the ratio needs two or more positive numbers, such as 8:1:1")
    bounds = np.rint(np.cumsum(shares) / shares.sum() * count).astype(np.int64)
    starts = np.concatenate([[0], bounds[:-1]])
    if (starts == bounds).any():
        raise UsageError(
            f"{counted(count, 'episode')} cannot be divided into {len(shares)} parts of this ratio"
        )
    return list(zip(starts.tolist(), bounds.tolist(), strict=True))
