"""Contents of a robot's bag, without a mapping."""

from __future__ import annotations

from contextlib import closing
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from mcaprl.errors import LogError, NotMcapError
from mcaprl.files import size_of
from mcaprl.recorder.dataset.open import find_logs
from mcaprl.recorder.format.metadata import METADATA_NAME
from mcaprl.recorder.format.reading import McapReader
from mcaprl.recorder.format.schema import STEP_TOPIC
from mcaprl.recorder.source import Definitions, Paths
from mcaprl.storage.remote import is_url
from mcaprl.texts import counted, size

if TYPE_CHECKING:
    from mcaprl.recorder.bags.bag import Bag
    from mcaprl.recorder.bags.overview import Recording, TopicOverview

_NS_PER_S = 1e9


@dataclass(frozen=True)
class BagTopic:
    """A topic of a bag.

    Attributes:
        name: Name of the topic.
        type: Message type, such as `nav_msgs/msg/Odometry`; empty if unknown.
        encoding: Encoding of the messages: `cdr`, `ros1`, `protobuf` or `json`.
        count: Number of messages.
        rate_hz: Messages per second by the median interval; 0 for fewer than two times.
        largest_gap_s: Longest time between two messages of a recording, seconds.
        first_ns: log_time of the first message; 0 if there are no messages.
        last_ns: log_time of the last message; 0 if there are no messages.
        readable: Whether the messages can be decoded.
        problem: Reason why the messages cannot be decoded; empty if they can.
        fields: Kind of each field by its path; empty if unknown.
    """

    name: str
    type: str
    encoding: str
    count: int
    rate_hz: float
    largest_gap_s: float
    first_ns: int
    last_ns: int
    readable: bool
    problem: str
    fields: dict[str, str]

    @classmethod
    def of(cls, topic: TopicOverview) -> BagTopic:
        """Return the description of a topic."""
        info = topic.info
        return cls(
            name=info.name,
            type=info.type_name,
            encoding=info.encoding,
            count=info.count,
            rate_hz=topic.rate_hz,
            largest_gap_s=topic.largest_gap_s,
            first_ns=info.first_ns,
            last_ns=info.last_ns,
            readable=not info.problem,
            problem=info.problem,
            fields=info.fields,
        )


@dataclass(frozen=True)
class BagInfo:
    """Facts about another robot's bag.

    Attributes:
        sources: Files of the bag.
        size_bytes: Size of all files.
        recordings: Recordings: their files, number of messages, and first and last log_time.
        topics: Topics by name.
        problems: Files that were cut off, warnings of the reader, and topics that cannot be read.
        next: Command to run next.
    """

    sources: tuple[Path, ...]
    size_bytes: int
    recordings: tuple[Recording, ...]
    topics: dict[str, BagTopic]
    problems: list[str]
    next: str

    topic_columns: ClassVar = [
        "topic",
        "type",
        "encoding",
        "messages",
        "rate",
        "longest gap",
        "from",
        "to",
        "readable",
    ]
    recording_columns: ClassVar = ["recording", "messages", "begins", "duration"]

    @property
    def title(self) -> str:
        """Path of the first file, and the number of other files."""
        more = f" and {len(self.sources) - 1} more" if len(self.sources) > 1 else ""
        return f"{self.sources[0]}{more}"

    def to_json(self) -> dict[str, Any]:
        """Return what `info --json` prints for a bag."""
        recordings = [
            {**asdict(each), "paths": list(map(str, each.paths))} for each in self.recordings
        ]
        return {
            "kind": "bag",
            "files": list(map(str, self.sources)),
            "size_bytes": self.size_bytes,
            "recordings": recordings,
            "topics": [asdict(topic) for topic in self.topics.values()],
            "problems": self.problems,
            "next": self.next,
        }

    def rows(self) -> list[tuple[str, str]]:
        """Return the name and the formatted value of each fact."""
        used = [each for each in self.recordings if each.messages]
        spans_s = [(each.last_ns - each.first_ns) / _NS_PER_S for each in used]
        messages = sum(each.messages for each in self.recordings)
        rows = [
            ("files", f"{len(self.sources)}, {size(self.size_bytes)}"),
            ("recordings", f"{len(self.recordings)}, {sum(spans_s):.1f} s"),
            ("messages", f"{messages} on {counted(len(self.topics), 'topic')}"),
        ]
        if used:
            rows.append(("begins", _date(min(each.first_ns for each in used))))
        return rows

    def topic_rows(self) -> list[list[str]]:
        """Return the rows of the table of topics; `topic_columns` are their columns."""
        start_ns = min((each.first_ns for each in self.recordings if each.messages), default=0)
        return [_topic_row(topic, start_ns) for topic in self.topics.values()]

    def recording_rows(self) -> list[list[str]]:
        """Return the rows of the table of recordings; `recording_columns` are their columns."""
        return [
            [
                ", ".join(path.name for path in each.paths),
                str(each.messages),
                _date(each.first_ns) if each.messages else "",
                f"{(each.last_ns - each.first_ns) / _NS_PER_S:.1f} s",
            ]
            for each in self.recordings
        ]


