"""Videos of LeRobot datasets: packets are copied from and to logs, or a reason is said."""

from __future__ import annotations

import json
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

import mcaprl
from mcaprl import Dataset
from mcaprl.cli import run
from mcaprl.errors import SpaceError
from tests.recorder.mapping.images.test_video import TEXT, video_message
from tests.recorder.record.test_camera import Rendered, drive
from tests.support.bags import Channel, integers, write_channels
from tests.support.lerobot.environment import run_lerobot
from tests.support.videos import GROUP, frames, packets

pytest.importorskip("pyarrow", reason="needs the extra tables")

RATE_HZ = 30
CAMERA = "videos/observation.image/chunk-000/file-000.mp4"
NAMES = {"h264": "h264", "h265": "hevc", "av1": "av1"}
_TYPE = "foxglove_msgs/msg/CompressedVideo"


def bag_of(path: Path, name: str, rows: Any = range(40), breaks: Any = ()) -> Path:
    """Write the packets `rows` of a stream, and a mode that is 2 in the steps `breaks`."""
    modes = [(k / RATE_HZ, 2 if k in breaks else k % 2) for k in range(40)]
    camera = Channel("/camera", _TYPE, TEXT, images_sent(name, rows))
    return write_channels(path, [camera, integers("/mode", modes)])


def images_sent(name: str, rows: Any = range(40)) -> list[tuple[float, bytes]]:
    """Return the times and the messages of the packets of a stream."""
    found = []
    for row in rows:
        time_ns = round(row / RATE_HZ * 1e9)
        data = video_message(packets(name)[row], name.split()[0], time_ns)
        found.append((time_ns / 1e9, data))
    return found


def opened(bag: Path, clock: Any = "/mode", **options: Any) -> Dataset:
    """Read the bag; an episode ends where the mode is 2."""
    return mcaprl.open(
        bag,
        mapping={
            "clock": clock if isinstance(clock, dict) else {"topic": clock},
            "observation": {
                "camera": {"image": "/camera", **options},
                "mode": {"field": "/mode.data"},
            },
            "action": {"field": "/mode.data"},
            "episodes": {"terminated": "mode == 2"},
        },
    )


def sent(name: str, rows: Any = range(40)) -> list[bytes]:
    """Return packets as MP4 files have them.

    Start codes have no length there, and AV1 has no temporal delimiters.
    """
    found = [packets(name)[row].removeprefix(b"\x12\0") for row in rows]
    return found if name == "av1" else list(map(_short, found))


def _short(data: bytes) -> bytes:
    return data.replace(b"\0\0\0\1", b"\0\0\1")


def stored(video: Path) -> list[bytes]:
    """Return the packets of an MP4 file in Annex B, or of AV1, by PyAV alone."""
    found = []
    with av.open(str(video)) as container:
        stream = container.streams.video[0]
        kind = stream.codec_context.codec.canonical_name
        each = (packet for packet in container.demux(stream) if packet.dts is not None)
        if kind == "av1":
            return [bytes(packet) for packet in each]
        convert = av.bitstream.BitStreamFilterContext(f"{kind}_mp4toannexb", stream)
        for packet in each:
            # The filter of HEVC puts the parameter sets of the file before those of the packet.
            size, data = packet.size, b"".join(map(bytes, convert.filter(packet)))
            found.append(_short(data[-size:] if kind == "hevc" else data))
    return found


def pixels(video: Path) -> np.ndarray[Any, Any]:
    with av.open(str(video)) as container:
        return np.stack([each.to_ndarray(format="rgb24") for each in container.decode(video=0)])


def images_of(name: str, rows: Any = range(40)) -> np.ndarray[Any, Any]:
    return np.stack([frames(name)[row].to_ndarray(format="rgb24") for row in rows])


