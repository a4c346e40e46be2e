"""Video topics as images: every frame is that of PyAV alone, or it is missing."""

from __future__ import annotations

import struct
import sys
from pathlib import Path
from typing import Any

import av
import foxglove
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import mcaprl
from mcaprl.errors import LogError, MissingExtraError, UsageError
from mcaprl.limits import MAX_IMAGE_PIXELS
from mcaprl.recorder.dataset.video import (
    LOST,
    NO_KEYFRAME,
    VideoDecoder,
    _av1,
    _h264,
    _h265,
    _vp9,
)
from mcaprl.recorder.mapping.config import Quantity
from mcaprl.recorder.mapping.images import ImageReader
from tests.support.bags import START_NS, Channel, integers, write_channels
from tests.support.memory_bag import MemoryBag
from tests.support.videos import CODECS, GROUP, frames, packets

KINDS = {"/camera.data": "uint8[]", "/camera.format": "string", "/camera.timestamp": "time"}
RATE_HZ = 30


def images_of(name: str, **size: int) -> np.ndarray[Any, Any]:
    return np.stack([each.to_ndarray(format="rgb24") for each in frames(name, **size)])


def video_bag(name: str, rows: Any = range(40), **columns: Any) -> MemoryBag:
    """Return a bag with the packets `rows` of a stream."""
    times_s = [row / RATE_HZ for row in rows]
    columns = {
        "format": [name.split()[0]] * len(times_s),
        "data": [packets(name)[row] for row in rows],
        "timestamp": [round(each * 1e9) for each in times_s],
        **columns,
    }
    return MemoryBag({"/camera": (times_s, columns)}, KINDS)


def reader_of(bag: MemoryBag, *, strict: bool = False, **options: Any) -> Any:
    quantity = Quantity.model_validate({"image": "/camera", **options})
    return ImageReader(bag, "/camera", quantity, strict=strict)


@pytest.mark.parametrize("name", CODECS)
def test_frames_equal_those_of_pyav_alone(name: str) -> None:
    expected = images_of(name)
    reader = reader_of(video_bag(name))
    found = reader.read(np.arange(40))
    assert not reader.failures
    np.testing.assert_array_equal(found, expected)
    # The streams differ from frame to frame, so an image of another frame would be seen.
    assert min(np.abs(np.diff(expected.astype(int), axis=0)).max(axis=(1, 2, 3))) > 30


