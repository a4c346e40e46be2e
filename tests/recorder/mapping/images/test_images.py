"""Images of bags as observations."""

from __future__ import annotations

import base64
import struct
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from PIL import Image

import mcaprl
from mcaprl.errors import LogError, UsageError
from mcaprl.recorder.bags.bag import Failure
from mcaprl.recorder.mapping.config import Quantity, parse_mapping
from mcaprl.recorder.mapping.images import ImageReader
from mcaprl.recorder.mapping.read import read_open_bag
from tests.support.memory_bag import MemoryBag

KINDS = {f"/camera.{name}": kind for name, kind in (("data", "uint8[]"), ("encoding", "string"))}


def raw_bag(arrays: list[np.ndarray[Any, Any]], encoding: str, padding: int = 0) -> MemoryBag:
    """Return a bag of raw images whose rows end with `padding` bytes."""
    rows = [array.reshape(len(array), -1).view(np.uint8) for array in arrays]
    padded = [np.pad(row, ((0, 0), (0, padding))) for row in rows]
    count = len(arrays)
    columns = {
        "height": [len(array) for array in arrays],
        "width": [array.shape[1] for array in arrays],
        "encoding": [encoding] * count,
        "is_bigendian": [0] * count,
        "step": [row.shape[1] for row in padded],
        "data": [row.tobytes() for row in padded],
    }
    return MemoryBag({"/camera": (range(count), columns)}, KINDS)


def reader_of(bag: MemoryBag, *, strict: Any = False, **options: Any) -> ImageReader:
    quantity = Quantity.model_validate({"image": "/camera", **options})
    return ImageReader(bag, "/camera", quantity, strict=strict)


def read(bag: MemoryBag, rows: list[int], **options: Any) -> Any:
    return reader_of(bag, **options).read(np.array(rows, np.int64))


def compressed_bag(format: str, *files: bytes) -> MemoryBag:
    columns = {"format": [format] * len(files), "data": list(files)}
    return MemoryBag({"/camera": (range(len(files)), columns)}, KINDS)


def file_of(pixels: Any, format: str) -> bytes:
    file = BytesIO()
    Image.fromarray(pixels).save(file, format)
    return file.getvalue()


COLORS = np.arange(4 * 6 * 3, dtype=np.uint8).reshape(4, 6, 3)


@pytest.mark.parametrize("padding", [0, 5])
def test_colors_are_read_in_the_order_red_green_blue(padding: int) -> None:
    np.testing.assert_array_equal(read(raw_bag([COLORS], "rgb8", padding), [0])[0], COLORS)
    found = read(raw_bag([COLORS], "bgr8", padding), [0])[0]
    np.testing.assert_array_equal(found, COLORS[..., ::-1])
    with_alpha = np.dstack([COLORS, np.full((4, 6), 255, np.uint8)])
    np.testing.assert_array_equal(read(raw_bag([with_alpha], "rgba8"), [0])[0], COLORS)


def test_gray_crop_and_resize_by_hand() -> None:
    image = np.array([[0, 0, 10, 30], [0, 0, 50, 70]], np.uint8)
    bag = raw_bag([image], "mono8")
    assert read(bag, [0]).shape == (1, 2, 4, 1)
    cropped = read(bag, [0], crop=(2, 0, 2, 2))
    assert cropped[0, ..., 0].tolist() == [[10, 30], [50, 70]]
    assert read(bag, [0], crop=(2, 0, 2, 2), resize=(1, 1))[0].item() == 40
    red = np.zeros((1, 1, 3), np.uint8)
    red[..., 0] = 100
    assert read(raw_bag([red], "rgb8"), [0], gray=True)[0].item() == 30
    with pytest.raises(UsageError, match=r"crop \[3, 0, 2, 2\] is outside of the image of 4 x 2"):
        read(bag, [0], crop=(3, 0, 2, 2))


def test_depth_keeps_its_unit() -> None:
    millimeters = np.array([[0, 1500], [3000, 65535]], np.uint16)
    found = read(raw_bag([millimeters], "16UC1"), [0])
    assert found.dtype == np.float32
    # REP 118: 16 bits are millimeters. The result of the division is exact to the last bit.
    assert found[0, ..., 0].tolist() == [[0.0, 1.5], [3.0, float(np.float32(65.535))]]
    meters = np.array([[np.nan, np.inf], [2.5, 0.5]], np.float32)
    np.testing.assert_allclose(
        read(raw_bag([meters], "32FC1"), [0])[0, ..., 0], [[0.0, 0.0], [2.5, 0.5]]
    )
    scaled = read(raw_bag([millimeters], "16UC1"), [0], range_m=(0.0, 3.0))
    assert scaled[0, ..., 0].tolist() == [[255, 128], [255, 255]]


