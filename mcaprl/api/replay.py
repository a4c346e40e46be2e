"""Replay of logs: in viewers, as images, or as a comparison of each step with the sim."""

from __future__ import annotations

import threading
import warnings
import webbrowser
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from mcaprl.api.environments import all_options, check_episode, sim_of
from mcaprl.api.policies import as_names
from mcaprl.api.ranges import check_port, check_positive
from mcaprl.errors import LogError, OutputExistsError, ReportError, UnknownNameError, UsageError
from mcaprl.files import check_target, replacing, temporary_folder, write_json
from mcaprl.progress import Advance, ProgressBar, no_progress
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.labels import Labels, label_by_json, labels_to_carry, read_labels
from mcaprl.recorder.dataset.open import find_logs
from mcaprl.recorder.dataset.transitions import Episode
from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.format.reading import McapReader
from mcaprl.recorder.format.schema import LABELS_TOPIC
from mcaprl.recorder.record.display import SCENE
from mcaprl.recorder.record.layout import LAYOUT_NAME
from mcaprl.recorder.record.panels import bounded_actions
from mcaprl.recorder.record.scene import DepthSource
from mcaprl.recorder.record.wrapper import RecordMcap
from mcaprl.recorder.source import Paths, open_data
from mcaprl.recorder.viewer.annotate import Comparison, Verification, attached_layout, write_labels
from mcaprl.recorder.viewer.annotate import verify as verify_dataset
from mcaprl.recorder.viewer.foxglove_server import (
    DEFAULT_PORT,
    MAX_SPEED,
    MIN_SPEED,
    LiveServer,
    prefixes_of,
    side_by_side,
)
from mcaprl.recorder.viewer.page.log_page import LogPage, PageServer, page_html
from mcaprl.recorder.viewer.playback import Player, SeenStep, Track, moments_of_episode
from mcaprl.recorder.viewer.video import (
    VIDEO_KINDS,
    check_output,
    evenly_spaced,
    parts_of_step,
    shown_steps,
    write_sheet,
    write_video,
)
from mcaprl.sims import SIMS, make_sim
from mcaprl.storage.remote import as_path, is_url
from mcaprl.system import has_display

_Images = Iterator[NDArray[np.uint8]]
_STILLS, _MOST_DIALS, _HEIGHTS_PX = 12, 8, (16, 4320)
_HOLD_S = 1.0  # Seconds for which a video shows the last image, which says how the episode ended


@dataclass(frozen=True)
class LiveAddress:
    """Address at which viewers connect.

    Attributes:
        app_url: URL that opens Foxglove and connects it to the server.
        url: Address of the server, for any viewer of the Foxglove protocol.
        layout: Path of the layout to import.
    """

    app_url: str
    url: str
    layout: Path


