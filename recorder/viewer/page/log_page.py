"""The page of one log: data of its episodes, an HTML text without references, and an HTTP server.

The server on 127.0.0.1 answers three kinds of requests: `/` returns the page, `/episode/K` the
packed data of an episode, and a POST to `/label` saves a label. No request names a file. A web page
of another site cannot read the answers, because the server checks the origin and the host name that
browsers send with a request. A label also needs the origin of the page, and the token in the page.

The packed data are compressed by gzip: the length of the header (uint32, little-endian), the
header as JSON, padding to a multiple of 8 bytes, and the arrays. In the header, an array is an
object with its `dtype`, its `shape` and its offset `at` in bytes; each array starts at a multiple
of 8 bytes.
"""

from __future__ import annotations

import base64
import gzip
import hashlib
import json
import math
import re
import secrets
import socket
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from functools import lru_cache, reduce
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl import limits
from mcaprl.errors import LogError, McaprlError, UsageError
from mcaprl.recorder.bags.decoders import decoder_of
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.transitions import Episode
from mcaprl.recorder.dataset.video import Converter, Decoded, VideoDecoder
from mcaprl.recorder.format.messages import LOG_TYPE
from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.format.reading import McapReader, Topic, telemetry_names
from mcaprl.recorder.format.schema import LOG_TOPIC, RETURN_SO_FAR
from mcaprl.recorder.format.spaces import observation_leaves
from mcaprl.recorder.format.video_messages import VIDEO_TYPE
from mcaprl.recorder.record.camera import VIDEO
from mcaprl.recorder.record.display import (
    DEPTH,
    SCENE,
    SCENE_STATIC,
    TELEMETRY,
    TF,
    TF_STATIC,
)
from mcaprl.recorder.record.layout import (
    CAMERA_M,
    DEPTH_M,
    TILT_DEG,
    VALUES_TOPIC,
    is_values_topic,
)
from mcaprl.recorder.record.panels import action_parts, bounded_actions, telemetry_groups
from mcaprl.recorder.source import open_data
from mcaprl.recorder.viewer.foxglove_server import is_loopback
from mcaprl.recorder.viewer.playback import SeenFrame, SeenShape, Track, frames_of, shapes_of
from mcaprl.texts import encodable

_ALIGNMENT = 8


def pack(value: Any) -> bytes:
    """Pack nested dicts and lists of texts, finite numbers and arrays.

    Arrays may have the types uint8, int32, float32 and float64.
    """
    arrays = bytearray()
    header = json.dumps(_without_arrays(value, arrays), allow_nan=False).encode()
    head = len(header).to_bytes(4, "little") + header
    # Level 6 of gzip takes a third of the time of the default level 9.
    return gzip.compress(_padded(head) + arrays, 6, mtime=0)


def _without_arrays(value: Any, arrays: bytearray) -> Any:
    """Append the arrays of a value to `arrays`.

    Return the value with descriptions in their place.
    """
    if isinstance(value, np.ndarray):
        described = {"dtype": value.dtype.name, "shape": value.shape, "at": len(arrays)}
        arrays += _padded(value.astype(value.dtype.newbyteorder("<")).tobytes())
        return described
    if isinstance(value, dict):
        return {key: _without_arrays(part, arrays) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_without_arrays(part, arrays) for part in value]
    return encodable(value) if isinstance(value, str) else value


def _padded(data: bytes) -> bytes:
    return data + bytes(-len(data) % _ALIGNMENT)


def scene_data(track: Track, start_ns: int, end_ns: int) -> dict[str, Any]:
    """Return the scene of an episode.

    Returns:
        `shapes`: all different shapes; see `_Shapes.columns`.
        `static`: (S,) indexes of the static shapes.
        `moments`: times at which the moving shapes change, in seconds from the start, and the
        indexes of the shapes at each time; see `_Moments.columns`.
        `frames`: coordinate frames with their parents and stamped poses.
        `follow`: name of the first moving frame; empty if there is none.
    """
    shapes, moments, static = _Shapes(), _Moments(), np.empty(0, np.int32)
    moving, fixed = list[tuple[int, SeenFrame]](), list[tuple[int, SeenFrame]]()
    latest = list(track.latest(start_ns))
    for time_ns, channel, data in [*latest, *track.between(start_ns + 1, end_ns + 1)]:
        if channel.topic == SCENE_STATIC:
            static = shapes.indexes(shapes_of(data))
        elif channel.topic == SCENE:
            moments.add((time_ns - start_ns) / 1e9, shapes.indexes(shapes_of(data)))
        elif channel.topic == TF:
            moving += frames_of(data)
        elif channel.topic == TF_STATIC:
            fixed += frames_of(data)
    return {
        "shapes": shapes.columns(),
        "static": static,
        "moments": moments.columns(),
        "frames": [*_poses(moving, start_ns), *_poses(fixed, start_ns)],
        "follow": moving[0][1].name if moving else "",
    }


