"""Functions on logs: contents and problems, validation and recovery."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from mcaprl.api.ranges import check_least
from mcaprl.errors import (
    LogError,
    NoEpisodesError,
    NotMcapError,
    Problem,
    ReportError,
    UsageError,
    import_extra,
)
from mcaprl.files import check_log_name, size_of, write_json
from mcaprl.page import PAGE_NAME
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.lint import lint
from mcaprl.recorder.dataset.open import find_logs
from mcaprl.recorder.dataset.quality import Flaw, flaws
from mcaprl.recorder.dataset.statistics import Calibration, calibration
from mcaprl.recorder.format.behavior import PROBABILITY
from mcaprl.recorder.format.metadata import METADATA_NAME
from mcaprl.recorder.format.reading import McapReader
from mcaprl.recorder.format.schema import STEP_TOPIC
from mcaprl.recorder.source import Definitions, Paths, Source, open_data, opened
from mcaprl.recorder.viewer.surprises import Surprise, moments_of
from mcaprl.storage.remote import is_url
from mcaprl.texts import counted, size

if TYPE_CHECKING:
    from mcaprl.recorder.bags.bag import OpenBag
    from mcaprl.recorder.bags.overview import Recording, TopicOverview
    from mcaprl.recorder.mapping.topic_quality import Looked
    from mcaprl.recorder.repair.recover import Recovery

_LONGEST_SPACE = 90


@dataclass(frozen=True)
class LogInfo:
    """Facts about one or more logs.

    Attributes:
        sources: Paths of the logs.
        env_id: Gymnasium id of the environment; empty if unknown.
        episodes: Number of episodes.
        steps: Number of steps.
        mean_return: Mean of the episodes' returns.
        return_range: Smallest and largest return.
        mean_length: Mean number of steps of an episode.
        duration_s: Simulated time in seconds.
        observations: Observation space.
        actions: Action space.
        action_counts: Number of times each action was taken, by its name.
        behavior_prob: Two numbers: the mean of 1 / `behavior_prob`, which estimates the number of
            actions, and the number of actions in the action space. None if unknown.
        action_parts: Parts of a vector action with their bounds and units, if they have names.
        behavior_field: Name of the log's column about the choice of the actions: `behavior_prob`,
            or `behavior_log_prob` for actions of floats.
        behavior_known: Number of steps in which this column has a value.
        behavior_estimated: Whether this column was estimated, not logged by the policy.
        policies: Names of the policies that acted.
        ends: Number of episodes by the reason of their end.
        size_bytes: Size of all files.
        storage: Storage of the columns: memory or files.
        problems: Defects of the logs, and warnings of the reader.
        findings: Defects and notes of `lint`.
        moments: Annotated steps with the largest TD errors or policy disagreements.
        quality: What is wrong with the data, ranked; None if it was not asked for.
    """

    sources: tuple[Path, ...]
    env_id: str
    episodes: int
    steps: int
    mean_return: float
    return_range: tuple[float, float]
    mean_length: float
    duration_s: float
    observations: str
    actions: str
    action_counts: dict[str, int]
    action_parts: list[str]
    behavior_field: str
    behavior_known: int
    behavior_prob: Calibration | None
    behavior_estimated: bool
    policies: list[str]
    ends: dict[str, int]
    size_bytes: int
    storage: str
    problems: list[str]
    findings: list[Problem] = field(repr=False)
    moments: list[Surprise] = field(repr=False)
    quality: list[Flaw] | None = field(default=None, repr=False)

    @property
    def title(self) -> str:
        """Path of the first log, and the number of other logs."""
        more = f" and {len(self.sources) - 1} more" if len(self.sources) > 1 else ""
        return f"{self.sources[0]}{more}" if self.sources else self.env_id or "arrays"

    def to_json(self) -> dict[str, Any]:
        """Return what `info --json` prints."""
        found = self.behavior_prob
        facts: dict[str, Any] = {
            **{name: value for name, value in vars(self).items() if name != "quality"},
            "return_range": list(self.return_range),
            "behavior_prob": found and {**found.to_json(), "text": str(found)},
            "findings": [asdict(finding) for finding in self.findings],
            "moments": [asdict(moment) for moment in self.moments],
            **_quality_json(self.quality),
        }
        del facts["sources"]
        return {"kind": "log", **facts}

    def rows(self) -> list[tuple[str, str]]:
        """Return the name and the formatted value of each fact."""
        low, high = self.return_range
        return [
            ("environment", self.env_id or "unknown"),
            ("files", f"{len(self.sources)}, {size(self.size_bytes)}"),
            ("episodes", str(self.episodes)),
            ("steps", f"{self.steps}, {self.mean_length:.1f} per episode"),
            ("simulated time", f"{self.duration_s:.1f} s"),
            ("mean return", f"{self.mean_return:.3f} (from {low:.3f} to {high:.3f})"),
            ("observations", _short(self.observations)),
            ("storage", self.storage),
            ("actions", _short(self.actions)),
            *([("action parts", ", ".join(self.action_parts))] if self.action_parts else []),
            ("action counts", _counts(self.action_counts) or "-"),
            (self.behavior_field, self._behavior()),
            ("policies", "; ".join(self.policies) or "unknown"),
            ("ends", _counts(self.ends)),
        ]

    def _behavior(self) -> str:
        origin = "estimated, " if self.behavior_estimated else ""
        if self.behavior_prob is not None:
            return f"{origin}implies {self.behavior_prob}"
        if not self.behavior_known or self.behavior_field == PROBABILITY.name:
            return "unknown"
        return f"{origin}known in {self.behavior_known} of {counted(self.steps, 'step')}"


def info(
    data: Source,
    *,
    report: str | Path | None = None,
    threads: int = 1,
    definitions: Definitions = (),
    quality: bool = False,
    test: Source | None = None,
) -> LogInfo | Any:
    """Return facts about logs, and their problems; or about another robot's bag.

    Without a mapping, the result for a bag is a `BagInfo`, which lists recordings and topics: type,
    number of messages, rate, longest gap, first and last time, and whether they can be read. The
    key `kind` of its `to_json` is `bag`; for logs and datasets, it is `log`. All times are in
    nanoseconds, and all durations in seconds.

    Args:
        data: File, folder, glob or URL of logs, or several of them; or a dataset of another tool;
            or MCAP files, rosbag2 folders and databases, ROS 1 bags, and folders of these; or what
            `mcaprl.open(..., mapping=...)` returns for a bag, or a function that returns it.
        report: Output folder of the HTML report, an image and JSON.
        threads: Number of threads that decompress chunks.
        definitions: Files and folders with definitions of ROS types that a bag lacks; see
            docs/bags.md.
        quality: Whether to look for faults of the data, which become `quality` of the result,
            ranked by the share of the data; see docs/howto/quality.md. Of a bag without a mapping,
            the topics are evaluated: times, repeated messages, and frames of cameras.
        test: Data that is held out, as `data`: its episodes must not be in `data`. Needs `quality`.

    Raises:
        LogError: A log or bag cannot be read.
        SpaceError: `test` has other spaces than `data`.
        UsageError: `test` is passed without `quality`, or for a bag without a mapping.
        MissingExtraError: The packages of the `report` extra are not installed.
        ReportError: The report cannot be written.
    """
    if report is not None:
        import_extra("matplotlib", "report")
        import_extra("jinja2", "report")
    if test is not None and not quality:
        raise UsageError("test data are compared if `quality=True` is passed")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        contents = _dataset_or_bag(data, threads, definitions, quality=quality)
    warned = [str(warning.message) for warning in caught]
    if isinstance(contents, BagInfo):
        if test is not None:
            raise UsageError("test data of a bag need a mapping: pass `mapping=FILE`")
        bag = replace(contents, problems=[*warned, *contents.problems])
        if report is not None:
            _bag_report(Path(report), bag)
        return bag
    if contents.origin.report is not None:
        warned = list(dict.fromkeys([*warned, *map(str, contents.origin.report.problems())]))
    found = _describe(contents, warned)
    if quality:
        held_out: Dataset | None = None
        if isinstance(test, Dataset) or callable(test):
            held_out = opened(test)
        elif test is not None:
            held_out = open_data(test, threads=threads)
        found = replace(found, quality=flaws(contents, held_out))
    if report is not None:
        from mcaprl.recorder.viewer.report import dataset_page

        folder = Path(report)
        write_json(folder / "dataset.json", found.to_json(), ReportError)
        findings = [*(found.quality or ()), *found.findings]
        dataset_page(folder / PAGE_NAME, contents, found.title, found.rows(), findings)
    return found


def _bag_report(folder: Path, bag: BagInfo) -> None:
    from mcaprl.recorder.viewer.report import bag_page

    write_json(folder / "bag.json", bag.to_json(), ReportError)
    problems = [Problem(text, "") for text in bag.problems]
    tables = {"Topics": (bag.topic_columns, bag.topic_rows())}
    if len(bag.recordings) > 1:
        tables["Recordings"] = (bag.recording_columns, bag.recording_rows())
    bag_page(folder / PAGE_NAME, bag.title, bag.rows(), tables, [*(bag.quality or ()), *problems])


def _dataset_or_bag(
    data: Source, threads: int, definitions: Definitions, *, quality: bool
) -> Dataset | BagInfo:
    if isinstance(data, Dataset) or callable(data):
        return opened(data)
    try:
        return open_data(data, threads=threads)
    except NoEpisodesError:
        raise
    except LogError:
        found = bag_info(data, definitions, quality=quality)
        if found is None:
            raise
        return found


def _describe(dataset: Dataset, warned: Sequence[str]) -> LogInfo:
    statistics, findings = dataset.statistics, lint(dataset)
    return LogInfo(
        sources=dataset.sources,
        env_id=dataset.env_id,
        episodes=statistics.episodes,
        steps=statistics.steps,
        mean_return=statistics.mean_return,
        return_range=(float(statistics.returns.min()), float(statistics.returns.max())),
        mean_length=float(statistics.lengths.mean()),
        duration_s=statistics.duration_s,
        observations=str(dataset.observation_space),
        actions=str(dataset.action_space),
        action_counts={
            dataset.action_names.get(action, str(action)): count
            for action, count in statistics.action_counts.items()
        },
        action_parts=list(dataset.action_labels),
        behavior_field=dataset.behavior_field.name,
        behavior_known=int((~np.isnan(dataset.behavior)).sum()),
        behavior_prob=calibration(dataset.behavior, dataset.action_space),
        behavior_estimated=dataset.has_estimated_probs,
        policies=sorted({episode.policy for episode in dataset.episodes if episode.policy}),
        ends=dict(statistics.ends),
        size_bytes=sum(map(size_of, dataset.sources)),
        storage=dataset.storage,
        problems=[*warned, *(str(one) for one in findings if one.severity == "problem")],
        findings=findings,
        moments=[moment for path in _logs(dataset) for moment in moments_of(path)],
    )


def _logs(dataset: Dataset) -> tuple[Path, ...]:
    return dataset.sources if dataset.origin.logs else ()


def _counts(counts: dict[str, int]) -> str:
    """Return counts by name; a name that is a number comes first: `0: 428`."""
    return ", ".join(
        f"{name}: {count}" if name.isdecimal() else f"{count} {name}"
        for name, count in counts.items()
    )


def _short(text: str) -> str:
    """Return the text of a space on one line, shortened for a large Box."""
    line = " ".join(text.split())
    return line if len(line) <= _LONGEST_SPACE else f"{line[:40]} ... {line[-40:]}"


@dataclass(frozen=True)
class CheckResult:
    """Result of `check`.

    Attributes:
        files: Files that were read.
        missing: Problems with paths that contain no logs.
        problems: All problems, in the order of the paths.
        notes: Files that are other robots' bags, whose messages were decoded.
    """

    files: tuple[Path, ...]
    missing: tuple[Problem, ...]
    problems: tuple[Problem, ...]
    notes: tuple[Problem, ...] = ()

    @property
    def ok(self) -> bool:
        """Whether there are no problems."""
        return not self.problems

    def to_json(self) -> dict[str, Any]:
        """Return what `check --json` prints."""
        return {"ok": self.ok, "problems": [problem.to_json() for problem in self.problems]}


def check(data: Source, *, threads: int = 1) -> CheckResult:
    """Read logs completely; validate structure, CRCs, indexes, episodes and metadata.

    Without a mapping, all messages of another robot's bag are decoded; topics and messages that
    cannot be decoded are problems. Of what `mcaprl.open(..., mapping=...)` returns, the function
    reports defects that affect many steps: missing or outdated values, commands that are far from
    every named action, and episodes that are too short.

    Args:
        data: File, folder or glob of logs or bags, or several of them. A path without logs and
            bags is reported as a problem. Or the dataset of a bag, or a function that returns it.
        threads: Number of threads that decompress chunks.

    Raises:
        UsageError: `data` is empty or a dataset without a mapping, or `threads` is below 1.
    """
    from mcaprl.recorder.repair.check import check_log

    check_least(1, threads=threads)
    if isinstance(data, Dataset) or callable(data):
        read = opened(data)
        if read.origin.report is None:
            raise UsageError("check reads files: pass the paths of the logs, not a dataset")
        return CheckResult(read.sources, (), tuple(read.origin.report.problems()))
    names: Sequence[str | Path] = [data] if isinstance(data, str | Path) else data
    if not names:
        raise UsageError("no data: the list of files is empty")
    files: list[Path] = []
    missing: list[Problem] = []
    problems: list[Problem] = []
    for name in names:
        try:
            found = logs_or_bags(name)
        except LogError as error:
            missing.append(
                Problem(str(error), "searching for logs", next="check the path", file=str(name))
            )
            problems.append(missing[-1])
            continue
        files += found
        problems += [problem for path in found for problem in check_log(path, threads=threads)]
    notes = tuple(one for one in problems if one.severity == "note")
    problems = [one for one in problems if one.severity == "problem"]
    return CheckResult(tuple(files), tuple(missing), tuple(problems), notes)


def recover(
    data: str | Path, out: str | Path, *, keep_unfinished: bool = False, overwrite: bool = False
) -> Recovery:
    """Write the valid part of a log that was cut off or damaged to a new log.

    Args:
        data: MCAP file, damaged or not; it is not changed.
        out: Path of the new log.
        keep_unfinished: Whether unfinished episodes are kept up to their last complete transition.
            They are marked as truncated.
        overwrite: Whether an existing file is replaced.

    Returns:
        Summary of kept and lost data.

    Raises:
        OutputExistsError: `out` exists.
        UsageError: `data` and `out` are the same file.
        LogError: Nothing can be kept, or `out` cannot be written.
    """
    from mcaprl.recorder.repair.recover import recover_log

    return recover_log(
        data, check_log_name(out), keep_unfinished=keep_unfinished, overwrite=overwrite
    )


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
        quality: What is wrong with the topics, ranked; None if it was not asked for.
        looked: Numbers of messages, and of those that were compared and decoded, of each topic
            that `quality` compared.
    """

    sources: tuple[Path, ...]
    size_bytes: int
    recordings: tuple[Recording, ...]
    topics: dict[str, BagTopic]
    problems: list[str]
    next: str
    quality: list[Flaw] | None = None
    looked: dict[str, Looked] = field(default_factory=dict, repr=False)

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
        looked = {name: each._asdict() for name, each in self.looked.items()}
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
            **_quality_json(self.quality),
            **({} if self.quality is None else {"looked": looked}),
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
        looked = list(self.looked.values())
        if looked:
            compared, among = sum(each.compared for each in looked), [e.messages for e in looked]
            rows.append(("compared", f"{compared} of {counted(sum(among), 'message')}"))
        if any(each.decoded for each in looked):
            frames = [(e.decoded, e.messages) for e in looked if e.decoded]
            decoded, among = (sum(each) for each in zip(*frames, strict=True))
            rows.append(("decoded", f"{decoded} of {counted(among, 'frame')}"))
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


def bag_info(
    data: Paths, definitions: Definitions = (), *, quality: bool = False
) -> BagInfo | None:
    """Return facts about a bag; None if the data is a log, or not a bag."""
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
            **_quality_of(bag, topics, quality=quality),
        )


def _quality_json(quality: list[Flaw] | None) -> dict[str, Any]:
    return {} if quality is None else {"quality": [flaw.to_json() for flaw in quality]}


def _quality_of(bag: OpenBag, topics: list[TopicOverview], *, quality: bool) -> dict[str, Any]:
    if not quality:
        return {}
    from mcaprl.recorder.mapping.topic_quality import bag_flaws

    found, looked = bag_flaws(bag, topics)
    return {"quality": found, "looked": looked}


def _opened(data: Paths, definitions: Definitions = ()) -> OpenBag | None:
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


def _problems(bag: OpenBag, topics: list[TopicOverview]) -> list[str]:
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
    """Return the files of logs; if there are no logs, those of bags."""
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
