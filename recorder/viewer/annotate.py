"""Adds topics to a copy of a log: what policies think of its steps, or what there was to see.

The copy has all messages of the log; new ones are written after them, with the log_times of their
steps, and a new layout shows them.
"""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import gymnasium as gym
from mcap.records import Attachment

from mcaprl.errors import LogError, OutputExistsError, UsageError
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.episode import Episode
from mcaprl.recorder.dataset.log_reader import describe
from mcaprl.recorder.format.log_writer import LogWriter
from mcaprl.recorder.format.reading import McapReader
from mcaprl.recorder.format.topics import LOG_TOPIC
from mcaprl.recorder.record.display import SCENE, Display
from mcaprl.recorder.record.layout import LAYOUT_NAME, VALUES_TOPIC
from mcaprl.recorder.viewer.log_layout import layout_of_log
from mcaprl.recorder.viewer.verify import Verification, verify


class AnnotatedCopy:
    """A copy of a log that grows; use it as a context. An error inside removes it again."""

    def __init__(self, source: Path, out: Path, *, overwrite: bool = False) -> None:
        """Copy the log.

        Raises:
            OutputExistsError: there is a file, and `overwrite` is not set; or it is the log itself.
            LogError: the log is damaged, not finished, or not one of ours; or it cannot be written.
        """
        if out.exists() and (not overwrite or out.samefile(source)):
            raise OutputExistsError(f"{out} exists: choose another path, or pass --overwrite")
        reader = McapReader(source)
        self._metadata = describe(reader)
        self._topics = {channel.topic for channel in reader.channels.values()}
        self._out = out
        try:
            out.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source, out)
        except OSError as error:
            raise LogError(f"cannot write {out}: {error.strerror}") from error
        try:
            self._log = LogWriter(out, self._metadata, append=True)
        except BaseException:
            out.unlink()
            raise

    def __enter__(self) -> Self:
        """Begin."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Attach the layout and finish; or remove what an error left unfinished."""
        if kind is not None:
            self._log.mcap.abandon()
            self._out.unlink(missing_ok=True)
            return
        self._log.close()
        self._attach_layout()

    def add_values(self, topic: str, episodes: Sequence[tuple[Episode, Mapping[str, Any]]]) -> None:
        """Write a topic of `schema.values_schema`, one message for each step.

        Args:
            topic: see `values_topics`.
            episodes: each with its columns, (T, ...) by field.

        Raises:
            UsageError: the log has the topic.
        """
        self._refuse(topic)
        rows = self._log.values_rows(topic, actions=episodes[0][1]["q"].shape[1])
        for episode, columns in episodes:
            rows.write_columns(episode.log_time_ns[:-1], columns)

    def add_scene(self, dataset: Dataset, env: gym.Env[Any, Any], *, camera: bool) -> Verification:
        """Step the environment through the log, and write what there is to see.

        Args:
            dataset: the log's.
            env: a new one of the same kind.
            camera: whether to write metric depth images, too.

        Raises:
            UsageError: the log has a scene, or the environment none.
            LogError: the environment gives something else than the log has, or cannot be stepped
                through it since there are no seeds.
        """
        self._refuse(SCENE)
        display = Display(self._log, env.unwrapped, scene=True, camera=camera)
        if not display.shows_steps:
            raise UsageError(f"{dataset.env_id} describes no scene; nothing can be added")
        step_ns = self._metadata.step_duration_ns

        def show(episode: Episode, step: int) -> None:
            if step == 0:
                display.begin(episode.summary.start_time_ns, step_ns)
            display.observe(step, float(episode.rewards[step - 1]) if step else 0.0)
            if step == episode.length:
                display.end(episode.length)

        found = verify(dataset, env, on_frame=show)
        if found.difference is not None:
            raise LogError(
                f"no scene was added, for the sim is another now: {found.difference.to_problem()}"
            )
        if found.unseeded:
            raise LogError(
                f"no scene was added, for the log has no seed of {len(found.unseeded)} episodes"
                f" (the first: {found.unseeded[0]})"
            )
        if LOG_TOPIC not in self._topics:
            self._log.write_log_lines([episode.summary for episode in dataset.episodes])
        return found

    def _refuse(self, topic: str) -> None:
        if topic in self._topics:
            raise UsageError(f"the log has {topic} already: annotate the log that it was made of")

    def _attach_layout(self) -> None:
        layout = layout_of_log(McapReader(self._out))
        log = LogWriter(self._out, self._metadata, append=True)
        time_ns = log.mcap.end_time_ns
        data = json.dumps(layout).encode()
        log.mcap.announce(Attachment(time_ns, time_ns, LAYOUT_NAME, "application/json", data))
        log.close()


def values_topics(names: Sequence[str]) -> dict[str, str]:
    """A topic for each policy by its name: one alone has `/rl/values`, several one below it each.

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
