"""`mcaprl replay --video` and `--contact-sheet`: an episode as a film or as stills."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from contextlib import closing
from pathlib import Path

import click
import numpy as np
from numpy.typing import NDArray

from mcaprl.cli.show import progress
from mcaprl.errors import LogError, UsageError
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

Pictures = Iterator[NDArray[np.uint8]]
STILLS = 12


def make_film(
    path: Path,
    number: int,
    *,
    sim: str | None,
    speed: float,
    video: Path | None,
    sheet: Path | None,
    overwrite: bool,
) -> None:
    """Draw one episode of a log, from its scene or, without one, as the sim draws itself."""
    for out, kinds in ((video, VIDEO_KINDS), (sheet, (".png",))):
        if out is not None:
            check_output(out, kinds, overwrite=overwrite)
    dataset = open_logs(path)
    episode = dataset.episodes[number]
    if video is not None:
        step_ns = float(np.median(np.diff(episode.log_time_ns)))
        shown, pictures_per_s = shown_steps(episode.length, speed * 1e9 / step_ns)
        with progress(f"drawing {video}", len(shown)) as advance:
            pictures = _ticking(_pictures(path, dataset, episode, shown, sim), advance)
            count = write_video(video, pictures, pictures_per_s)
        click.echo(f"{video}: {count} pictures of episode {number}")
    if sheet is not None:
        steps = evenly_spaced(episode.length, STILLS)
        write_sheet(sheet, list(_pictures(path, dataset, episode, steps, sim)))
        click.echo(f"{sheet}: {len(steps)} stills of episode {number}")


def _pictures(
    path: Path, dataset: Dataset, episode: Episode, steps: Collection[int], sim: str | None
) -> Pictures:
    reader = McapReader(path)
    if reader.channel_of(SCENE) is not None:
        return _of_scene(reader, dataset, episode, steps)
    return _of_sim(path, dataset, episode, steps, sim)


def _of_scene(
    reader: McapReader, dataset: Dataset, episode: Episode, steps: Collection[int]
) -> Pictures:
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
                caption(dataset, episode, moment.step),
            )


def _of_sim(
    path: Path, dataset: Dataset, episode: Episode, steps: Collection[int], sim: str | None
) -> Pictures:
    """As the sim draws itself, stepped through the log."""
    from mcaprl.cli.replay import sim_of

    found: list[NDArray[np.uint8]] = []
    with closing(sim_of(dataset, path, sim, render_mode="rgb_array")) as env:

        def draw(now: Episode, step: int) -> None:
            if now.index == episode.index and step in steps:
                picture = env.render()
                if not isinstance(picture, np.ndarray):
                    raise UsageError(f"{path} has no scene, and {dataset.env_id} draws no pictures")
                found.append(np.ascontiguousarray(picture, np.uint8))

        result = verify(dataset, env, only=episode.index, on_frame=draw)
    if result.difference is not None:
        raise LogError(f"{path} has no scene, and the sim is another now: {result.difference}")
    if not found:
        raise LogError(f"{path} has no scene, and no seed of episode {episode.index}")
    yield from found


def caption(dataset: Dataset, episode: Episode, step: int) -> list[str]:
    """What stands in the corner of a picture."""
    since_s = (episode.log_time_ns[step] - episode.log_time_ns[0]) / 1e9
    first = f"episode {episode.index}   {since_s:.2f} s   step {step} of {episode.length}"
    total = float(episode.rewards[:step].sum())
    if step == episode.length:
        return [first, f"return {total:.2f}   {episode.reason}"]
    action = episode.actions[step]
    name = dataset.action_names.get(int(action), "") if action.ndim == 0 else ""
    return [first, f"return {total:.2f}   {name}"]


def _ticking(pictures: Pictures, advance: Callable[[], None]) -> Pictures:
    for picture in pictures:
        advance()
        yield picture
