"""Check of the messages of a bag that is not a log."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

from mcaprl.errors import LogError
from mcaprl.problem import Problem, Shortlist
from mcaprl.recorder.bags.bag import Bag, open_bag
from mcaprl.texts import counted

_LISTED = 3
"""Number of undecodable messages of a topic that are listed."""


def check_messages(path: Path) -> list[Problem]:
    """Decode all messages of a bag file, or of a rosbag2 folder; return the problems by topic.

    One message is in memory at a time. If the file can be opened, the last finding is a note that
    it is a bag.
    """
    try:
        with closing(open_bag(path)) as bag:
            found = Shortlist[Problem]()
            if not any(info.count for info in bag.topics.values()):
                found.append(Problem("the bag has no messages", "all topics", file=str(path)))
            for name in bag.topics:
                found.extend(_problems_of(bag, name, str(path)))
            return [*found, *found.rest(), _note(path)]
    except LogError as error:
        what = str(error).removeprefix(f"{path}: ").removeprefix(f"{path} ")
        return [Problem(what, "reading the bag", file=str(path))]


def _note(path: Path) -> Problem:
    return Problem(
        "this is another robot's bag, not a log: its messages were decoded",
        "no topic /rl/step",
        next="to check its transitions, pass --mapping FILE; `mcaprl convert --suggest BAG > FILE`"
        " drafts one",
        file=str(path),
        severity="note",
    )


def _problems_of(bag: Bag, name: str, file: str) -> Iterator[Problem]:
    info = bag.topics[name]
    if info.problem:
        effect = f"its {counted(info.count, 'message')} cannot be read"
        yield Problem(info.problem, name, effect=effect, file=file)
        return
    count = 0
    try:
        for failure in bag.failures(name):
            count += 1
            if count <= _LISTED:
                what = f"message {failure.row} at {failure.log_time_ns} ns: {failure.reason}"
                yield Problem(what, name, file=file)
    except LogError as error:
        yield Problem(str(error).removeprefix(f"{file}: "), name, file=file)
    if count > _LISTED:
        what = f"{count} of {counted(info.count, 'message')} cannot be decoded"
        yield Problem(what, name, file=file)
