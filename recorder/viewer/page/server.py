"""The page of one log as an HTML text without references to other files, and its HTTP server.

The server on 127.0.0.1 answers two kinds of requests: `/` returns the page, and `/episode/K` the
packed data of an episode. No request names a file. A web page of another site cannot read the
answers, because the server checks the origin and the host name that browsers send with a request.
"""

from __future__ import annotations

import base64
import hashlib
import re
import socket
import sys
import threading
from contextlib import suppress
from functools import lru_cache
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from string import Template
from typing import Any

from mcaprl import limits
from mcaprl.errors import McaprlError, UsageError
from mcaprl.recorder.viewer.foxglove_server import is_loopback
from mcaprl.recorder.viewer.page.episode_data import LogPage

_SCRIPTS = ("data.js", "scene.js", "plots.js", "images.js", "main.js")


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

    def __init__(self, page: LogPage, *, port: int, **settings: Any) -> None:
        """Start to listen."""
        self._html = page_html(page.index(**settings)).encode()
        self._count = len(page.dataset.episodes)
        self._episode = lru_cache(_EPISODES_KEPT)(page.episode)
        handler = type("_Handler", (_Handler,), {"respond": self._respond})
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

    def _respond(self, path: str) -> tuple[int, str, bytes]:
        """Return status, type and body of the answer to a request."""
        found = _EPISODE.fullmatch(path)
        if path == "/":
            return 200, "text/html; charset=utf-8", self._html
        if found is None or int(found[1]) >= self._count:
            return 404, "text/plain; charset=utf-8", b"there is no such page"
        try:
            return 200, "application/octet-stream", self._episode(int(found[1]))
        except McaprlError as error:
            return 500, "text/plain; charset=utf-8", str(error).encode(errors="backslashreplace")


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def handle_error(self, *_: Any) -> None:
        """Ignore errors of connections that are closed early or too slow; print all others."""
        if not isinstance(sys.exception(), ConnectionError | TimeoutError):
            super().handle_error(*_)


class _Handler(BaseHTTPRequestHandler):
    respond: Any

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
            status, kind, body = 403, "text/plain; charset=utf-8", b"this page may not connect"
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