@pytest.mark.parametrize("name", NAMES)
def test_packets_of_a_bag_are_copied(tmp_path: Path, name: str) -> None:
    bag, out = (
        bag_of(tmp_path / "bag.mcap", name, breaks=[GROUP - 1, 3 * GROUP - 1]),
        tmp_path / "out",
    )
    data = opened(bag)
    # Each episode begins with a keyframe, and the last observation of one is not in its video.
    assert data.episode_lengths.tolist() == [9, 19, 9]
    said = data.to_lerobot(out)
    assert said[0] == f"video: observation.images.camera is copied, {NAMES[name]}"
    video = out / CAMERA.replace("observation.image", "observation.images.camera")
    rows = [*range(9), *range(10, 29), *range(30, 39)]
    assert stored(video) == sent(name, rows)
    np.testing.assert_array_equal(pixels(video), images_of(name, rows))
    with av.open(str(video)) as container:
        times = [frame.time for frame in container.decode(video=0)]
        key = [p.is_keyframe for p in av.open(str(video)).demux(video=0) if p.dts is not None]
    np.testing.assert_allclose(times, np.arange(37) / RATE_HZ, atol=1e-6)
    assert [rows[k] for k in np.flatnonzero(key)] == [0, 10, 20, 30]
    info = json.loads((out / "meta/info.json").read_text())
    feature = info["features"]["observation.images.camera"]
    assert (feature["dtype"], feature["shape"]) == ("video", [48, 64, 3])
    assert (feature["info"]["video.codec"], feature["info"]["video.pix_fmt"]) == (
        NAMES[name],
        "yuv420p",
    )


def test_lerobot_reads_and_joins_copied_packets(tmp_path: Path) -> None:
    cameras = [Channel(f"/{name}", _TYPE, TEXT, images_sent(name)) for name in NAMES]
    modes = integers("/mode", [(k / RATE_HZ, 2 if k == GROUP - 1 else k % 2) for k in range(40)])
    data = mcaprl.open(
        write_channels(tmp_path / "bag.mcap", [*cameras, modes]),
        mapping={
            "clock": {"topic": "/mode"},
            "observation": {name: {"image": f"/{name}"} for name in NAMES},
            "fields": {"mode": {"field": "/mode.data"}},
            "action": {"field": "/mode.data"},
            "episodes": {"terminated": "mode == 2"},
        },
    )
    data.to_lerobot(tmp_path / "out")
    items = tmp_path / "items.npz"
    run_lerobot("merge", tmp_path / "out", tmp_path / "twice", items, folder=tmp_path)
    found = np.load(items)
    for name in NAMES:
        images = images_of(name, [*range(9), *range(10, 39)])
        wanted = np.concatenate([images, images]).transpose(0, 3, 1, 2) / 255
        # LeRobot has another version of PyAV, and so of the conversion of colors.
        np.testing.assert_allclose(found[f"observation.images.{name}"], wanted, atol=2 / 255)


REASONS: dict[str, tuple[Any, dict[str, Any], str]] = {
    "resized": (partial(bag_of, name="h264"), {"resize": [32, 24]}, "the mapping has resize"),
    "cropped": (
        partial(bag_of, name="h264"),
        {"crop": [0, 0, 32, 24], "gray": True},
        "the mapping has crop, gray",
    ),
    "every other frame": (
        partial(bag_of, name="h264"),
        {"clock": {"rate_hz": RATE_HZ / 2}},
        "the images of episode 0 are not successive frames of the video",
    ),
    "within a group": (
        partial(bag_of, name="h264", breaks=[GROUP]),
        {},
        "episode 1 does not begin with a keyframe that has parameter sets",
    ),
    "lost packet": (
        partial(bag_of, name="h264", rows=[*range(14), *range(15, 40)]),
        {},
        "the images of episode 0 are not successive frames of the video",
    ),
    "B-frames": (
        partial(bag_of, name="h264 with B-frames"),
        {},
        "its packets are not in the order of its frames (B-frames)",
    ),
    "vp9": (partial(bag_of, name="vp9"), {}, "videos of LeRobot are h264, hevc or av1, not vp9"),
}


