"""Replay of logs to Foxglove viewers."""

from __future__ import annotations

import tempfile
import threading
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path

from mcaprl.api.data import Paths
from mcaprl.api.environments import check_episode
from mcaprl.api.policies import as_names
from mcaprl.api.ranges import check_port, check_positive
from mcaprl.files import write_json
from mcaprl.recorder.dataset.open import find_logs, open_logs
from mcaprl.recorder.format.reading import McapReader
from mcaprl.recorder.viewer.foxglove_server import DEFAULT_PORT
from mcaprl.recorder.viewer.log_layout import attached_layout
from mcaprl.recorder.viewer.playback import Player, Track
from mcaprl.recorder.viewer.player_server import LiveServer
from mcaprl.recorder.viewer.prefix import prefixes_of, side_by_side


@dataclass(frozen=True)
class LiveAddress:
    """Address at which viewers connect.

    Attributes:
        app_url: Address that opens Foxglove and connects it.
        url: Address of the server, for any viewer of the Foxglove protocol.
        layout: Path of the layout to import.
    """

    app_url: str
    url: str
    layout: Path


def replay(
    files: Paths,
    *,
    episode: int | None = None,
    speed: float = 1.0,
    loop: bool = False,
    port: int = DEFAULT_PORT,
    allow_origin: str | Sequence[str] = (),
    on_open: Callable[[LiveAddress], None] = lambda address: None,
    stop: threading.Event | None = None,
) -> None:
    """Play logs in Foxglove until `stop` is set or Ctrl-C is pressed.

    Several logs play side by side: all start at the same time, each with its own topic prefix.

    Args:
        files: File, folder or glob of logs, or several of them.
        episode: Index of the only episode to play; None for all.
        speed: Simulated seconds per second.
        loop: Whether the replay restarts at the end.
        port: Port on 127.0.0.1; 0 for any free port.
        allow_origin: Origin, or several, of web pages that may connect, besides pages on this
            machine, Foxglove and Lichtblick.
        on_open: Function called with the address once viewers can connect.
        stop: Event that ends the replay.

    Raises:
        UsageError: A log does not have the episode, the port is in use, or a number is out of
            range.
        LogError: A log cannot be read.
        MissingExtraError: The packages of the `foxglove` extra are not installed.
    """
    check_positive(speed=speed)
    check_port(port)
    paths = find_logs(files)
    datasets = [open_logs(path, columns=[]) for path in paths]
    windows = []
    for path, dataset in zip(paths, datasets, strict=True):
        check_episode(dataset, episode, path)
        chosen = dataset.episodes if episode is None else dataset.episodes[episode : episode + 1]
        windows.append((int(chosen[0].log_time_ns[0]), int(chosen[-1].log_time_ns[-1])))
    readers = [McapReader(path) for path in paths]
    tracks = [Track(*pair) for pair in zip(readers, windows, strict=True)]
    player = Player(tracks, speed=speed, loops=loop)
    starts = [int(e.log_time_ns[0]) for e in datasets[0].episodes] if episode is None else []
    prefixes = prefixes_of(paths)
    layout = side_by_side([attached_layout(reader) for reader in readers], prefixes)
    server = LiveServer(
        player,
        prefixes=prefixes,
        episode_starts_ns=starts,
        name=", ".join(path.name for path in paths),
        port=port,
        origins=as_names(allow_origin),
    )
    with tempfile.TemporaryDirectory(prefix="mcaprl-") as folder, closing(server):
        layout_path = Path(folder) / "foxglove-layout.json"
        write_json(layout_path, layout)
        on_open(LiveAddress(server.app_url, server.url, layout_path))
        with suppress(KeyboardInterrupt):
            server.run(stop or threading.Event())