def test_each_message_is_read_once_and_repeated_in_order() -> None:
    images = [np.full((2, 2), k, np.uint8) for k in range(5)]
    found = read(raw_bag(images, "mono8"), [4, 0, 0, 2])
    assert found[:, 0, 0, 0].tolist() == [4, 0, 0, 2]


def test_compressed_images() -> None:
    content = BytesIO()
    Image.fromarray(COLORS).save(content, "PNG")
    depth = BytesIO()
    Image.fromarray(np.array([[0, 1500]], np.uint16)).save(depth, "PNG")
    # With quantization 100 and maximum 10 m, A = 100 * 101 and B = 1 - A / 10, so that 2.5 m is
    # 10100 / 2.5 - 1009 = 3031, and 10 m is 1.
    code = BytesIO()
    Image.fromarray(np.array([[0, 3031, 1]], np.uint16)).save(code, "PNG")
    header = struct.pack("<iff", 0, 10100.0, -1009.0)
    for data, kind, expected in (
        (content.getvalue(), "png", COLORS),
        (header + code.getvalue(), "32FC1; compressedDepth png", [[[0.0], [2.5], [10.0]]]),
        (bytes(12) + depth.getvalue(), "16UC1; compressedDepth png", [[[0.0], [1.5]]]),
    ):
        columns = {"format": [kind], "data": [data]}
        found = read(MemoryBag({"/camera": ([0], columns)}, KINDS), [0])
        np.testing.assert_allclose(found[0], expected)


def test_damaged_and_unknown_images_are_clear_errors() -> None:
    bag = MemoryBag({"/camera": ([0], {"format": ["jpeg"], "data": [b"no image"]})}, KINDS)
    with pytest.raises(LogError, match=r"/camera: a compressed image \(jpeg\) cannot be read"):
        read(bag, [0])
    with pytest.raises(LogError, match="encoding 'jpeg2000'; supported: rgb8"):
        read(raw_bag([COLORS], "jpeg2000"), [0])
    short = raw_bag([COLORS], "rgb8")
    short._columns["/camera"]["data"][0] = b"123"
    with pytest.raises(LogError, match="an image of 6 x 4 rgb8 with 18 bytes per row has 3 bytes"):
        read(short, [0])
    uneven = raw_bag([COLORS, COLORS[:2]], "rgb8")
    with pytest.raises(LogError, match=r"is \(2, 6, 3\) uint8, but the first is \(4, 6, 3\)"):
        read(uneven, [0, 1])
    assert read(uneven, [0, 1], resize=(3, 2)).shape == (2, 2, 3, 3)
    with pytest.raises(UsageError, match="not images: expected sensor_msgs/Image"):
        read(MemoryBag({"/camera": ([0], {"x": [1.0]})}), [0])


def test_spaces_of_images() -> None:
    reader = ImageReader(raw_bag([COLORS], "rgb8"), "/camera", Quantity(image="/camera"))
    images = reader.read(np.zeros(1, np.int64))
    assert images is not None
    assert reader.space(images) == spaces.Box(0, 255, (4, 6, 3), np.uint8)


GRAY = np.arange(64, dtype=np.uint8).reshape(8, 8)


@pytest.mark.parametrize("format", ["JPEG", "WEBP", "PNG"])
@pytest.mark.parametrize(
    "kind", ["16UC1; jpeg compressed ", "32FC1; jpeg compressed", "mono16; jpeg compressed mono8"]
)
def test_depth_in_eight_bits_is_refused(kind: str, format: str) -> None:
    bag = compressed_bag(kind, file_of(GRAY, format))
    for options in ({}, {"range_m": (0, 5)}, {"as": "depth"}):
        with pytest.raises(UsageError, match="8 bits per pixel and have lost the depth: use a raw"):
            read(bag, [0], **options)
    # Colors stay colors, such as those of WEBP, which has no gray.
    found = read(bag, [0], **{"as": "intensity", "gray": True})
    assert found.dtype == np.uint8
    np.testing.assert_allclose(found[0, ..., 0], GRAY, atol=6)
    small = bytes(12) + file_of(GRAY, "PNG")
    with pytest.raises(UsageError, match="have lost the depth"):
        read(compressed_bag("16UC1; compressedDepth png", small), [0])


