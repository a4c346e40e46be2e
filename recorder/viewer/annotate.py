"""Comparison of a log with a replay in the environment, and copies of logs with more topics.

The copy contains all messages of the log, then the new messages, and a layout that shows the new
topics. Each new message has the log_time of its step.

A deterministic environment that is reset with the logged seed and stepped with the logged actions
returns bit-identical observations, rewards and flags. An episode that was reset without a seed
continues the random state of the previous episode, so it is replayed directly after that episode.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from mcap.records import Attachment
from numpy.typing import NDArray

from mcaprl.errors import CorruptLogError, LogError, McaprlError, Problem, SpaceError, UsageError
from mcaprl.files import parse_json, replacing
from mcaprl.frames import rows_of
from mcaprl.limits import STEP_LIMIT
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.log_reader import describe
from mcaprl.recorder.dataset.transitions import Episode
from mcaprl.recorder.format import messages
from mcaprl.recorder.format.log_writer import LogWriter
from mcaprl.recorder.format.messages import INTERRUPTED, TEXT_TYPE
from mcaprl.recorder.format.reading import McapReader, Topic, telemetry_names
from mcaprl.recorder.format.schema import EPISODE_TOPIC, LABELS_TOPIC, LOG_TOPIC
from mcaprl.recorder.format.spaces import Leaf, observation_leaves
from mcaprl.recorder.format.writing import McapWriter
from mcaprl.recorder.record.camera import VIDEO, rendering_env
from mcaprl.recorder.record.display import DEPTH, SCENE, TF, Display, ShownTopics
from mcaprl.recorder.record.layout import (
    LAYOUT_NAME,
    VALUES_TOPIC,
    is_values_topic,
    layout_bytes,
    layout_of,
)
from mcaprl.recorder.record.recordable import recorded_like, value_at
from mcaprl.recorder.record.step_rows import as_declared
from mcaprl.texts import counted, encodable

_MOST_FIELDS = 8
_MOST_EPISODES = 10
_Result = TypeVar("_Result")
Paths = dict[Leaf, tuple[str | int, ...]]
"""Path of each logged leaf in an observation of the environment."""


@dataclass(frozen=True)
class FieldDifference:
    """A value that differs between the log and the replay.

    Attributes:
        name: `reward`, `terminated`, `truncated`, or the name of the observation element.
        logged: Value in the log.
        now: Value that the environment returned.
    """

    name: str
    logged: str
    now: str


@dataclass(frozen=True)
class Difference:
    """The first step at which the replay differs from the log.

    Attributes:
        episode: Index of the episode in the dataset.
        step: Step of the observation; 0 after `reset`.
        time_ns: log_time of the observation.
        time_s: Time of the observation since the start of the episode.
        fields: The first values that differ, at most `_MOST_FIELDS`.
    """

    episode: int
    step: int
    time_ns: int
    time_s: float
    fields: tuple[FieldDifference, ...]

    def to_problem(self, file: str = "") -> Problem:
        """Return a description of the difference."""
        fields = [f"{one.name} logged {one.logged}, now {one.now}" for one in self.fields]
        return Problem(
            f"episode {self.episode} differs first at step {self.step}",
            f"{self.time_s:.3f} s after its start, log_time {self.time_ns} ns",
            "; ".join(fields),
            file=file,
        )


@dataclass(frozen=True)
class Verification:
    """Result of a comparison.

    Attributes:
        episodes: Number of compared episodes.
        steps: Number of compared steps.
        unseeded: Indexes of episodes that cannot be replayed, because their start is unknown.
        difference: The first difference; None if there is none.
    """

    episodes: int
    steps: int
    unseeded: tuple[int, ...]
    difference: Difference | None

    def problems(self, file: str = "") -> list[Problem]:
        """Return the difference, if any, and a note if episodes were not compared."""
        found = [] if self.difference is None else [self.difference.to_problem(file)]
        if self.unseeded:
            more = ", ..." if len(self.unseeded) > _MOST_EPISODES else ""
            where = f"episodes {', '.join(map(str, self.unseeded[:_MOST_EPISODES]))}{more}"
            what = f"{counted(len(self.unseeded), 'episode')} without a seed: not compared"
            found.insert(0, Problem(what, where, file=file, severity="note"))
        return found


def verify(
    dataset: Dataset,
    env: gym.Env[Any, Any],
    *,
    only: int | None = None,
    on_frame: Callable[[Episode, int], None] = lambda episode, step: None,
) -> Verification:
    """Repeat the logged actions in `env` up to the first difference.

    Args:
        dataset: Dataset of one log.
        env: New environment of the same kind as the logged one; this function resets and steps it.
        only: Index of the episode to compare. If the start of this episode depends on earlier
            episodes, these are also compared. Default: all episodes.
        on_frame: Function of episode and step. It is called after each observation that matches the
            log, while the environment is in the state of that step.
    """
    comparison = Comparison(dataset, env, only)
    for episode, step in comparison:
        on_frame(episode, step)
    return comparison.result


class Comparison:
    """Iterable over the frames that are equal in the log and the environment; see `verify`.

    It yields episode and step, while the environment is in the state of that step.

    Attributes:
        result: Result of the comparison, after the iteration.
    """

    result: Verification

    def __init__(self, dataset: Dataset, env: gym.Env[Any, Any], only: int | None = None) -> None:
        """Store the arguments, which are those of `verify`."""
        self._dataset, self._env, self._only = dataset, env, only

    def __iter__(self) -> Iterator[tuple[Episode, int]]:
        """Yield each frame; raise the same errors as `verify`."""
        self.result = yield from _compare_all(self._dataset, self._env, self._only)


_Frames = Generator[tuple[Episode, int], None, _Result]


def _compare_all(
    dataset: Dataset, env: gym.Env[Any, Any], only: int | None
) -> _Frames[Verification]:
    paths = _checked_paths(dataset, env)
    compared = steps = 0
    unseeded: list[int] = []
    is_start_known = False
    for episode in _needed(dataset.episodes, only):
        continues = is_start_known and _follows(dataset.episodes, episode.index)
        is_start_known = episode.seed is not None or continues
        difference = None
        if is_start_known:
            difference = yield from _compare(dataset, env, episode, paths)
        if difference is not None and episode.seed is None and difference.step == 0:
            # The episode started from an unknown state, so a difference is expected.
            is_start_known, difference = False, None
        if not is_start_known:
            unseeded.append(episode.index)
            continue
        compared += 1
        steps += episode.length if difference is None else difference.step
        if difference is not None:
            return Verification(compared, steps, tuple(unseeded), difference)
    return Verification(compared, steps, tuple(unseeded), None)


def _needed(episodes: tuple[Episode, ...], only: int | None) -> tuple[Episode, ...]:
    """Return the episode `only`, and the episodes on which the start of this episode depends.

    If `only` is None, return all episodes.
    """
    if only is None:
        return episodes
    first = only
    while first > 0 and episodes[first].seed is None and _follows(episodes, first):
        first -= 1
    return episodes[first : only + 1]


def _follows(episodes: tuple[Episode, ...], index: int) -> bool:
    """Return whether an episode directly follows the previous one in the same recording."""
    number = episodes[index].summary.episode
    return index > 0 and number > 0 and episodes[index - 1].summary.episode == number - 1


def _compare(
    dataset: Dataset, env: gym.Env[Any, Any], episode: Episode, paths: Paths
) -> _Frames[Difference | None]:
    """Replay one episode; yield the equal frames, and return the first difference."""
    for step, now in enumerate(_stepped(env, episode, dataset.action_space)):
        fields = []
        if step > 0:
            fields += _transition_differences(episode, step - 1, now)
        logged = _at(episode, step)
        for leaf, path in paths.items():
            value = value_at(now[0], path)
            fields += _leaf_differences(leaf, logged, value, dataset.observation_names)
        if fields:
            time_ns = int(episode.log_time_ns[step])
            since_s = (time_ns - int(episode.log_time_ns[0])) / 1e9
            return Difference(episode.index, step, time_ns, since_s, tuple(fields[:_MOST_FIELDS]))
        yield episode, step
    return None


_Frame = tuple[Any, float, bool, bool]


def _stepped(
    env: gym.Env[Any, Any], episode: Episode, action_space: spaces.Space[Any]
) -> Iterator[_Frame]:
    """Yield (observation, reward, terminated, truncated) after `reset` and after each step.

    After `reset`, the reward is 0 and both flags are False.
    """
    try:
        options = parse_json(episode.summary.options or "null")
    except ValueError as error:
        raise LogError(f"the reset options of the episode cannot be read: {error}") from error
    step = 0
    try:
        observation, _ = env.reset(seed=episode.seed, options=options)
        yield observation, 0.0, False, False
        for logged in episode.actions:
            step += 1
            action = int(logged) if isinstance(action_space, spaces.Discrete) else logged.copy()
            observation, reward, terminated, truncated, _ = env.step(action)
            yield observation, float(reward), bool(terminated), bool(truncated)
    # An environment can raise any exception.
    except Exception as error:
        raise LogError(
            f"the environment fails at step {step} of the logged episode {episode.index}:"
            f" {type(error).__name__}: {error}"
        ) from error


def _transition_differences(episode: Episode, step: int, now: _Frame) -> list[FieldDifference]:
    _, reward, terminated, truncated = now
    pairs: list[tuple[str, Any, Any]] = [
        ("reward", episode.rewards[step], np.float64(reward)),
        ("terminated", episode.terminated[step], np.bool_(terminated)),
    ]
    broken_off = episode.reason in (INTERRUPTED, STEP_LIMIT) and step == episode.length - 1
    if not broken_off:
        pairs.append(("truncated", episode.truncated[step], np.bool_(truncated)))
    return [
        FieldDifference(name, str(logged), str(given))
        for name, logged, given in pairs
        if logged.tobytes() != given.tobytes()
    ]


def _leaf_differences(
    leaf: Leaf, logged: Any, now: Any, names: tuple[str, ...]
) -> list[FieldDifference]:
    old = np.asarray(leaf.of(logged))
    new = as_declared(now, leaf)
    if old.tobytes() == new.tobytes():
        return []
    places = np.argwhere(_bits(old) != _bits(new)).tolist()
    named = leaf.path == () and len(names) == leaf.size
    found = []
    for place in places[:_MOST_FIELDS]:
        index = tuple(place)
        label = f"{leaf.name}{place if place else ''}"
        if named:
            label = names[int(np.ravel_multi_index(index, leaf.shape)) if index else 0]
        found.append(FieldDifference(label, str(old[index]), str(new[index])))
    return found


def _bits(array: NDArray[Any]) -> NDArray[Any]:
    """View an array as integers, so that NaN equals NaN and 0.0 differs from -0.0."""
    return np.ascontiguousarray(array).view(f"u{array.dtype.itemsize}").reshape(array.shape)


def _at(episode: Episode, step: int) -> Any:
    """Return the logged observation at a step; `step` is from 0 to the episode's length."""
    source = episode.observations if step < episode.length else episode.next_observations
    return rows_of(source, min(step, episode.length - 1))


