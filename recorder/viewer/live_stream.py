"""Live stream of a running environment to viewers: single episodes at a lower speed.

Viewers receive the topics of a log (see `log_writer` and `display`) and one more:

    /rl/training    mcaprl_msgs/msg/Telemetry...    metrics of the learner: loss, epsilon, ...

An environment in training runs many times faster than real time. The stream therefore shows one
whole episode at a given speed and skips the episodes that begin meanwhile. Messages are encoded
while the environment runs, and a thread sends them later. The environment never waits for a viewer.
Log times are wall-clock times. Nothing is stored.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from gymnasium import spaces
from mcap.records import Schema
from numpy.typing import NDArray

from mcaprl.recorder.format import messages
from mcaprl.recorder.format.log_writer import LogTopics, Message, MessageSink
from mcaprl.recorder.format.messages import EpisodeSummary
from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.format.schema import (
    LOG_TOPIC,
    PHASE_TOPIC,
    ImageRows,
    TopicRows,
    telemetry_message,
    telemetry_schema,
)
from mcaprl.recorder.format.spaces import observation_leaves
from mcaprl.recorder.record.display import (
    DEPTH,
    MAP,
    SCENE,
    SCENE_STATIC,
    TELEMETRY,
    TF,
    TF_STATIC,
    TRACKS,
    ShownTopics,
)
from mcaprl.recorder.record.layout import TRAINING_TOPIC, VALUES_TOPIC, layout_of
from mcaprl.recorder.record.scene import (
    DepthSource,
    Frame,
    Moment,
    MotionSource,
    SceneSource,
    TelemetrySource,
    Tracks,
    depth_millimeters,
    marker_array,
    motion_transforms,
    transforms,
)
from mcaprl.recorder.record.step_rows import as_declared
from mcaprl.recorder.viewer.foxglove_server import DEFAULT_PORT, ViewerServer

_PERIOD_S = 1 / 30


class LiveSink(MessageSink):
    """A sink with a thread that sends messages to viewers at their log_times, in write order.

    The latest messages of the topics in `kept` are also sent to each new viewer.
    """

    def __init__(self, viewers: ViewerServer, kept: Sequence[str]) -> None:
        """Create a sink without channels."""
        self._viewers, self._kept = viewers, kept
        self._channels: list[Any] = []
        self._kept_ids: set[int] = set()
        self._latest: dict[int, bytes] = {}
        self._waiting: deque[Message] = deque()
        self._has_newcomers = False
        self._lock, self._stop = threading.Lock(), threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def start(self) -> None:
        """Start to send messages."""
        self._thread.start()

    def close(self) -> None:
        """Stop the thread, send the messages that are due, and drop all later messages."""
        if self._thread.is_alive():
            self._stop.set()
            self._thread.join()
        self._send_due()

    def has_viewers(self) -> bool:
        """Return whether a viewer subscribes to any topic."""
        return any(channel.has_sinks() for channel in self._channels)

    def welcome(self) -> None:
        """Send the latest message of each topic in `kept` to all viewers, including new viewers."""
        self._has_newcomers = True

    def send(self, channel_id: int, time_ns: int, data: bytes) -> None:
        """Send a message now, before all messages in the queue."""
        self._channels[channel_id].log(data, log_time=time_ns)

    def add_metadata(self, name: str, metadata: dict[str, str]) -> None:
        """Do nothing: viewers do not use metadata."""

    def add_channel(
        self, topic: str, schema_name: str, schema_text: str, metadata: dict[str, str] | None = None
    ) -> int:
        """Advertise a topic and return its channel id."""
        schema = Schema(len(self._channels) + 1, schema_text.encode(), "ros2msg", schema_name)
        self._channels.append(self._viewers.add_channel(topic, schema))
        channel_id = len(self._channels) - 1
        if topic in self._kept:
            self._kept_ids.add(channel_id)
        return channel_id

    def write_rows(self, rows: NDArray[Any]) -> None:
        """Queue message records of one channel, to be sent at their log_times."""
        self.write_messages(
            [
                (int(row["channel_id"]), int(row["log_time"]), row["payload"].tobytes())
                for row in rows
            ]
        )

    def write_messages(self, messages: Sequence[Message]) -> None:
        """Queue messages, to be sent at their log_times."""
        with self._lock:
            self._waiting.extend(messages)

    def _run(self) -> None:
        while not self._stop.wait(_PERIOD_S):
            self._send_due()

    def _send_due(self) -> None:
        now_ns = time.time_ns()
        if self._has_newcomers:
            self._has_newcomers = False
            for channel_id, data in self._latest.items():
                self.send(channel_id, now_ns, data)
        while self._waiting and self._waiting[0][1] <= now_ns:
            with self._lock:
                channel_id, time_ns, data = self._waiting.popleft()
            if channel_id in self._kept_ids:
                self._latest[channel_id] = data
            self.send(channel_id, time_ns, data)


DEFAULT_SPEED = 2.0
MAX_STEPS = 2_000
"""Maximum number of steps shown per episode; messages take about 20 kB per step in memory."""
# Topics whose latest message is sent to each new viewer.
_KEPT_TOPICS = (SCENE, SCENE_STATIC, TRACKS, MAP, TF, TF_STATIC, PHASE_TOPIC)
# Poses within a step are sent only if the step takes at least this long.
_SHORTEST_MOTION_NS = 10_000_000
_ROW = slice(1)
"""Slice that selects the single row of the `TopicRows` of a topic with fixed-size messages."""


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
        behavior: Probability of the action under the behavior policy, or natural logarithm of its
            density if actions are floats; NaN if unknown.
        epsilon: Probability of a random action; NaN if unknown.
        policy_version: Number of updates of the policy so far.
        values: Fields of `schema.values_schema`; empty if unknown.
    """

    episode: int
    step: int
    observation: Any
    action: Any
    reward: float
    terminated: bool
    truncated: bool
    behavior: float = math.nan
    epsilon: float = math.nan
    policy_version: int = -1
    values: Mapping[str, Any] = field(default_factory=dict)


