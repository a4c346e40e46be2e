"""Shows an environment while it runs to whoever connects: as many frames as there is time for.

Viewers find the topics of a log, as `log_writer` and `display` describe them, and one more:

    /rl/training    mcaprl_msgs/msg/Telemetry...    named numbers of the learner: loss, epsilon, ...

Nothing is kept, and nobody is waited for. Times are those of the wall clock: simulated time is no
use where whole episodes are left out. What does not move is told to each new viewer, and again
where it changes.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.recorder.format.episode_summary import EpisodeSummary
from mcaprl.recorder.format.log_writer import LogWriter
from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.format.schema import (
    message_dtype,
    telemetry_message,
    telemetry_schema,
    values_schema,
)
from mcaprl.recorder.format.spaces import observation_leaves
from mcaprl.recorder.format.writing import ENCAPSULATION, McapWriter, message_rows
from mcaprl.recorder.record.display import DEPTH, SCENE, SCENE_STATIC, TELEMETRY, TF, TF_STATIC
from mcaprl.recorder.record.layout import RETURN_SO_FAR, TRAINING_TOPIC, VALUES_TOPIC, layout_of
from mcaprl.recorder.record.scene import (
    DepthSource,
    SceneSource,
    TelemetrySource,
    depth_millimetres,
    marker_array,
    transforms,
)
from mcaprl.recorder.record.step_rows import as_declared
from mcaprl.recorder.viewer.foxglove_server import DEFAULT_PORT, ViewerServer

_SHARE = 0.025
"""Of all time, at most so much is spent on frames."""
_PERIOD_S = 1 / 20
"""Frames do not come faster than this."""
_STATIC_PERIOD_S = 10.0
"""What does not move may be something else by then."""


@dataclass(frozen=True)
class LiveStep:
    """One transition of the environment that is watched, and what its learner made of it.

    Attributes:
        episode: counted from 0.
        step: from the episode's start.
        observation: of the environment's space.
        action: taken there.
        reward: that it brought.
        terminated: whether it ended in a terminal state.
        truncated: whether it cut the episode off.
        behavior_prob: of the action, under the policy that chose it; NaN if unknown.
        epsilon: probability of a random action; NaN if unknown.
        policy_version: updates that the policy has seen.
        values: the fields of `schema.values_schema`; empty if unknown.
        training: numbers of the learner, by the names given to `LiveStream`.
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


