"""HTTP server on 127.0.0.1 that serves a folder, supports range requests and counts bytes."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from email.utils import formatdate
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread


@dataclass
class RangeServer:
    """A running HTTP server.

    Attributes:
        url: URL of the folder.
        folder: Folder that is served.
        sent: Number of bytes of each answer to a GET request.
        knows_ranges: Whether the server supports range requests.
        sends_dates: Whether the server sends the time of the last change of a file.
        cuts: Whether the server closes the connection in the middle of an answer.
        refusal: Status of the answer to a request for a missing file.
    """

    url: str
    folder: Path
    sent: list[int] = field(default_factory=list)
    knows_ranges: bool = True
    sends_dates: bool = True
    cuts: bool = False
    refusal: int = 404


@contextmanager
def range_server(folder: Path) -> Iterator[RangeServer]:
    """Serve a folder until the context ends."""

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_HEAD(self) -> None:
            self._answer(send=False)

        def do_GET(self) -> None:
            self._answer(send=True)

        def _answer(self, *, send: bool) -> None:
            path = folder / self.path.lstrip("/")
            if not path.is_file():
                self.send_error(state.refusal)
                return
            content = path.read_bytes()
            wanted = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range", ""))
            start, stop = 0, len(content)
            if wanted and state.knows_ranges:
                start, stop = int(wanted[1]), min(int(wanted[2]) + 1, len(content))
                self.send_response(206)
                self.send_header("Content-Range", f"bytes {start}-{stop - 1}/{len(content)}")
            else:
                self.send_response(200)
            if state.knows_ranges:
                self.send_header("Accept-Ranges", "bytes")
            if state.sends_dates:
                changed_s = path.stat().st_mtime
                self.send_header("Last-Modified", formatdate(changed_s, usegmt=True))
            self.send_header("Content-Length", str(stop - start))
            self.end_headers()
            if send:
                state.sent.append(stop - start)
                if state.cuts:
                    self.wfile.write(content[start : (start + stop) // 2])
                    self.close_connection = True
                else:
                    self.wfile.write(content[start:stop])

        def log_message(self, *_: object) -> None:
            return

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    state = RangeServer(f"http://127.0.0.1:{server.server_port}", folder)
    thread = Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield state
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