class _Shapes:
    """Table of shapes, in which equal shapes have one row."""

    def __init__(self) -> None:
        self._rows: dict[Any, int] = {}
        self._shapes: list[SeenShape] = []

    def indexes(self, shapes: Iterable[SeenShape]) -> NDArray[np.int32]:
        """Return the row of each shape; add a row for each new shape."""
        return np.array([self._row(shape) for shape in shapes], np.int32)

    def _row(self, shape: SeenShape) -> int:
        key = tuple(
            value.tobytes() if isinstance(value, np.ndarray) else value
            for value in vars(shape).values()
        )
        row = self._rows.setdefault(key, len(self._shapes))
        if row == len(self._shapes):
            self._shapes.append(shape)
        return row

    def columns(self) -> dict[str, Any]:
        """Return columns: texts as lists, and numbers as arrays.

        `numbers` are (N, 11): color, size, position, yaw. The points of shape k are the rows
        `starts[k]` to `starts[k + 1]` of `points`.
        """
        shapes = self._shapes
        numbers = [(*s.color, *s.size, *s.position, s.yaw_rad) for s in shapes]
        points = [np.empty((0, 3)), *(shape.points for shape in shapes)]
        return {
            "kinds": [shape.kind for shape in shapes],
            "frames": [shape.frame for shape in shapes],
            "texts": [shape.text for shape in shapes],
            "numbers": np.array(numbers, np.float32).reshape(-1, 11),
            "points": np.concatenate(points).astype(np.float32),
            "starts": np.cumsum([len(part) for part in points]).astype(np.int32),
        }


