"""A Foxglove WebSocket server on 127.0.0.1, and its channels."""

from __future__ import annotations

import secrets
from collections.abc import Sequence
from functools import partial
from socket import create_server
from typing import Any
from urllib.parse import quote

from mcap.records import Schema

from mcaprl.errors import UsageError, import_extra
from mcaprl.recorder.viewer.origin_filter import VIEWER_ORIGINS, OriginFilter

HOST = "127.0.0.1"
DEFAULT_PORT = 8765


class ViewerServer:
    """A Foxglove server that listens only on 127.0.0.1.

    Subclasses implement callbacks for viewers' requests; see `foxglove.websocket.ServerListener`.
    """

    def __init__(self) -> None:
        """Create a server without channels. It does not listen until `start` is called.

        Raises:
            MissingExtraError: foxglove-sdk is not installed.
        """
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
        """Start the server.

        Args:
            name: Name of the server, as viewers display it.
            port: Port to listen on; 0 selects a free port.
            origins: Origins of additional web pages that may connect.
            **options: Further arguments of `foxglove.start_server`.

        Raises:
            UsageError: The port is in use.
        """
        try:
            socket = create_server((HOST, port))
        except OSError as error:
            raise UsageError(f"cannot listen on {HOST}:{port}: {error}; pass --port") from error
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
