"""Topics for viewers, with the same log times as the transitions.

/scene                  moving shapes, at most ten times a second, and at episode starts and ends
/scene/static           static shapes, if they changed since the previous episode
/scene/map              route, vehicle and its track in this episode, for a view from above, written
                        when the track is a sixteenth longer
/scene/tracks           tracks of the episodes so far, written at the ends of episodes
/tf                     poses of the moving frames at and between the steps; each pose has its own
                        stamp
/tf_static              static frames, if they changed since the previous episode
/telemetry              numbers to plot: the environment's telemetry and the return so far
/camera/depth           metric depth in millimeters
/camera/camera_info     intrinsics of the depth camera, once
/camera/image           video of what the environment renders, with `camera="h264"`

After a seek, a viewer needs only the latest message of each scene topic.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from operator import itemgetter
from typing import Any

import gymnasium as gym

from mcaprl.recorder.format.log_writer import LogTopics
from mcaprl.recorder.format.messages import EpisodeSummary
from mcaprl.recorder.format.schema import (
    RETURN_SO_FAR,
    TELEMETRY_TOPIC,
    telemetry_message,
    telemetry_schema,
)
from mcaprl.recorder.format.video_messages import VIDEO_TEXT, VIDEO_TYPE
from mcaprl.recorder.format.writing import HoldSignals
from mcaprl.recorder.record.camera import VIDEO, VIDEO_PERIOD_NS, VideoEncoder, rendered
from mcaprl.recorder.record.layout import AROUND_M
from mcaprl.recorder.record.scene import (
    DepthSource,
    Frame,
    Moment,
    MotionSource,
    PinholeSource,
    SceneSource,
    Shape,
    TelemetrySource,
    Tracks,
    camera_info,
    depth_millimeters,
    map_shapes,
    marker_array,
    motion_transforms,
    transforms,
)
from mcaprl.recorder.record.step_rows import ImageColumn

SCENE, SCENE_STATIC, TRACKS = "/scene", "/scene/static", "/scene/tracks"
MAP = "/scene/map"
TF, TF_STATIC, TELEMETRY = "/tf", "/tf_static", TELEMETRY_TOPIC
DEPTH, CAMERA_INFO = "/camera/depth", "/camera/camera_info"
# Buffered display messages are written when their total size exceeds this number of bytes, and at
# the end of an episode.
_CHUNK_BYTES = 2**20
# The tracks are written again only after other display messages were written, with a total size of
# at least this many times the size of the tracks.
_BYTES_PER_TRACKS = 4
# Period at which moving shapes are written, simulated time. Shapes that are fixed to a moving frame
# follow this frame at each step.
_SCENE_PERIOD_NS = 100_000_000


class ShownTopics:
    """The scene and telemetry topics of an environment, whose channels are added to a log."""

    def __init__(self, log: LogTopics, source: object) -> None:
        """Add a channel for each topic that `source` provides; `source` must have been reset."""
        types: dict[str, str] = {}
        self.telemetry_names: tuple[str, ...] = ()
        self.follow_frame = ""  # Frame that the 3D view moves with; empty for none
        self._world_m = log.metadata.view.get("world_m", AROUND_M)
        if isinstance(source, SceneSource):
            self.follow_frame = next((frame.name for frame in source.frames()), "")
            types |= dict.fromkeys(
                (SCENE, SCENE_STATIC, TRACKS, MAP), "visualization_msgs/msg/MarkerArray"
            )
            types |= dict.fromkeys((TF, TF_STATIC), "tf2_msgs/msg/TFMessage")
        self.channels = {topic: log.add_channel(topic, name) for topic, name in types.items()}
        if isinstance(source, TelemetrySource):
            self.telemetry_names = tuple({RETURN_SO_FAR: 0.0, **source.telemetry()})
            name, text = telemetry_schema(self.telemetry_names)
            self.channels[TELEMETRY] = log.sink.add_channel(TELEMETRY, name, text)

    def map(self, source: SceneSource, tracks: Tracks) -> bytes:
        """Return a message of `/scene/map`."""
        return marker_array(map_shapes(source, self.follow_frame, self._world_m, tracks))

    def telemetry(self, source: TelemetrySource, return_so_far: float) -> bytes:
        """Return a message of `/telemetry`."""
        values = {RETURN_SO_FAR: return_so_far, **source.telemetry()}
        return telemetry_message([values.get(name, math.nan) for name in self.telemetry_names])


class Display:
    """Buffer of the display messages of an episode, which are written in separate chunks."""

    def __init__(
        self,
        log: LogTopics,
        source: object,
        *,
        scene: bool,
        camera: bool,
        rendering: gym.Env[Any, Any] | None = None,
    ) -> None:
        """Select the topics to record."""
        # The depth camera is also recorded if observations have images.
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
        self._camera = b""
        self._rendering, self._video = rendering, None if rendering is None else VideoEncoder()
        self.shows_steps = any((self._scene, self._telemetry, self._depth, self._rendering))
        self._shown: ShownTopics | None = None
        self._tracks, self._bytes_since_tracks, self._tracks_bytes = Tracks(), 0, 0
        self._static: dict[str, bytes] = {}
        # Latest static shapes and their message.
        self._static_scene: tuple[Sequence[Shape], bytes] = ((), marker_array(()))
        # Latest shapes that are not in a message yet. If no later message contains them, they are
        # written at the end of the episode.
        self._pending: tuple[int, Sequence[Shape]] | None = None
        # Frames at the latest step. They are written at the next step, in one message with all
        # poses between the two steps.
        self._moment: Moment | None = None

    @property
    def shown(self) -> ShownTopics:
        """The scene and telemetry topics. They are available after the first call of `begin`."""
        assert self._shown is not None, "no episode has begun"
        return self._shown

    @property
    def topics(self) -> tuple[str, ...]:
        """Names of all display topics. They are known after the first call of `begin`."""
        return (*self.shown.channels, *((DEPTH,) if self._depth_images else ()))

    def begin(self, start_ns: int, step_ns: int) -> None:
        """Begin an episode at the log_time `start_ns`; call this after the environment's reset."""
        self._start_ns, self._step_ns = start_ns, step_ns
        self._return_so_far = 0.0
        self._tracks.begin()
        self._steps_per_scene = max(1, _SCENE_PERIOD_NS // step_ns)
        self._steps_per_image = max(1, math.ceil(VIDEO_PERIOD_NS / step_ns))
        if self._shown is None:
            self._shown = ShownTopics(self._log, self._source)
            if self._depth is not None:
                shape = self._depth.depth_image_m().shape
                self._depth_images = ImageColumn(self._log, DEPTH, shape, "16UC1")
                if isinstance(self._depth, PinholeSource):
                    self._camera = camera_info(self._depth.depth_focal_px(), shape)
                    channel = self._log.add_channel(CAMERA_INFO, "sensor_msgs/msg/CameraInfo")
                    self.shown.channels[CAMERA_INFO] = channel
            if self._rendering is not None:
                channel = self._log.sink.add_channel(VIDEO, VIDEO_TYPE, VIDEO_TEXT)
                self.shown.channels[VIDEO] = channel
        if self._rendering is not None:
            self._video = VideoEncoder()
        if self._scene is not None:
            self._emit_changed(SCENE_STATIC, start_ns, self._encode_static(self._scene))
            self._emit_changed(TF_STATIC, start_ns, transforms(self._scene.static_frames(), 0))
        if self._depth_images is not None:
            self._depth_images.begin(start_ns, step_ns)
        if self._camera:
            self._emit_changed(CAMERA_INFO, start_ns, self._camera)

    def observe(self, step: int, reward: float) -> None:
        """Add the display messages for the state after `step` steps, with the last reward."""
        self._return_so_far += reward
        time_ns = self._start_ns + step * self._step_ns
        if self._scene is not None:
            self._pending = (time_ns, self._scene.scene())
            if step % self._steps_per_scene == 0:
                self._draw_pending()
            frames = self._scene.frames()
            self._emit_motion(time_ns, frames)
            if frames and self._tracks.add(frames[0].position):
                self._emit(MAP, time_ns, self.shown.map(self._scene, self._tracks))
        if self._telemetry is not None:
            message = self.shown.telemetry(self._telemetry, self._return_so_far)
            self._emit(TELEMETRY, time_ns, message)
        if self._video is not None and step % self._steps_per_image == 0:
            self._emit(VIDEO, time_ns, self._video.encode(rendered(self._rendering), time_ns))
        if self._depth is not None and self._depth_images is not None:
            if step >= self._depth_images.full_at:
                with HoldSignals():
                    self._depth_images.flush(step)
            self._depth_images.append(depth_millimeters(self._depth.depth_image_m()))

    def end(self, summary: EpisodeSummary) -> None:
        """Write the messages of an episode that has ended."""
        self._draw_pending()
        if self._moment is not None:
            self._emit(TF, self._moment[0], motion_transforms([self._moment]))
            self._moment = None
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
        self._messages, self._bytes, self._pending, self._moment = [], 0, None, None

    def resend_static(self) -> None:
        """Write all static messages again in the next episode."""
        self._static = {}

    def _draw_pending(self) -> None:
        if self._pending is not None:
            time_ns, shapes = self._pending
            self._emit(SCENE, time_ns, marker_array(shapes))
            self._pending = None

    def _emit_motion(self, time_ns: int, frames: Sequence[Frame]) -> None:
        """Add the poses of the coordinate frames since the previous step, up to `time_ns`."""
        end = (time_ns, frames)
        if self._moment is not None:
            inner = self._motion.motion() if self._motion is not None else ()
            # The recording's step may differ from that of the sim.
            ns_per_s = self._step_ns / getattr(self._motion, "step_duration_s", self._step_ns / 1e9)
            between = [(time_ns - round(left_s * ns_per_s), each) for left_s, each in inner]
            self._emit(TF, self._moment[0], motion_transforms([self._moment, *between, end]))
        self._moment = end

    def _emit_tracks(self, summary: EpisodeSummary) -> None:
        """Write the tracks so far, but limit their share of the log if episodes are short."""
        failed = self._log.metadata.is_failure(summary.reason)
        self._tracks.end(summary.episode, summary.total_reward, failed=failed)
        # Encoding the tracks takes longer than encoding the rest of a short episode. Their message
        # seldom becomes shorter, so its last size shows whether it can be written.
        if self._bytes_since_tracks < _BYTES_PER_TRACKS * self._tracks_bytes:
            return
        data = marker_array(self._tracks.shapes())
        self._tracks_bytes = len(data)
        if self._bytes_since_tracks >= _BYTES_PER_TRACKS * len(data):
            self._emit(TRACKS, summary.end_time_ns, data)
            self._bytes_since_tracks = 0

    def _encode_static(self, scene: SceneSource) -> bytes:
        """Return the message of the static shapes, which are usually those of the last episode."""
        shapes = scene.static_scene()
        # The same list may contain other shapes than before.
        if not (isinstance(shapes, tuple) and shapes is self._static_scene[0]):
            self._static_scene = shapes, marker_array(shapes)
        return self._static_scene[1]

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
        if not self._messages:
            return
        # Sorting by topic puts similar messages next to each other, which saves 10% of file size.
        self._messages.sort(key=itemgetter(0))
        # The static scene is written as a separate chunk, which is compressed at a higher level.
        static = self.shown.channels.get(SCENE_STATIC)
        # A signal must not interrupt the writes, because some messages would be written twice.
        with HoldSignals():
            for alone in (True, False):
                part = [message for message in self._messages if (message[0] == static) == alone]
                self._log.sink.write_messages(part)
            self._messages, self._bytes = [], 0