def test_options_of_depth_are_not_ignored_for_other_images() -> None:
    jpeg = compressed_bag("jpeg", file_of(GRAY, "JPEG"))
    for bag in (jpeg, raw_bag([GRAY], "mono8"), raw_bag([COLORS], "rgb8")):
        with pytest.raises(UsageError, match="are not depth: remove range_m from the mapping"):
            read(bag, [0], range_m=(0, 5))
        with pytest.raises(UsageError, match="are not depth: remove as: depth from the mapping"):
            read(bag, [0], **{"as": "depth"})


def test_sixteen_bits_are_depth_or_intensity() -> None:
    values = np.array([[0, 30000], [20000, 65535]], np.uint16)
    bag = raw_bag([values], "mono16")
    reader = reader_of(bag)
    found: Any = reader.read(np.array([0]))
    assert found[0, ..., 0].tolist() == [[0, 30], [20, float(np.float32(65.535))]]
    (problem,) = reader.problems()
    assert str(problem) == (
        "images 'mono16' are read as depth, but may have other values (/camera); set `as: depth`,"
        " or `as: intensity` for infrared and thermal images"
    )
    certain: list[dict[str, Any]] = [{"as": "depth"}, {"range_m": (0, 10)}, {"as": "intensity"}]
    for options in certain:
        reader = reader_of(bag, **options)
        reader.read(np.array([0]))
        assert not reader.problems()
    intensity = read(bag, [0], **{"as": "intensity"})
    assert intensity.dtype == np.float32
    assert intensity[0, ..., 0].tolist() == values.tolist()
    reader = reader_of(bag, **{"as": "intensity"})
    assert reader.space(intensity) == spaces.Box(-np.inf, np.inf, (2, 2, 1), np.float32)
    # (30000 - 20000) / 20000 * 255 = 127.5, which is rounded to even.
    scaled = read(bag, [0], **{"as": "intensity", "range": (20000, 40000)})
    assert scaled.dtype == np.uint8
    assert scaled[0, ..., 0].tolist() == [[0, 128], [0, 255]]
    # Depth is resized by the nearest pixel, intensity by averaging.
    mean = read(bag, [0], **{"as": "intensity", "resize": (1, 1)})
    assert mean.item() == np.float32(values.mean())
    assert read(bag, [0], resize=(1, 1)).item() in values / np.float32(1000)


def test_intensity_of_floats_and_of_eight_bits() -> None:
    celsius = np.array([[-10.0, np.nan], [np.inf, 30.5]], np.float32)
    found = read(raw_bag([celsius], "32FC1"), [0], **{"as": "intensity"})
    assert found[0, ..., 0].tolist() == [[-10, 0], [0, 30.5]]
    gray = np.array([[0, 100, 200]], np.uint8)
    assert read(raw_bag([gray], "mono8"), [0], **{"as": "intensity"})[0, ..., 0].tolist() == [
        [0, 100, 200]
    ]
    stretched = read(raw_bag([gray], "mono8"), [0], **{"as": "intensity", "range": (100, 200)})
    assert stretched[0, ..., 0].tolist() == [[0, 0, 255]]


def test_images_without_the_byte_order_are_little_endian() -> None:
    bag = raw_bag([np.array([[1500]], np.uint16)], "16UC1")
    del bag._columns["/camera"]["is_bigendian"], bag.topics["/camera"].fields["is_bigendian"]
    assert read(bag, [0]).item() == 1.5


def test_images_in_json_without_a_schema() -> None:
    pixels = [1, 2, 3, 250, 251, 252]
    for data in (base64.b64encode(bytes(pixels)).decode(), pixels):
        columns = {
            "height": [1],
            "width": [2],
            "encoding": ["rgb8"],
            "step": [6],
            "data": np.array([data]),
            "is_bigendian": [None],
            "format": [None],
        }
        bag = MemoryBag({"/camera": ([0], columns)})
        bag.topics["/camera"].fields.clear()
        assert read(bag, [0]).ravel().tolist() == pixels
    for wrong in (["a"], [-1.5], "no base64!", 10**12, [256], [-1], None):
        columns["data"] = [wrong]
        bag = MemoryBag({"/camera": ([0], {**columns, "data": np.array([wrong, 0], object)[:1]})})
        with pytest.raises(LogError, match="the data of the image"):
            read(bag, [0])


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"as": "yaw"}, "as: yaw is not for image"),
        ({"as": "count"}, "as: count is not for image"),
        ({"range": [0, 1]}, "range is for images with `as: intensity`"),
        ({"range_m": [0, 1], "as": "intensity"}, "range_m is for depth"),
        ({"range_m": [1, 1]}, "two different values"),
        ({"range_m": [0, ".nan"]}, "Input should be a"),
        ({"resize": [0, 4]}, "greater than or equal to 1"),
        ({"resize": [60_000, 60_000]}, "resize is limited to"),
        ({"crop": [0, 0, 0, 1]}, "greater than or equal to 1"),
    ],
)
def test_wrong_options_of_images(options: dict[str, Any], expected: str) -> None:
    tree = {
        "clock": {"rate_hz": 1},
        "observation": {"camera": {"image": "/camera", **options}},
        "action": {"field": "/mode.data"},
    }
    with pytest.raises(UsageError, match=expected):
        parse_mapping(tree)
    tree["observation"] = {"speed": {"field": "/odom.speed", "as": "depth"}}
    with pytest.raises(UsageError, match="as: depth is not for field"):
        parse_mapping(tree)


