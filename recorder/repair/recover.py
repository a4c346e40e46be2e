"""Recovery of the valid part of a log that was cut off or damaged.

    valid records -> valid MCAP file with new indexes and CRCs -> whole episodes -> OUT
    (salvage)        (valid_copy)                                (whole_episodes)

Metadata, attachments and all topics are kept; only messages of `/rl/` topics that belong to a
dropped episode are omitted. All omissions are reported.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from mcap.records import Channel, Metadata

from mcaprl.errors import CorruptLogError, LogError, NoEpisodesError, NoStepsError, UsageError
from mcaprl.files import locked_file, replacing
from mcaprl.problem import Problem, Shortlist
from mcaprl.recorder.format.metadata import METADATA_NAME
from mcaprl.recorder.format.reading import Damage, McapReader
from mcaprl.recorder.format.topics import STEP_TOPIC
from mcaprl.recorder.format.writing import recover_file
from mcaprl.recorder.repair.check import check_log
from mcaprl.recorder.repair.episode_check import IMPOSSIBLE_ACTION
from mcaprl.recorder.repair.whole_episodes import (
    DroppedEpisode,
    EpisodePlan,
    plan_episodes,
    write_planned,
)
from mcaprl.storage.remote import as_path
from mcaprl.texts import counted

_LISTS = ("damages", "dropped")


@dataclass
class Recovery:
    """Result of a recovery.

    Attributes:
        source: Path of the damaged file.
        messages: Number of messages in the new file.
        episodes: Number of episodes in the new file; 0 if it has no `/rl/step`.
        damages: Byte ranges that could not be read.
        dropped: Episodes of the old file that are not in the new file.
        ended: Number of unfinished episodes that were kept up to their last whole transition.
        strays: Number of messages on `/rl/` topics that do not belong to a kept episode.
    """

    source: str
    messages: int = 0
    episodes: int = 0
    damages: Shortlist[Damage] = field(default_factory=Shortlist)
    dropped: Shortlist[DroppedEpisode] = field(default_factory=Shortlist)
    ended: int = 0
    strays: int = 0

    @property
    def has_losses(self) -> bool:
        """Whether the new file lacks anything that is in the old file."""
        return bool(self.damages or self.dropped or self.ended or self.strays)

    def to_json(self) -> dict[str, Any]:
        """Return the JSON object that `recover --json` prints."""
        return {
            "ok": not self.has_losses,
            **{name: value for name, value in vars(self).items() if name not in _LISTS},
            **{name: [asdict(one) for one in getattr(self, name)] for name in _LISTS},
            "not_listed": [problem.what for problem in self.damages.rest() + self.dropped.rest()],
        }

    @property
    def problems(self) -> list[Problem]:
        """Lost messages: `damages`, then `dropped`, then `strays`."""
        found = [(one.what, f"byte {one.offset}, {one.bytes} bytes", "") for one in self.damages]
        found += [
            (f"episode {one.number}", f"{one.records} of its records were read", one.why)
            for one in self.dropped
        ]
        if self.strays:
            found.append(
                (counted(self.strays, "message"), "/rl/ topics", "part of dropped episodes")
            )
        problems = [
            Problem(f"lost: {what}", where, effect, file=self.source)
            for what, where, effect in found
        ]
        return problems + self.damages.rest() + self.dropped.rest()


def recover_log(
    source: str | Path,
    target: str | Path,
    *,
    keep_unfinished: bool = False,
    overwrite: bool = False,
) -> Recovery:
    """Write the valid part of `source` to `target` as a valid log."""
    source, target = as_path(source, whole=True), Path(target)
    if source.exists() and target.exists() and target.samefile(source):
        raise UsageError(f"{target} is the damaged file: recover to another path")
    recovery = Recovery(str(source))
    with locked_file(source), replacing(target, LogError, overwrite=overwrite) as result:
        copied = result.with_name("records.mcap" if result.name != "records.mcap" else "_")
        restore = partial(_restore_metadata, recovery.damages)
        recover_file(source, copied, recovery.damages, restore)
        _keep_whole_episodes(copied, result, recovery, keep_unfinished)
    return recovery


def _keep_whole_episodes(
    copied: Path, result: Path, recovery: Recovery, keep_unfinished: bool
) -> None:
    """Write the file `copied` to `result`, without its incomplete episodes.

    If `keep_unfinished` is set, episodes without an end are kept up to their last whole transition.
    """
    reader = McapReader(copied)
    recovery.messages = _count_messages(reader)
    if recovery.messages == 0:
        raise NoStepsError(f"{recovery.source} cannot be recovered: it has no readable message")
    plan = plan_episodes(reader, keep_unfinished=keep_unfinished)
    if plan is None and not recovery.damages and _is_complete(recovery.source):
        raise LogError(
            f"{recovery.source} is a valid MCAP file, but not an mcaprl log: there is nothing to"
            " recover"
        )
    if plan is None:
        os.replace(copied, result)
        return
    _add_plan(recovery, plan)
    if plan.changes_anything:
        recovery.messages = write_planned(reader, result, plan).messages
    else:
        os.replace(copied, result)
    problems = [one for one in check_log(result) if one.next != IMPOSSIBLE_ACTION]
    if problems:
        what, where = problems[0].what, problems[0].where
        raise LogError(f"{recovery.source} cannot be recovered: {what} ({where})")


def _is_complete(source: str) -> bool:
    try:
        return McapReader(source).complete
    except CorruptLogError:
        return False


def _restore_metadata(
    damages: Shortlist[Damage], metadata: list[Metadata], channels: Iterable[Channel]
) -> list[Metadata]:
    """Replace the metadata record by its copy in the channel of `/rl/step`, if there is a copy."""
    for channel in channels:
        if channel.topic == STEP_TOPIC and "format_version" in channel.metadata:
            records = [record for record in metadata if record.name == METADATA_NAME]
            if any(record.metadata != channel.metadata for record in records):
                damages.append(Damage(0, 0, "the metadata record and its copy differ"))
            others = [record for record in metadata if record.name != METADATA_NAME]
            return [Metadata(METADATA_NAME, channel.metadata), *others]
    return metadata


def _count_messages(reader: McapReader) -> int:
    channels = reader.channels.values()
    return sum(len(part) for channel in channels for part in reader.message_ranges(channel))


def _add_plan(recovery: Recovery, plan: EpisodePlan) -> None:
    """Copy the counts and dropped episodes of an `EpisodePlan` to the result of the recovery."""
    recovery.episodes, recovery.dropped = plan.episodes, plan.dropped
    recovery.ended, recovery.strays = len(plan.ended), plan.strays
    if plan.episodes == 0:
        can_end = any(dropped.can_end for dropped in plan.dropped)
        hint = "; pass `keep_unfinished=True` to keep unfinished episodes" if can_end else ""
        raise NoEpisodesError(f"{recovery.source} has no whole episode{hint}")
