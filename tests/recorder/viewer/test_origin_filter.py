"""Connections that the live server accepts, and parameters that a viewer can set."""

from __future__ import annotations

import base64
import math
import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from gymnasium import spaces

from mcaprl import limits
from mcaprl.errors import UsageError
from mcaprl.recorder.columns.reader import McapReader
from mcaprl.recorder.viewer.foxglove_server import (
    HOST,
    MAX_SPEED,
    VIEWER_ORIGINS,
    LiveServer,
    _hidden_host,
    is_allowed,
)
from mcaprl.recorder.viewer.playback import Player, Track
from tests.support.recordings import record

KEY = base64.b64encode(b"0123456789abcdef").decode()


def head(host: str = "127.0.0.1:8765", origin: str | None = None, more: str = "") -> bytes:
    named = "" if origin is None else f"Origin: {origin}\r\n"
    return (
        f"GET / HTTP/1.1\r\nHost: {host}\r\n{named}{more}Upgrade: websocket\r\n"
        f"Connection: Upgrade\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: {KEY}\r\n"
        "Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n"
    ).encode()


@pytest.mark.parametrize(
    "request_head",
    [
        head(),
        head(host="localhost:1"),
        head(host="[::1]:8765"),
        head(origin="http://localhost:8080"),
        head(origin="https://127.0.0.1"),
        head(origin="https://viewer.example"),
        head(host="viewer.example", origin="https://viewer.example"),
        *(head(origin=origin) for origin in VIEWER_ORIGINS),
    ],
)
def test_programs_and_known_pages_are_allowed(request_head: bytes) -> None:
    assert is_allowed(request_head, [*VIEWER_ORIGINS, "https://viewer.example"])


@pytest.mark.parametrize(
    "request_head",
    [
        head(origin="https://evil.example"),
        head(host="evil.example"),
        head(host="evil.example:8765", origin="http://127.0.0.1:8765"),
        head(host=""),
        head(origin="null"),
        head(origin="http://localhost.evil.example"),
        head(origin="http://127.0.0.1.evil.example"),
        head(origin="http://127.0.0.1@evil.example"),
        head(origin="https://app.foxglove.dev.evil.example"),
        head(origin="https://[evil"),
        head(origin="https://app.foxglove.dev", more="Origin: https://evil.example\r\n"),
        head(more="Host: evil.example\r\n"),
        head(more=" Origin: https://evil.example\r\n"),
        head(more="no header\r\n"),
        head().replace(b"Upgrade: websocket\r\n", b""),
        b"GET / HTTP/1.1\r\n\r\n",
    ],
)
def test_foreign_pages_are_refused(request_head: bytes) -> None:
    assert not is_allowed(request_head, VIEWER_ORIGINS)


@pytest.fixture
def server(log_path: Path) -> Iterator[LiveServer]:
    pytest.importorskip("foxglove")
    record(log_path, spaces.Discrete(3), spaces.Discrete(2), [20, 20])
    player = Player([Track(McapReader(log_path))])
    with closing(LiveServer(player, port=0, origins=["https://viewer.example"])) as made:
        yield made


def answer(server: LiveServer, sent: bytes) -> bytes:
    """Send bytes to the server, and return the first bytes of its response."""
    port = int(server.url.rpartition(":")[2])
    with socket.create_connection((HOST, port), timeout=10) as connection:
        connection.sendall(sent)
        return connection.recv(4096)


def test_the_server_refuses_foreign_pages_only(server: LiveServer) -> None:
    for allowed in (head(), head(origin="https://viewer.example"), head(origin="file://")):
        assert answer(server, allowed).startswith(b"HTTP/1.1 101 ")
    for refused in (head(origin="https://evil.example"), head(host="evil.example")):
        assert answer(server, refused).startswith(b"HTTP/1.1 403 ")
    assert server.url.partition("//")[2].replace(":", "%3A") in server.app_url


def test_junk_and_half_requests_do_not_stop_the_server(server: LiveServer) -> None:
    port = int(server.url.rpartition(":")[2])
    with ExitStack() as stack:
        for _ in range(20):
            half = stack.enter_context(socket.create_connection((HOST, port)))
            half.sendall(b"GET / HTTP/1.1\r\nHost:")
        junk = stack.enter_context(socket.create_connection((HOST, port), timeout=10))
        with suppress(ConnectionError):
            junk.sendall(b"x" * 10**6)
            assert junk.recv(1) == b""
        assert answer(server, head()).startswith(b"HTTP/1.1 101 ")


@pytest.mark.parametrize("start", [b"", b"GET / HTTP/1.1\r\nHost:"])
def test_silent_clients_are_disconnected(
    server: LiveServer, start: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "CLIENT_TIMEOUT_S", 0.2)
    port = int(server.url.rpartition(":")[2])
    with socket.create_connection((HOST, port), timeout=2) as connection:
        connection.sendall(start)
        assert connection.recv(1) == b""
    assert answer(server, head()).startswith(b"HTTP/1.1 101 ")


def test_messages_pass_through_the_filter(server: LiveServer) -> None:
    port = int(server.url.rpartition(":")[2])
    with socket.create_connection((HOST, port), timeout=10) as connection:
        connection.sendall(head())
        received = b""
        while b"/rl/step" not in received:
            received += connection.recv(65536)
    assert b"serverInfo" in received


def test_a_port_in_use_is_one_clear_error(server: LiveServer) -> None:
    port = int(server.url.rpartition(":")[2])
    with pytest.raises(UsageError, match=rf"cannot listen on 127.0.0.1:{port}.*`port=`"):
        LiveServer(server._player, port=port)


def test_a_closed_server_leaves_no_thread_and_no_port(log_path: Path) -> None:
    pytest.importorskip("foxglove")
    record(log_path, spaces.Discrete(3), spaces.Discrete(2), [20])
    made = LiveServer(Player([Track(McapReader(log_path))]), port=0)
    port = int(made.url.rpartition(":")[2])
    with socket.create_connection((HOST, port)) as connection:
        connection.sendall(head())
        connection.recv(10)
        made.close()
    assert not [thread for thread in threading.enumerate() if "origin" in thread.name]
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection((HOST, port), timeout=10)


def test_the_inner_server_is_at_an_address_that_pages_cannot_guess() -> None:
    assert len({_hidden_host() for _ in range(100)}) > 90


@pytest.mark.parametrize("speed", [math.inf, -math.inf, math.nan, 1e300, 0.0, -1.0, 1e-300])
def test_speeds_that_no_clock_can_have_are_ignored(server: LiveServer, speed: float) -> None:
    command: Any = SimpleNamespace(
        playback_speed=speed,
        seek_time=None,
        playback_command=server._ws.PlaybackCommand.Play,
        request_id="1",
    )
    server.on_playback_control_request(command)
    server.tick(0.01)
    assert server._player.speed == 1.0
    command.playback_speed = MAX_SPEED
    server.on_playback_control_request(command)
    assert server._player.speed == MAX_SPEED


@pytest.mark.parametrize("episode", [math.inf, math.nan, -1, 1e300, "1", None])
def test_episodes_that_are_not_numbers_are_ignored(server: LiveServer, episode: Any) -> None:
    parameter: Any = SimpleNamespace(name="episode", get_value=lambda: episode)
    before = server._player.time_ns
    server.on_set_parameters(None, [parameter])
    assert server._player.time_ns == before
