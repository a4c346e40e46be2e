"""A server of the Foxglove WebSocket protocol on 127.0.0.1, and its channels."""

from __future__ import annotations

from typing import Any

from mcaprl.errors import UsageError, import_extra

HOST = "127.0.0.1"
DEFAULT_PORT = 8765


class ViewerServer:
    """Foxglove server that listens on 127.0.0.1 only.

    Attributes:
        foxglove: The module `foxglove`.
        websocket: The module `foxglove.websocket`.
    """

    def __init__(self) -> None:
        """Create a server without channels; `start` opens the port.

        Raises:
            MissingExtraError: foxglove-sdk is not installed.
        """
        self.foxglove = import_extra("foxglove", "foxglove")
        self.websocket = import_extra("foxglove.websocket", "foxglove")
        self._context = self.foxglove.Context()
        self._channels: list[Any] = []
        self._server: Any = None

    def add_channel(
        self,
        topic: str,
        type_name: str,
        definition: bytes,
        *,
        encoding: str = "cdr",
        schema_encoding: str = "ros2msg",
    ) -> Any:
        """Advertise a topic; returns a channel with `log(data, log_time=...)` and `has_sinks()`."""
        schema = self.foxglove.Schema(name=type_name, encoding=schema_encoding, data=definition)
        channel = self.foxglove.Channel(
            topic, message_encoding=encoding, schema=schema, context=self._context
        )
        self._channels.append(channel)
        return channel

    def start(self, name: str, port: int, listener: Any, **options: Any) -> Any:
        """Start the server.

        Args:
            name: Name of the server, as viewers display it.
            port: Port to listen on; 0 selects a free port.
            listener: Callbacks for viewers' requests; see `foxglove.websocket.ServerListener`.
            **options: Further arguments of `foxglove.start_server`.

        Returns:
            Handle of the server, for `broadcast_time` etc.

        Raises:
            UsageError: The port is in use.
        """
        try:
            self._server = self.foxglove.start_server(
                name=name,
                host=HOST,
                port=port,
                server_listener=listener,
                supported_encodings=["cdr"],
                context=self._context,
                **options,
            )
        except (OSError, RuntimeError) as error:
            raise UsageError(f"cannot listen on {HOST}:{port}: {error}; pass --port") from error
        return self._server

    @property
    def url(self) -> str:
        """WebSocket URL of the server."""
        return f"ws://{HOST}:{self._server.port}"

    @property
    def app_url(self) -> str:
        """Link that opens Foxglove connected to the server."""
        return str(self._server.app_url())

    def close(self) -> None:
        """Stop the server and close its channels."""
        if self._server is not None:
            self._server.stop()
        for channel in self._channels:
            channel.close()