def _checked_paths(dataset: Dataset, env: gym.Env[Any, Any]) -> Paths:
    """Return the path of each logged leaf in an observation of the environment."""
    logged, actual = dataset.observation_space, env.observation_space
    own: dict[tuple[str, ...], tuple[str | int, ...]] = {}
    try:
        recorded = recorded_like(actual, logged)
        actual = recorded.space
        own = {tuple(map(str, path)): path for path in recorded.paths}
    except McaprlError:
        # The environment lacks a logged part, so the spaces differ.
        pass
    pairs = {
        "observation_space": (logged, actual),
        "action_space": (dataset.action_space, env.action_space),
    }
    for role, (ours, theirs) in pairs.items():
        if ours != theirs:
            name = env.spec.id if env.spec else "the environment"
            raise SpaceError(f"the log has {role} {ours}, but {name} has {theirs}")
    return {leaf: own[leaf.path] for leaf in observation_leaves(logged)}


def layout_of_log(
    reader: McapReader,
    topics: Sequence[str] | None = None,
    shown: ShownTopics | None = None,
    without_q: Collection[str] = (),
    agreement: Mapping[str, float] | None = None,
) -> dict[str, Any]:
    """Return a layout that shows the topics of a log and plots its series."""
    own = sorted({channel.topic for channel in reader.channels.values()})
    if shown is None:
        names, frame = telemetry_names(reader), _first_frame(reader)
    else:
        names, frame = list(shown.telemetry_names), shown.follow_frame
    values = [topic for topic in own if is_values_topic(topic)]
    empty = [topic for topic in values if not _has_q(reader, topic)]
    shares = {topic: _agreement(reader, topic) for topic in values}
    shown_topics = own if topics is None else topics
    if not _has_depth(reader):
        shown_topics = [topic for topic in shown_topics if topic != DEPTH]
    return layout_of(
        describe(reader),
        shown_topics,
        names,
        frame,
        without_q={*without_q, *empty},
        episodes=len(Topic(reader, EPISODE_TOPIC).times),
        sensors={
            channel.topic: reader.type_of(channel)
            for channel in reader.channels.values()
            if not channel.topic.startswith("/rl/")
        },
        agreement={topic: share for topic, share in shares.items() if share is not None}
        | dict(agreement or {}),
    )


