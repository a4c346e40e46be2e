"""Page that shows the episodes of a log in a browser, served on this machine or saved."""

from __future__ import annotations

import os
import sys
import threading
import webbrowser
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path

from mcaprl.api.environments import check_episode
from mcaprl.api.ranges import check_port, check_positive
from mcaprl.errors import ReportError, UnknownNameError
from mcaprl.files import check_target, replacing
from mcaprl.recorder.viewer.page.episode_data import LogPage
from mcaprl.recorder.viewer.page.server import PageServer, page_html
from mcaprl.storage.remote import as_path

_KINDS = (".html", ".htm")


def browse(
    data: str | Path,
    *,
    episode: int = 0,
    speed: float = 1.0,
    loop: bool = False,
    port: int = 0,
    show: bool = True,
    on_open: Callable[[str], None] = lambda url: None,
    stop: threading.Event | None = None,
) -> None:
    """Serve a page with a log's episodes on 127.0.0.1 until `stop` is set or Ctrl-C is pressed.

    Args:
        data: Path of the log.
        episode: Index of the episode that the page shows first.
        speed: Initial playback speed, simulated seconds per second.
        loop: Whether an episode restarts at its end.
        port: Port on 127.0.0.1; 0 for any free port.
        show: Whether to open the page in the browser, if there is a display.
        on_open: Function called with the URL when the page can be opened.
        stop: Event that ends the server.

    Raises:
        UsageError: The log has no such episode, the port is in use, or a number is out of range.
        LogError: The log cannot be read.
    """
    check_positive(speed=speed)
    check_port(port)
    page = _page(data, episode)
    with closing(PageServer(page, port=port, first=episode, speed=speed, loop=loop)) as server:
        on_open(server.url)
        if show and _has_display():
            webbrowser.open(server.url)
        with suppress(KeyboardInterrupt):
            server.run(stop or threading.Event())


def save_page(
    data: str | Path,
    page: str | Path,
    *,
    episode: int = 0,
    speed: float = 1.0,
    loop: bool = False,
    overwrite: bool = False,
) -> int:
    """Save an episode as one HTML file, which a browser shows without a server or a network.

    Args:
        data: Path of the log.
        page: File to write: .html.
        episode: Index of the episode.
        speed: Initial playback speed, simulated seconds per second.
        loop: Whether the episode restarts at its end.
        overwrite: Whether an existing file is replaced.

    Returns:
        Size of the page in bytes.

    Raises:
        UsageError: The log has no such episode, or `speed` is not positive.
        LogError: The log cannot be read.
        OutputExistsError: `page` exists.
        ReportError: `page` cannot be written.
    """
    check_positive(speed=speed)
    out = Path(page)
    if out.suffix not in _KINDS:
        raise UnknownNameError("kind of output", out.suffix or out.name, _KINDS)
    check_target(out, overwrite=overwrite)
    log = _page(data, episode)
    index = log.index(only=episode, first=episode, speed=speed, loop=loop)
    html = page_html(index, log.episode(episode)).encode()
    with replacing(out, ReportError, overwrite=overwrite) as unfinished:
        unfinished.write_bytes(html)
    return len(html)


def _page(data: str | Path, episode: int) -> LogPage:
    path = as_path(data)
    page = LogPage(path)
    check_episode(page.dataset, episode, path)
    return page


def _has_display() -> bool:
    """Return whether a browser can open a window. Otherwise, `webbrowser` runs text browsers."""
    has_windows = sys.platform in ("win32", "darwin")
    return has_windows or any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY")))
