"""A Foxglove WebSocket server on 127.0.0.1, and a proxy that keeps untrusted web pages from it.

Any web page can open a WebSocket to a local port. The browser sends the page's origin in the header
`Origin`, which a server must check. foxglove-sdk does not check it. The proxy checks the head of
each request and forwards allowed connections unchanged. Requests without `Origin` are allowed,
because they come from local programs other than browsers. `Host` is also checked, because the host
name of another page can resolve to this machine (DNS rebinding).
"""

from __future__ import annotations

import asyncio
import contextlib
import secrets
import socket
import threading
from collections.abc import Collection, Sequence
from functools import partial
from socket import create_server
from typing import Any
from urllib.parse import quote, urlsplit

from mcap.records import Schema

from mcaprl import limits
from mcaprl.errors import UsageError, import_extra

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
