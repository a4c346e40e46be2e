"""Images of an episode: a video, or a contact sheet."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from mcaprl.api.environments import check_episode, sim_of
from mcaprl.api.ranges import check_positive
from mcaprl.errors import LogError, UsageError
from mcaprl.progress import Advance, ProgressBar, no_progress
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.episode import Episode
from mcaprl.recorder.dataset.open import open_logs
from mcaprl.recorder.format.reading import McapReader
from mcaprl.recorder.record.display import SCENE
from mcaprl.recorder.viewer.scene_reader import moments_of_episode
from mcaprl.recorder.viewer.verify import verify
from mcaprl.recorder.viewer.video import (
    VIDEO_KINDS,
    check_output,
    evenly_spaced,
    shown_steps,
    write_sheet,
    write_video,
)

Images = Iterator[NDArray[np.uint8]]
MakeEnv = Callable[[], gym.Env[Any, Any]]
"""Function that makes the environment of a log."""
STILLS = 12


@dataclass(frozen=True)
class Rendering:
    """Result of `render`.

    Attributes:
        episode: Index of the episode.
        frames: Number of images of the video; 0 without one.
        stills: Number of images of the contact sheet; 0 without one.
    """

    episode: int
    frames: int
    stills: int


def render(
    file: str | Path,
    *,
    episode: int = 0,
    speed: float = 1.0,
    video: str | Path | None = None,
    contact_sheet: str | Path | None = None,
    overwrite: bool = False,
    sim: str | None = None,
    trust_env: bool = False,
    progress: ProgressBar = no_progress,
) -> Rendering:
    """Render one episode of a log from its scene or, without one, with the sim.

    Args:
        file: Path of the log.
        episode: Index of the episode.
        speed: Simulated seconds per second of the video.
        video: Video to write: .mp4 or .gif.
        contact_sheet: Image to write, .png, with evenly spaced steps.
        overwrite: Whether existing files are replaced.
        sim: Short name or Gymnasium id to use instead of the logged one.
        trust_env: Whether to import the module that the logged id names, and to pass the logged
            arguments to any environment.
        progress: Function that opens a progress bar.

    Raises:
        UsageError: There is no output, the log has no such episode, `speed` is not positive, or the
            sim renders no images.
        LogError: The log has no scene, and the sim does not reproduce the episode.
        OutputExistsError: An output exists.
        MissingExtraError: The packages of the `video` extra are not installed.
    """
    check_positive(speed=speed)
    if video is None and contact_sheet is None:
        raise UsageError("render needs a video, a contact sheet, or both")
    path = Path(file)
    check_episode(open_logs(path, columns=[]), episode, path)
    movie, sheet = (None if out is None else Path(out) for out in (video, contact_sheet))
    for out, kinds in ((movie, VIDEO_KINDS), (sheet, (".png",))):
        if out is not None:
            check_output(out, kinds, overwrite=overwrite)
    dataset = open_logs(path)
    one = dataset.episodes[episode]
    make = partial(sim_of, dataset, path, sim, trust_env=trust_env, render_mode="rgb_array")
    frames, stills = 0, list[int]()
    if movie is not None:
        step_ns = float(np.median(np.diff(one.log_time_ns)))
        shown, images_per_s = shown_steps(one.length, speed * 1e9 / step_ns)
        with progress(f"drawing {movie}", len(shown)) as advance:
            images = _counted(_images(path, dataset, one, shown, make), advance)
            frames = write_video(movie, images, images_per_s)
    if sheet is not None:
        stills = evenly_spaced(one.length, STILLS)
        write_sheet(sheet, list(_images(path, dataset, one, stills, make)))
    return Rendering(episode, frames, len(stills))


def _images(
    path: Path, dataset: Dataset, episode: Episode, steps: Collection[int], make: MakeEnv
) -> Images:
    reader = McapReader(path)
    if reader.channel_of(SCENE) is not None:
        return _of_scene(reader, dataset, episode, steps)
    return _of_sim(path, dataset, episode, steps, make)


def _of_scene(
    reader: McapReader, dataset: Dataset, episode: Episode, steps: Collection[int]
) -> Images:
    from mcaprl.sims.drawing.chase_view import ChaseView
    from mcaprl.sims.drawing.scene import Frame, Shape

    static, last = [], None
    with closing(ChaseView()) as view:
        for moment in moments_of_episode(reader, episode):
            if moment.step not in steps:
                continue
            if moment.static is not last:
                static, last = [Shape(**vars(seen)) for seen in moment.static], moment.static
            yield view.draw(
                static,
                [Shape(**vars(seen)) for seen in moment.moving],
                [Frame(**vars(seen)) for seen in moment.frames],
                moment.follow,
                _caption(dataset, episode, moment.step),
            )


def _of_sim(
    path: Path, dataset: Dataset, episode: Episode, steps: Collection[int], make: MakeEnv
) -> Images:
    """Yield the images that the sim renders while it repeats the logged actions."""
    found: list[NDArray[np.uint8]] = []
    with closing(make()) as env:

        def draw(now: Episode, step: int) -> None:
            if now.index == episode.index and step in steps:
                image = env.render()
                if not isinstance(image, np.ndarray):
                    raise UsageError(f"{path} has no scene, and {dataset.env_id} renders no images")
                found.append(np.ascontiguousarray(image, np.uint8))

        result = verify(dataset, env, only=episode.index, on_frame=draw)
    if result.difference is not None:
        raise LogError(f"{path} has no scene, and the sim has changed: {result.difference}")
    if not found:
        raise LogError(f"{path} has no scene, and episode {episode.index} has no seed")
    yield from found


def _caption(dataset: Dataset, episode: Episode, step: int) -> list[str]:
    """Return the lines in the corner of an image."""
    since_s = (episode.log_time_ns[step] - episode.log_time_ns[0]) / 1e9
    first = f"episode {episode.index}   {since_s:.2f} s   step {step} of {episode.length}"
    total = float(episode.rewards[:step].sum())
    if step == episode.length:
        return [first, f"return {total:.2f}   {episode.reason}"]
    action = episode.actions[step]
    name = dataset.action_names.get(int(action), "") if action.ndim == 0 else ""
    return [first, f"return {total:.2f}   {name}"]


def _counted(images: Images, advance: Advance) -> Images:
    for image in images:
        advance(1)
        yield image
