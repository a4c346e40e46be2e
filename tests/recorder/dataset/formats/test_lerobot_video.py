"""Videos of LeRobot datasets: packets are copied from and to logs, or a reason is said."""

from __future__ import annotations

import json
import shutil
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import mcaprl
from mcaprl import Dataset
from mcaprl.cli import run
from mcaprl.errors import CorruptLogError, SpaceError, UsageError
from mcaprl.recorder.dataset import save
from mcaprl.recorder.format import video_messages
from tests.recorder.mapping.images.test_video import TEXT, video_message
from tests.recorder.record.test_camera import Rendered, drive
from tests.support.bags import Channel, integers, write_channels
from tests.support.lerobot.environment import run_lerobot
from tests.support.videos import GROUP, frames, packets

pytest.importorskip("pyarrow", reason="needs the extra tables")

RATE_HZ = 30
CAMERA = "videos/observation.image/chunk-000/file-000.mp4"
NAMES = {"h264": "h264", "h265": "hevc", "av1": "av1"}
GOLDEN = Path(__file__).parents[3] / "golden/lerobot-video"
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


def test_old_versions_of_pyav_write_images(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = opened(bag_of(tmp_path / "bag.mcap", "h264", breaks=[GROUP - 1]))
    monkeypatch.setattr(av, "__version__", "17.0.1")
    said = data.to_lerobot(tmp_path / "out")
    assert said[0] == (
        "video: observation.images.camera is written as images, because PyAV is older than 18"
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


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Return a LeRobot dataset of three episodes for each codec; the last one is truncated."""
    found = dict[str, Path]()
    for name in NAMES:
        folder = tmp_path_factory.mktemp(name)
        bag = bag_of(folder / "bag.mcap", name, breaks=[GROUP - 1, 3 * GROUP - 1])
        opened(bag).to_lerobot(found.setdefault(name, folder / "lerobot"))
    return found


ROWS = [*range(9), *range(10, 29), *range(30, 39)]
"""Packets of the episodes, in order."""
CAMERAS = CAMERA.replace("observation.image", "observation.images.camera")
TOPIC = "/rl/observation/camera"


@pytest.mark.filterwarnings("ignore:.*is not stored")
@pytest.mark.parametrize("name", NAMES)
def test_packets_go_to_a_log_and_back(
    tmp_path: Path, folders: dict[str, Path], name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    log, out = tmp_path / "out.mcap", tmp_path / "again"
    assert run(["convert", str(folders[name]), str(log)]) == 0
    with mcaprl.open_bag(log) as bag:
        stream, steps_ns = bag.read(TOPIC, ["data", "format", "timestamp"]), bag.times("/rl/step")
    # Byte for byte those of the first bag, but for the temporal delimiters of AV1.
    whole = [packets(name)[row].removeprefix(b"\x12\0") for row in ROWS]
    assert [bytes(each) for each in stream.columns["data"]] == whole
    assert set(stream.columns["format"]) == {name}
    assert stream.columns["timestamp"].tolist() == stream.log_time_ns.tolist()
    # The last observation of a terminated episode is that of the step before.
    ends = [9, 29]
    assert stream.log_time_ns.tolist() == np.delete(steps_ns, ends).tolist()

    data = mcaprl.open(log)
    source = Dataset.from_lerobot(folders[name])
    assert data.fingerprint == source.fingerprint
    images = images_of(name, ROWS)
    shown = np.insert(images, [9, 28], images[[8, 27]], axis=0)
    np.testing.assert_array_equal(data.frames["camera"], shown)
    for options in ({"images": "mapped"}, {"episodes": [1]}, {"columns": ["camera"]}):
        found = mcaprl.open(log, **options)
        rows = slice(10, 30) if "episodes" in options else slice(None)
        camera = found.frames["camera"] if isinstance(found.frames, dict) else found.frames
        np.testing.assert_array_equal(camera[:], shown[rows])
    assert mcaprl.check(log).problems == ()

    capsys.readouterr()
    assert run(["convert", str(log), str(out), "--to", "lerobot"]) == 0
    assert f"video: observation.images.camera is copied, {NAMES[name]}" in capsys.readouterr().out
    # An episode that did not terminate loses its last step, as LeRobot has no place for it.
    assert stored(out / CAMERAS) == stored(folders[name] / CAMERAS)[:-1] == sent(name, ROWS[:-1])
    np.testing.assert_array_equal(pixels(out / CAMERAS), images[:-1])


@pytest.mark.filterwarnings("ignore:.*(is not stored|rewards are NaN)")
def test_a_dataset_of_lerobot_goes_to_a_log_and_back(tmp_path: Path) -> None:
    """LeRobot wrote it, with its encoder of AV1 and two episodes in a file."""
    source = Dataset.from_lerobot(GOLDEN)
    source.save(tmp_path / "log.mcap")
    data = mcaprl.open(tmp_path / "log.mcap")
    assert data.fingerprint == source.fingerprint
    with mcaprl.open_bag(tmp_path / "log.mcap") as bag:
        kinds = {
            name: info.type_name
            for name, info in bag.topics.items()
            if name.startswith("/rl/observation/")
        }
    assert set(kinds.values()) == {_TYPE}
    assert len(kinds) == 2
    said = data.to_lerobot(tmp_path / "out")
    assert [text for text in said if text.startswith("video: ")] == [
        f"video: observation.images.{name} is copied, av1" for name in ("front", "wrist")
    ]


@pytest.mark.filterwarnings("ignore:.*is not stored")
def test_a_log_with_video_is_learned_from_and_edited(
    tmp_path: Path, folders: dict[str, Path]
) -> None:
    log, out = tmp_path / "log.mcap", tmp_path / "out.mcap"
    data = Dataset.from_lerobot(folders["h264"]).with_rewards(np.arange(36))
    data.save(log)
    shown = data.frames["camera"]
    train = ["train-offline", str(log), "--algo", "bc", "--updates", "2", "--batch-size", "4"]
    assert run([*train, "--out", str(tmp_path / "run")]) == 0
    # What is copied by messages, and what is written again.
    mcaprl.split(log, tmp_path / "parts", episodes=1)
    parts = sorted((tmp_path / "parts").glob("*.mcap"))
    np.testing.assert_array_equal(mcaprl.open(parts[1]).frames["camera"], shown[10:30])
    mcaprl.merge([parts[0], parts[2]], out)
    joined = mcaprl.open(out)
    np.testing.assert_array_equal(joined.frames["camera"], np.delete(shown, range(10, 30), axis=0))
    joined.save(out, overwrite=True)
    assert mcaprl.check(out).problems == ()
    found = mcaprl.recover(log, out, overwrite=True)
    assert (found.episodes, found.has_losses) == (3, False)
    np.testing.assert_array_equal(mcaprl.open(out).frames["camera"], shown)
    # Step 9 is the first one of the second episode, and step 19 is its next keyframe.
    mcaprl.slice(log, out, steps=(19, 25), overwrite=True)
    np.testing.assert_array_equal(mcaprl.open(out).frames["camera"], shown[20:27])
    with pytest.raises(UsageError, match="a video without a keyframe at step 5 of episode 1"):
        mcaprl.slice(log, out, steps=(14, 25), overwrite=True)


@pytest.mark.filterwarnings("ignore:.*is not stored")
def test_a_damaged_packet_is_found_and_its_episode_dropped(
    tmp_path: Path, folders: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    log, out = tmp_path / "log.mcap", tmp_path / "out.mcap"
    data = Dataset.from_lerobot(folders["h264"])
    bad_ns = int(data.episodes[1].log_time_ns[12])
    original = video_messages.video_message

    def damaged(time_ns: int, kind: str, packet: bytes) -> bytes:
        return original(time_ns, kind, b"\0\0\1\x41" if time_ns == bad_ns else packet)

    monkeypatch.setattr(save, "video_message", damaged)
    data.save(log)
    # Of the second episode, steps 12 to 18 and the observation after them.
    (problem,) = mcaprl.check(log).problems
    assert (problem.what, problem.where) == ("8 of 39 records have no image", TOPIC)
    with pytest.raises(CorruptLogError, match=rf"{TOPIC} at log_time {bad_ns} has no image: "):
        mcaprl.open(log)
    found = mcaprl.recover(log, out)
    assert (found.episodes, [each.number for each in found.dropped]) == (2, [1])
    shown = np.delete(data.frames["camera"], range(10, 30), axis=0)
    np.testing.assert_array_equal(mcaprl.open(out).frames["camera"], shown)


@pytest.mark.filterwarnings("ignore:.*(is not stored|rewards are NaN)")
def test_a_log_has_exact_images_where_packets_cannot_be_copied(
    tmp_path: Path, folders: dict[str, Path]
) -> None:
    log, said = tmp_path / "log.mcap", f"{TOPIC} has images, not the packets of their video: "
    data = Dataset.from_lerobot(folders["h264"])
    part = data.without(np.arange(len(data)) == 2)
    with pytest.warns(UserWarning, match=f"{said}episode 1 does not begin with a keyframe"):
        part.save(log)
    np.testing.assert_array_equal(mcaprl.open(log).frames["camera"], part.frames["camera"])
    # The same images in a video with B-frames, and of another codec.
    folder = tmp_path / "lerobot"
    shutil.copytree(folders["h264"], folder)
    encode(folder / CAMERAS, "libx264", {"x264-params": "b-adapt=0:scenecut=0", "bf": "2"})
    data = Dataset.from_lerobot(folder)
    with pytest.warns(UserWarning, match=f"{said}its packets are not in the order"):
        data.save(log, overwrite=True)
    np.testing.assert_array_equal(mcaprl.open(log).frames["camera"], data.frames["camera"])
    encode(folder / CAMERAS, "mpeg4", {})
    data = Dataset.from_lerobot(folder)
    with pytest.warns(UserWarning, match="h264, hevc or av1, not mpeg4"):
        data.save(log, overwrite=True)
    np.testing.assert_array_equal(mcaprl.open(log).frames["camera"], data.frames["camera"])


def encode(video: Path, encoder: str, options: dict[str, str]) -> None:
    with av.open(str(video), "w") as container:
        stream: Any = container.add_stream(encoder, RATE_HZ, options=options)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for image in images_of("h264", ROWS):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, "rgb24")))
        container.mux(stream.encode(None))


@pytest.mark.filterwarnings("ignore:.*is not stored")
def test_keyframes_get_the_parameter_sets_of_their_file(
    tmp_path: Path, folders: dict[str, Path]
) -> None:
    """Encoders of MP4 files put the parameter sets into the header alone."""
    folder, log = tmp_path / "lerobot", tmp_path / "log.mcap"
    images = Dataset.from_lerobot(folders["h264"])
    images.without(np.arange(36) == 40 - 38).to_lerobot(folder, video=True, lossy=True)
    data = Dataset.from_lerobot(folder)
    data.save(log)
    np.testing.assert_array_equal(mcaprl.open(log).frames["camera"], data.frames["camera"])
    with mcaprl.open_bag(log) as bag:
        every = [bytes(each) for each in bag.read(TOPIC, ["data"]).columns["data"]]
    kinds = [[unit[0] & 31 for unit in each.split(b"\0\0\1")[1:]] for each in every]
    assert {tuple(kind[:2]) for kind in kinds if 5 in kind} == {(7, 8)}
    assert sum(5 in kind for kind in kinds) > 10


@given(st.binary(max_size=30), st.integers(0, 2**62), st.data())
def test_messages_of_videos_come_back_or_are_damaged(
    packet: bytes, time_ns: int, data: st.DataObject
) -> None:
    message = video_messages.video_message(time_ns % 2**61, "h265", packet)
    assert video_messages.packet_of(message) == ("h265", packet)
    cut = data.draw(st.integers(0, len(message) - 1))
    with pytest.raises(CorruptLogError, match="a message of a video is damaged"):
        video_messages.packet_of(message[:cut])
