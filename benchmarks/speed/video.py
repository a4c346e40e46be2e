"""Measure the CPU time of videos of a scene: reading the log, drawing and encoding.

`python -m benchmarks.speed.video` prints milliseconds per frame on this machine; `make bench` has
the ratios.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from fractions import Fraction
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

import mcaprl
from benchmarks.measure import OURS, Side, Table, compare, cpu_s
from mcaprl.sims import make_pilot, make_sim

SIMS = ("lane", "powerline", "racer")
STEPS = {"lane": 60, "powerline": 80, "racer": 200}
"""Largest number of recorded steps; they are 200 to 300 frames."""
GOAL_MS, HEIGHT = 10.0, 480
ROUNDS = 3


def tables(folder: Path) -> list[Table]:
    """Time the video of a short episode of each sim."""
    return [
        compare(
            f"Video of an episode of {name}, {HEIGHT} lines",
            _sides(name, folder),
            goal=f"{GOAL_MS:.0f} ms per frame, encoding included",
            rounds=ROUNDS,
            unit="CPU time per frame, ours = 1",
        )
        for name in SIMS
    ]


def main() -> None:
    """Print the milliseconds per frame of each side, in the best of several turns."""
    print("| sim | side | ms per frame |\n|---|---|---|")
    with TemporaryDirectory() as folder:
        for name in SIMS:
            for side in _sides(name, Path(folder)):
                taken_s = min(cpu_s(side.run) for _ in range(ROUNDS)) / side.share
                print(f"| {name} | {side.name} | {1000 * taken_s:.1f} |", flush=True)


def _sides(name: str, folder: Path) -> list[Side]:
    """Return the sides for one sim; a share of 1 is one frame."""
    log, video = folder / f"{name}.mcap", folder / f"{name}.mp4"
    _record(name, log)

    def ours() -> None:
        mcaprl.render(log, video=video, height=HEIGHT, overwrite=True)

    ours()
    images = _decoded(video)
    count = len(images)
    return [
        Side(OURS, ours, share=count),
        Side("x264 alone, our options", _encoder(images, superfast=True), share=count),
        Side("x264 alone, its default options", _encoder(images, superfast=False), share=count),
        Side("Matplotlib, 500 polygons of the same size, not encoded", _matplotlib(), share=1),
    ]


def _record(name: str, path: Path) -> None:
    env = make_sim(name)
    pilot = make_pilot(env)
    with closing(mcaprl.RecordMcap(env, path)) as recorder:
        observation, _ = recorder.reset(seed=1)
        for _ in range(STEPS[name]):
            observation, _, terminated, truncated, _ = recorder.step(
                pilot.act(observation[None])[0]
            )
            if terminated or truncated:
                break


def _decoded(path: Path) -> list[NDArray[np.uint8]]:
    import av

    with av.open(path) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def _encoder(images: list[NDArray[np.uint8]], *, superfast: bool) -> Callable[[], object]:
    """Return a function that encodes frames, which are already in the encoder's pixel format."""
    import av

    frames = [
        av.VideoFrame.from_ndarray(i, format="rgb24").reformat(format="yuv420p") for i in images
    ]
    options = {"preset": "superfast", "crf": "25"} if superfast else {}

    def run() -> None:
        with av.open(BytesIO(), "w", format="mp4") as container:
            stream: Any = container.add_stream("libx264", rate=Fraction(20), options=options)
            stream.height, stream.width, _ = images[0].shape
            stream.pix_fmt = "yuv420p"
            for number, frame in enumerate(frames):
                frame.pts = number
                container.mux(stream.encode(frame))
            container.mux(stream.encode())

    return run


def _matplotlib() -> Callable[[], object]:
    """Return a function that draws 500 quadrilaterals, as many faces as a frame of a sim shows."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.collections import PolyCollection
        from matplotlib.figure import Figure
    except ImportError as error:
        reason = str(error)

        def fail() -> object:
            raise ImportError(reason)

        return fail
    random = np.random.default_rng(0)
    corners = random.random((500, 1, 2)) + random.normal(0, 0.05, (500, 4, 2))
    colors = random.random((500, 3))

    def run() -> object:
        figure = Figure(figsize=(8.54, 4.8), dpi=100)
        canvas = FigureCanvasAgg(figure)
        axes = figure.add_axes((0, 0, 1, 1))
        axes.set_axis_off()
        axes.add_collection(PolyCollection(corners, facecolors=colors))
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())

    return run


if __name__ == "__main__":
    main()