class Pace:
    """Tells when there is time for another frame."""

    def __init__(
        self,
        share: float = _SHARE,
        period_s: float = _PERIOD_S,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        """Spend at most `share` of all time, at most once in `period_s`; `clock` gives seconds."""
        self._share, self._period_s, self._clock = share, period_s, clock
        self._next_s = -math.inf
        self._began_s = 0.0
        self._spent_s = 0.0

    def due(self) -> bool:
        """Whether there is time now."""
        return self._clock() >= self._next_s

    def begin(self) -> None:
        """Work on a frame begins, or goes on."""
        self._began_s = self._clock()

    def pause(self) -> None:
        """Work on a frame stops, since the environment is stepped."""
        self._spent_s += self._clock() - self._began_s

    def end(self) -> None:
        """A frame is done."""
        self.pause()
        rest_s = self._spent_s * (1 / self._share - 1)
        self._next_s = self._clock() + max(rest_s, self._period_s - self._spent_s)
        self._spent_s = 0.0


class LiveStream:
    """Frames of one environment, to be asked for in this order: `due`, `look`, step, `show`."""

    def __init__(
        self,
        metadata: LogMetadata,
        source: object,
        training: Sequence[str],
        *,
        name: str = "mcaprl",
        port: int = DEFAULT_PORT,
        pace: Pace | None = None,
    ) -> None:
        """Announce the topics and listen.

        Args:
            metadata: of the environment.
            source: the unwrapped environment, after a reset, with methods of the protocols in
                `scene` or without.
            training: names of numbers of the learner.
            name: that viewers show.
            port: of 127.0.0.1; 0 takes any that is free.
            pace: when there is time for frames.

        Raises:
            MissingExtraError: foxglove-sdk is not installed.
            UsageError: the port is taken.
            SpaceError: a log cannot hold the spaces.
        """
        self._pace = pace or Pace()
        self._viewers = ViewerServer()
        self._log = _LiveLog(self._viewers, metadata)
        self._channels = cast(_Channels, self._log.mcap)
        self._training = tuple(training)
        self._announce(source)
        self._newcomers, self._static_at_s = True, -math.inf
        self._static_shapes: Sequence[Any] | None = None
        self._static: list[tuple[str, bytes]] = []
        if isinstance(source, SceneSource):
            self._standing(source)
        self._time_ns = 0
        self._finished: list[EpisodeSummary] = []
        self._viewers.start(name, port, self)

    @property
    def url(self) -> str:
        """Where viewers connect."""
        return self._viewers.url

    @property
    def app_url(self) -> str:
        """A link that opens Foxglove with it."""
        return self._viewers.app_url

    def due(self) -> bool:
        """Whether there is time for a frame, and somebody to see it."""
        if not self._pace.due():
            return False
        self._pace.begin()
        if self._channels.has_viewers():
            return True
        self._pace.end()
        return False

    def look(self, source: object, return_so_far: float) -> None:
        """Keep what there is to see before a step; call it when a frame is due."""
        self._time_ns = max(time.time_ns(), self._time_ns + 1)
        seen = []
        if isinstance(source, SceneSource) and SCENE in self._topics:
            seen += self._standing(source)
            seen += [
                (SCENE, marker_array(source.scene())),
                (TF, transforms(source.frames(), self._time_ns)),
            ]
        if isinstance(source, TelemetrySource) and TELEMETRY in self._topics:
            told = {RETURN_SO_FAR: return_so_far, **source.telemetry()}
            numbers = [told.get(name, math.nan) for name in self._telemetry_names]
            seen.append((TELEMETRY, telemetry_message(numbers)))
        if isinstance(source, DepthSource) and self._depth is not None:
            millimetres = np.ascontiguousarray(depth_millimetres(source.depth_image_m()))
            self._depth["payload"]["data"] = millimetres.view(np.uint8).ravel()
        self._seen = seen
        self._pace.pause()

    def show(self, step: LiveStep) -> None:
        """Send what was seen, and the step that was taken there."""
        self._pace.begin()
        time_ns, topics = self._time_ns, self._topics
        self._log.mcap.write_messages([(topics[t], time_ns, data) for t, data in self._seen])
        if self._depth is not None:
            self._send(self._depth, self._log.write_images)
        self._put_step(step)
        numbers = [step.training.get(name, math.nan) for name in self._training]
        training = (topics[TRAINING_TOPIC], time_ns, telemetry_message(numbers))
        self._log.mcap.write_messages([training])
        if self._values is not None and step.values:
            for field_name, value in step.values.items():
                self._values["payload"][field_name] = value
            self._send(self._values, self._log.write_steps)
        finished, self._finished = self._finished, []
        self._log.write_episodes(finished)
        self._pace.end()

    def tell_end(self, summary: EpisodeSummary) -> None:
        """Tell of a finished episode with the next frame; of many, the last one."""
        self._finished = [summary]

    def layout(self) -> dict[str, Any]:
        """What to look at; see `layout.layout_of`."""
        return layout_of(
            self._log.metadata,
            sorted(self._topics),
            self._telemetry_names,
            self._follow_frame,
            self._training,
        )

    def close(self) -> None:
        """Say goodbye to all viewers."""
        self._viewers.close()

    def on_subscribe(self, client: Any, channel: Any) -> None:
        """Show a new viewer what does not move, too."""
        self._newcomers = True

    def on_unsubscribe(self, client: Any, channel: Any) -> None:
        """Nothing to do: messages go to who asks for them."""

    def _standing(self, source: SceneSource) -> list[tuple[str, bytes]]:
        """What does not move, for newcomers; for all, where it may be something else by now."""
        told_s = time.monotonic() - self._static_at_s
        if not (self._newcomers or told_s > _STATIC_PERIOD_S):
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

    def _announce(self, source: object) -> None:
        """Announce all topics, and reserve a row of each that has messages of one length."""
        log = self._log
        types: dict[str, str] = {}
        self._follow_frame = ""
        self._telemetry_names: tuple[str, ...] = ()
        if isinstance(source, SceneSource):
            self._follow_frame = next((frame.name for frame in source.frames()), "")
            types |= dict.fromkeys((SCENE, SCENE_STATIC), "visualization_msgs/msg/MarkerArray")
            types |= dict.fromkeys((TF, TF_STATIC), "tf2_msgs/msg/TFMessage")
        self._topics = {topic: log.add_channel(topic, name) for topic, name in types.items()}
        if isinstance(source, TelemetrySource):
            self._telemetry_names = tuple({RETURN_SO_FAR: 0.0, **source.telemetry()})
            self._add(TELEMETRY, *telemetry_schema(self._telemetry_names))
        self._add(TRAINING_TOPIC, *telemetry_schema(self._training))
        self._depth: NDArray[Any] | None = None
        self._values: NDArray[Any] | None = None
        if isinstance(source, DepthSource):
            shape = source.depth_image_m().shape
            self._depth = log.add_image_topic(DEPTH, shape, "16UC1")[:1].copy()
            self._topics[DEPTH] = int(self._depth["channel_id"][0])
        if isinstance(log.metadata.action_space, spaces.Discrete):
            name, text = values_schema(int(log.metadata.action_space.n))
            self._values = _one_row(text, self._add(VALUES_TOPIC, name, text))
        self._steps, self._learner = log.step_rows()[:1].copy(), log.learner_rows()[:1].copy()
        self._images = {
            leaf: log.add_image_topic(leaf.topic, leaf.shape, leaf.encoding or "")[:1].copy()
            for leaf in log.image_leaves
        }

    def _add(self, topic: str, name: str, text: str) -> int:
        self._topics[topic] = self._log.mcap.add_channel(topic, name, text)
        return self._topics[topic]

    def _put_step(self, step: LiveStep) -> None:
        """Send the transition, as a log would have it."""
        row = self._steps["payload"]
        row["action"] = as_declared(step.action, self._log.action)
        for name in ("reward", "behavior_prob", "episode", "step", "terminated", "truncated"):
            row[name] = getattr(step, name)
        for leaf in observation_leaves(self._log.metadata.observation_space):
            value = np.asarray(leaf.of(step.observation))
            if leaf in self._images:
                self._images[leaf]["payload"]["data"] = np.ascontiguousarray(value).ravel()
                self._send(self._images[leaf], self._log.write_images)
            else:
                row[leaf.name] = as_declared(value, leaf)
        self._send(self._steps, self._log.write_steps)
        learner = self._learner["payload"]
        learner["epsilon"], learner["policy_version"] = step.epsilon, step.policy_version
        self._send(self._learner, self._log.write_steps)

    def _send(self, rows: NDArray[Any], write: Callable[[NDArray[Any]], None]) -> None:
        rows["log_time"] = self._time_ns
        write(rows)


class _Channels:
    """Takes what a log's file would, and passes it on to viewers."""

    def __init__(self, viewers: ViewerServer) -> None:
        self._viewers = viewers
        self._channels: list[Any] = []

    def has_viewers(self) -> bool:
        return any(channel.has_sinks() for channel in self._channels)

    def add_metadata(self, name: str, metadata: dict[str, str]) -> None:
        """Viewers have no use for it."""

    def add_channel(self, topic: str, name: str, text: str, _: Any = None) -> int:
        self._channels.append(self._viewers.add_channel(topic, name, text.encode()))
        return len(self._channels) - 1

    def write_rows(self, rows: NDArray[Any]) -> None:
        for row in rows:
            channel = self._channels[int(row["channel_id"])]
            channel.log(row["payload"].tobytes(), log_time=int(row["log_time"]))

    def write_messages(self, messages: Sequence[tuple[int, int, bytes]]) -> None:
        for channel_id, time_ns, data in messages:
            self._channels[channel_id].log(data, log_time=time_ns)


class _LiveLog(LogWriter):
    """A log's topics and messages without its file."""

    def __init__(self, viewers: ViewerServer, metadata: LogMetadata) -> None:
        self._prepare(metadata)
        self.mcap = cast(McapWriter, _Channels(viewers))
        self._announce(metadata.to_strings())


def _one_row(text: str, channel: int) -> NDArray[Any]:
    dtype = message_dtype(text)
    assert dtype is not None
    rows = message_rows(1, dtype, channel)
    rows["payload"]["encapsulation"] = ENCAPSULATION
    return rows