@pytest.mark.filterwarnings("ignore:.*cannot be decoded")
@pytest.mark.parametrize("what", REASONS)
def test_what_is_not_copied_is_exact_or_encoded_with_a_reason(tmp_path: Path, what: str) -> None:
    write, options, reason = REASONS[what]
    data = opened(write(tmp_path / "bag.mcap"), **options)
    name = "observation.images.camera"
    assert data.to_lerobot(tmp_path / "out")[0] == (
        f"video: {name} is written as images, because {reason}"
    )
    with pytest.warns(UserWarning, match="is not stored"):
        found = Dataset.from_lerobot(tmp_path / "out")
    # The images are exact.
    first = int(found.episode_lengths[0])
    for images in (found.observations["camera"], data.observations["camera"]):
        np.testing.assert_array_equal(images[:first], data.frames["camera"][:first])
    lost = f"{name} is compressed as video, which changes its pixels, because"
    with pytest.raises(SpaceError, match=f"{lost} "):
        data.to_lerobot(tmp_path / "video", video=True)
    said = data.to_lerobot(tmp_path / "video", video=True, lossy=True)
    assert said[0] == f"{lost} {reason}"


def test_cached_frames_are_known_to_be_reordered(tmp_path: Path) -> None:
    bag = bag_of(tmp_path / "bag.mcap", "h264 with B-frames")
    for _ in range(2):
        data = mcaprl.open(
            bag,
            mapping={
                "clock": {"topic": "/mode"},
                "observation": {"camera": {"image": "/camera"}},
                "action": {"field": "/mode.data"},
            },
            images="mapped",
        )
        assert "(B-frames)" in data.to_lerobot(tmp_path / "out", overwrite=True)[0]


def test_chosen_and_joined_episodes_keep_their_packets(tmp_path: Path) -> None:
    parts = [
        opened(bag_of(tmp_path / f"{name}.mcap", name, breaks=[GROUP - 1, 3 * GROUP - 1]))
        for name in ("h264", "h264")
    ]
    both = Dataset.concatenate(parts).filter(lambda episode: episode.index in (1, 3, 5))
    both.to_lerobot(tmp_path / "out")
    rows = [*range(10, 29), *range(9), *range(30, 39)]
    video = tmp_path / "out" / CAMERA.replace("observation.image", "observation.images.camera")
    assert stored(video) == sent("h264", rows)
    other = opened(bag_of(tmp_path / "other.mcap", "h265", breaks=[39]))
    reason = "because the videos have the codecs h264, hevc"
    mixed = Dataset.concatenate([parts[0], other])
    assert reason in mixed.to_lerobot(tmp_path / "mixed")[0]
    assert "video: " not in parts[0].to_lerobot(tmp_path / "images", video=False)[0]
    assert not list(tmp_path.glob("images/videos"))


def test_the_command_says_what_is_copied(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Logs of `record --camera h264` have videos that a mapping makes features."""
    log = tmp_path / "log.mcap"
    with closing(mcaprl.RecordMcap(Rendered(), log, camera="h264")) as recorder:
        drive(recorder)
    mapping = tmp_path / "robot.yaml"
    mapping.write_text(
        json.dumps(
            {
                "clock": {"topic": "/rl/step"},
                "observation": {"camera": {"image": "/camera/image"}},
                "action": {"field": "/rl/step.action"},
                "episodes": {"terminated": "final"},
                "fields": {"final": {"field": "/rl/step.final"}},
            }
        )
    )
    out = str(tmp_path / "out")
    assert run(["convert", str(log), out, "--to", "lerobot", "--mapping", str(mapping)]) == 0
    assert "video: observation.image is copied, h264" in capsys.readouterr().out
    with mcaprl.open_bag(log) as bag:
        every = bag.read("/camera/image", ["data"]).columns["data"]
    # Without the last observation of each episode.
    rows = [*range(5), *range(6, 11)]
    assert stored(tmp_path / "out" / CAMERA) == [_short(bytes(every[row])) for row in rows]
