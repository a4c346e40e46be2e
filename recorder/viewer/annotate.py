"""Copies of logs with additional topics for the outputs of policies, or for the scene.

The copy contains all messages of the log, then the new messages, and a layout that shows the new
topics. Each new message has the log_time of its step.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium as gym
from mcap.records import Attachment

from mcaprl.errors import CorruptLogError, LogError, UsageError
from mcaprl.files import parse_json, replacing
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.log_reader import describe
from mcaprl.recorder.dataset.transitions import Episode
from mcaprl.recorder.format import messages
from mcaprl.recorder.format.log_writer import LogWriter
from mcaprl.recorder.format.reading import McapReader, Topic
from mcaprl.recorder.format.schema import LOG_TOPIC
from mcaprl.recorder.record.display import SCENE, TELEMETRY, TF, Display, ShownTopics
from mcaprl.recorder.record.layout import LAYOUT_NAME, VALUES_TOPIC, layout_bytes, layout_of
from mcaprl.recorder.viewer.verify import Verification, verify
from mcaprl.texts import counted


def layout_of_log(
    reader: McapReader, topics: Sequence[str] | None = None, shown: ShownTopics | None = None
) -> dict[str, Any]:
    """Return a layout that shows the topics of a log and plots its series."""
    if topics is None:
        topics = sorted({channel.topic for channel in reader.channels.values()})
    if shown is not None:
        return layout_of(describe(reader), topics, shown.telemetry_names, shown.follow_frame)
    telemetry = [name for name in Topic(reader, TELEMETRY).fields if name != "encapsulation"]
    return layout_of(describe(reader), topics, telemetry, _first_frame(reader))


def attached_layout(reader: McapReader) -> dict[str, Any]:
    """Return the layout attached to a log, or a new one if there is none."""
    attached = reader.attachment(LAYOUT_NAME)
    if attached is None:
        return layout_of_log(reader)
    try:
        found = parse_json(attached)
    except ValueError as error:
        raise CorruptLogError(f"{reader.path}: attachment {LAYOUT_NAME}: {error}") from error
    if not (isinstance(found, dict) and isinstance(found.get("configById", {}), dict)):
        raise CorruptLogError(f"{reader.path}: attachment {LAYOUT_NAME} is not a layout")
    return found


def _first_frame(reader: McapReader) -> str:
    """Return the name of the first moving coordinate frame; empty if there is none."""
    channel = reader.channel_of(TF)
    first = next(reader.messages(channel), None) if channel is not None else None
    if first is None:
        return ""
    found = messages.decode(first[1], "tf2_msgs/msg/TFMessage").transforms
    return str(found[0].child_frame_id) if found else ""


@contextmanager
def annotated_copy(source: Path, out: Path, *, overwrite: bool = False) -> Iterator[AnnotatedCopy]:
    """Yield a copy of a log; move it to `out` if the `with` block ends without an error."""
    reader = McapReader(source)
    with replacing(out, LogError, overwrite=overwrite) as unfinished:
        log = LogWriter(unfinished, describe(reader), source=source)
        try:
            copy = AnnotatedCopy(log, reader)
            yield copy
            copy.attach_layout()
            log.close()
        finally:
            log.mcap.abandon()


class AnnotatedCopy:
    """A copy of a log to which topics are added."""

    def __init__(self, log: LogWriter, source: McapReader) -> None:
        """Prepare to add topics to `log`, which is a copy of `source`."""
        self._log, self._source = log, source
        self._topics = {channel.topic for channel in source.channels.values()}
        self._display: Display | None = None

    def add_values(self, topic: str, episodes: Sequence[tuple[Episode, Mapping[str, Any]]]) -> None:
        """Write a topic with schema `schema.values_schema` and one message per step.

        Args:
            topic: Topic to write; see `values_topics`.
            episodes: Pairs of an episode and its columns (T, ...) by field name.
        """
        self._refuse(topic)
        rows = self._log.values_rows(topic)
        for episode, columns in episodes:
            rows.write_columns(episode.log_time_ns[:-1], columns)

    def add_scene(self, dataset: Dataset, env: gym.Env[Any, Any], *, camera: bool) -> Verification:
        """Replay the log in the environment, and write the scene."""
        self._refuse(SCENE)
        display = Display(self._log, env.unwrapped, scene=True, camera=camera)
        if not display.shows_steps:
            raise UsageError(f"{dataset.env_id} provides no scene")
        self._display, step_ns = display, self._log.metadata.step_duration_ns

        def show(episode: Episode, step: int) -> None:
            if step == 0:
                display.begin(episode.summary.start_time_ns, step_ns)
            display.observe(step, float(episode.rewards[step - 1]) if step else 0.0)
            if step == episode.length:
                display.end(episode.summary)

        found = verify(dataset, env, on_frame=show)
        if found.difference is not None:
            raise LogError(
                f"no scene was added, since the replay differs: {found.difference.to_problem()}"
            )
        if found.unseeded:
            raise LogError(
                "no scene was added, since the log has no seed for"
                f" {counted(len(found.unseeded), 'episode')}"
                f" (first: {found.unseeded[0]})"
            )
        if LOG_TOPIC not in self._topics:
            self._log.write_log_lines([episode.summary for episode in dataset.episodes])
        return found

    def _refuse(self, topic: str) -> None:
        if topic in self._topics:
            raise UsageError(f"the log already has {topic}: annotate the original log")

    def attach_layout(self) -> None:
        """Attach a layout that shows the added topics."""
        mcap = self._log.mcap
        topics = sorted({channel.topic for channel in mcap.channels.values()})
        shown = None if self._display is None else self._display.shown
        layout = layout_of_log(self._source, topics, shown)
        data, time_ns = layout_bytes(layout), mcap.end_time_ns
        mcap.announce(Attachment(time_ns, time_ns, LAYOUT_NAME, "application/json", data))


def values_topics(names: Sequence[str]) -> dict[str, str]:
    """Return the topic of each policy: `/rl/values`, or `/rl/values/<name>` if there are several.

    >>> values_topics(["runs/cql", "runs/b c"])
    {'runs/cql': '/rl/values/runs_cql', 'runs/b c': '/rl/values/runs_b_c'}
    """
    if len(names) == 1:
        return {names[0]: VALUES_TOPIC}
    topics: dict[str, str] = {}
    for name in names:
        word = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_") or "policy"
        if word[0].isdigit():
            word = f"policy_{word}"
        while f"{VALUES_TOPIC}/{word}" in topics.values():
            word += "_b"
        topics[name] = f"{VALUES_TOPIC}/{word}"
    return topics