def _topic_row(topic: BagTopic, start_ns: int) -> list[str]:
    row = [topic.name, topic.type, topic.encoding, str(topic.count)]
    row.append(f"{topic.rate_hz:.3g} Hz" if topic.rate_hz else "")
    row.append(f"{topic.largest_gap_s:.3g} s" if topic.rate_hz else "")
    ends = [f"{(t - start_ns) / _NS_PER_S:.1f} s" for t in (topic.first_ns, topic.last_ns)]
    return [*row, *(ends if topic.count else ["", ""]), "yes" if topic.readable else "no"]


def _date(time_ns: int) -> str:
    """Return a time as a date; times of simulations, which begin near 0, as seconds."""
    if not 0 <= time_ns < 2**62 or time_ns < 365 * 86400 * _NS_PER_S:
        return f"{time_ns / _NS_PER_S:.3f} s"
    return datetime.fromtimestamp(time_ns // 10**9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")


def bag_info(data: Paths, definitions: Definitions = ()) -> BagInfo | None:
    """Return facts about a bag; None if the data is a log, or not a bag.

    Raises:
        LogError: The data is a bag, but is damaged.
    """
    from mcaprl.recorder.bags.overview import recordings_in, topics_of

    bag = _opened(data, definitions)
    if bag is None:
        return None
    with closing(bag):
        topics = topics_of(bag)
        return BagInfo(
            sources=bag.paths,
            size_bytes=sum(size_of(path) for path in bag.paths),
            recordings=tuple(recordings_in(bag, topics)),
            topics={topic.info.name: BagTopic.of(topic) for topic in topics},
            problems=_problems(bag, topics),
            next=_next(data, topics),
        )


def _opened(data: Paths, definitions: Definitions = ()) -> Bag | None:
    from mcaprl.recorder.bags.bag import open_bag

    if any(map(is_url, [data] if isinstance(data, str | Path) else data)):
        return None
    try:
        bag = open_bag(data, definitions=definitions)
    except NotMcapError:
        return None
    if STEP_TOPIC in bag.topics:
        bag.close()
        return None
    return bag


def _problems(bag: Bag, topics: list[TopicOverview]) -> list[str]:
    found = [
        f"{path} has no end, because its writer was killed or is still running: messages after its"
        f" last whole record are lost, unless `mcaprl recover {path} OUT` finds some"
        for path in bag.cut
    ]
    return found + [
        f"{topic.info.name} cannot be read: {topic.info.problem}"
        for topic in topics
        if topic.info.problem
    ]


def _next(data: Paths, topics: list[TopicOverview]) -> str:
    if not any(topic.info.count for topic in topics):
        return "record again: the bag has no messages"
    names = [data] if isinstance(data, str | Path) else data
    return f"mcaprl convert --suggest {' '.join(map(_argument, names))} > robot.yaml"


def _argument(name: str | Path) -> str:
    """Return a path as an argument of a shell; globs stay patterns."""
    import shlex

    text = str(name)
    return text if any(mark in text for mark in "*?[") and " " not in text else shlex.quote(text)


def logs_or_bags(data: str | Path) -> list[Path]:
    """Return the files of logs; if there are no logs, those of bags.

    Raises:
        LogError: There are neither logs nor bags.
    """
    try:
        logs = find_logs(data)
    except LogError:
        logs = []
    if is_url(data) or Path(data).is_file() or (logs and _is_log(logs[0])):
        return logs or find_logs(data)
    try:
        bag = _opened(data)
    except LogError:
        bag = None
        if not logs:
            raise
    if bag is None:
        return logs or find_logs(data)
    with closing(bag):
        return list(bag.paths)


def _is_log(path: Path) -> bool:
    """Return whether a file is a log, or a file that may have been one."""
    try:
        reader = McapReader(path)
    except LogError:
        return path.is_file()
    return bool(reader.channels_of(STEP_TOPIC)) or METADATA_NAME in reader.metadata