def _has_q(reader: McapReader, topic: str) -> bool:
    """Return whether the first message of a policy's topic has Q-values."""
    values = Topic(reader, topic)
    found = values.read(("q",), np.arange(min(1, len(values.times))))["q"]
    return bool(np.isfinite(found.astype(np.float64)).any())


def _agreement(reader: McapReader, topic: str) -> float | None:
    """Return the share of steps at which a policy agrees with the log; None of Box actions."""
    values = Topic(reader, topic)
    if "agrees" not in values.fields or not len(values):
        return None
    return float(values.read(("agrees",))["agrees"].mean())


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
    kind = "tf2_msgs/msg/TFMessage"
    for channel in reader.channels_of(TF):
        # A robot's own transforms may have any encoding.
        if channel.message_encoding == "cdr" and reader.type_of(channel) == kind:
            first = next(reader.messages(channel), None)
            found = messages.decode(first[1], kind).transforms if first is not None else []
            if found:
                return str(found[0].child_frame_id)
    return ""


def _has_depth(reader: McapReader) -> bool:
    """Return whether `/camera/depth` may have depth images in millimeters."""
    channels = reader.channels_of(DEPTH)
    kinds = {(channel.message_encoding, reader.type_of(channel)) for channel in channels}
    if kinds != {("cdr", "sensor_msgs/msg/Image")}:
        return all(re.split(r"[/.]", kind)[-1] in ("Image", "RawImage") for _, kind in kinds)
    depth = Topic(reader, DEPTH)
    found = depth.read(("encoding",), np.arange(min(1, len(depth.times))))["encoding"]
    return all(str(each) in ("16UC1", "mono16") for each in found.astype(np.str_))


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
        self._without_q: set[str] = set()
        self._agreement: dict[str, float] = {}

    def add_values(
        self, topic: str, episodes: Sequence[tuple[NDArray[np.int64], Mapping[str, Any]]]
    ) -> None:
        """Write a topic with schema `schema.values_schema` and one message per step.

        Args:
            topic: Topic to write; see `values_topics`.
            episodes: Of each episode, log_times (T,) of steps and the columns (T, ...) by field
                name.
        """
        self._refuse(topic)
        rows = self._log.values_rows(topic)
        if not any(np.isfinite(columns["q"]).any() for _, columns in episodes):
            self._without_q.add(topic)
        agrees = [columns["agrees"] for _, columns in episodes if "agrees" in columns]
        if agrees:
            self._agreement[topic] = float(np.concatenate(agrees).mean())
        for times_ns, columns in episodes:
            rows.write_columns(times_ns, columns)

    def add_labels(self, texts: Sequence[tuple[int, str]]) -> None:
        """Write `/rl/labels`, pairs of log_time and text."""
        self._refuse(LABELS_TOPIC)
        _write_labels(self._log.mcap, texts)

    def add_scene(
        self,
        dataset: Dataset,
        env: gym.Env[Any, Any],
        *,
        scene: bool = True,
        camera: bool | str = False,
    ) -> Verification:
        """Replay the log in the environment, and write its scene, its camera, or both."""
        rendering = rendering_env(env, camera)
        for topic, is_added in ((SCENE, scene), (VIDEO, rendering is not None)):
            if is_added:
                self._refuse(topic)
        options: Any = {"scene": scene, "camera": camera is True, "rendering": rendering}
        display = Display(self._log, env.unwrapped if scene else None, **options)
        if not display.shows_steps:
            raise UsageError(f"{dataset.env_id} provides no scene")
        if scene:
            self._display = display
        what, step_ns = "scene" if scene else "video", self._log.metadata.step_duration_ns

        def show(episode: Episode, step: int) -> None:
            if step == 0:
                display.begin(episode.summary.start_time_ns, step_ns)
            display.observe(step, float(episode.rewards[step - 1]) if step else 0.0)
            if step == episode.length:
                display.end(episode.summary)

        found = verify(dataset, env, on_frame=show)
        if found.difference is not None:
            raise LogError(
                f"no {what} was added, since the replay differs: {found.difference.to_problem()}"
            )
        if found.unseeded:
            raise LogError(
                f"no {what} was added, since the log has no seed for"
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
        layout = layout_of_log(self._source, topics, shown, self._without_q, self._agreement)
        data, time_ns = layout_bytes(layout), mcap.end_time_ns
        mcap.announce(Attachment(time_ns, time_ns, LAYOUT_NAME, "application/json", data))


def write_labels(path: Path, texts: Sequence[tuple[int, str]]) -> None:
    """Write a file that has `/rl/labels` alone, to be played beside a log."""
    mcap = McapWriter(path)
    _write_labels(mcap, texts)
    mcap.close()


def _write_labels(mcap: McapWriter, texts: Sequence[tuple[int, str]]) -> None:
    channel = mcap.add_channel(LABELS_TOPIC, TEXT_TYPE, messages.definition(TEXT_TYPE))
    mcap.write_messages(
        [(channel, at, messages.text_message(encodable(text))) for at, text in texts]
    )


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
