"""Writes the topics that only viewers read, beside the transitions and under the same times.

/rosout                 each episode's start and end, for any environment
/scene, /scene/static   shapes; the static ones again at each episode's start, because a viewer
                        that jumps into the file fetches just the last message of each topic
/tf, /tf_static         frames, likewise
/telemetry              named numbers to plot
/camera/depth           metric depth, millimetres
"""

from __future__ import annotations

import struct

from mcaprl.recorder import messages
from mcaprl.recorder.log_writer import EpisodeSummary, LogWriter
from mcaprl.recorder.rows import ImageColumn
from mcaprl.recorder.scene import (
    DepthSource,
    SceneSource,
    TelemetrySource,
    depth_millimetres,
    marker_array,
    transforms,
)
from mcaprl.recorder.schema import ENCAPSULATION, telemetry_schema

ROSOUT, SCENE, SCENE_STATIC = "/rosout", "/scene", "/scene/static"
TF, TF_STATIC, TELEMETRY, DEPTH = "/tf", "/tf_static", "/telemetry", "/camera/depth"
_INFO = 20
# Display messages are written when this much has gathered, or the episode ends.
_CHUNK_BYTES = 2**20


class Display:
    """Collects an episode's display messages and writes them in chunks of their own."""

    def __init__(self, log: LogWriter, source: object, *, scene: bool, camera: bool) -> None:
        """Prepare for `source`, an unwrapped environment, with methods of the protocols or without.

        Args:
            log: to write to.
            source: what is to be shown.
            scene: whether to record shapes, frames and telemetry.
            camera: whether to record the depth camera; it is anyway if observations are images.
        """
        self._log = log
        self._messages: list[tuple[int, int, bytes]] = []
        self._bytes = 0
        self._scene = source if scene and isinstance(source, SceneSource) else None
        self._telemetry = source if scene and isinstance(source, TelemetrySource) else None
        camera = camera or bool(log.image_leaves)
        self._depth = source if camera and isinstance(source, DepthSource) else None
        self._depth_images: ImageColumn | None = None
        self._channels: dict[str, int] = {}
        self.telemetry_names: tuple[str, ...] = ()
        self.follow_frame = ""

    @property
    def topics(self) -> tuple[str, ...]:
        """The topics that are written; known once the first episode has begun."""
        return (*self._channels, *((DEPTH,) if self._depth_images else ()))

    def begin(self, time_ns: int, episode: int, policy: str) -> None:
        """Show an episode's start; the environment has just been reset."""
        if not self._channels:
            self._announce()
        self._say(time_ns, f"episode {episode} begins" + (f", {policy} acts" if policy else ""))
        if self._scene is not None:
            self._emit(SCENE_STATIC, time_ns, marker_array(self._scene.static_scene(), time_ns))
            self._emit(TF_STATIC, time_ns, transforms(self._scene.static_frames(), time_ns))
        self.observe(time_ns)

    def observe(self, time_ns: int) -> None:
        """Show the environment as it is at this moment."""
        if self._scene is not None:
            self._emit(SCENE, time_ns, marker_array(self._scene.scene(), time_ns))
            self._emit(TF, time_ns, transforms(self._scene.frames(), time_ns))
        if self._telemetry is not None:
            values = self._telemetry.telemetry()
            numbers = struct.pack(
                f"<I{len(values)}d", ENCAPSULATION, *(values[n] for n in self.telemetry_names)
            )
            self._emit(TELEMETRY, time_ns, numbers)
        if self._depth is not None and self._depth_images is not None:
            self._depth_images.next_row(time_ns)
            millimetres = depth_millimetres(self._depth.depth_image_m())
            self._depth_images.column[self._depth_images.row] = millimetres.view("u1").ravel()

    def end(self, summary: EpisodeSummary) -> None:
        """Tell how an episode ended, and write what has gathered."""
        self._say(
            summary.end_time_ns,
            f"episode {summary.episode} ends after {summary.length} steps:"
            f" {summary.reason}, return {summary.total_reward:.4g}",
        )
        self._flush()

    def clear(self) -> None:
        """Forget what has gathered."""
        self._messages, self._bytes = [], 0
        if self._depth_images is not None:
            self._depth_images.clear()

    def _announce(self) -> None:
        types = {ROSOUT: "rcl_interfaces/msg/Log"}
        if self._scene is not None:
            self.follow_frame = next((frame.name for frame in self._scene.frames()), "")
            types |= dict.fromkeys((SCENE, SCENE_STATIC), "visualization_msgs/msg/MarkerArray")
            types |= dict.fromkeys((TF, TF_STATIC), "tf2_msgs/msg/TFMessage")
        self._channels = {
            topic: self._log.add_channel(topic, name) for topic, name in types.items()
        }
        if self._telemetry is not None:
            self.telemetry_names = tuple(self._telemetry.telemetry())
            name, text = telemetry_schema(self.telemetry_names)
            self._channels[TELEMETRY] = self._log.mcap.add_channel(TELEMETRY, name, text)
        if self._depth is not None:
            shape = self._depth.depth_image_m().shape
            self._depth_images = ImageColumn(self._log, DEPTH, shape, "16UC1")

    def _say(self, time_ns: int, text: str) -> None:
        line = messages.new(
            "rcl_interfaces/msg/Log",
            stamp=messages.stamp(time_ns),
            level=_INFO,
            name="mcaprl",
            msg=text,
            file="",
            function="",
            line=0,
        )
        self._emit(ROSOUT, time_ns, messages.encode(line))

    def _emit(self, topic: str, time_ns: int, data: bytes) -> None:
        self._messages.append((self._channels[topic], time_ns, data))
        self._bytes += len(data)
        if self._bytes > _CHUNK_BYTES:
            self._flush_messages()

    def _flush(self) -> None:
        self._flush_messages()
        if self._depth_images is not None:
            self._depth_images.flush()

    def _flush_messages(self) -> None:
        self._log.mcap.write_messages(self._messages)
        self._messages, self._bytes = [], 0
