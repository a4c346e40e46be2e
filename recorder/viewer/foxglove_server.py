"""Foxglove WebSocket server on 127.0.0.1 with a filter of web pages, and the player of logs.

Any web page can open a WebSocket to a local port. The browser sends the page's origin in the header
`Origin`, which a server must check. foxglove-sdk does not check it. The proxy checks the head of
each request and forwards allowed connections unchanged. Requests without `Origin` are allowed,
because they come from local programs other than browsers. `Host` is also checked, because the host
name of another page can resolve to this machine (DNS rebinding).

Messages are sent as they are stored in the file. If several logs are played at once, a prefix for
each log is added to the frame names in its messages, because the names must differ between logs.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import re
import secrets
import socket
import threading
from collections import Counter
from collections.abc import Collection, Sequence
from functools import partial
from pathlib import Path
from socket import create_server
from typing import Any
from urllib.parse import quote, urlsplit

from mcap.records import Schema

from mcaprl import limits
from mcaprl.errors import UsageError, import_extra
from mcaprl.recorder.format import messages
from mcaprl.recorder.format.reading import McapReader
from mcaprl.recorder.format.schema import EPISODE_TOPIC, LOG_TOPIC
from mcaprl.recorder.viewer.playback import Played, Player

VIEWER_ORIGINS = (
    "https://app.foxglove.dev",
    "https://lichtblick-suite.github.io",
    # Origin of desktop applications.
    "file://",
)
_LOOPBACK = ("127.0.0.1", "localhost", "::1")
_END = b"\r\n\r\n"
_MAX_HEAD_BYTES = 2**14
_CLOSE_TIMEOUT_S = 1.0
_BLOCK_BYTES = 2**16


def is_allowed(head: bytes, origins: Collection[str]) -> bool:
    """Return whether a request opens a WebSocket from a trusted page or a local program."""
    _, *lines = head.decode("latin-1").removesuffix("\r\n\r\n").split("\r\n")
    headers: dict[str, str] = {}
    for line in lines:
        name, colon, value = line.partition(":")
        name = name.lower()
        # A header name with leading or trailing spaces may be a folded line, which servers parse
        # differently.
        if not colon or name != name.strip() or (name in headers and name in ("host", "origin")):
            return False
        headers[name] = value.strip()
    trusted = {_host_of(origin) for origin in origins if origin.startswith("http")}
    host = f"//{headers.get('host', '')}"
    origin = headers.get("origin")
    return (
        headers.get("upgrade", "").lower() == "websocket"
        and (is_loopback(host) or _host_of(host) in trusted)
        and (
            origin is None
            or origin in origins
            or (origin.startswith("http") and is_loopback(origin))
        )
    )


def is_loopback(url: str) -> bool:
    """Return whether the host of a URL is this machine."""
    return _host_of(url) in _LOOPBACK


def _host_of(url: str) -> str:
    try:
        return urlsplit(url).hostname or ""
    except ValueError:
        return ""


class OriginFilter:
    """A listener that forwards allowed connections to a server, in a separate thread.

    Attributes:
        port: Port on which the listener accepts connections.
    """

    def __init__(self, listener: socket.socket, server: tuple[str, int], origins: Collection[str]):
        """Start to accept connections."""
        self.port: int = listener.getsockname()[1]
        self._listener, self._server, self._origins = listener, server, tuple(origins)
        self._loop = asyncio.new_event_loop()
        self._closing = asyncio.Event()
        self._connections = set[asyncio.Task[None]]()
        self._thread = threading.Thread(target=self._run, name="mcaprl-origin-filter", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop listening, and close the connections that the server has not closed."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._closing.set)
            self._thread.join()

    def _run(self) -> None:
        with contextlib.closing(self._loop):
            self._loop.run_until_complete(self._serve())

    async def _serve(self) -> None:
        listening = await asyncio.start_server(
            self._accept, sock=self._listener, limit=_MAX_HEAD_BYTES
        )
        await self._closing.wait()
        listening.close()
        if self._connections:
            _, open_ones = await asyncio.wait(self._connections, timeout=_CLOSE_TIMEOUT_S)
            for connection in open_ones:
                connection.cancel()
            await asyncio.gather(*open_ones, return_exceptions=True)

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._connections.add(task)
        try:
            with contextlib.suppress(OSError, EOFError, asyncio.LimitOverrunError):
                await self._connect(reader, writer)
        finally:
            self._connections.discard(task)
            writer.close()

    async def _connect(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Read the head of a request, and reject the request or forward the connection."""
        head = await asyncio.wait_for(reader.readuntil(_END), limits.CLIENT_TIMEOUT_S)
        if not is_allowed(head, self._origins):
            text = b"this page may not connect; see --allow-origin of mcaprl\n"
            writer.write(b"HTTP/1.1 403 Forbidden\r\nConnection: close\r\n")
            writer.write(b"Content-Length: %d\r\n\r\n%s" % (len(text), text))
            await writer.drain()
            return
        inner_reader, inner_writer = await asyncio.open_connection(*self._server)
        inner_writer.write(head)
        try:
            await asyncio.gather(_pass_on(reader, inner_writer), _pass_on(inner_reader, writer))
        finally:
            inner_writer.close()


