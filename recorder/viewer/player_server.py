"""A live server that plays logs to Foxglove, with play, pause, speed and seek.

Messages are sent as they are stored in the file. If several logs are played at once, frame names in
messages get a prefix per log, so that the frames of two cars differ.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from typing import Any

from mcaprl.recorder.format.reading import McapReader
from mcaprl.recorder.viewer.foxglove_server import DEFAULT_PORT, ViewerServer
from mcaprl.recorder.viewer.playback import Played, Player
from mcaprl.recorder.viewer.prefix import PREFIXED_TYPES, prefixed_message

_PERIOD_S = 1 / 30
# Range of speeds that a viewer may request; others are ignored.
MIN_SPEED, MAX_SPEED = 1e-3, 1e3


class LiveServer(ViewerServer):
    """Server that plays logs to all connected viewers, starting with the first subscriber.

    Viewers can set two parameters: `episode`, which seeks to the episode's start, and `loop`.
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
            origins: Additional origins of web pages that may connect.

        Raises:
            MissingExtraError: foxglove-sdk is not installed.
            UsageError: The port is in use.
        """
        super().__init__()
        self._player, self._prefixes = player, prefixes
        self._starts_ns = tuple(episode_starts_ns)
        self._lock = threading.Lock()
        self._looked_at = False
        self._newly_subscribed = self._seeked = False
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
        """Send the messages that are due."""
        with self._lock:
            restarts = self._player.ended and self._player.loops and self._player.playing
            if restarts:
                self._player.seek(self._player.start_ns)
            fresh = restarts or self._newly_subscribed or self._seeked
            self._newly_subscribed = self._seeked = False
            was_playing = self._player.playing
            due = self._player.current_messages() if fresh else []
            due += self._player.advance(elapsed_s)
            time_ns, stopped = self._player.time_ns, was_playing and not self._player.playing
            state = self._state(did_seek=restarts)
            # The lock is held until all is sent, so that no message from before a seek follows the
            # response to the seek.
            if restarts:
                # Clear the display of viewers without a seek bar.
                self._server.clear_session()
            for message in due:
                self._send(message)
            self._server.broadcast_time(time_ns)
            if restarts or stopped:
                self._server.broadcast_playback_state(state)

    def on_playback_control_request(self, request: Any) -> Any:
        """Play, pause, change the speed, or seek."""
        with self._lock:
            player = self._player
            if MIN_SPEED <= request.playback_speed <= MAX_SPEED:
                player.speed = request.playback_speed
            if request.seek_time is not None:
                player.seek(request.seek_time)
                self._seeked = True
            player.playing = request.playback_command == self._ws.PlaybackCommand.Play
            if player.playing and player.ended:
                player.seek(player.start_ns)
                self._seeked = True
            return self._state(did_seek=self._seeked, request_id=request.request_id)

    def on_subscribe(self, client: Any, channel: Any) -> None:
        """Send the current state with the next tick, and start the clock on the first call."""
        with self._lock:
            if not self._looked_at:
                self._looked_at = self._player.playing = True
            self._newly_subscribed = True

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

    def _jump(self, episode: int) -> None:
        if 0 <= episode < len(self._starts_ns):
            self._player.seek(self._starts_ns[episode])
            self._seeked = True
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
            schema = reader.schema_of(channel)
            announced = self.add_channel(
                f"/{prefix}{channel.topic}" if prefix else channel.topic,
                schema.name,
                schema.data,
                encoding=channel.message_encoding,
                schema_encoding=schema.encoding,
            )
            found.append(((number, channel.id), announced))
        return found

    def _send(self, message: Played) -> None:
        data = message.data
        reader, prefix = self._reader(message.track), self._prefixes[message.track]
        if prefix:
            type_name = reader.schema_of(reader.channels[message.channel_id]).name
            if type_name in PREFIXED_TYPES:
                shift_ns = self._player.shifts_ns[message.track]
                data = prefixed_message(data, type_name, prefix, shift_ns)
        channel = self._channels[message.track, message.channel_id]
        channel.log(data, log_time=message.time_ns)

    def _reader(self, number: int) -> McapReader:
        return self._player.tracks[number].reader


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)
