"""Writes a whole log from what is left of one that was cut off or damaged.

    sound records -> a file that is whole      -> episodes that are whole -> OUT
    (salvage)        (sound_copy: chunks,         (whole_episodes)
                      indexes, CRCs anew)

Metadata, attachments and all topics are kept; only the topics of `/rl/` follow the episodes, so
that none of them is there in part. What cannot be kept is told, never left out in silence.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from mcap.opcode import Opcode

from mcaprl.errors import LogError, NoEpisodesError, OutputExistsError, UsageError
from mcaprl.recorder.format.reading import (
    Damage,
    McapReader,
    SoundRecord,
    chunk_header,
    map_file,
    parse_record,
    sound_records,
)
from mcaprl.recorder.format.writing import McapWriter, refuse_if_taken
from mcaprl.recorder.repair.check import check_log
from mcaprl.recorder.repair.sound_copy import copy_records
from mcaprl.recorder.repair.whole_episodes import (
    DroppedEpisode,
    EpisodePlan,
    plan_episodes,
    write_planned,
)


@dataclass
class Recovery:
    """What became of a log.

    Attributes:
        messages: that are in the new file.
        episodes: likewise; 0 if it has no `/rl/step`.
        damages: places that could not be read.
        dropped: episodes that are not in the new file, as far as any of them was read.
        ended: episodes that were not finished, and were kept up to their last whole transition.
        strays: messages of `/rl/` topics that belonged to none of the kept episodes.
    """

    messages: int = 0
    episodes: int = 0
    damages: list[Damage] = field(default_factory=list)
    dropped: list[DroppedEpisode] = field(default_factory=list)
    ended: int = 0
    strays: int = 0

    @property
    def has_losses(self) -> bool:
        """Whether anything of the old file is missing in the new one."""
        return bool(self.damages or self.dropped or self.ended or self.strays)


def recover_log(
    source: str | Path,
    target: str | Path,
    *,
    keep_unfinished: bool = False,
    overwrite: bool = False,
) -> Recovery:
    """Write what is left of `source` to `target`, which is whole then.

    Args:
        source: an MCAP file, damaged or not. It is not changed.
        target: where to.
        keep_unfinished: keep episodes whose end is missing, marked truncated, up to the last
            transition that is there. By default they are dropped.
        overwrite: replace a file that is there.

    Raises:
        OutputExistsError, UsageError: the target is taken, or is the source.
        LogError: nothing can be kept, or the target cannot be written.
    """
    source, target = Path(source), Path(target)
    _check_paths(source, target, overwrite)
    stages = [target.with_name(f"{target.name}.{part}.part") for part in ("records", "whole")]
    recovery = Recovery()
    try:
        view = map_file(source)
        records = list(sound_records(view, recovery.damages))
        how = _Manner.of(view, records)
        how.write(stages[0], lambda writer: copy_records(view, records, writer, recovery.damages))
        reader = McapReader(stages[0])
        recovery.messages = _count_messages(reader)
        if recovery.messages == 0:
            raise LogError(f"{source} cannot be recovered: no message in it can be read")
        plan = plan_episodes(reader, keep_unfinished=keep_unfinished)
        result = stages[0]
        if plan is not None:
            _note(plan, source, recovery)
            if plan.changes_anything:
                result = stages[1]
                how.write(result, lambda writer: write_planned(reader, writer, plan))
                recovery.messages = _count_messages(McapReader(result))
            _make_sure(source, result)
        os.replace(result, target)
    finally:
        for path in stages:
            path.unlink(missing_ok=True)
    return recovery


@dataclass(frozen=True)
class _Manner:
    """How the damaged file was written, and the new one is to be.

    Attributes:
        compression: of its first chunk.
        profile: of its header.
    """

    compression: str
    profile: str

    @classmethod
    def of(cls, view: memoryview, records: list[SoundRecord]) -> _Manner:
        first = next((offset for offset, opcode, _ in records if opcode == Opcode.CHUNK), None)
        name = "zstd" if first is None else chunk_header(view, first).compression or "none"
        headers = [parse_record(opcode, c) for _, opcode, c in records if opcode == Opcode.HEADER]
        profile = headers[0].profile if headers else "ros2"
        return cls(name if name in ("zstd", "lz4", "none") else "zstd", profile)

    def write(self, path: Path, write: Callable[[McapWriter], None]) -> None:
        """Write a whole file."""
        writer = McapWriter(
            path, compression=self.compression, overwrite=True, profile=self.profile
        )
        try:
            write(writer)
            writer.close()
        finally:
            writer.abandon()


def _check_paths(source: Path, target: Path, overwrite: bool) -> None:
    if source.exists() and target.exists() and target.samefile(source):
        raise UsageError(f"{target} is the damaged file itself: recover to another one")
    if target.exists() and not overwrite:
        raise OutputExistsError(f"{target} exists: choose another path, or pass --overwrite")
    refuse_if_taken(source)
    refuse_if_taken(target)


def _count_messages(reader: McapReader) -> int:
    channels = reader.channels.values()
    return sum(len(part) for channel in channels for part in reader.message_ranges(channel))


def _note(plan: EpisodePlan, source: Path, recovery: Recovery) -> None:
    """Tell what becomes of the episodes.

    Raises:
        NoEpisodesError: none can be kept.
    """
    recovery.episodes, recovery.dropped = plan.episodes, plan.dropped
    recovery.ended, recovery.strays = plan.ended, plan.strays
    if plan.episodes == 0:
        can_end = any(dropped.can_end for dropped in plan.dropped)
        hint = "; --keep-unfinished keeps the beginning of one" if can_end else ""
        raise NoEpisodesError(f"{source} has no whole episode{hint}")


def _make_sure(source: Path, result: Path) -> None:
    """Read the new log before it takes its place.

    Raises:
        LogError: something in it contradicts itself, so that it cannot be made whole.
    """
    problems = check_log(result)
    if problems:
        raise LogError(f"{source} cannot be made whole: {problems[0].what} ({problems[0].where})")
