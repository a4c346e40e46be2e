"""A server of the Foxglove protocol on this machine, and the channels that viewers find there."""

from __future__ import annotations

from typing import Any

from mcaprl.errors import UsageError, import_extra

HOST = "127.0.0.1"
DEFAULT_PORT = 8765


class ViewerServer:
    """Listens on 127.0.0.1 only, once it is started.

    Attributes:
        foxglove: the module.
        websocket: its part for servers.
    """

    def __init__(self) -> None:
        """Make one without channels.

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
        """Announce a topic; the channel has `log(data, log_time=...)` and `has_sinks()`."""
        schema = self.foxglove.Schema(name=type_name, encoding=schema_encoding, data=definition)
        channel = self.foxglove.Channel(
            topic, message_encoding=encoding, schema=schema, context=self._context
        )
        self._channels.append(channel)
        return channel

    def start(self, name: str, port: int, listener: Any, **options: Any) -> Any:
        """Begin to listen.

        Args:
            name: that viewers show.
            port: 0 takes any that is free.
            listener: told of viewers; see `foxglove.websocket.ServerListener`.
            **options: more for `foxglove.start_server`.

        Returns:
            Its handle, for `broadcast_time` and so on.

        Raises:
            UsageError: the port is taken.
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
        """Where viewers connect."""
        return f"ws://{HOST}:{self._server.port}"

    @property
    def app_url(self) -> str:
        """A link that opens Foxglove with it."""
        return str(self._server.app_url())

    def close(self) -> None:
        """Say goodbye to all viewers."""
        if self._server is not None:
            self._server.stop()
        for channel in self._channels:
            channel.close()
