"""Encodings of raw images, with colors worked by hand, and compared with FFmpeg's."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mcaprl.errors import LogError
from mcaprl.limits import MAX_IMAGE_PIXELS
from mcaprl.recorder.mapping.image_pixels import ENCODINGS, raw_pixels

# ITU-R BT.601 with limited range, by hand, such as for red (Y 81, U 90, V 240):
# R = 1.164 * (81 - 16) + 1.596 * (240 - 128) = 75.7 + 178.7 = 254.4
# G = 75.7 - 0.813 * 112 - 0.391 * (90 - 128) = 75.7 - 91.1 + 14.9 = -0.5
# B = 75.7 + 2.018 * (90 - 128) = 75.7 - 76.7 = -1.0
COLORS_OF_YUV = {
    (16, 128, 128): (0, 0, 0),
    (235, 128, 128): (255, 255, 255),
    (126, 128, 128): (128, 128, 128),
    (5, 128, 128): (0, 0, 0),
    (81, 90, 240): (254, 0, 0),
}


def decoded(encoding: str, height: int, width: int, data: Any, **fields: Any) -> Any:
    raw = np.asarray(data).tobytes()
    message = {"height": height, "width": width, "encoding": encoding, "step": 0, "data": raw}
    rows = {"nv12": 1.5, "nv21": 1.5, "nv24": 3, "i420": 1.5}.get(encoding, 1)
    step = int(len(raw) / (height * rows))
    return np.asarray(raw_pixels({**message, "step": step, **fields}).image)


@pytest.mark.parametrize(("yuv", "rgb"), COLORS_OF_YUV.items())
def test_yuv_is_that_of_bt_601_with_limited_range(
    yuv: tuple[int, int, int], rgb: tuple[int, int, int]
) -> None:
    y, u, v = yuv
    two_rows = [y] * 4
    for encoding, data in (
        ("yuv422", [u, y, v, y] * 2),
        ("uyvy", [u, y, v, y] * 2),
        ("yuv422_yuy2", [y, u, y, v] * 2),
        ("yuyv", [y, u, y, v] * 2),
        ("YUY2", [y, u, y, v] * 2),
        ("nv12", [*two_rows, u, v]),
        ("nv21", [*two_rows, v, u]),
        ("nv24", [*two_rows, *[u, v] * 4]),
        ("i420", [*two_rows, u, v]),
    ):
        found = decoded(encoding, 2, 2, np.array(data, np.uint8))
        assert found.tolist() == [[list(rgb)] * 2] * 2, encoding


def test_pixels_share_their_colors_in_pairs_and_squares() -> None:
    # Y of each pixel differs; U and V belong to two pixels of a row, or to two of each of two rows.
    packed = np.array([[16, 90, 126, 240, 235, 128, 235, 128]], np.uint8)
    found = decoded("yuyv", 1, 4, packed)
    # 1.164 * 110 = 128.0 and the differences of red: + 178.7, - 76.2, - 76.7.
    assert found.tolist() == [[[179, 0, 0], [255, 52, 51], [255] * 3, [255] * 3]]
    planes = np.array([16, 126, 235, 235, 16, 16, 235, 235, 90, 240, 128, 128], np.uint8)
    found = decoded("nv12", 2, 4, planes)
    assert found[:, :2].tolist() == [[[179, 0, 0], [255, 52, 51]], [[179, 0, 0], [179, 0, 0]]]
    assert (found[:, 2:] == 255).all()


@pytest.mark.parametrize("encoding", ["yuyv", "uyvy", "nv12", "nv21", "i420"])
def test_yuv_equals_that_of_ffmpeg(encoding: str) -> None:
    av = pytest.importorskip("av", reason="needs PyAV")
    names = {"yuyv": "yuyv422", "uyvy": "uyvy422", "i420": "yuv420p"}
    # Neighbors are alike, because FFmpeg interpolates U and V.
    ramp = np.add.outer(np.arange(32), np.arange(48)).astype(np.uint8)
    colors = np.stack([3 * ramp, 255 - 2 * ramp, ramp + 60], axis=-1).astype(np.uint8)
    frame = av.VideoFrame.from_ndarray(colors, format="rgb24").reformat(
        format=names.get(encoding, encoding)
    )
    planes: list[Any] = []
    for plane in frame.planes:
        rows = np.frombuffer(plane, np.uint8).reshape(plane.height, plane.line_size)
        used = plane.width * (2 if len(frame.planes) < 3 and (planes or encoding[0] in "yu") else 1)
        planes.append(rows[:, :used].ravel())
    found = decoded(encoding, 32, 48, np.concatenate(planes))
    expected = frame.reformat(format="rgb24").to_ndarray()
    assert np.abs(found[:, 2:-2].astype(int) - expected[:, 2:-2]).mean() < 2
    assert np.abs(found[:, 2:-2].astype(int) - expected[:, 2:-2]).max() <= 8


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_a_bayer_mosaic_of_one_color_becomes_this_color(pattern: str, bits: int) -> None:
    scale, dtype = (1, np.uint8) if bits == 8 else (257, np.uint16)
    color = {"r": 200 * scale, "g": 100 * scale, "b": 50 * scale}
    tile = np.array([color[name] for name in pattern], dtype).reshape(2, 2)
    found = decoded(f"bayer_{pattern}{bits}", 4, 6, np.tile(tile, (2, 3)))
    assert found.dtype == np.uint8
    assert (found == [200, 100, 50]).all()


def test_a_bayer_mosaic_is_interpolated_from_the_nearest_pixels() -> None:
    # R G R G
    # G B G B
    # R G R G
    # G B G B
    mosaic = np.array([[10, 1, 20, 2], [3, 50, 4, 60], [30, 5, 40, 6], [7, 70, 8, 80]], np.uint8)
    found = decoded("bayer_rggb8", 4, 4, mosaic)
    # Blue pixel (1, 1): red is the mean of four corners, green of four neighbors (1, 3, 4, 5).
    assert found[1, 1].tolist() == [25, 3, 50]
    # Green pixel (1, 2) in a row of blue: red above and below (20, 40), blue beside (50, 60).
    assert found[1, 2].tolist() == [30, 4, 55]
    # Green pixel (2, 1) in a row of red: red beside (30, 40), blue above and below (50, 70).
    assert found[2, 1].tolist() == [35, 5, 60]
    # Red pixel (2, 2): blue of four corners 65, green of 4, 5, 6, 8: 5.75.
    assert found[2, 2].tolist() == [40, 6, 65]
    # At the corner, the mirrored neighbors are the pixels themselves.
    assert found[0, 0].tolist() == [10, 2, 50]


def test_sixteen_bits_become_eight_by_division_by_257() -> None:
    values = np.array([[[0, 257, 65535], [128, 129, 32896]]], np.uint16)
    expected = [[[0, 1, 255], [0, 1, 128]]]
    assert decoded("rgb16", 1, 2, values).tolist() == expected
    assert decoded("bgr16", 1, 2, values[..., ::-1]).tolist() == expected
    assert decoded("16UC3", 1, 2, values[..., ::-1]).tolist() == expected
    big = values.astype(">u2")
    assert decoded("rgb16", 1, 2, big, is_bigendian=1).tolist() == expected
    alpha = np.full((1, 2, 1), 9, np.uint16)
    assert decoded("rgba16", 1, 2, np.dstack([values, alpha])).tolist() == expected
    assert decoded("bgra16", 1, 2, np.dstack([values[..., ::-1], alpha])).tolist() == expected


def test_channels_of_opencv_are_blue_green_red() -> None:
    pixel = np.array([[[1, 2, 3, 4]]], np.uint8)
    for encoding in ("8UC4", "8uc4", "bgra8", " BGRA8 "):
        assert decoded(encoding, 1, 1, pixel).tolist() == [[[3, 2, 1]]]


def test_sizes_are_compared_with_the_bytes_before_memory_is_taken() -> None:
    for encoding in ENCODINGS:
        with pytest.raises(LogError, match=r"with 4 bytes per row has 4 bytes, which do not match"):
            decoded(encoding, 8, 8, np.zeros(4, np.uint8), step=4)
    with pytest.raises(LogError, match=f"1 to {MAX_IMAGE_PIXELS} can be read"):
        decoded("mono8", 2**16, 2**16, np.zeros(4, np.uint8), step=2**16)
    for height in (-2, None, float("nan"), float("inf"), "x"):
        with pytest.raises(LogError, match=r"pixels; 1 to|is not a number"):
            raw_pixels({"height": height, "width": -2, "step": 1, "encoding": "rgb8", "data": b"1"})
    with pytest.raises(LogError, match="share their colors, so its size must be even"):
        decoded("yuyv", 1, 3, np.zeros(6, np.uint8))
    with pytest.raises(LogError, match="share their colors, so its size must be even"):
        decoded("nv12", 3, 2, np.zeros(9, np.uint8), step=2)


def test_an_unknown_encoding_is_one_line_with_the_known_ones() -> None:
    with pytest.raises(LogError) as caught:
        decoded("x\ny" * 100, 1, 1, np.zeros(3, np.uint8))
    assert str(caught.value).endswith(f"; supported: {', '.join(ENCODINGS)}")
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 600
