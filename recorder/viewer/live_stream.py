"""Live stream of a running environment to viewers, at a limited share of the run time.

Viewers receive the topics of a log (see `log_writer` and `display`) and one more:

    /rl/training    mcaprl_msgs/msg/Telemetry...    metrics of the learner: loss, epsilon, ...

Nothing is stored, and the environment never waits for a viewer. Timestamps are wall-clock times,
because whole episodes can be skipped. Static shapes and frames are sent to each new viewer, and
again when they change.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.recorder.format.episode_summary import EpisodeSummary
from mcaprl.recorder.format.log_writer import LogTopics, MessageSink
from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.format.rows import ImageRows, TopicRows
from mcaprl.recorder.format.schema import telemetry_message, telemetry_schema
from mcaprl.recorder.format.spaces import observation_leaves
from mcaprl.recorder.record.display import (
    DEPTH,
    SCENE,
    SCENE_STATIC,
    TELEMETRY,
    TF,
    TF_STATIC,
    ShownTopics,
)
from mcaprl.recorder.record.layout import TRAINING_TOPIC, VALUES_TOPIC, layout_of
from mcaprl.recorder.record.scene import (
    DepthSource,
    SceneSource,
    TelemetrySource,
    depth_millimeters,
    marker_array,
    transforms,
)
from mcaprl.recorder.record.step_rows import as_declared
from mcaprl.recorder.viewer.foxglove_server import DEFAULT_PORT, ViewerServer

_STATIC_PERIOD_S = 10.0
"""Time after which the static scene is checked for changes."""
_ROW = slice(1)
"""The only row that is reserved for each topic."""


@dataclass(frozen=True)
class LiveStep:
    """A transition of the streamed environment, and the learner's metrics at that step.

    Attributes:
        episode: Number of the episode, from 0.
        step: Number of steps since the episode's start.
        observation: Observation, in the environment's space.
        action: Action taken.
        reward: Reward of the action.
        terminated: Whether the transition reached a terminal state.
        truncated: Whether the episode was truncated.
        behavior_prob: Probability of the action under the behavior policy; NaN if unknown.
        epsilon: Probability of a random action; NaN if unknown.
        policy_version: Number of updates of the policy so far.
        values: Fields of `schema.values_schema`; empty if unknown.
        training: Metrics of the learner, by the names passed to `LiveStream`.
    """

    episode: int
    step: int
    observation: Any
    action: Any
    reward: float
    terminated: bool
    truncated: bool
    behavior_prob: float = math.nan
    epsilon: float = math.nan
    policy_version: int = -1
    values: Mapping[str, Any] = field(default_factory=dict)
    training: Mapping[str, float] = field(default_factory=dict)


@dataclass
class Pace:
    """A limit on the time that is spent on frames.

    Attributes:
        share: Largest share of the run time that is spent on frames.
        period_s: Shortest time between two frames.
        clock: Function that returns the time in seconds.
    """

    share: float = 0.025
    period_s: float = 1 / 20
    clock: Callable[[], float] = time.perf_counter
    _next_s: float = field(default=-math.inf, init=False)
    _began_s: float = field(default=0.0, init=False)
    _spent_s: float = field(default=0.0, init=False)

    def due(self) -> bool:
        """Return whether there is time for a frame now."""
        return self.clock() >= self._next_s

    def begin(self) -> None:
        """Start or continue the timer of a frame."""
        self._began_s = self.clock()

    def pause(self) -> None:
        """Stop the timer of a frame while the environment is stepped."""
        self._spent_s += self.clock() - self._began_s

    def end(self) -> None:
        """End a frame and schedule the next one."""
        self.pause()
        rest_s = self._spent_s * (1 / self.share - 1)
        self._next_s = self.clock() + max(rest_s, self.period_s - self._spent_s)
        self._spent_s = 0.0


class LiveStream(ViewerServer):
    """Frames of one environment; call `due`, `look`, `env.step` and `show` in this order."""

    def __init__(
        self,
        metadata: LogMetadata,
        source: object,
        training: Sequence[str],
        *,
        name: str = "mcaprl",
        port: int = DEFAULT_PORT,
        origins: Sequence[str] = (),
        pace: Pace | None = None,
    ) -> None:
        """Announce the topics and listen.

        Args:
            metadata: Metadata of the environment.
            source: Unwrapped environment after a reset, which implements any of the protocols in
                `scene.py`.
            training: Names of the learner's metrics.
            name: Name of the server, as viewers display it.
            port: Port on 127.0.0.1; 0 selects a free port.
            origins: Additional origins of web pages that may connect.
            pace: Limit on the time spent on frames.

        Raises:
            MissingExtraError: foxglove-sdk is not installed.
            UsageError: The port is in use.
            SpaceError: The log format does not support the spaces.
        """
        super().__init__()
        self._pace = pace or Pace()
        self._sink = _ViewerSink(self)
        self._log = log = LogTopics(metadata, self._sink)
        self._training = tuple(training)
        self._shown = ShownTopics(log, source)
        self._topics = dict(self._shown.channels)
        type_name, text = telemetry_schema(self._training)
        self._topics[TRAINING_TOPIC] = log.sink.add_channel(TRAINING_TOPIC, type_name, text)
        # A row is reserved for each topic of fixed-size messages.
        self._depth: ImageRows | None = None
        self._values: TopicRows | None = None
        if isinstance(source, DepthSource):
            self._depth = log.image_rows(DEPTH, source.depth_image_m().shape, "16UC1", 1)
            self._topics[DEPTH] = self._depth.channel_id
        if isinstance(metadata.action_space, spaces.Discrete):
            self._values = log.values_rows(VALUES_TOPIC, int(metadata.action_space.n), 1)
            self._topics[VALUES_TOPIC] = self._values.channel_id
        self._steps, self._learner = log.step_rows(1), log.learner_rows(1)
        self._images = {
            leaf: log.image_rows(leaf.topic, leaf.shape, leaf.encoding, 1)
            for leaf in log.image_leaves
        }
        self._newcomers, self._static_at_s = True, -math.inf
        self._static_shapes: Sequence[Any] | None = None
        self._static: list[tuple[str, bytes]] = []
        if isinstance(source, SceneSource):
            self._static_messages(source)
        self._time_ns = 0
        self._finished: list[EpisodeSummary] = []
        self.start(name, port, origins)

    def due(self) -> bool:
        """Return whether there is time for a frame and a viewer is subscribed."""
        if not self._pace.due():
            return False
        self._pace.begin()
        if self._sink.has_viewers():
            return True
        self._pace.end()
        return False

    def look(self, source: object, return_so_far: float) -> None:
        """Store the environment's display messages before a step, if a frame is due."""
        self._time_ns = max(time.time_ns(), self._time_ns + 1)
        seen = []
        if isinstance(source, SceneSource) and SCENE in self._topics:
            seen += self._static_messages(source)
            seen += [
                (SCENE, marker_array(source.scene())),
                (TF, transforms(source.frames(), self._time_ns)),
            ]
        if isinstance(source, TelemetrySource) and TELEMETRY in self._topics:
            seen.append((TELEMETRY, self._shown.telemetry(source, return_so_far)))
        if isinstance(source, DepthSource) and self._depth is not None:
            self._put_image(self._depth, depth_millimeters(source.depth_image_m()))
        self._seen = seen
        self._pace.pause()

    def show(self, step: LiveStep) -> None:
        """Send the messages that `look` stored, and then the step that followed `look`."""
        self._pace.begin()
        time_ns, topics = self._time_ns, self._topics
        self._sink.write_messages([(topics[t], time_ns, data) for t, data in self._seen])
        if self._depth is not None:
            self._depth.write(_ROW, time_ns)
        self._send_step(step)
        numbers = [step.training.get(name, math.nan) for name in self._training]
        training = (topics[TRAINING_TOPIC], time_ns, telemetry_message(numbers))
        self._sink.write_messages([training])
        if self._values is not None and step.values:
            self._send(self._values, step.values)
        finished, self._finished = self._finished, []
        self._log.write_episodes(finished)
        self._pace.end()

    def end_episode(self, summary: EpisodeSummary) -> None:
        """Send the summary of the latest finished episode with the next frame."""
        self._finished = [summary]

    def layout(self) -> dict[str, Any]:
        """Return the layout that shows these topics; see `layout.layout_of`."""
        return layout_of(
            self._log.metadata,
            sorted(self._topics),
            self._shown.telemetry_names,
            self._shown.follow_frame,
            self._training,
        )

    def on_subscribe(self, client: Any, channel: Any) -> None:
        """Send the static scene with the next frame, for the new viewer."""
        self._newcomers = True

    def _static_messages(self, source: SceneSource) -> list[tuple[str, bytes]]:
        """Return the static scene if there are new viewers or a periodic check finds a change."""
        age_s = time.monotonic() - self._static_at_s
        if not (self._newcomers or age_s > _STATIC_PERIOD_S):
            return []
        shapes, self._static_at_s = source.static_scene(), time.monotonic()
        if shapes is not self._static_shapes:
            self._static_shapes = shapes
            self._static = [
                (SCENE_STATIC, marker_array(shapes)),
                (TF_STATIC, transforms(source.static_frames(), 0)),
            ]
        elif not self._newcomers:
            return []
        self._newcomers = False
        return self._static

    def _send_step(self, step: LiveStep) -> None:
        """Send the transition in the messages of a log."""
        columns = {name: getattr(step, name) for name in ("reward", "behavior_prob")}
        columns["action"] = as_declared(step.action, self._log.action)
        for leaf in observation_leaves(self._log.metadata.observation_space):
            value = np.asarray(leaf.of(step.observation))
            if leaf in self._images:
                self._put_image(self._images[leaf], value)
                self._images[leaf].write(_ROW, self._time_ns)
            else:
                columns[leaf.name] = as_declared(value, leaf)
        self._steps.number(_ROW, step.episode, step.step)
        columns |= {"terminated": step.terminated, "truncated": step.truncated}
        self._send(self._steps, columns)
        learner = {"epsilon": step.epsilon, "policy_version": step.policy_version}
        self._send(self._learner, learner)

    def _put_image(self, rows: ImageRows, image: NDArray[Any]) -> None:
        rows.put("data", _ROW, np.ascontiguousarray(image).view(np.uint8))

    def _send(self, rows: TopicRows, columns: Mapping[str, Any]) -> None:
        for name, value in columns.items():
            rows.put(name, _ROW, value)
        rows.write(_ROW, self._time_ns)


class _ViewerSink(MessageSink):
    """A sink that sends a log's messages to viewers."""

    def __init__(self, viewers: ViewerServer) -> None:
        self._viewers = viewers
        self._channels: list[Any] = []

    def has_viewers(self) -> bool:
        return any(channel.has_sinks() for channel in self._channels)

    def add_metadata(self, name: str, metadata: dict[str, str]) -> None:
        """Do nothing: viewers do not use metadata."""

    def add_channel(
        self, topic: str, schema_name: str, schema_text: str, metadata: dict[str, str] | None = None
    ) -> int:
        self._channels.append(self._viewers.add_channel(topic, schema_name, schema_text.encode()))
        return len(self._channels) - 1

    def write_rows(self, rows: NDArray[Any]) -> None:
        for row in rows:
            channel = self._channels[int(row["channel_id"])]
            channel.log(row["payload"].tobytes(), log_time=int(row["log_time"]))

    def write_messages(self, messages: Sequence[tuple[int, int, bytes]]) -> None:
        for channel_id, time_ns, data in messages:
            self._channels[channel_id].log(data, log_time=time_ns)