@dataclass
class Pace:
    """A limit on the time spent on frames. A frame is the work of sending one episode to viewers.

    Attributes:
        share: Maximum fraction of the run time that is spent on frames.
        period_s: Shortest time between two frames.
        clock: Function that returns the time in seconds.
    """

    share: float = 0.025
    period_s: float = 1 / 10
    clock: Callable[[], float] = time.perf_counter
    _next_s: float = field(default=-math.inf, init=False)
    _began_s: float = field(default=0.0, init=False)
    _spent_s: float = field(default=0.0, init=False)

    def due(self) -> bool:
        """Return whether the next frame is due."""
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
    """Server that streams episodes of one environment, and metrics of its learner.

    For an episode, call `begin_episode`, then `look`, `pause`, `env.step` and `show` for each step,
    and then `end_episode`.
    """

    def __init__(
        self,
        metadata: LogMetadata,
        source: object,
        training: Mapping[str, str],
        *,
        name: str = "mcaprl",
        port: int = DEFAULT_PORT,
        origins: Sequence[str] = (),
        speed: float = DEFAULT_SPEED,
        pace: Pace | None = None,
    ) -> None:
        """Advertise the topics and start the server.

        Args:
            metadata: Metadata of the environment.
            source: Unwrapped environment after a reset, which implements any of the protocols in
                `scene.py`.
            training: Labels of the learner's metrics, by name.
            name: Name of the server, as viewers display it.
            port: Port on 127.0.0.1; 0 selects a free port.
            origins: Origins of additional web pages that may connect.
            speed: Simulated seconds per second.
            pace: Limit on the time spent on episodes and metrics. `pace.period_s` is the minimum
                time between two scenes, two depth images, or two messages with metrics.
        """
        super().__init__()
        self._speed, self._pace = speed, pace or Pace()
        self._metrics_at_s = -math.inf
        self._step_ns = max(1, round(metadata.step_duration_ns / speed))
        self._sink = LiveSink(self, _KEPT_TOPICS)
        self._log = log = LogTopics(metadata, self._sink)
        self._training = dict(training)
        self._shown = ShownTopics(log, source)
        # `begin_messages` adds the channels of the log lines. Its messages are not sent.
        self._line_channel = log.begin_messages(0, "", 0)[0][0]
        self._topics = dict(self._shown.channels)
        type_name, text = telemetry_schema(tuple(training))
        self._topics[TRAINING_TOPIC] = log.sink.add_channel(TRAINING_TOPIC, type_name, text)
        # Each topic of fixed-size messages has a `TopicRows` with one row, for the current message.
        self._depth: ImageRows | None = None
        self._values: TopicRows | None = None
        if isinstance(source, DepthSource):
            self._depth = log.image_rows(DEPTH, source.depth_image_m().shape, "16UC1", 1)
            self._topics[DEPTH] = self._depth.channel_id
        if isinstance(metadata.action_space, spaces.Discrete | spaces.Box):
            self._values = log.values_rows(VALUES_TOPIC, 1)
            self._topics[VALUES_TOPIC] = self._values.channel_id
        self._steps, self._learner = log.step_rows(1), log.learner_rows(1)
        self._images = {
            leaf: log.image_rows(leaf.topic, leaf.shape, leaf.encoding, 1)
            for leaf in log.image_leaves
        }
        self._static_shapes: Sequence[Any] | None = None
        self._tracks = Tracks()
        # Coordinate frames of the latest step. They are sent at the next step, in one message with
        # all poses between the two steps.
        self._moment: Moment | None = None
        self._start_ns = self._time_ns = self._next_ns = self._frame_ns = 0
        self._steps_shown = 0
        if isinstance(source, SceneSource):
            self._send_static(source, time.time_ns())
        self.start(name, port, origins)
        self._sink.start()

    def begin_episode(self, episode: int, policy: str) -> bool:
        """Return whether to show the episode that begins now.

        The episode is shown if a viewer subscribes to a topic, the last shown episode has been
        sent, and `pace` allows a frame.
        """
        now_ns = time.time_ns()
        if now_ns < self._next_ns or not self._pace.due() or not self._sink.has_viewers():
            return False
        self._start_ns = self._next_ns = now_ns
        self._steps_shown = self._frame_ns = 0
        self._moment = None
        self._tracks.begin()
        self._sink.write_messages(self._log.begin_messages(episode, policy, now_ns))
        return True

    def look(self, source: object, return_so_far: float) -> bool:
        """Start the timer of the frame; send telemetry, scene and depth image before a step.

        Returns:
            Whether shapes and depth images were sent. If so, the caller should set `values` of the
            next `LiveStep`.
        """
        self._pace.begin()
        self._time_ns = time_ns = max(time.time_ns(), self._next_ns)
        self._next_ns = time_ns + self._step_ns
        is_shown = time_ns - self._frame_ns >= self._pace.period_s * 1e9
        if is_shown:
            self._frame_ns = time_ns
        if isinstance(source, SceneSource) and SCENE in self._topics:
            self._send_scene(source, is_shown=is_shown)
        if isinstance(source, TelemetrySource) and TELEMETRY in self._topics:
            self._emit(TELEMETRY, time_ns, self._shown.telemetry(source, return_so_far))
        if is_shown and isinstance(source, DepthSource) and self._depth is not None:
            self._put_image(self._depth, depth_millimeters(source.depth_image_m()))
            self._depth.write(_ROW, time_ns)
        return is_shown

    def pause(self) -> None:
        """Stop the timer of the frame while the environment is stepped."""
        self._pace.pause()

    def show(self, step: LiveStep) -> bool:
        """Send the step that followed `look`, and return whether to show the next step, too."""
        self._pace.begin()
        self._send_step(step)
        if self._values is not None and step.values:
            self._send(self._values, step.values)
        self._steps_shown += 1
        goes_on = self._steps_shown < MAX_STEPS or step.terminated or step.truncated
        if goes_on:
            self._pace.pause()
        else:
            text = f"episode {step.episode} is shown up to step {step.step} only"
            line = messages.log_message(self._next_ns, text, messages.WARN)
            self._sink.write_messages([(self._line_channel, self._next_ns, line)])
            self._pace.end()
        return goes_on

    def end_episode(self, summary: EpisodeSummary) -> None:
        """Send the end of the shown episode, with the stream's times in place of the summary's."""
        self._pace.begin()
        summary = summary._replace(start_time_ns=self._start_ns, end_time_ns=self._next_ns)
        self._send_motion([])
        self._log.write_episodes([summary])
        self._sink.write_messages(self._log.end_messages(summary))
        failed = self._log.metadata.is_failure(summary.reason)
        self._tracks.end(summary.episode, summary.total_reward, failed=failed)
        if TRACKS in self._topics:
            self._emit(TRACKS, self._next_ns, marker_array(self._tracks.shapes()))
        self._pace.end()

    def wants_metrics(self) -> bool:
        """Return whether metrics are due and a viewer subscribes; if so, start the frame timer."""
        now_s = self._pace.clock()
        if now_s < self._metrics_at_s or not self._sink.has_viewers():
            return False
        self._metrics_at_s = now_s + self._pace.period_s
        self._pace.begin()
        return True

    def show_metrics(self, metrics: Mapping[str, float]) -> None:
        """Send the learner's metrics now. NaN replaces missing metrics."""
        data = telemetry_message([metrics.get(name, math.nan) for name in self._training])
        self._sink.send(self._topics[TRAINING_TOPIC], time.time_ns(), data)
        self._pace.pause()

    def layout(self) -> dict[str, Any]:
        """Return the layout that shows the topics of the stream; see `layout.layout_of`."""
        return layout_of(
            self._log.metadata,
            sorted((LOG_TOPIC, PHASE_TOPIC, *self._topics)),
            self._shown.telemetry_names,
            self._shown.follow_frame,
            self._training,
        )

    def on_subscribe(self, client: Any, channel: Any) -> None:
        """Send the current scene again, because the new viewer needs it."""
        self._sink.welcome()

    def close(self) -> None:
        """Send the messages that are due, and disconnect all viewers."""
        self._sink.close()
        super().close()

    def _send_scene(self, source: SceneSource, *, is_shown: bool) -> None:
        """Send the poses of coordinate frames and, if `is_shown` is set, the shapes."""
        time_ns = self._time_ns
        if self._steps_shown == 0:
            self._send_static(source, time_ns)
        frames = source.frames()
        inner: Sequence[tuple[float, Sequence[Frame]]] = ()
        if isinstance(source, MotionSource) and self._step_ns >= _SHORTEST_MOTION_NS:
            inner = source.motion()
        between = [(time_ns - round(s / self._speed * 1e9), each) for s, each in inner]
        self._send_motion([*between, (time_ns, frames)])
        if frames and self._tracks.add(frames[0].position):
            self._emit(MAP, time_ns, self._shown.map(source, self._tracks))
        if is_shown:
            self._emit(SCENE, time_ns, marker_array(source.scene()))

    def _send_motion(self, moments: Sequence[Moment]) -> None:
        """Send the poses of coordinate frames from the previous step to the current step."""
        if self._moment is not None:
            self._emit(
                TF, self._moment[0], motion_transforms([self._moment, *moments], thins=False)
            )
        self._moment = moments[-1] if moments else None

    def _send_static(self, source: SceneSource, time_ns: int) -> None:
        """Send the static shapes and coordinate frames if they have changed."""
        shapes = source.static_scene()
        if shapes is not self._static_shapes:
            self._static_shapes = shapes
            self._emit(SCENE_STATIC, time_ns, marker_array(shapes))
            self._emit(TF_STATIC, time_ns, transforms(source.static_frames(), 0))

    def _emit(self, topic: str, time_ns: int, data: bytes) -> None:
        self._sink.write_messages([(self._topics[topic], time_ns, data)])

    def _send_step(self, step: LiveStep) -> None:
        """Send the transition as messages on the same topics as in a log."""
        columns: dict[str, Any] = {
            "reward": step.reward,
            self._log.behavior.name: step.behavior,
            "action": as_declared(step.action, self._log.action),
        }
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
