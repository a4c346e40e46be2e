"""Topics that only viewers read, with the same log times as the transitions.

/scene, /scene/static   shapes: moving ones at most five times a second and at each episode's start
                        and end; static ones when they differ from the previous episode's. A viewer
                        that seeks needs only the latest message of each topic
/scene/tracks           tracks of the episodes so far, written at the ends of episodes
/tf, /tf_static         frames: moving ones at each step, and at the moments within the step that
                        the environment provides; static ones as above
/telemetry              numbers to plot: the environment's telemetry and the return so far
/camera/depth           metric depth in millimeters
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from operator import itemgetter

from mcaprl.recorder.format.episode_summary import EpisodeSummary
from mcaprl.recorder.format.log_writer import LogTopics
from mcaprl.recorder.format.schema import telemetry_message, telemetry_schema
from mcaprl.recorder.format.writing import HoldSignals
from mcaprl.recorder.record.layout import RETURN_SO_FAR
from mcaprl.recorder.record.scene import (
    DepthSource,
    MotionSource,
    SceneSource,
    Shape,
    TelemetrySource,
    depth_millimeters,
    marker_array,
    transforms,
)
from mcaprl.recorder.record.step_rows import ImageColumn
from mcaprl.recorder.record.tracks import Tracks

SCENE, SCENE_STATIC, TRACKS = "/scene", "/scene/static", "/scene/tracks"
TF, TF_STATIC, TELEMETRY, DEPTH = "/tf", "/tf_static", "/telemetry", "/camera/depth"
# Display messages are written when they exceed this size or the episode ends.
_CHUNK_BYTES = 2**20
# Tracks are written again when the messages since the last ones have this many times their size.
_BYTES_PER_TRACKS = 4
# Bodies move with their frames at each step; other moving shapes are redrawn after this time.
_SCENE_PERIOD_NS = 200_000_000


class ShownTopics:
    """The scene and telemetry topics of an environment, announced to a log.

    Attributes:
        channels: Channel id of each topic.
        telemetry_names: Fields of `/telemetry`.
        follow_frame: Frame that the 3D view moves with; empty for none.
    """

    def __init__(self, log: LogTopics, source: object) -> None:
        """Announce the topics that `source`, an environment after `reset`, provides."""
        types: dict[str, str] = {}
        self.telemetry_names: tuple[str, ...] = ()
        self.follow_frame = ""
        if isinstance(source, SceneSource):
            self.follow_frame = next((frame.name for frame in source.frames()), "")
            types |= dict.fromkeys(
                (SCENE, SCENE_STATIC, TRACKS), "visualization_msgs/msg/MarkerArray"
            )
            types |= dict.fromkeys((TF, TF_STATIC), "tf2_msgs/msg/TFMessage")
        self.channels = {topic: log.add_channel(topic, name) for topic, name in types.items()}
        if isinstance(source, TelemetrySource):
            self.telemetry_names = tuple({RETURN_SO_FAR: 0.0, **source.telemetry()})
            name, text = telemetry_schema(self.telemetry_names)
            self.channels[TELEMETRY] = log.sink.add_channel(TELEMETRY, name, text)

    def telemetry(self, source: TelemetrySource, return_so_far: float) -> bytes:
        """Return a message of `/telemetry`."""
        values = {RETURN_SO_FAR: return_so_far, **source.telemetry()}
        return telemetry_message([values.get(name, math.nan) for name in self.telemetry_names])


class Display:
    """The display messages of an episode, collected and written in separate chunks."""

    def __init__(self, log: LogTopics, source: object, *, scene: bool, camera: bool) -> None:
        """Select the topics to record.

        Args:
            log: Log to write to.
            source: Unwrapped environment, which implements any of the protocols in `scene.py`.
            scene: Whether to record shapes, frames and telemetry.
            camera: Whether to record the depth camera, which is always recorded if observations
                contain images.
        """
        self._log, self._source = log, source if scene else None
        self._messages: list[tuple[int, int, bytes]] = []
        self._bytes = 0
        self._scene = source if scene and isinstance(source, SceneSource) else None
        self._telemetry = source if scene and isinstance(source, TelemetrySource) else None
        self._motion = source if scene and isinstance(source, MotionSource) else None
        if camera and not isinstance(source, DepthSource):
            warnings.warn("the environment has no depth camera to record", stacklevel=3)
        camera = camera or bool(log.image_leaves)
        self._depth = source if camera and isinstance(source, DepthSource) else None
        self._depth_images: ImageColumn | None = None
        self.shows_steps = any((self._scene, self._telemetry, self._depth))
        self._shown: ShownTopics | None = None
        self._tracks, self._bytes_since_tracks = Tracks(), 0
        self._static: dict[str, bytes] = {}
        # Latest shapes that are not drawn yet; they are drawn at the end of the episode.
        self._pending: tuple[int, Sequence[Shape]] | None = None

    @property
    def shown(self) -> ShownTopics:
        """The announced scene and telemetry topics; defined after the first `begin`."""
        assert self._shown is not None, "no episode has begun"
        return self._shown

    @property
    def topics(self) -> tuple[str, ...]:
        """Names of all display topics; defined after the first `begin`."""
        return (*self.shown.channels, *((DEPTH,) if self._depth_images else ()))

    def begin(self, start_ns: int, step_ns: int) -> None:
        """Begin an episode, after the environment's reset, at the log_time `start_ns`."""
        self._start_ns, self._step_ns = start_ns, step_ns
        self._return_so_far = 0.0
        self._tracks.begin()
        self._steps_per_scene = max(1, _SCENE_PERIOD_NS // step_ns)
        if self._shown is None:
            self._shown = ShownTopics(self._log, self._source)
            if self._depth is not None:
                shape = self._depth.depth_image_m().shape
                self._depth_images = ImageColumn(self._log, DEPTH, shape, "16UC1")
        if self._scene is not None:
            self._emit_changed(SCENE_STATIC, start_ns, marker_array(self._scene.static_scene()))
            self._emit_changed(TF_STATIC, start_ns, transforms(self._scene.static_frames(), 0))
        if self._depth_images is not None:
            self._depth_images.begin(start_ns, step_ns)

    def observe(self, step: int, reward: float) -> None:
        """Add the display messages after `step` steps, the last of which had this reward."""
        self._return_so_far += reward
        time_ns = self._start_ns + step * self._step_ns
        if self._scene is not None:
            self._pending = (time_ns, self._scene.scene())
            if step % self._steps_per_scene == 0:
                self._draw_pending()
            self._emit_motion(time_ns)
            frames = self._scene.frames()
            self._emit(TF, time_ns, transforms(frames, time_ns))
            if frames:
                self._tracks.add(frames[0].position)
        if self._telemetry is not None:
            message = self.shown.telemetry(self._telemetry, self._return_so_far)
            self._emit(TELEMETRY, time_ns, message)
        if self._depth is not None and self._depth_images is not None:
            if step >= self._depth_images.full_at:
                with HoldSignals():
                    self._depth_images.flush(step)
            self._depth_images.append(depth_millimeters(self._depth.depth_image_m()))

    def end(self, summary: EpisodeSummary) -> None:
        """Write the messages of an episode that has ended."""
        self._draw_pending()
        if self._scene is not None:
            self._emit_tracks(summary)
        self._flush_messages()
        if self._depth_images is not None:
            self._depth_images.flush(summary.length + 1)

    def clear(self) -> None:
        """Drop the messages that are not written yet."""
        if self._messages:
            # The dropped messages may include the static scene.
            self.resend_static()
        self._messages, self._bytes, self._pending = [], 0, None

    def resend_static(self) -> None:
        """Write the static scene again with the next episode, for a new file."""
        self._static = {}

    def _draw_pending(self) -> None:
        if self._pending is not None:
            time_ns, shapes = self._pending
            self._emit(SCENE, time_ns, marker_array(shapes))
            self._pending = None

    def _emit_motion(self, end_ns: int) -> None:
        """Add the frames within the step that ends at the log_time `end_ns`."""
        if self._motion is not None:
            for left_s, frames in self._motion.motion():
                time_ns = end_ns - round(left_s * 1e9)
                self._emit(TF, time_ns, transforms(frames, time_ns))

    def _emit_tracks(self, summary: EpisodeSummary) -> None:
        """Write the tracks so far, unless short episodes would make them most of the log."""
        failed = self._log.metadata.is_failure(summary.reason)
        self._tracks.end(summary.episode, summary.total_reward, failed=failed)
        data = marker_array(self._tracks.shapes())
        if self._bytes_since_tracks >= _BYTES_PER_TRACKS * len(data):
            self._emit(TRACKS, summary.end_time_ns, data)
            self._bytes_since_tracks = 0

    def _emit_changed(self, topic: str, time_ns: int, data: bytes) -> None:
        if self._static.get(topic) != data:
            self._static[topic] = data
            self._emit(topic, time_ns, data)

    def _emit(self, topic: str, time_ns: int, data: bytes) -> None:
        self._messages.append((self.shown.channels[topic], time_ns, data))
        self._bytes += len(data)
        self._bytes_since_tracks += len(data)
        if self._bytes > _CHUNK_BYTES:
            self._flush_messages()

    def _flush_messages(self) -> None:
        # Sorting by topic puts similar messages next to each other, which saves 10% of file size.
        self._messages.sort(key=itemgetter(0))
        self._log.sink.write_messages(self._messages)
        self._messages, self._bytes = [], 0
