"""Images of bags as observations."""

from __future__ import annotations

import struct
from io import BytesIO
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from PIL import Image

from mcaprl.errors import LogError, UsageError
from mcaprl.recorder.mapping.config import Quantity
from mcaprl.recorder.mapping.images import ImageReader
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


def read(bag: MemoryBag, rows: list[int], **options: Any) -> Any:
    reader = ImageReader(bag, "/camera", Quantity(image="/camera", **options))
    return reader.read(np.array(rows, np.int64))


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
    np.testing.assert_allclose(found[0, ..., 0], [[0.0, 1.5], [3.0, 65.535]], rtol=1e-6)
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
    assert reader.space(reader.read(np.zeros(1, np.int64))) == spaces.Box(
        0, 255, (4, 6, 3), np.uint8
    )