def replay(
    data: Paths,
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
        data: File, folder or glob of logs, or several of them.
        episode: Index of the only episode to play; None for all.
        speed: Simulated seconds per second.
        loop: Whether the replay restarts at the end.
        port: Port on 127.0.0.1; 0 for any free port.
        allow_origin: Origin of other web pages that may connect, or a list of origins. Pages on
            this machine, Foxglove and Lichtblick may always connect.
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
    paths = find_logs(data)
    datasets = [open_data(path, columns=[]) for path in paths]
    windows = []
    for path, dataset in zip(paths, datasets, strict=True):
        check_episode(dataset, episode, path)
        chosen = dataset.episodes if episode is None else dataset.episodes[episode : episode + 1]
        windows.append((int(chosen[0].log_time_ns[0]), int(chosen[-1].log_time_ns[-1])))
    readers = [McapReader(path) for path in paths]
    tracks = [Track(*pair) for pair in zip(readers, windows, strict=True)]
    starts = [int(e.log_time_ns[0]) for e in datasets[0].episodes] if episode is None else []
    prefixes = prefixes_of(paths)
    layout = side_by_side([attached_layout(reader) for reader in readers], prefixes)
    with temporary_folder() as folder, ExitStack() as opened:
        for number, path in enumerate(paths):
            if labels := _label_track(path, windows[number], folder / f"labels-{number}.mcap"):
                tracks.append(labels)
                prefixes.append(prefixes[number])
        server = LiveServer(
            Player(tracks, speed=speed, loops=loop),
            prefixes=prefixes,
            episode_starts_ns=starts,
            name=", ".join(path.name for path in paths),
            port=port,
            origins=as_names(allow_origin),
        )
        opened.enter_context(closing(server))
        layout_path = folder / LAYOUT_NAME
        write_json(layout_path, layout)
        on_open(LiveAddress(server.app_url, server.url, layout_path))
        with suppress(KeyboardInterrupt):
            server.run(stop or threading.Event())


def _label_track(path: Path, window_ns: tuple[int, int], out: Path) -> Track | None:
    """Return what shows the labels of a log beside it; None without labels."""
    if is_url(path) or LABELS_TOPIC in {one.topic for one in McapReader(path).channels.values()}:
        return None
    try:
        labels = labels_to_carry(path)
    except LogError as error:
        warnings.warn(str(error), stacklevel=3)
        return None
    if labels is None or not (texts := labels.texts(open_data(path, columns=[]))):
        return None
    write_labels(out, texts)
    return Track(McapReader(out), window_ns)


def verify(
    data: str | Path,
    *,
    episode: int | None = None,
    sim: str | None = None,
    trust_env: bool = False,
    sim_options: Mapping[str, Any] | None = None,
    progress: ProgressBar = no_progress,
) -> Verification:
    """Repeat the logged actions in the sim, and compare each step until one differs.

    Args:
        data: Path of the log.
        episode: Index of the only episode to compare; None for all.
        sim: Short name or Gymnasium id to use instead of the logged one.
        trust_env: Whether to import the module that the logged id names, and to pass the logged
            arguments to environments other than the sims of `SIMS`. Arguments with which the
            environment is registered need no trust.
        sim_options: Arguments of the environment that replace the logged ones.
        progress: Function that opens a progress bar.

    Raises:
        UsageError: The log has no such episode, or no environment id.
        LogError: The log cannot be read, or the sim fails on a logged action.
        SpaceError: The spaces of the sim and the log differ.
    """
    path = as_path(data)
    dataset = open_data(path)
    check_episode(dataset, episode, path)
    with (
        closing(sim_of(dataset, path, sim, trust_env=trust_env, sim_options=sim_options)) as env,
        progress("stepping", len(dataset)) as advance,
    ):
        return verify_dataset(
            dataset, env, only=episode, on_frame=lambda _, step: advance(min(step, 1))
        )


@dataclass(frozen=True)
class Rendering:
    """Result of `render`.

    Attributes:
        episode: Index of the episode.
        frames: Number of images of the video; 0 without a video.
        stills: Number of images of the contact sheet; 0 without a contact sheet.
    """

    episode: int
    frames: int
    stills: int


def render(
    data: str | Path,
    *,
    episode: int = 0,
    speed: float = 1.0,
    video: str | Path | None = None,
    contact_sheet: str | Path | None = None,
    height: int | None = None,
    overwrite: bool = False,
    sim: str | None = None,
    trust_env: bool = False,
    sim_options: Mapping[str, Any] | None = None,
    progress: ProgressBar = no_progress,
) -> Rendering:
    """Render one episode of a log.

    The images show the logged scene. If the log has no scene, the sim repeats the episode and
    renders the images.

    Args:
        data: Path of the log.
        episode: Index of the episode.
        speed: Simulated seconds per second of the video.
        video: Video to write: .mp4, .gif or .webp.
        contact_sheet: PNG image to write; it shows evenly spaced steps.
        height: Height of the images of a logged scene in pixels, 16 to 4320; default: 540. The
            width is 16/9 of it.
        overwrite: Whether existing files are replaced.
        sim: Short name or Gymnasium id to use instead of the logged one.
        trust_env: Whether to import the module that the logged id names, and to pass the logged
            arguments to any environment.
        sim_options: Arguments of the environment that replace the logged ones.
        progress: Function that opens a progress bar.

    Raises:
        UsageError: Both outputs are None, the episode does not exist, `speed` or `height` is out of
            range, `height` is given for a log without a scene, or the sim renders no images.
        LogError: The log has no scene, and the sim does not reproduce the episode.
        OutputExistsError: An output exists.
        MissingExtraError: The packages of the `video` extra are not installed.
    """
    if not MIN_SPEED <= speed <= MAX_SPEED:
        raise UsageError(f"`speed={speed}`: give a number from {MIN_SPEED:g} to {MAX_SPEED:g}")
    if video is None and contact_sheet is None:
        raise UsageError("render needs a video, a contact sheet, or both")
    if height is not None and not _HEIGHTS_PX[0] <= height <= _HEIGHTS_PX[1]:
        raise UsageError(
            f"height is {height}, expected {_HEIGHTS_PX[0]} to {_HEIGHTS_PX[1]} pixels"
        )
    path = as_path(data)
    check_episode(open_data(path, columns=[]), episode, path)
    movie, sheet = (None if out is None else Path(out) for out in (video, contact_sheet))
    for out, kinds in ((movie, VIDEO_KINDS), (sheet, (".png",))):
        if out is not None:
            check_output(out, kinds, overwrite=overwrite)
    dataset = open_data(path)
    one = dataset.episodes[episode]
    reader = McapReader(path)
    has_scene = reader.channel_of(SCENE) is not None
    if has_scene:
        draw = partial(_of_scene, reader, dataset, one, height=height)
    elif height is not None:
        raise UsageError(
            f"{path} has no scene, so the sim chooses the height of its images: omit the height"
        )
    else:
        trust: dict[str, Any] = {"trust_env": trust_env, "sim_options": sim_options}
        make = partial(sim_of, dataset, path, sim, render_mode="rgb_array", **trust)
        draw = partial(_of_sim, path, dataset, one, make)
    frames, stills = 0, list[int]()
    if movie is not None:
        step_ns = float(np.median(np.diff(one.log_time_ns)))
        shown, images_per_s = shown_steps(one.length, speed * 1e9 / step_ns)
        # A logged scene can be drawn at times between two steps. The sim renders only the steps.
        parts = parts_of_step(images_per_s) if has_scene else 1
        images = draw(shown, parts) if has_scene else draw(shown)
        with progress(f"drawing {movie}", (len(shown) - 1) * parts + 1) as advance:
            fps = images_per_s * parts
            frames = write_video(movie, _counted(images, advance), fps, _HOLD_S)
    if sheet is not None:
        stills = evenly_spaced(one.length, _STILLS)
        write_sheet(sheet, list(draw(stills)))
    return Rendering(episode, frames, len(stills))


def _of_scene(
    reader: McapReader,
    dataset: Dataset,
    episode: Episode,
    steps: Collection[int],
    parts: int = 1,
    *,
    height: int | None,
) -> _Images:
    from mcaprl.sims.drawing.chase_view import HEIGHT_PX, ChaseView, Dial
    from mcaprl.sims.drawing.scene import Frame, Shape

    static, moving, last = [], [], SeenStep(0, 0)
    bounded = bounded_actions(LogMetadata.from_strings(dataset.metadata))[:_MOST_DIALS]
    actions = episode.actions.reshape(episode.length, -1)
    with closing(ChaseView(height or HEIGHT_PX)) as view:
        for moment in moments_of_episode(reader, episode, parts):
            if moment.step not in steps:
                continue
            # The view prepares a list of shapes once, so an unchanged list stays the same object.
            if moment.static is not last.static:
                static = [Shape(**vars(seen)) for seen in moment.static]
            if moment.moving is not last.moving:
                moving = [Shape(**vars(seen)) for seen in moment.moving]
            last = moment
            yield view.draw(
                static,
                moving,
                [Frame(**vars(seen)) for seen in moment.frames],
                moment.follow,
                _caption(dataset, episode, moment.step, moment.time_ns),
                [
                    Dial(one.name, float(actions[moment.step, one.element]), *one.ends)
                    for one in bounded
                    if moment.step < episode.length
                ],
            )


def _of_sim(
    path: Path,
    dataset: Dataset,
    episode: Episode,
    make: Callable[[], gym.Env[Any, Any]],
    steps: Collection[int],
) -> _Images:
    """Yield the images that the sim renders while it repeats the logged actions."""
    with closing(make()) as env:
        comparison = Comparison(dataset, env, episode.index)
        for now, step in comparison:
            if now.index == episode.index and step in steps:
                image = env.render()
                if not isinstance(image, np.ndarray):
                    raise UsageError(f"{path} has no scene, and {dataset.env_id} renders no images")
                yield np.ascontiguousarray(image, np.uint8)
    if comparison.result.difference is not None:
        what = comparison.result.difference
        raise LogError(f"{path} has no scene, and the sim has changed: {what}")
    if episode.index in comparison.result.unseeded:
        raise LogError(f"{path} has no scene, and episode {episode.index} has no seed")


def _caption(dataset: Dataset, episode: Episode, step: int, time_ns: int) -> list[str]:
    """Return the lines in the corner of an image."""
    since_s = (time_ns - int(episode.log_time_ns[0])) / 1e9
    first = f"episode {episode.index}   {since_s:.2f} s   step {step} of {episode.length}"
    total = float(episode.rewards[:step].sum())
    if step == episode.length:
        return [first, f"return {total:.2f}   {episode.reason}"]
    action = episode.actions[step]
    name = dataset.action_names.get(int(action), "") if action.ndim == 0 else ""
    return [first, f"return {total:.2f}   {name}"]


def _counted(images: _Images, advance: Advance) -> _Images:
    for image in images:
        advance(1)
        yield image


def layout(
    source: str | Path,
    out: str | Path | None = None,
    *,
    actions: str | int | None = None,
    sim_options: Mapping[str, Any] | None = None,
    keys: Sequence[str] | None = None,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Return the Foxglove layout of a log, or of the logs of a sim.

    Args:
        source: Path or URL of a log, short name of a sim, or Gymnasium id.
        out: JSON file to write; None to write nothing.
        actions: Actions of the sim, such as `continuous`.
        sim_options: Other arguments of the environment.
        keys: Keys of the parts of a Dict or Tuple observation that the logs contain; default: all.
        overwrite: Whether an existing file is replaced.

    Raises:
        UsageError: `out` has the suffix of a log, or arguments or keys are given for a log.
        UnknownNameError: There is no such sim.
        OutputExistsError: `out` exists.
        LogError: The log cannot be read.
        ReportError: `out` cannot be written.
    """
    path = None if out is None else Path(out)
    if path is not None and path.suffix == ".mcap":
        raise UsageError(f"{path}: a layout is a JSON file and must not replace a log")
    if path is not None and path.exists() and not overwrite:
        raise OutputExistsError(f"{path} exists: choose another path, or pass `overwrite=True`")
    name = str(source)
    is_file = is_url(name) or Path(name).is_file() or name.endswith(".mcap")
    is_log = name not in SIMS and is_file
    options = all_options(None, None, actions, sim_options)
    if is_log and (options or keys is not None):
        raise UsageError(
            f"{name} is a log, but `actions=`, `sim_options=` and `keys=` are for a sim: omit them"
        )
    found = attached_layout(McapReader(name)) if is_log else _layout_of_sim(name, options, keys)
    if path is not None:
        write_json(path, found, ReportError)
    return found


def _layout_of_sim(sim: str, options: dict[str, Any], keys: Sequence[str] | None) -> dict[str, Any]:
    """Return the layout of a temporary recording of a sim."""
    with temporary_folder() as folder:
        path = folder / "reset.mcap"
        env = make_sim(sim, **options)
        camera = isinstance(env.unwrapped, DepthSource)
        with closing(RecordMcap(env, path, camera=camera, keys=keys)) as log:
            log.reset(seed=0)
        return attached_layout(McapReader(path))


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

    The page also labels episodes and steps; it saves what `mcaprl.label` saves, beside the log.

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
    settings: dict[str, Any] = {"first": episode, "speed": speed, "loop": loop}
    label = None if is_url(data) else partial(label_by_json, Path(data))
    labels = partial(_labels, data)
    with closing(PageServer(page, port=port, labels=labels, label=label, **settings)) as server:
        on_open(server.url)
        if show and has_display():
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
    settings = {"first": episode, "speed": speed, "loop": loop, **_labels(data)}
    index = log.index(only=episode, **settings)
    html = page_html(index, log.episode(episode)).encode()
    with replacing(out, ReportError, overwrite=overwrite) as unfinished:
        unfinished.write_bytes(html)
    return len(html)


def _page(data: str | Path, episode: int) -> LogPage:
    path = as_path(data)
    page = LogPage(path)
    check_episode(page.dataset, episode, path)
    return page


def _labels(data: str | Path) -> dict[str, Any]:
    """Return the labels of a log, and why they cannot be read, as settings of a page."""
    if is_url(data):
        return {"labels": Labels("").to_json(), "problem": ""}
    try:
        return {"labels": read_labels(Path(data)).to_json(), "problem": ""}
    except LogError as error:
        return {"labels": Labels("").to_json(), "problem": str(error)}