async def _pass_on(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Copy bytes until one side closes; wait if the receiver is slow."""
    try:
        while data := await reader.read(_BLOCK_BYTES):
            writer.write(data)
            await writer.drain()
    finally:
        writer.close()


HOST = "127.0.0.1"
DEFAULT_PORT = 8765


class ViewerServer:
    """A Foxglove server that listens only on 127.0.0.1.

    Subclasses implement callbacks for viewers' requests; see `foxglove.websocket.ServerListener`.
    """

    def __init__(self) -> None:
        """Create a server without channels. It does not listen until `start` is called."""
        self._foxglove = import_extra("foxglove", "foxglove")
        self._ws = import_extra("foxglove.websocket", "foxglove")
        self._context = self._foxglove.Context()
        self._advertised: list[Any] = []
        self._server: Any = None
        self._inner = ""
        self._filter: OriginFilter | None = None

    def add_channel(
        self,
        topic: str,
        schema: Schema | None,
        *,
        encoding: str = "cdr",
    ) -> Any:
        """Advertise a topic, with or without a schema, and return its `foxglove.Channel`."""
        known = None
        if schema is not None:
            known = self._foxglove.Schema(
                name=schema.name, encoding=schema.encoding, data=schema.data
            )
        channel = self._foxglove.Channel(
            topic, message_encoding=encoding, schema=known, context=self._context
        )
        self._advertised.append(channel)
        return channel

    def start(self, name: str, port: int, origins: Sequence[str], **options: Any) -> None:
        """Start the server."""
        try:
            socket = create_server((HOST, port))
        except OSError as error:
            raise UsageError(
                f"cannot listen on {HOST}:{port}: {error}; pass another `port=`"
            ) from error
        start = partial(
            self._foxglove.start_server,
            name=name,
            port=0,
            server_listener=self,
            supported_encodings=["cdr"],
            context=self._context,
            **options,
        )
        host = _hidden_host()
        try:
            self._server = start(host=host)
        except (OSError, RuntimeError):
            # Some systems have only one loopback address.
            host = HOST
            self._server = start(host=host)
        self._inner = f"{host}:{self._server.port}"
        target = (host, self._server.port)
        self._filter = OriginFilter(socket, target, [*VIEWER_ORIGINS, *origins])

    @property
    def url(self) -> str:
        """WebSocket URL of the server."""
        return f"ws://{self._outer}"

    @property
    def app_url(self) -> str:
        """Link that opens Foxglove and connects it to the server."""
        return str(self._server.app_url()).replace(quote(self._inner), quote(self._outer))

    @property
    def _outer(self) -> str:
        assert self._filter is not None, "the server is not started"
        return f"{HOST}:{self._filter.port}"

    def close(self) -> None:
        """Disconnect all viewers, stop the server and close its channels."""
        if self._server is not None:
            self._server.stop()
        if self._filter is not None:
            self._filter.close()
        for channel in self._advertised:
            channel.close()

    def on_unsubscribe(self, client: Any, channel: Any) -> None:
        """Do nothing: messages are sent only to subscribers."""


def _hidden_host() -> str:
    """Return a random loopback address, so that web pages cannot bypass the origin filter."""
    return "127." + ".".join(str(1 + secrets.randbelow(254)) for _ in range(3))


WORLD = "map"
"""Name of the coordinate frame that all logs share."""
_MARKERS, _FRAMES = "visualization_msgs/msg/MarkerArray", "tf2_msgs/msg/TFMessage"
PREFIXED_TYPES = (_MARKERS, _FRAMES)
"""Types of messages that contain frame names; these names get a prefix."""


def prefixes_of(paths: Sequence[Path]) -> list[str]:
    """Return a unique prefix for each file; a single file gets an empty prefix.

    >>> prefixes_of([Path("runs/a.mcap"), Path("b/a.mcap"), Path("C-1.mcap")])
    ['a', 'a_2', 'c_1']
    """
    if len(paths) == 1:
        return [""]
    words: list[str] = []
    for path in paths:
        stem = re.sub(r"[^a-z0-9]+", "_", path.stem.lower()).strip("_") or "log"
        word, count = stem, 1
        while word in words:
            count += 1
            word = f"{stem}_{count}"
        words.append(word)
    return words


def prefixed_message(data: bytes, type_name: str, prefix: str, shift_ns: int) -> bytes:
    """Add a prefix to a message's frame names other than `WORLD`, and shift its stamps.

    Args:
        data: CDR bytes of the message.
        type_name: Type of the message, one of `PREFIXED_TYPES`.
        prefix: Prefix of the log.
        shift_ns: Time to add to nonzero stamps.
    """
    message = messages.decode(data, type_name)
    parts = message.markers if type_name == _MARKERS else message.transforms
    for part in parts:
        part.header.frame_id = _below(prefix, part.header.frame_id)
        stamp_ns = part.header.stamp.sec * 10**9 + part.header.stamp.nanosec
        if stamp_ns:
            part.header.stamp = messages.stamp(stamp_ns + shift_ns)
        if type_name == _FRAMES:
            part.child_frame_id = _below(prefix, part.child_frame_id)
    return messages.encode(message)


def side_by_side(layouts: Sequence[dict[str, Any]], prefixes: Sequence[str]) -> dict[str, Any]:
    """Return a layout in which each screen shows several logs side by side."""
    parts = [_prefixed_layout(*pair) for pair in zip(layouts, prefixes, strict=True)]
    if len(parts) == 1:
        return parts[0]
    panels = {name: panel for part in parts for name, panel in part.get("configById", {}).items()}
    variables = {
        name: value for part in parts for name, value in part.get("globalVariables", {}).items()
    }
    roots = [part.get("layout") for part in parts]
    screens = [_screens(panels, root) for root in roots]
    root = _in_a_row(roots)
    if all(screens) and len({tuple(each) for each in screens}) == 1:
        panels = {name: panel for name, panel in panels.items() if name not in roots}
        shown = {title: _in_a_row([each[title] for each in screens]) for title in screens[0]}
        tabs = [{"title": title, "layout": node} for title, node in shown.items()]
        root = "Tab!screens"
        panels[root] = {"activeTabIdx": 0, "tabs": tabs}
    return {**parts[0], "configById": panels, "globalVariables": variables, "layout": root}


def _screens(panels: dict[str, Any], root: Any) -> dict[str, Any]:
    """Return the layout of each screen by title; empty if the root is not a panel with tabs."""
    panel = panels.get(root) if isinstance(root, str) else None
    tabs = panel.get("tabs", []) if isinstance(panel, dict) else []
    return {tab["title"]: tab["layout"] for tab in tabs}


def _in_a_row(nodes: Sequence[Any]) -> Any:
    *firsts, root = nodes
    for count, first in enumerate(reversed(firsts), start=2):
        root = {"first": first, "second": root, "direction": "row", "splitPercentage": 100 / count}
    return root


def _prefixed_layout(layout: dict[str, Any], prefix: str) -> dict[str, Any]:
    """Add a prefix to the topics, coordinate frames, variables and panels of a layout."""
    if not prefix:
        return layout
    text = json.dumps(layout)
    # Strings that begin with a slash are topics. Names of panels have the form `Kind!title`.
    text = re.sub(r'"(/[a-z])', rf'"/{prefix}\1', text)
    text = re.sub(r'"(\w+)!', rf'"\1!{prefix} ', text)
    # Titles of screens are not prefixed.
    text = re.sub(r'("(?:foxglove|lichtblick)PanelTitle": ")', rf"\g<1>{prefix}: ", text)
    text = re.sub(r'("followTf": "|"frame:)(?!map")', rf"\g<1>{prefix}/", text)
    text = re.sub(r'(\{\w+==\$|"globalVariableName": ")', rf"\g<1>{prefix}_", text)
    found: dict[str, Any] = json.loads(text)
    variables = found.get("globalVariables", {})
    return {**found, "globalVariables": {f"{prefix}_{name}": variables[name] for name in variables}}


def _below(prefix: str, frame: str) -> str:
    return frame if frame in ("", WORLD) else f"{prefix}/{frame}"


_PERIOD_S = 1 / 30
# Range of speeds that a viewer may request; requests for other speeds are ignored.
MIN_SPEED, MAX_SPEED = 1e-3, 1e3
# Number of ticks between a seek and the next messages. Viewers drop all messages when the time goes
# back, so the new time must arrive first. The server has separate queues for times and messages.
_TICKS_AFTER_SEEK = 2
# Topics whose messages are events. A viewer that receives an event twice shows the event twice.
_EVENT_TOPICS = (EPISODE_TOPIC, LOG_TOPIC)
# Schema id of channels without a schema.
_NO_SCHEMA = 0


class LiveServer(ViewerServer):
    """Server that plays logs to all connected viewers. Playback starts at the first subscription.

    Viewers can set two parameters: `episode` seeks to the start of an episode, and `loop` sets
    whether playback restarts at the end.
    """

    def __init__(
        self,
        player: Player,
        *,
        prefixes: Sequence[str] = ("",),
        episode_starts_ns: Sequence[int] = (),
        name: str = "mcaprl",
        port: int = DEFAULT_PORT,
        origins: Sequence[str] = (),
    ) -> None:
        """Start the server.

        Args:
            player: Clock and messages of the logs.
            prefixes: Prefix of each log's topics; an empty string adds none.
            episode_starts_ns: Start of each episode on the player's clock, nanoseconds.
            name: Name of the server, as viewers display it.
            port: Port to listen on; 0 selects a free port.
            origins: Origins of additional web pages that may connect.
        """
        super().__init__()
        self._player, self._prefixes = player, prefixes
        self._starts_ns = tuple(episode_starts_ns)
        self._lock = threading.Lock()
        self._looked_at = self._seeked = False
        self._ticks_to_latest = 0
        # Number of subscribers of each channel, and set of channels that have a new subscriber.
        self._subscribers: Counter[int] = Counter()
        self._joined: set[int] = set()
        # Time up to which all events have been sent.
        self._sent_ns = -1
        # Seek, so that `advance` skips the messages at the start time. `_latest` returns these
        # messages.
        player.seek(player.start_ns)
        self._channels = dict(
            pair for number in range(len(prefixes)) for pair in self._announced(number)
        )
        can = self._ws.Capability
        self.start(
            name,
            port,
            origins,
            capabilities=[can.Time, can.Parameters, can.PlaybackControl],
            playback_time_range=(player.start_ns, player.end_ns),
        )

    def run(self, stop: threading.Event) -> None:
        """Play until `stop` is set."""
        while not stop.wait(_PERIOD_S):
            self.tick(_PERIOD_S)

    def tick(self, elapsed_s: float) -> None:
        """Send the latest messages that viewers still need, then the messages that are due."""
        # The lock is held until all messages are sent. Otherwise a message from before a seek could
        # arrive after the response to the seek.
        with self._lock:
            player = self._player
            if player.ended and player.loops and player.playing:
                self._seek(player.start_ns)
                self._server.broadcast_playback_state(self._state(did_seek=True))
            if self._ticks_to_latest:
                self._ticks_to_latest -= 1
                self._server.broadcast_time(player.time_ns)
                return
            latest, was_playing = self._latest(), player.playing
            due = player.advance(elapsed_s)
            self._server.broadcast_time(player.time_ns)
            for message in latest + due:
                self._send(message)
            self._sent_ns = player.time_ns
            if was_playing and not player.playing:
                self._server.broadcast_playback_state(self._state(did_seek=False))

    def on_playback_control_request(self, request: Any) -> Any:
        """Play, pause, change the speed, or seek."""
        with self._lock:
            player, seek_ns = self._player, request.seek_time
            if MIN_SPEED <= request.playback_speed <= MAX_SPEED:
                player.speed = request.playback_speed
            if seek_ns is not None:
                self._seek(seek_ns)
            player.playing = request.playback_command == self._ws.PlaybackCommand.Play
            if player.playing and player.ended:
                seek_ns = player.start_ns
                self._seek(seek_ns)
            return self._state(did_seek=seek_ns is not None, request_id=request.request_id)

    def on_subscribe(self, client: Any, channel: Any) -> None:
        """Mark the topic's latest message for sending. The first subscription starts the clock."""
        with self._lock:
            if not self._looked_at:
                self._looked_at = self._player.playing = True
            self._subscribers[channel.id] += 1
            self._joined.add(channel.id)

    def on_unsubscribe(self, client: Any, channel: Any) -> None:
        """Update the number of the topic's subscribers."""
        with self._lock:
            self._subscribers[channel.id] -= 1

    def on_get_parameters(self, client: Any, names: list[str], request_id: Any = None) -> list[Any]:
        """Return the requested parameters, or all if no name is given."""
        with self._lock:
            return [p for p in self._parameters() if not names or p.name in names]

    def on_set_parameters(
        self, client: Any, parameters: list[Any], request_id: Any = None
    ) -> list[Any]:
        """Seek to an episode, or set whether the player loops."""
        with self._lock:
            for parameter in parameters:
                value = parameter.get_value()
                if parameter.name == "loop":
                    self._player.loops = bool(value)
                elif parameter.name == "episode" and _is_number(value):
                    self._jump(int(value))
            return self._parameters()

    def on_parameters_subscribe(self, names: list[str]) -> None:
        """Do nothing: `on_set_parameters` returns new values."""

    def on_parameters_unsubscribe(self, names: list[str]) -> None:
        """Do nothing."""

    def _latest(self) -> list[Played]:
        """Return the latest messages that viewers need after a seek or a new subscription."""
        seeked, joined = self._seeked, self._joined
        self._seeked, self._joined = False, set()
        if not (seeked or joined):
            return []
        current = self._player.current_messages()
        return [message for message in current if self._is_lacking(message, joined, seeked)]

    def _is_lacking(self, message: Played, joined: set[int], seeked: bool) -> bool:
        """Return whether viewers still need the latest message of a topic. Events are sent once."""
        channel_id = self._channels[message.track, message.channel_id].id()
        topic = self._reader(message.track).channels[message.channel_id].topic
        if topic not in _EVENT_TOPICS:
            return seeked or channel_id in joined
        first_ns = self._player.start_ns
        is_first = channel_id in joined and self._subscribers[channel_id] == 1
        if not is_first and self._player.time_ns >= self._sent_ns:
            # After a seek forward, viewers still show the events that were already sent.
            first_ns = max(first_ns, self._sent_ns + 1)
        return (seeked or is_first) and message.time_ns >= first_ns

    def _seek(self, time_ns: int) -> None:
        self._player.seek(time_ns)
        self._seeked, self._ticks_to_latest = True, _TICKS_AFTER_SEEK

    def _jump(self, episode: int) -> None:
        if 0 <= episode < len(self._starts_ns):
            self._seek(self._starts_ns[episode])
            self._server.broadcast_playback_state(self._state(did_seek=True))

    def _parameters(self) -> list[Any]:
        now = sum(start <= self._player.time_ns for start in self._starts_ns) - 1
        parameter = self._foxglove.Parameter
        return [
            parameter("episode", value=max(now, 0)),
            parameter("loop", value=self._player.loops),
        ]

    def _state(self, *, did_seek: bool, request_id: str | None = None) -> Any:
        status, player = self._ws.PlaybackStatus, self._player
        running = status.Playing if player.playing else status.Paused
        return self._ws.PlaybackState(
            status=status.Ended if player.ended and not player.playing else running,
            current_time=player.time_ns,
            playback_speed=player.speed,
            did_seek=did_seek,
            request_id=request_id,
        )

    def _announced(self, number: int) -> list[tuple[tuple[int, int], Any]]:
        reader, prefix = self._reader(number), self._prefixes[number]
        found = []
        for channel in reader.channels.values():
            announced = self.add_channel(
                f"/{prefix}{channel.topic}" if prefix else channel.topic,
                None if channel.schema_id == _NO_SCHEMA else reader.schema_of(channel),
                encoding=channel.message_encoding,
            )
            found.append(((number, channel.id), announced))
        return found

    def _send(self, message: Played) -> None:
        data = message.data
        reader, prefix = self._reader(message.track), self._prefixes[message.track]
        if prefix:
            schema = reader.schemas.get(reader.channels[message.channel_id].schema_id)
            type_name = "" if schema is None else schema.name
            if type_name in PREFIXED_TYPES:
                shift_ns = self._player.shifts_ns[message.track]
                data = prefixed_message(data, type_name, prefix, shift_ns)
        channel = self._channels[message.track, message.channel_id]
        channel.log(data, log_time=message.time_ns)

    def _reader(self, number: int) -> McapReader:
        return self._player.tracks[number].reader


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)