class _Moments:
    """Lists of shapes at the times at which they change."""

    def __init__(self) -> None:
        self._times_s: list[float] = []
        self._indexes: list[NDArray[np.int32]] = []

    def add(self, time_s: float, indexes: NDArray[np.int32]) -> None:
        """Add the shapes at a time, which must not be before an earlier added time."""
        self._times_s.append(time_s)
        self._indexes.append(indexes)

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return the times, and the rows of the shapes at each time.

        The rows for time k are `indexes[starts[k] : starts[k + 1]]`.
        """
        indexes = [np.empty(0, np.int32), *self._indexes]
        return {
            "times": np.array(self._times_s, np.float64),
            "starts": np.cumsum([len(part) for part in indexes]).astype(np.int32),
            "indexes": np.concatenate(indexes),
        }


def _poses(stamped: Sequence[tuple[int, SeenFrame]], start_ns: int) -> list[dict[str, Any]]:
    """Return the poses of each coordinate frame in its first parent, with their times.

    A pose is a position and a quaternion.
    """
    found: dict[str, list[tuple[int, SeenFrame]]] = {}
    for stamp_ns, frame in stamped:
        found.setdefault(frame.name, []).append((stamp_ns, frame))
    frames = []
    for name, poses in found.items():
        # The pose at the time of a step is in two messages.
        rows = dict(sorted(poses, key=lambda pose: pose[0]))
        times = np.array([(stamp_ns - start_ns) / 1e9 for stamp_ns in rows], np.float64)
        values = [(*frame.position, *frame.rotation) for frame in rows.values()]
        frames.append(
            {
                "name": name,
                "parent": poses[0][1].parent,
                "times": times,
                "poses": np.array(values, np.float32).reshape(-1, 7),
            }
        )
    return frames


_SCENE_TYPES = {
    SCENE: "visualization_msgs/msg/MarkerArray",
    SCENE_STATIC: "visualization_msgs/msg/MarkerArray",
    TF: "tf2_msgs/msg/TFMessage",
    TF_STATIC: "tf2_msgs/msg/TFMessage",
}
_VALUES_FIELDS = ("q", "policy_action", "value", "advantage", "td_error")
# If the images of one topic are larger than this without compression, some are left out.
_MOST_IMAGE_BYTES = 2**26
_MOST_CHANNELS = 4
_MOST_EDGE = 320
"""Width or height in pixels to which larger frames of a video are reduced."""


class LogPage:
    """Data of one log, read episode by episode.

    Attributes:
        name: Name of the file.
        dataset: Dataset of the log, without observations.
    """

    def __init__(self, path: Path) -> None:
        """Read the summaries of the episodes."""
        self.name = path.name
        self.dataset = open_data(path, columns=[])
        self._path, self._reader = path, McapReader(path)
        self._metadata = LogMetadata.from_strings(self.dataset.metadata)
        typed = [
            topic for topic, name in _SCENE_TYPES.items() if _type_of(self._reader, topic) == name
        ]
        self._scene = Track(self._reader, topics=typed) if SCENE in typed else None
        self._reading = threading.Lock()

    def index(self, only: int | None = None, **settings: Any) -> bytes:
        """Return the packed description of the log and its episodes."""
        view = self._metadata.view
        episodes = self.dataset.episodes[slice(None) if only is None else slice(only, only + 1)]
        reasons = sorted({episode.reason for episode in episodes})
        number_of = {reason: number for number, reason in enumerate(reasons)}
        actions = self.dataset.action_names
        return pack(
            {
                "name": self.name,
                "environment": self.dataset.env_id,
                "policies": sorted({e.policy for e in episodes if e.policy}),
                "actions": [actions[key] for key in sorted(actions)],
                "first_action": min(actions, default=0),
                "parts": list(action_parts(self._metadata)),
                "limits": {one.name: list(one.ends) for one in bounded_actions(self._metadata)},
                "distance_m": _finite(view.get("distance_m"), CAMERA_M),
                "tilt_deg": _finite(view.get("tilt_deg"), TILT_DEG),
                "reasons": reasons,
                "failures": [self._metadata.is_failure(reason) for reason in reasons],
                "numbers": _column([e.index for e in episodes], np.int32),
                "reason": _column([number_of[e.reason] for e in episodes], np.int32),
                "returns": _column([e.total_reward for e in episodes], np.float64),
                "lengths": _column([e.length for e in episodes], np.int32),
                **settings,
            }
        )

    def episode(self, number: int) -> bytes:
        """Return the packed data of an episode."""
        with self._reading:
            dataset = open_data(self._path, episodes=number)
            episode = dataset.episodes[0]
            start_ns, end_ns = int(episode.log_time_ns[0]), int(episode.log_time_ns[-1])
            scene = self._scene and scene_data(self._scene, start_ns, end_ns)
            notes, rendered = list[str](), list[dict[str, Any]]()
            try:
                rendered += self._rendered_images(episode)
            except (LogError, UsageError) as error:
                notes.append(f"the video of {VIDEO} cannot be shown: {error}")
            return pack(
                {
                    "times": _seconds(episode.log_time_ns, start_ns),
                    "rewards": episode.rewards.astype(np.float32),
                    "actions": _rows(episode.actions).T.astype(np.float32),
                    "is_discrete": isinstance(dataset.action_space, spaces.Discrete),
                    "plots": list(self._plots(dataset, episode)),
                    # Policies without Q-values are last.
                    "policies": sorted(
                        self._policies(episode), key=lambda one: bool(np.isnan(one["q"]).all())
                    ),
                    "images": [
                        *rendered,
                        *_observed_images(dataset),
                        *self._depth_images(episode),
                    ],
                    "notes": notes,
                    "lines": self._lines(start_ns, end_ns),
                    "scene": scene,
                }
            )

    def _plots(self, dataset: Dataset, episode: Episode) -> Iterator[dict[str, Any]]:
        """Yield plots: a title, the names of the series, and their values (series, T or T + 1)."""
        leaves = observation_leaves(dataset.observation_space)
        for leaf in leaves:
            if leaf.encoding is None:
                values = _rows(_at(dataset.frames, leaf.path))
                names = list(dataset.observation_names) if len(leaves) == 1 else []
                yield _plot("/".join(("observation", *leaf.path)), names, values)
        names = [name for name in telemetry_names(self._reader) if name != RETURN_SO_FAR]
        telemetry = self._at_steps(TELEMETRY, episode.log_time_ns) if names else {}
        for title, group in telemetry_groups([n for n in names if n in telemetry]).items():
            yield _plot(title, list(group), np.column_stack([telemetry[name] for name in group]))
        infos = {
            name: np.ma.filled(info.astype(np.float64), np.nan)
            for name, info in episode.infos.items()
            if info.ndim == 1 and info.dtype.kind in "biuf"
        }
        if infos:
            yield _plot("info", list(infos), np.column_stack(list(infos.values())))
        if not np.isnan(episode.behavior).all():
            field = episode.behavior_field
            yield _plot(f"{field.what} of the action", [field.name], episode.behavior)

    def _policies(self, episode: Episode) -> Iterator[dict[str, Any]]:
        """Yield the values of each policy that annotated the log."""
        topics = {channel.topic for channel in self._reader.channels.values()}
        for topic in sorted(filter(is_values_topic, topics)):
            columns = self._at_steps(topic, episode.log_time_ns[:-1])
            if set(_VALUES_FIELDS) <= set(columns):
                name = topic.removeprefix(VALUES_TOPIC).lstrip("/")
                fields = [*_VALUES_FIELDS, "preference"]
                yield {"name": name, **{f: columns[f].T for f in fields if f in columns}}

    def _depth_images(self, episode: Episode) -> Iterator[dict[str, Any]]:
        """Yield the depth images as numbers from 1 (near) to 255 (far). 0 means unknown."""
        if _type_of(self._reader, DEPTH) != "sensor_msgs/msg/Image":
            return
        topic = Topic(self._reader, DEPTH)
        # A robot's own images have other times than the steps.
        times_ns = episode.log_time_ns
        found = np.flatnonzero((topic.times >= times_ns[0]) & (topic.times <= times_ns[-1]))
        if not len(found):
            return
        found = found[np.argsort(topic.times[found], kind="stable")]
        latest = np.searchsorted(topic.times[found], times_ns, side="right") - 1
        seen, steps = np.unique(np.maximum(latest, 0), return_index=True)
        found, steps = found[seen], steps.astype(np.int32)
        first = topic.read(("height", "width", "encoding"), found[:1])
        if first["encoding"][0] not in ("16UC1", b"16UC1"):
            return
        height, width = int(first["height"][0]), int(first["width"][0])
        every = _thinning(len(found) * height * width)
        data = topic.read(("data",), found[::every])["data"]
        depth_m = data.view("<u2").reshape(-1, height, width) / np.float32(1000)
        view = self._metadata.view
        low, high = (
            _finite(view.get(name), default)
            for name, default in zip(("depth_min_m", "depth_max_m"), DEPTH_M, strict=True)
        )
        share = np.clip((depth_m - low) / max(high - low, 1e-6), 0, 1)
        coded = np.where(depth_m > 0, 1 + np.rint(share * 254), 0).astype(np.uint8)
        title = f"depth, {low:g} to {high:g} m"
        yield {
            "title": title,
            "is_depth": True,
            "steps": steps[::every],
            "pixels": coded[..., None],
        }

    def _rendered_images(self, episode: Episode) -> Iterator[dict[str, Any]]:
        """Yield the video of the environment's images, at most `_MOST_EDGE` wide and high."""
        if _type_of(self._reader, VIDEO) != VIDEO_TYPE:
            return
        channel, times_ns = self._reader.channels_of(VIDEO)[0], episode.log_time_ns
        packets: list[tuple[int, bytes]] = []
        for part in self._reader.message_ranges(channel):
            logged_ns = part.index["log_time"].astype(np.int64)
            index = part.index[(logged_ns >= times_ns[0]) & (logged_ns <= times_ns[-1])]
            if len(index):
                records = self._reader.records_of(part)
                for time_ns, offset in index.tolist():
                    data = self._reader.message(records, channel, time_ns, offset)
                    packets.append((time_ns, data))
        schema = self._reader.schema_of(channel)
        messages = decoder_of(channel.message_encoding, VIDEO_TYPE, schema.encoding, schema.data)
        decoder, found = VideoDecoder(), dict[int, NDArray[np.uint8]]()
        converter, every = None, 1
        for row, frame in _frames_of(decoder, [messages.decode(data) for _, data in packets]):
            if isinstance(frame, str):
                continue
            if converter is None:
                shrink = min(1, _MOST_EDGE / max(frame.width, frame.height))
                size = (max(1, round(edge * shrink)) for edge in (frame.width, frame.height))
                width, height = size
                converter = Converter((width, height))
                every = _thinning(len(packets) * width * height * 3)
            if row % every == 0:
                found[row] = converter.pixels(frame)
        if not found:
            raise LogError("it has no frame that can be decoded")
        seen_ns = np.array([packets[row][0] for row in sorted(found)])
        steps = np.searchsorted(times_ns, seen_ns, side="right").astype(np.int32) - 1
        pixels = np.stack([found[row] for row in sorted(found)])
        yield {"title": "rendered", "is_depth": False, "steps": steps, "pixels": pixels}

    def _lines(self, start_ns: int, end_ns: int) -> dict[str, Any]:
        """Return the log lines of an episode."""
        # A robot's own lines may have another type.
        is_known = _type_of(self._reader, LOG_TOPIC) == LOG_TYPE
        topic = Topic(self._reader, LOG_TOPIC if is_known else "")
        rows = np.flatnonzero((topic.times >= start_ns) & (topic.times <= end_ns))
        if not len(rows) or not {"msg", "level"} <= set(topic.fields):
            return {"times": np.empty(0), "levels": np.empty(0, np.int32), "texts": []}
        columns = topic.read(("msg", "level"), rows)
        return {
            "times": _seconds(topic.times[rows], start_ns),
            "levels": columns["level"].astype(np.int32),
            "texts": [str(text) for text in columns["msg"]],
        }

    def _at_steps(self, topic_name: str, times_ns: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
        """Return the numeric fields of a topic at these log_times; NaN where there is no message.

        Returns:
            Arrays (len(times_ns),) or (len(times_ns), N) of float32, by field.
        """
        topic = Topic(self._reader, topic_name)
        found, steps = _rows_at(topic, times_ns)
        names = [name for name, dtype in topic.fields.items() if dtype.base.kind in "biuf"]
        columns = {}
        for name, values in topic.read(names, found).items() if len(found) else ():
            if name in names:
                columns[name] = np.full((len(times_ns), *values.shape[1:]), np.nan, np.float32)
                columns[name][steps] = values
        return columns


def _frames_of(decoder: VideoDecoder, messages: Sequence[Any]) -> Iterator[Decoded]:
    for row, message in enumerate(messages):
        yield from decoder.feed(row, str(message.format), bytes(message.data))
    yield from decoder.end()


def _observed_images(dataset: Dataset) -> Iterator[dict[str, Any]]:
    """Yield the image observations of a dataset of one episode."""
    for leaf in observation_leaves(dataset.observation_space):
        images = _at(dataset.frames, leaf.path)
        if leaf.encoding is None or math.prod(leaf.shape[2:]) > _MOST_CHANNELS:
            continue
        every = _thinning(math.prod(images.shape))
        steps = np.arange(0, len(images), every, dtype=np.int32)
        pixels = np.asarray(images[steps]).reshape(len(steps), *leaf.shape[:2], -1)
        title = "/".join(("observation", *leaf.path))
        yield {"title": title, "is_depth": False, "steps": steps, "pixels": pixels}


def _plot(title: str, names: Sequence[str], values: NDArray[Any]) -> dict[str, Any]:
    columns = _rows(values)
    known = len(names) == columns.shape[1]
    return {
        "title": title,
        "names": list(names) if known else [str(number) for number in range(columns.shape[1])],
        "values": np.ascontiguousarray(columns.T, np.float32),
    }


def _rows_at(topic: Topic, times_ns: NDArray[np.int64]) -> tuple[NDArray[Any], NDArray[np.int32]]:
    """Return the rows of a topic whose log_times are in `times_ns`.

    Also return the index of each of these log_times in `times_ns`, which is increasing.
    """
    rows = np.flatnonzero(np.isin(topic.times, times_ns))
    return rows, np.searchsorted(times_ns, topic.times[rows]).astype(np.int32)


def _type_of(reader: McapReader, topic: str) -> str:
    """Return the type of a topic's messages.

    If there is not exactly one type, the string is empty.
    """
    names = {reader.type_of(channel) for channel in reader.channels_of(topic)}
    return names.pop() if len(names) == 1 else ""


def _at(nested: Any, path: Sequence[str]) -> Any:
    return reduce(lambda part, key: part[key], path, nested)


def _rows(values: NDArray[Any]) -> NDArray[Any]:
    return values.reshape(len(values), -1)


def _column(values: Sequence[float], dtype: type[Any]) -> NDArray[Any]:
    return np.array(values, dtype)


def _seconds(times_ns: NDArray[np.int64], start_ns: int) -> NDArray[np.float64]:
    return (times_ns - start_ns) / 1e9


def _finite(value: float | None, default: float) -> float:
    return float(value) if value is not None and math.isfinite(value) else default


def _thinning(size: int) -> int:
    """Return k such that every k-th image is shown, to limit the total size."""
    return max(1, math.ceil(size / _MOST_IMAGE_BYTES))


_SCRIPTS = ("data.js", "scene.js", "plots.js", "images.js", "labels.js", "main.js")


def page_html(log: bytes, episode: bytes = b"") -> str:
    """Return the page.

    Texts from the log are encoded as base64, and the page's Content Security Policy permits only
    the scripts of this package. Therefore, no text can become HTML or code.
    """
    style = _text("vendor/libraries.min.css") + _text("assets/style.css")
    names = ("vendor/libraries.min.js", *(f"assets/{name}" for name in _SCRIPTS))
    scripts = [_text(name) for name in names]
    policy = [
        "default-src 'none'",
        f"script-src {' '.join(map(_hash, scripts))}",
        # uPlot and OrbitControls set styles from scripts. `style-src` does not prevent this.
        f"style-src {_hash(style)}",
        "img-src data:",
        "base-uri 'none'; form-action 'none'",
        "connect-src 'none'" if episode else "connect-src 'self'",
    ]
    return Template(_text("assets/index.html")).substitute(
        policy="; ".join(policy),
        licenses=_text("vendor/LICENSES.txt"),
        style=style,
        log=base64.b64encode(log).decode(),
        episode=base64.b64encode(episode).decode(),
        scripts="\n".join(f"<script>{script}</script>" for script in scripts),
    )


def _text(name: str) -> str:
    return files(__package__).joinpath(name).read_text("utf-8")


def _hash(text: str) -> str:
    digest = hashlib.sha256(text.encode()).digest()
    return f"'sha256-{base64.b64encode(digest).decode()}'"


_EPISODE = re.compile(r"/episode/(\d{1,9})")
_EPISODES_KEPT = 4
_BLOCK_BYTES = 2**20
_MOST_DIGITS = 12
_REFUSED = 403, "text/plain; charset=utf-8", b"this page may not connect"
_HEADERS = {
    "Cache-Control": "no-store",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Content-Security-Policy": "frame-ancestors 'none'",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


class PageServer:
    """Server of the page of a log.

    Attributes:
        url: Address of the page.
    """

    def __init__(
        self,
        page: LogPage,
        *,
        port: int,
        labels: Callable[[], dict[str, Any]],
        label: Callable[[bytes], dict[str, Any]] | None = None,
        **settings: Any,
    ) -> None:
        """Start to listen.

        Args:
            page: Log.
            port: Port; 0 for any free port.
            labels: Function that returns the labels, settings of `LogPage.index`.
            label: Function that changes the labels as a JSON object says, and returns them; None if
                they cannot be saved.
            settings: Other settings of `LogPage.index`.
        """
        self._token = "" if label is None else secrets.token_urlsafe()
        settings["token"] = self._token
        self._page, self._settings = page, settings
        self._labels, self._label = labels, label
        self._count = len(page.dataset.episodes)
        self._episode = lru_cache(_EPISODES_KEPT)(page.episode)
        handler = type("_Handler", (_Handler,), {"respond": self._respond, "save": self._save})
        try:
            self._server = _Server(("127.0.0.1", port), handler)
        except OSError as error:
            raise UsageError(f"port {port}: {error.strerror or error}; choose another") from error
        self.url = f"http://127.0.0.1:{self._server.server_port}/"

    def run(self, stop: threading.Event) -> None:
        """Answer requests until `stop` is set."""
        serving = threading.Thread(target=self._server.serve_forever, daemon=True)
        serving.start()
        try:
            stop.wait()
        finally:
            self._server.shutdown()
            serving.join()

    def close(self) -> None:
        """Stop listening."""
        self._server.server_close()

    def _html(self) -> bytes:
        return page_html(self._page.index(**self._settings, **self._labels())).encode()

    def _respond(self, path: str) -> tuple[int, str, bytes]:
        """Return status, type and body of the answer to a request."""
        found = _EPISODE.fullmatch(path)
        if path == "/":
            return 200, "text/html; charset=utf-8", self._html()
        if found is None or int(found[1]) >= self._count:
            return 404, "text/plain; charset=utf-8", b"there is no such page"
        try:
            return 200, "application/octet-stream", self._episode(int(found[1]))
        except McaprlError as error:
            return 500, "text/plain; charset=utf-8", str(error).encode(errors="backslashreplace")

    def _save(self, path: str, token: str, body: bytes) -> tuple[int, str, bytes]:
        """Change the labels; return status, type and body of the answer."""
        plain = "text/plain; charset=utf-8"
        if path != "/label" or self._label is None:
            return 404, plain, b"this page saves no labels"
        if not secrets.compare_digest(token.encode(), self._token.encode()):
            return 403, plain, b"the page is of an earlier server: reload it"
        try:
            return 200, "application/json", json.dumps(self._label(body)).encode()
        except McaprlError as error:
            return 400, plain, str(error).encode(errors="backslashreplace")


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def handle_error(self, *_: Any) -> None:
        """Ignore errors of connections that are closed early or too slow; print all others."""
        if not isinstance(sys.exception(), ConnectionError | TimeoutError):
            super().handle_error(*_)


class _Handler(BaseHTTPRequestHandler):
    respond: Any
    save: Any

    def setup(self) -> None:
        """Limit the time for the request and for each block of the answer."""
        super().setup()
        self.connection.settimeout(limits.CLIENT_TIMEOUT_S)
        # A client that sends one byte after the other would never reach the time-out of a byte.
        self._hang_up = threading.Timer(limits.CLIENT_TIMEOUT_S, self._close_connection)
        self._hang_up.daemon = True
        self._hang_up.start()

    def _close_connection(self) -> None:
        with suppress(OSError):
            self.connection.shutdown(socket.SHUT_RDWR)

    def finish(self) -> None:
        """Close the connection."""
        self._hang_up.cancel()
        super().finish()

    def do_GET(self) -> None:
        """Answer a request of the page, or of a program on this machine."""
        self._hang_up.cancel()
        if self._is_allowed():
            status, kind, body = self.respond(self.path)
        else:
            status, kind, body = _REFUSED
        self._answer(status, kind, body)

    def do_POST(self) -> None:
        """Save a label that the page sends."""
        length = self.headers.get("Content-Length", "")
        is_bounded = length.isascii() and length.isdigit() and len(length) < _MOST_DIGITS
        if not (self._is_allowed() and self.headers.get("Origin")):
            answer = _REFUSED
        elif self.headers.get_content_type() != "application/json":
            answer = 415, "text/plain; charset=utf-8", b"a label is application/json"
        elif not is_bounded or int(length) > limits.MAX_LABEL_BYTES:
            answer = 413, "text/plain; charset=utf-8", b"a label has a length, and at most 64 KiB"
        else:
            body = self.rfile.read(int(length))
            self._hang_up.cancel()
            answer = self.save(self.path, self.headers.get("X-Label-Token", ""), body)
        self._answer(*answer)

    def _answer(self, status: int, kind: str, body: bytes) -> None:
        self.send_response(status)
        for name, value in {"Content-Type": kind, **_HEADERS}.items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        for start in range(0, len(body), _BLOCK_BYTES):
            self.wfile.write(body[start : start + _BLOCK_BYTES])

    def _is_allowed(self) -> bool:
        hosts, origins = (self.headers.get_all(name, []) for name in ("Host", "Origin"))
        return (
            len(hosts) == 1
            and is_loopback(f"//{hosts[0]}")
            and all(origin == f"http://{hosts[0]}" for origin in origins)
        )

    def log_message(self, *_: Any) -> None:
        """Print no line for a request."""
