"""Writes the topics that only viewers read, beside the transitions and under the same times.

/scene, /scene/static   shapes: those that move, at most five times a second and at each episode's
                        start and end; those that do not, when an episode's differ from the one's
                        before. A viewer that jumps into the file fetches the last message of each
                        topic, and that is all there is to see
/tf, /tf_static         frames: at each step, and likewise
/telemetry              named numbers to plot: the environment's own, and the return so far
/camera/depth           metric depth, millimetres
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from operator import itemgetter

from mcaprl.recorder.format.log_writer import LogTopics
from mcaprl.recorder.format.schema import telemetry_message, telemetry_schema
from mcaprl.recorder.format.writing import HoldSignals
from mcaprl.recorder.record.layout import RETURN_SO_FAR
from mcaprl.recorder.record.scene import (
    DepthSource,
    SceneSource,
    Shape,
    TelemetrySource,
    depth_millimetres,
    marker_array,
    transforms,
)
from mcaprl.recorder.record.step_rows import ImageColumn

SCENE, SCENE_STATIC = "/scene", "/scene/static"
TF, TF_STATIC, TELEMETRY, DEPTH = "/tf", "/tf_static", "/telemetry", "/camera/depth"
# Display messages are written when this much has gathered, or the episode ends.
_CHUNK_BYTES = 2**20
# Bodies move with their frames at each step; what else moves is drawn anew no sooner than this.
_SCENE_PERIOD_NS = 200_000_000


class Display:
    """Collects an episode's display messages and writes them in chunks of their own."""

    def __init__(
        self,
        log: LogTopics,
        source: object,
        *,
        scene: bool,
        camera: bool,
    ) -> None:
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
        if camera and not isinstance(source, DepthSource):
            warnings.warn("the environment has no depth camera to record", stacklevel=3)
        camera = camera or bool(log.image_leaves)
        self._depth = source if camera and isinstance(source, DepthSource) else None
        self._depth_images: ImageColumn | None = None
        self.shows_steps = any((self._scene, self._telemetry, self._depth))
        self._channels: dict[str, int] = {}
        self._is_announced = False
        self._static: dict[str, bytes] = {}
        # Shapes that were not drawn, for the next ones may be due: those at an episode's end are.
        self._held: tuple[int, Sequence[Shape]] | None = None
        self.telemetry_names: tuple[str, ...] = ()
        self.follow_frame = ""

    @property
    def topics(self) -> tuple[str, ...]:
        """The topics that are written; known once the first episode has begun."""
        return (*self._channels, *((DEPTH,) if self._depth_images else ()))

    def begin(self, start_ns: int, step_ns: int) -> None:
        """Show an episode's start; the environment has just been reset.

        Args:
            start_ns: log_time of the first observation.
            step_ns: from one to the next.
        """
        self._start_ns, self._step_ns = start_ns, step_ns
        self._return_so_far = 0.0
        self._steps_per_scene = max(1, _SCENE_PERIOD_NS // step_ns)
        if not self._is_announced:
            self._announce()
            self._is_announced = True
        if self._scene is not None:
            self._emit_changed(SCENE_STATIC, start_ns, marker_array(self._scene.static_scene()))
            self._emit_changed(TF_STATIC, start_ns, transforms(self._scene.static_frames(), 0))
        if self._depth_images is not None:
            self._depth_images.begin(start_ns, step_ns)

    def observe(self, step: int, reward: float) -> None:
        """Show the environment as it is after `step` steps, if anything of it can be shown.

        Args:
            step: from the episode's start.
            reward: of the last one; 0 at the start.
        """
        self._return_so_far += reward
        time_ns = self._start_ns + step * self._step_ns
        if self._scene is not None:
            self._held = (time_ns, self._scene.scene())
            if step % self._steps_per_scene == 0:
                self._draw_held()
            self._emit(TF, time_ns, transforms(self._scene.frames(), time_ns))
        if self._telemetry is not None:
            values = {RETURN_SO_FAR: self._return_so_far, **self._telemetry.telemetry()}
            numbers = [values.get(name, math.nan) for name in self.telemetry_names]
            self._emit(TELEMETRY, time_ns, telemetry_message(numbers))
        if self._depth is not None and self._depth_images is not None:
            if step >= self._depth_images.full_at:
                with HoldSignals():
                    self._depth_images.flush(step)
            millimetres = depth_millimetres(self._depth.depth_image_m())
            self._depth_images.keep(millimetres)

    def end(self, steps: int) -> None:
        """Write what has gathered in an episode of so many steps."""
        self._draw_held()
        self._flush_messages()
        if self._depth_images is not None:
            self._depth_images.flush(steps + 1)

    def clear(self) -> None:
        """Forget what has gathered."""
        if self._messages:
            # What does not move may have been among them.
            self._static = {}
        self._messages, self._bytes, self._held = [], 0, None

    def forget_what_stands(self) -> None:
        """Show again what does not move, since another file begins."""
        self._static = {}

    def _announce(self) -> None:
        types: dict[str, str] = {}
        if self._scene is not None:
            self.follow_frame = next((frame.name for frame in self._scene.frames()), "")
            types |= dict.fromkeys((SCENE, SCENE_STATIC), "visualization_msgs/msg/MarkerArray")
            types |= dict.fromkeys((TF, TF_STATIC), "tf2_msgs/msg/TFMessage")
        self._channels = {
            topic: self._log.add_channel(topic, name) for topic, name in types.items()
        }
        if self._telemetry is not None:
            self.telemetry_names = tuple({RETURN_SO_FAR: 0.0, **self._telemetry.telemetry()})
            name, text = telemetry_schema(self.telemetry_names)
            self._channels[TELEMETRY] = self._log.sink.add_channel(TELEMETRY, name, text)
        if self._depth is not None:
            shape = self._depth.depth_image_m().shape
            self._depth_images = ImageColumn(self._log, DEPTH, shape, "16UC1")

    def _draw_held(self) -> None:
        if self._held is not None:
            time_ns, shapes = self._held
            self._emit(SCENE, time_ns, marker_array(shapes))
            self._held = None

    def _emit_changed(self, topic: str, time_ns: int, data: bytes) -> None:
        if self._static.get(topic) != data:
            self._static[topic] = data
            self._emit(topic, time_ns, data)

    def _emit(self, topic: str, time_ns: int, data: bytes) -> None:
        self._messages.append((self._channels[topic], time_ns, data))
        self._bytes += len(data)
        if self._bytes > _CHUNK_BYTES:
            self._flush_messages()

    def _flush_messages(self) -> None:
        # Topic by topic, each finds what it repeats close by: a tenth of the file less.
        self._messages.sort(key=itemgetter(0))
        self._log.sink.write_messages(self._messages)
        self._messages, self._bytes = [], 0
