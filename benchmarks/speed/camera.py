"""Measure the CPU time of the images of a video topic, beside PyAV alone.

`python -m benchmarks.speed.camera` prints milliseconds per frame on this machine; `make bench` has
the ratios.
"""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import av
import foxglove
import numpy as np
from av.video.reformatter import VideoReformatter
from foxglove.channels import CompressedVideoChannel
from foxglove.messages import CompressedVideo, Timestamp

import mcaprl
from benchmarks.measure import OURS, Side, Table, compare, cpu_s

FRAMES, WIDTH, HEIGHT, RATE_HZ, SMALL = 600, 640, 480, 30, (84, 84)
GOAL = 0.85
"""Smallest share of the speed of PyAV alone, as its users call it: by the methods of a frame."""
ROUNDS = 5


def tables(folder: Path) -> list[Table]:
    """Time the images of a video of 20 s, averaged and as they are."""
    packets = _packets()
    bag = _written(folder / "camera.mcap", packets)
    return [
        compare(
            f"Images of an H.264 topic, {WIDTH}x{HEIGHT} to {name}",
            _sides(bag, packets, size),
            goal=f"at least {GOAL:.0%} of the speed of PyAV alone, by the methods of its frames",
            rounds=ROUNDS,
            unit="CPU time per frame, ours = 1",
        )
        for name, size in (("84x84", SMALL), ("memory", None))
    ]


def main() -> None:
    """Print the milliseconds per frame of each side, in the best of several turns."""
    print("| size | side | ms per frame |\n|---|---|---|")
    with TemporaryDirectory() as folder:
        packets = _packets()
        bag = _written(Path(folder) / "camera.mcap", packets)
        for size in (SMALL, None):
            for side in _sides(bag, packets, size):
                try:
                    taken_s = min(cpu_s(side.run) for _ in range(ROUNDS)) / side.share
                except ImportError as error:
                    print(f"| {size or 'full'} | {side.name} | not measured: {error} |")
                    continue
                print(f"| {size or 'full'} | {side.name} | {1000 * taken_s:.2f} |", flush=True)


def _sides(bag: Path, packets: list[bytes], size: tuple[int, int] | None) -> list[Side]:
    camera = {"image": "/camera", **({"resize": list(size)} if size else {})}
    mapping = {
        "clock": {"topic": "/mode"},
        "observation": {"camera": camera},
        "action": {"field": "/mode.data"},
    }

    def ours() -> None:
        found = mcaprl.open(bag, mapping=mapping, images="memory")
        assert len(found.frames) == FRAMES

    one = VideoReformatter()

    def alone(frame: Any) -> Any:
        width, height = size or (WIDTH, HEIGHT)
        return one.reformat(frame, width, height, "rgb24", interpolation="AREA").to_ndarray()

    def each(frame: Any) -> Any:
        small = frame.reformat(*size, "rgb24", interpolation="AREA") if size else frame
        return small.to_ndarray(format="rgb24")

    found = {
        OURS: ours,
        "PyAV alone, one conversion for all frames": _decoder(packets, alone),
        "PyAV alone, by the methods of its frames": _decoder(packets, each),
        "torchcodec, LeRobot's default, from MP4": partial(_torchcodec, bag, packets, size),
    }
    if size is None:
        found["mcap-frames"] = partial(_mcap_frames, bag)
    return [Side(name, run, share=FRAMES) for name, run in found.items()]


def _mcap_frames(bag: Path) -> None:
    """Decode all frames with a library for exact frames of videos in MCAP."""
    import mcap_frames

    images = np.empty((FRAMES, HEIGHT, WIDTH, 3), np.uint8)
    video = mcap_frames.open(str(bag)).video("/camera")
    for row, frame in enumerate(video.iter_frames(range(len(video)))):
        images[row] = frame.image


def _torchcodec(bag: Path, packets: list[bytes], size: tuple[int, int] | None) -> None:
    """Decode all frames from a file of the same packets; it averages pixels otherwise than ours."""
    try:
        from torchcodec.decoders import VideoDecoder
        from torchcodec.transforms import Resize
    except (ImportError, OSError, RuntimeError) as error:
        raise ImportError("torchcodec needs FFmpeg's libraries (Debian: ffmpeg)") from error

    path = bag.with_suffix(".mp4")
    if not path.exists():
        with av.open(str(path), "w") as file:
            stream = file.add_stream("h264", rate=RATE_HZ)
            stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
            for row, data in enumerate(packets):
                packet = av.Packet(data)
                packet.stream, packet.pts, packet.dts = stream, row, row
                packet.time_base = Fraction(1, RATE_HZ)
                file.mux(packet)
    resize = [Resize(size[::-1])] if size else None
    video = VideoDecoder(path, dimension_order="NHWC", num_ffmpeg_threads=1, transforms=resize)
    assert len(video[:]) == FRAMES


def _decoder(packets: list[bytes], convert: Callable[[Any], Any]) -> Callable[[], object]:
    """Return a function that decodes all packets into one array, with one thread as ours."""

    def run() -> Any:
        context: Any = av.CodecContext.create("h264", "r")
        context.thread_count = 1
        found: Any = None
        frames = (
            frame for data in [*packets, None] for frame in context.decode(data and av.Packet(data))
        )
        for row, frame in enumerate(frames):
            image = convert(frame)
            found = np.empty((FRAMES, *image.shape), np.uint8) if found is None else found
            found[row] = image
        return found

    return run


def _packets() -> list[bytes]:
    """Return a stream of about 1 Mbit/s: a camera that moves over a scene, with noise."""
    rng = np.random.default_rng(0)
    coarse = rng.integers(0, 255, (HEIGHT // 16 + 80, WIDTH // 16 + 90, 3), np.uint8)
    wide = av.VideoFrame.from_ndarray(coarse, format="rgb24")
    world = wide.reformat(16 * wide.width, 16 * wide.height, interpolation="BICUBIC").to_ndarray(
        format="rgb24"
    )
    context: Any = av.CodecContext.create("libx264", "w")
    context.width, context.height, context.pix_fmt = WIDTH, HEIGHT, "yuv420p"
    context.time_base, context.framerate = Fraction(1, RATE_HZ), Fraction(RATE_HZ)
    context.gop_size, context.max_b_frames = RATE_HZ, 0
    context.options = {"preset": "veryfast", "crf": "23"}
    found: list[Any] = []
    for k in range(FRAMES):
        part = world[2 * k : 2 * k + HEIGHT, 2 * k : 2 * k + WIDTH].astype(np.int16)
        noisy = part + rng.normal(0, 2, (HEIGHT, WIDTH, 1)).astype(np.int16)
        frame = av.VideoFrame.from_ndarray(noisy.clip(0, 255).astype(np.uint8), format="rgb24")
        frame.pts = k
        found += context.encode(frame)
    return [bytes(each) for each in [*found, *context.encode(None)]]


def _written(path: Path, packets: list[bytes]) -> Path:
    context = foxglove.Context()
    with foxglove.open_mcap(path, context=context):
        camera = CompressedVideoChannel("/camera", context=context)
        mode = foxglove.Channel("/mode", message_encoding="json", context=context)
        for row, data in enumerate(packets):
            time_ns = 10**18 + row * 10**9 // RATE_HZ
            stamp = Timestamp(*divmod(time_ns, 10**9))
            video = CompressedVideo(timestamp=stamp, frame_id="c", data=data, format="h264")
            camera.log(video, log_time=time_ns)
            mode.log({"data": row % 2}, log_time=time_ns)
    return path


if __name__ == "__main__":
    main()