def test_a_damaged_image_is_collected_with_its_row_time_and_reason() -> None:
    whole = file_of(np.full((8, 8), 7, np.uint8), "PNG")
    bag = compressed_bag("png", b"", whole, file_of(GRAY, "PNG")[:50], whole, b"text")
    reader = reader_of(bag)
    assert reader.read(np.array([0, 1, 2, 3, 3])) is None
    assert sorted(reader.failures) == [0, 2]
    row, time_ns, reason = reader.failures[2]
    assert (row, time_ns) == (2, 2 * 10**9)
    assert reason.startswith("a compressed image (png) cannot be read: the ")
    assert "2 images cannot be decoded, the first is message 0 at 0 ns" in str(reader.problems()[0])
    found = reader.read(np.array([1, 3]))
    assert found is not None
    assert (found[:] == 7).all()
    with pytest.raises(
        LogError, match=r"none of the 2 images can be decoded; message 2 at 20000000"
    ):
        reader_of(bag).read(np.array([2, 4]))
    with pytest.raises(LogError, match=r"/camera: message 2 at 2000000000 ns: a compressed image"):
        reader_of(bag, strict=True).read(np.array([1, 2]))


class BagWithCutMessages(MemoryBag):
    """Bag that cannot decode some messages."""

    def read(self, topic: str, fields: Any, rows: Any = None) -> Any:
        assert rows is not None
        is_cut = np.isin(rows, (1, 3))
        failures = tuple(Failure(row, row * 10**9, "too short") for row in rows[is_cut].tolist())
        return super().read(topic, fields, rows[~is_cut])._replace(failures=failures)


def test_a_message_that_cannot_be_decoded_costs_one_image() -> None:
    files = [file_of(np.full((8, 8), k, np.uint8), "PNG") for k in range(6)]
    columns = {"format": ["png"] * 6, "data": files}
    reader = reader_of(BagWithCutMessages({"/camera": (range(6), columns)}, KINDS))
    assert reader.read(np.arange(6)) is None
    assert sorted(reader.failures) == [1, 3]
    found = reader.read(np.array([5, 0, 2, 4]))
    assert found is not None
    assert found[:, 0, 0, 0].tolist() == [5, 0, 2, 4]


def drive(files: list[bytes], **parts: Any) -> Any:
    """Read a bag with an image in each second, 0.2 s after a step."""
    times = list(range(len(files)))
    bag = MemoryBag(
        {
            "/camera": (
                [t + 0.8 for t in times],
                {"format": ["png"] * len(files), "data": files},
            ),
            "/mode": (times, {"data": [float(t % 2) for t in times]}),
        },
        KINDS,
    )
    tree = {
        "clock": {"rate_hz": 1},
        "observation": {"camera": {"image": "/camera"}},
        "action": {"field": "/mode.data"},
        **parts,
    }
    return read_open_bag(bag, parse_mapping(tree))


def test_the_image_before_a_damaged_one_is_used_if_it_is_young_enough() -> None:
    files = [file_of(np.full((8, 8), 10 * k, np.uint8), "PNG") for k in range(7)]
    data, report = drive(files)
    # Step t has the image of t - 0.2 s.
    assert data.observations[:, 0, 0, 0].tolist() == [0, 10, 20, 30, 40]
    assert not report.images
    files[2] = files[2][:50]
    data, report = drive(files)
    assert data.observations[:, 0, 0, 0].tolist() == [0, 10, 10, 30, 40]
    assert "1 image cannot be decoded, the first is message 2 at" in str(report.problems()[-1])
    assert report.to_json()["images"]
    # Without the image there is a gap, and another episode begins at the image after it.
    data, _ = drive(files, episodes={"gap_s": 1.1, "min_steps": 1})
    assert data.episode_lengths.tolist() == [1, 3]
    assert data.observations[:, 0, 0, 0].tolist() == [0, 30, 40, 50]
    # Several runs of damaged images, some of which only become needed without the others.
    files[1] = b"png"
    data, report = drive(files, episodes={"gap_s": 3})
    assert data.observations[:, 0, 0, 0].tolist() == [0, 0, 0, 30, 40]