@pytest.mark.parametrize("name", CODECS)
@settings(max_examples=25)
@given(lost=st.sets(st.integers(0, 39), min_size=1, max_size=5), data=st.data())
def test_with_lost_packets_a_frame_is_right_or_missing(
    name: str, lost: set[int], data: st.DataObject
) -> None:
    rows = [row for row in range(40) if row not in lost]
    wanted = sorted(data.draw(st.sets(st.integers(0, len(rows) - 1), min_size=1)))
    reader, expected = reader_of(video_bag(name, rows)), images_of(name)
    readable = [k for k in wanted if k not in reader.failures]
    if readable and (found := dict(reader.images(np.array(readable)))):
        for k, image in found.items():
            np.testing.assert_array_equal(image, expected[rows[k]])
        assert found.keys() | reader.failures.keys() >= set(wanted)
    if "B-frames" not in name:
        # All frames before the first lost packet of a group are there, and none after it.
        first = {row // GROUP: row for row in sorted(lost, reverse=True)}
        for k in wanted:
            is_missing = rows[k] > first.get(rows[k] // GROUP, 40)
            assert (k in reader.failures) == is_missing


def test_old_versions_that_do_not_report_missing_references_are_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(av, "__version__", "15.1.0")
    with pytest.raises(MissingExtraError, match=r"PyAV 15\.1\.0 .* of hevc .*mcaprl\[video\]"):
        reader_of(video_bag("h265")).read(np.arange(4))
    assert reader_of(video_bag("h264")).read(np.arange(4)) is not None


@pytest.mark.parametrize("name", ["h264", "h265", "vp9", "av1"])
def test_what_is_missing_is_said_and_counted(name: str) -> None:
    rows = [*range(4, 15), *range(16, 40)]
    reader = reader_of(video_bag(name, rows))
    assert list(reader.failures) == list(range(6))
    assert {each.reason for each in reader.failures.values()} == {NO_KEYFRAME}
    assert reader.read(np.arange(6, 35)) is None
    missing = list(reader.failures)
    assert [rows[k] for k in missing] == [4, 5, 6, 7, 8, 9, 16, 17, 18, 19]
    (problem,) = reader.problems()
    assert problem.what.startswith("10 images cannot be decoded, the first is message 0 at")
    assert problem.effect.startswith(f"6: {NO_KEYFRAME}; ")
    found = reader.read(np.array([k for k in range(35) if k not in missing]))
    kept = [row for k, row in enumerate(rows) if k not in missing]
    np.testing.assert_array_equal(found, images_of(name)[kept])


def test_a_lost_keyframe_is_seen_although_the_numbers_go_on() -> None:
    # As if the last number before the lost keyframe was 0, as it is 16 frames after the one before.
    stream = packets("h264")
    decoder, found = VideoDecoder(100.0), dict[int, Any]()
    for row, time_ns in [(0, 0), (11, 200)]:
        found |= dict(decoder.feed(row, "h264", stream[row], (time_ns,)))
    assert found[11] == LOST
    # Without the pause, packet 11 would be taken for the one after keyframe 0.
    decoder = VideoDecoder(100.0)
    for row, time_ns in [(0, 0), (11, 100)]:
        found |= dict(decoder.feed(row, "h264", stream[row], (time_ns,)))
    assert not isinstance(found[11], str)


def test_a_stream_does_not_go_on_in_the_next_recording() -> None:
    bag = MemoryBag.together(*(video_bag("h264", rows) for rows in (range(5), range(5, 40))))
    reader = reader_of(bag)
    assert list(reader.failures) == [5, 6, 7, 8, 9]
    expected = images_of("h264")
    np.testing.assert_array_equal(reader.read(np.array([4, 10, 30])), expected[[4, 10, 30]])
    with pytest.raises(LogError, match=r"message 7 at .* there is no keyframe before it"):
        reader_of(bag, strict=True).read(np.array([4, 7]))
    with pytest.raises(LogError, match="no frame can be decoded: there is no keyframe"):
        reader_of(video_bag("h264", range(1, 9)))


def test_only_groups_with_wanted_frames_are_decoded(monkeypatch: pytest.MonkeyPatch) -> None:
    count, fed = 400, []
    original = VideoDecoder.feed

    def feed(self: VideoDecoder, row: int, *message: Any) -> Any:
        fed.append(row)
        return original(self, row, *message)

    monkeypatch.setattr(VideoDecoder, "feed", feed)
    stream = packets("h264", count)
    times_s = [row / RATE_HZ for row in range(count)]
    columns = {
        "format": ["h264"] * count,
        "data": stream,
        "timestamp": [round(each * 1e9) for each in times_s],
    }
    bag = MemoryBag({"/camera": (times_s, columns)}, KINDS)
    found = reader_of(bag).read(np.array([123, 125, 305]))
    np.testing.assert_array_equal(found, images_of("h264", count=count)[[123, 125, 305]])
    assert fed == [*range(120, 126), *range(300, 306)]
    # A stream with one keyframe is decoded once, however far apart the wanted frames are.
    fed.clear()
    one = [stream[0], *(each for k, each in enumerate(stream) if k % GROUP)]
    columns = {"format": ["h264"] * len(one), "data": one}
    bag = MemoryBag({"/camera": (range(len(one)), columns)}, KINDS)
    with pytest.raises(LogError, match=LOST):
        reader_of(bag).read(np.array([100]))
    assert fed == list(range(101))


def test_frames_are_averaged_as_they_are_decoded() -> None:
    # 64 x 48 pixels become 16 x 12: means of 4 x 4 of the luminance Y from 16 to 235.
    planes = frames("h264")[7].to_ndarray(format="yuv420p").astype(float)
    expected = (planes[:48].reshape(12, 4, 16, 4).mean((1, 3)) - 16) * 255 / 219
    bag, full = video_bag("h264"), images_of("h264")[7].astype(float)
    found = reader_of(bag, resize=(16, 12)).read(np.array([7]))
    assert found is not None
    # Colors that red, green and blue cannot show are clipped.
    error = np.abs(found[0] @ [0.299, 0.587, 0.114] - expected)
    assert error.max() < 4
    assert np.abs(found[0] - full.reshape(12, 4, 16, 4, 3).mean((1, 3))).mean() < 2
    cropped = reader_of(bag, crop=(8, 4, 32, 24), resize=(8, 6)).read(np.array([7]))
    expected = full[4:28, 8:40].reshape(6, 4, 8, 4, 3).mean((1, 3))
    # Pillow rounds after the rows, and again after the columns.
    np.testing.assert_allclose(cropped, expected[None], atol=1)
    gray = reader_of(bag, gray=True).read(np.array([7]))
    np.testing.assert_array_equal(gray[0, ..., 0], np.rint(full @ [0.299, 0.587, 0.114]))
    with pytest.raises(UsageError, match="images 'video' are not depth"):
        reader_of(bag, range_m=(0, 1)).read(np.array([7]))


def test_a_change_of_size_is_missing_or_resized() -> None:
    stream = packets("h264", 10)
    stream = [*stream, *packets("h264", 20, 96, 80)]
    columns = {"format": ["h264"] * 30, "data": stream}
    bag = MemoryBag({"/camera": ([row / 30 for row in range(30)], columns)}, KINDS)
    reader = reader_of(bag)
    assert reader.read(np.arange(30)) is None
    assert list(reader.failures) == list(range(10, 30))
    assert "image 10 is (80, 96, 3) uint8, but the first is (48, 64, 3)" in (
        reader.failures[10].reason
    )
    assert reader.read(np.arange(10)).shape == (10, 48, 64, 3)
    reader = reader_of(bag, resize=(32, 24))
    assert reader.read(np.arange(30)).shape == (30, 24, 32, 3)


@pytest.mark.parametrize("kind", ["h264", "h265", "vp9", "av1"])
@given(data=st.binary(max_size=80))
def test_any_bytes_are_looked_at(kind: str, data: bytes) -> None:
    decoder = VideoDecoder()
    list(decoder.feed(0, kind, packets(kind)[0]))
    found = [*decoder.feed(1, kind, data), *decoder.feed(2, kind, packets(kind)[1])]
    found += decoder.end()
    # No packet is without an answer.
    assert {row for row, _ in found} >= {1, 2}


def test_damaged_packets() -> None:
    stream = packets("h264")
    for damage in (b"", stream[14][: len(stream[14]) // 2], bytes(50)):
        columns = {"data": [*stream[:14], damage, *stream[15:]]}
        reader = reader_of(video_bag("h264", **columns))
        found = dict(reader.images(np.arange(40)))
        assert list(reader.failures) == list(range(14, 20))
        expected = images_of("h264")
        assert all((image == expected[k]).all() for k, image in found.items())


def test_huge_frames_are_refused() -> None:
    # Marker, profile, no shown frame, key, shown, and no resilience: 8 bits; the sync code: 24;
    # color space and range: 4; then 16 bits each of width and height, less one.
    head = packets("vp9")[0][:9]
    bits = int.from_bytes(head)
    assert (bits >> 20 & 0xFFFF, bits >> 4 & 0xFFFF) == (63, 47)
    assert MAX_IMAGE_PIXELS < 8001 * 8001
    bits = (bits >> 36 << 36) | 8000 << 20 | 8000 << 4 | (bits & 15)
    bag = video_bag("vp9", range(1), data=[bits.to_bytes(9) + packets("vp9")[0][9:]])
    with pytest.raises(LogError, match="the packet cannot be decoded: Invalid argument"):
        reader_of(bag).read(np.array([0]))


def test_parameter_sets_may_be_only_at_the_begin() -> None:
    for name, look in (("h264", _h264), ("h265", _h265), ("av1", _av1)):
        stream = packets(name)
        sets = look(stream[0], b"").parameters
        assert sets
        later = [stream[0], *(each.replace(sets, b"") for each in stream[1:])]
        assert len(later[30]) < len(stream[30])
        reader = reader_of(video_bag(name, data=later))
        np.testing.assert_array_equal(reader.read(np.array([35])), images_of(name)[[35]])


def test_packets_by_hand() -> None:
    # VP9: marker 10, profile 0, no shown frame, key 0; then with a frame that is not a key.
    assert _vp9(bytes([0b10000010]), b"").is_key
    assert not _vp9(bytes([0b10000110]), b"").is_key
    # Profile 3 has another bit; frame 10 in it is shown again.
    assert _vp9(bytes([0b10110000]), b"").is_key
    assert not _vp9(bytes([0b10110100]), b"").is_key
    # H.265: unit 19 is a keyframe, 1 a frame after it, 32 a parameter set.
    sets = b"\0\0\0\1\x40\1\7"
    assert _h265(sets + b"\0\0\1\x26\1\x80", b"") == (True, sets, None)
    assert _h265(b"\0\0\1\x02\1\x80", b"") == (False, b"", None)
    # H.264, profile 66: 8 bits of profile, 16 of limits and level, then 1 (id 0), and 1 (4 bits).
    sets = b"\0\0\0\1\x67\x42\0\x1e\xc0"
    # A slice: 1 (first block 0), 1 (type 0), 1 (id 0), 0101 (number 5).
    assert _h264(sets + b"\0\0\1\x65\xea", b"") == (True, sets, (5, 16, True))
    assert _h264(b"\0\0\1\x01\xea", sets) == (False, b"", (5, 16, False))
    assert _h264(b"\0\0\1\x01\xea", b"") == (False, b"", None)
    # AV1: a unit with an extension and without a size has the rest of the packet.
    assert _av1(b"", b"").is_key is False
    numbers = [_av1(each, packets("av1")[0]).number for each in packets("av1")[:3]]
    assert [each and each.value for each in numbers] == [0, 1, 2]


TEXT = "\n".join(
    [
        *("builtin_interfaces/Time timestamp", "string frame_id", "uint8[] data", "string format"),
        *("=" * 80, "MSG: builtin_interfaces/Time", "int32 sec", "uint32 nanosec"),
    ]
)
PACKET_TEXT = "\n".join(
    [
        *("std_msgs/Header header", "int32 width", "int32 height", "string encoding"),
        *("uint64 pts", "uint8 flags", "bool is_bigendian", "uint8[] data"),
        *("=" * 80, "MSG: std_msgs/Header", "builtin_interfaces/Time stamp", "string frame_id"),
        *("=" * 80, "MSG: builtin_interfaces/Time", "int32 sec", "uint32 nanosec"),
    ]
)


def text_after(content: bytes, text: bytes, end: bytes = b"\0") -> bytes:
    """Return the content with a string or bytes of CDR after it."""
    content += bytes(-len(content) % 4)
    return content + struct.pack("<I", len(text + end)) + text + end


def video_message(data: bytes, kind: str, time_ns: int) -> bytes:
    content = struct.pack("<iI", *divmod(time_ns, 10**9))
    return text_after(text_after(text_after(content, b"camera"), data, b""), kind.encode())


def packet_message(data: bytes, kind: str, time_ns: int) -> bytes:
    content = text_after(struct.pack("<iI", *divmod(time_ns, 10**9)), b"camera")
    content += bytes(-len(content) % 4) + struct.pack("<ii", 64, 48)
    content = text_after(content, kind.encode())
    content += bytes(-len(content) % 8) + struct.pack("<QBB", 7, 1, 0)
    return text_after(content, data, b"")


WRITERS = {
    "foxglove_msgs": ("foxglove_msgs/msg/CompressedVideo", TEXT, video_message, "h264"),
    "packets": (
        "ffmpeg_image_transport_msgs/msg/FFMPEGPacket",
        PACKET_TEXT,
        packet_message,
        "libx264",
    ),
    "sensor_msgs": (
        "sensor_msgs/msg/CompressedImage",
        "std_msgs/Header header\nstring format\nuint8[] data\n"
        + PACKET_TEXT[PACKET_TEXT.index("=") :],
        lambda data, kind, time_ns: text_after(
            text_after(
                text_after(struct.pack("<iI", *divmod(time_ns, 10**9)), b"camera"), kind.encode()
            ),
            data,
            b"",
        ),
        "h264",
    ),
}


def write_bag(path: Path, writer: str, rows: Any = range(40)) -> Path:
    kind, text, message, format = WRITERS[writer]
    images = []
    for row in rows:
        time_ns = round(row / RATE_HZ * 1e9)
        images.append((time_ns / 1e9, message(packets("h264")[row], format, time_ns)))
    actions = integers("/mode", [(k / RATE_HZ, k % 2) for k in range(40)])
    return write_channels(path, [Channel("/camera", kind, text, images), actions])


def write_foxglove(path: Path) -> Path:
    """Write the stream by Foxglove's SDK, in protobuf."""
    from foxglove.channels import CompressedVideoChannel
    from foxglove.messages import CompressedVideo, Timestamp

    context = foxglove.Context()
    with foxglove.open_mcap(path, context=context):
        camera = CompressedVideoChannel("/camera", context=context)
        mode = foxglove.Channel("/mode", message_encoding="json", context=context)
        for row, data in enumerate(packets("h264")):
            time_ns = START_NS + round(row / RATE_HZ * 1e9)
            stamp = Timestamp(*divmod(time_ns, 10**9))
            camera.log(
                CompressedVideo(timestamp=stamp, frame_id="c", data=data, format="h264"),
                log_time=time_ns,
            )
            mode.log({"data": row % 2}, log_time=time_ns)
    return path


def mapping(**options: Any) -> dict[str, Any]:
    return {
        "clock": {"topic": "/mode"},
        "observation": {"camera": {"image": "/camera", **options}},
        "action": {"field": "/mode.data"},
    }


@pytest.mark.parametrize("writer", [*WRITERS, "protobuf"])
def test_topics_of_all_writers(tmp_path: Path, writer: str) -> None:
    path = tmp_path / "bag.mcap"
    bag = write_foxglove(path) if writer == "protobuf" else write_bag(path, writer)
    found = mcaprl.open(bag, mapping=mapping())
    np.testing.assert_array_equal(found.observations, images_of("h264")[: len(found)])
    assert len(found) == 39


@pytest.mark.parametrize("storage", ["memory", "mapped"])
def test_each_packet_is_decoded_once(
    tmp_path: Path, storage: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The recording begins within a group, as that of a running camera does.
    bag = write_bag(tmp_path / "bag.mcap", "foxglove_msgs", range(4, 40))
    fed = []
    original = VideoDecoder.feed

    def feed(self: VideoDecoder, row: int, *message: Any) -> Any:
        fed.append(row)
        return original(self, row, *message)

    monkeypatch.setattr(VideoDecoder, "feed", feed)
    for expected in (list(range(6, 36)), [6] if storage == "mapped" else list(range(6, 36))):
        fed.clear()
        with pytest.warns(UserWarning, match="6 images cannot be decoded, the first is message 0"):
            found = mcaprl.open(bag, mapping=mapping(), images=storage)
        np.testing.assert_array_equal(found.observations[:], images_of("h264")[10:39])
        assert fed == expected


def test_a_video_is_suggested(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag.mcap", "foxglove_msgs", range(4, 40))
    with pytest.warns(UserWarning, match="no action yet"):
        text = mcaprl.suggest_mapping(bag)
    assert "{image: /camera, resize: [84, 84]}" in text


def test_without_pyav_one_line_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bag = write_bag(tmp_path / "bag.mcap", "foxglove_msgs")
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(UsageError, match=r"camera: av is not installed: pip install 'mcaprl\[vi"):
        mcaprl.open(bag, mapping=mapping())


def test_other_codecs_are_named() -> None:
    bag = video_bag("h264", format=["mpeg4"] * 40)
    with pytest.raises(UsageError, match="video 'mpeg4' is not supported; supported: h264, h265"):
        reader_of(bag).read(np.arange(3))