def test_strict_reading_raises_at_the_first_damaged_image() -> None:
    files = [file_of(np.full((8, 8), 10 * k, np.uint8), "PNG") for k in range(4)]
    files[2] = b"cut"
    times = list(range(4))
    columns = {"format": ["png"] * 4, "data": files}
    bag = MemoryBag({"/camera": (times, columns), "/mode": (times, {"data": [0.0] * 4})}, KINDS)
    tree = {
        "clock": {"rate_hz": 1},
        "observation": {"camera": {"image": "/camera"}},
        "action": {"field": "/mode.data"},
    }
    with pytest.raises(LogError, match=r"/camera: message 2 at 2000000000 ns"):
        read_open_bag(bag, parse_mapping({**tree, "strict": True}))


def test_observations_of_too_many_elements_are_refused_at_the_first_image() -> None:
    bag = compressed_bag("png", file_of(np.zeros((3000, 3000, 3), np.uint8), "PNG"), b"never read")
    reader = reader_of(bag, strict=True)
    with pytest.raises(UsageError, match="an observation of 54000000 elements is too large"):
        reader.read(np.array([[0, 0], [0, 1]]))


def test_stacks_are_joined_oldest_first() -> None:
    images = [np.full((2, 2), k, np.uint8) for k in range(5)]
    found = reader_of(raw_bag(images, "mono8")).read(np.array([[0, 0], [0, 3], [3, 4]]))
    assert found is not None
    assert found.shape == (3, 2, 2, 2)
    assert found[:, 0, 0].tolist() == [[0, 0], [0, 3], [3, 4]]
    colors = [COLORS, COLORS + 1]
    found = reader_of(raw_bag(colors, "rgb8")).read(np.array([[1, 0]]))
    assert found is not None
    np.testing.assert_array_equal(found[0], np.concatenate([COLORS + 1, COLORS], axis=-1))


@pytest.fixture(scope="module")
def foxglove_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write raw and compressed images as protobuf, and raw images as JSON without a schema."""
    foxglove = pytest.importorskip("foxglove", reason="needs foxglove-sdk")
    from foxglove.channels import CompressedImageChannel, RawImageChannel
    from foxglove.messages import CompressedImage, RawImage

    path = tmp_path_factory.mktemp("foxglove") / "robot.mcap"
    context = foxglove.Context()
    raw = RawImageChannel("/raw", context=context)
    compressed = CompressedImageChannel("/compressed", context=context)
    plain = foxglove.Channel("/json", message_encoding="json", context=context)
    schema = {"type": "object", "properties": {"mode": {"type": "integer"}}}
    modes = foxglove.Channel("/mode", schema=schema, context=context)
    with foxglove.open_mcap(path, context=context):
        for k in range(12):
            pixels = np.full((8, 10, 3), 10 * k, np.uint8)
            data = pixels.tobytes()
            sizes: dict[str, Any] = {"height": 8, "width": 10, "encoding": "rgb8", "step": 30}
            raw.log(RawImage(**sizes, data=data), log_time=k * 10**8)
            file = file_of(pixels, "PNG")
            compressed.log(CompressedImage(data=file, format="png"), log_time=k * 10**8)
            text = base64.b64encode(data).decode()
            plain.log({**sizes, "data": text}, log_time=k * 10**8)
            modes.log({"mode": k % 2}, log_time=k * 10**8)
    return path


def test_images_of_foxglove(foxglove_log: Path) -> None:
    for topic in ("/raw", "/compressed", "/json"):
        tree = {
            "clock": {"rate_hz": 10},
            "observation": {"camera": {"image": topic}},
            "action": {"field": "/mode.mode"},
        }
        found = mcaprl.open(foxglove_log, mapping=tree)
        assert found.observation_space == spaces.Box(0, 255, (8, 10, 3), np.uint8)
        assert found.observations[:, 3, 4, 1].tolist() == [10 * k for k in range(11)]
    with pytest.warns(UserWarning, match="no topic looks like a command"):
        text = mcaprl.suggest_mapping(foxglove_log)
    assert "# camera: {image: /compressed, resize: [84, 84]}  # foxglove.CompressedImage" in text
    assert "# camera1: {image: /raw, resize: [84, 84]}  # foxglove.RawImage, 12" in text
    assert "height" not in text
