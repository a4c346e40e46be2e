"""Compressed images: RVL against an encoder and by hand, image files, and their limits."""

from __future__ import annotations

import os
import stat
import struct
import zlib
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from mcaprl.errors import LogError, SpaceError
from mcaprl.limits import MAX_IMAGE_PIXELS
from mcaprl.recorder.dataset.images import FORMATS, decoded_file
from mcaprl.recorder.mapping.image_pixels import compressed_pixels, rvl_decoded


def rvl_encoded(pixels: list[int]) -> bytes:
    """Encode pixels as in the paper's listing."""
    nibbles: list[int] = []

    def put(number: int) -> None:
        while True:
            nibble, number = number & 7, number >> 3
            nibbles.append(nibble | (8 if number else 0))
            if not number:
                return

    at, previous = 0, 0
    while at < len(pixels):
        zeros = at
        while at < len(pixels) and pixels[at] == 0:
            at += 1
        put(at - zeros)
        others = at
        while at < len(pixels) and pixels[at] != 0:
            at += 1
        put(at - others)
        for value in pixels[others:at]:
            delta = value - previous
            put((delta << 1) ^ (delta >> 31))
            previous = value
    nibbles += [0] * (-len(nibbles) % 8)
    words = [
        int("".join(f"{n:x}" for n in nibbles[k : k + 8]), 16) for k in range(0, len(nibbles), 8)
    ]
    return struct.pack(f"<{len(words)}I", *words)


def test_an_rvl_stream_worked_by_hand() -> None:
    # Pixels 0 0 5 4 0: two zeros (2), two others (2), +5 -> 10 = 0b001_010 -> nibbles 2 | 8, 1;
    # -1 -> 1; one zero (1), no others (0).
    stream = struct.pack("<I", 0x22A11100)
    assert rvl_encoded([0, 0, 5, 4, 0]) == stream
    assert rvl_decoded(stream, 5).tolist() == [0, 0, 5, 4, 0]


@given(st.lists(st.one_of(st.just(0), st.integers(0, 65535), st.integers(999, 1003)), max_size=200))
def test_rvl_streams_are_decoded_as_they_were_encoded(pixels: list[int]) -> None:
    assert rvl_decoded(rvl_encoded(pixels), len(pixels)).tolist() == pixels


@given(st.binary(max_size=64), st.integers(1, 100))
def test_a_damaged_rvl_stream_is_an_error(data: bytes, count: int) -> None:
    try:
        found = rvl_decoded(data, count)
    except LogError:
        return
    assert found.shape == (count,)


@pytest.mark.parametrize(
    ("stream", "expected"),
    [
        (b"", "ends after 0 of 4 pixels"),
        (struct.pack("<I", 0x20000000), "is damaged after 2 of 4 pixels"),
        (struct.pack("<I", 0x70000000), "is damaged after 4 of 4 pixels"),
        (struct.pack("<I", 0x07111111), "is damaged after 0 of 4 pixels"),
        (struct.pack("<II", 0xFFFFFFFF, 0xFFFF0000), "more than 32 bits"),
    ],
)
def test_wrong_counts_in_an_rvl_stream(stream: bytes, expected: str) -> None:
    with pytest.raises(LogError, match=expected):
        rvl_decoded(stream, 4)


def test_rvl_depth_of_ros() -> None:
    header = struct.pack("<iffII", 1, 10100.0, -1009.0, 3, 1)
    found = compressed_pixels("16UC1; compressedDepth rvl", header + rvl_encoded([0, 1500, 3000]))
    assert found.image.tolist() == [[0, 1500, 3000]]
    assert (found.units_per_m, found.is_certain) == (1000, True)
    # 10100 / 2.5 + B = 3031, and 10100 / 10 + B = 1; see `test_compressed_images`.
    found = compressed_pixels("32FC1; compressedDepth rvl", header + rvl_encoded([0, 3031, 1]))
    assert found.image.tolist() == [[0.0, 2.5, 10.0]]
    for size in ((0, 5), (2**31, 2**31), (8001, 8000)):
        data = struct.pack("<iffII", 1, 0, 0, *size) + rvl_encoded([1])
        with pytest.raises(LogError, match=rf"it declares {size[0]} x {size[1]} pixels"):
            compressed_pixels("16UC1; compressedDepth rvl", data)
    for data, expected in (
        (b"12", "2 bytes are too short for the header of compressedDepth"),
        (bytes(15), "3 bytes are too short for the header of RVL"),
        (header, "ends after 0 of 3 pixels"),
    ):
        with pytest.raises(LogError, match=expected):
            compressed_pixels("16UC1; compressedDepth rvl", data)
    with pytest.raises(LogError, match="neither PNG nor RVL"):
        compressed_pixels("16UC1; compressedDepth", bytes(40))


def file_of(format: str, mode: str = "RGB") -> bytes:
    file = BytesIO()
    Image.new(mode, (8, 8)).save(file, format)
    return file.getvalue()


POSTSCRIPT = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 8 8\n%%EndComments\nshowpage\n%%EOF\n"


@pytest.fixture
def ghostscript(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Put programs into PATH that note that they ran; return the folder of the notes."""
    ran = tmp_path / "ran"
    ran.mkdir()
    for name in ("gs", "gswin32c", "gswin64c", "djpeg", "convert"):
        program = tmp_path / name
        program.write_text(f"#!/bin/sh\ntouch {ran}/{name}\n")
        program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    # Pillow remembers whether it found Ghostscript.
    monkeypatch.setattr("PIL.EpsImagePlugin.gs_binary", None)
    monkeypatch.setattr("PIL.EpsImagePlugin.gs_windows_binary", None)
    return ran


def test_the_program_gs_would_run_without_the_list_of_formats(ghostscript: Path) -> None:
    with pytest.raises(OSError):  # noqa: PT011
        Image.open(BytesIO(POSTSCRIPT)).load()
    assert [each.name for each in ghostscript.iterdir()] == ["gs"]


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_no_format_starts_a_program_or_is_decoded_without_being_listed(ghostscript: Path) -> None:
    Image.init()
    files = {"EPS": POSTSCRIPT, "ANIMATED": file_of("GIF")}
    for name in Image.SAVE:
        for mode in ("RGB", "L", "1", "P"):
            try:
                files[name] = file_of(name, mode)
                break
            # Some formats cannot be written to memory, or need other sizes.
            except (OSError, ValueError, KeyError, AttributeError):
                continue
    assert len(files) > 15
    for name, data in files.items():
        for read in (
            lambda data: decoded_file(data, "bags"),
            lambda data: compressed_pixels("jpeg", data),
            lambda data: compressed_pixels("16UC1; compressedDepth png", bytes(12) + data),
        ):
            if name in (*FORMATS, "MPO"):
                continue
            with pytest.raises(LogError):
                read(data)
    for name in FORMATS:
        assert decoded_file(files[name], "bags").size == (8, 8)
    assert not list(ghostscript.iterdir())


def test_image_columns_of_lerobot_open_the_same_formats(ghostscript: Path) -> None:
    pytest.importorskip("pyarrow", reason="needs PyArrow")
    from mcaprl.recorder.dataset.formats.lerobot_features import image_of

    for data in (POSTSCRIPT, file_of("GIF"), file_of("PPM")):
        with pytest.raises(LogError, match=r"an image of front is damaged: .* are not JPEG, PNG"):
            image_of("front", data)
    assert image_of("front", file_of("PNG")).shape == (8, 8, 3)
    with pytest.raises(LogError, match=r"it declares 8 x 8 pixels; at most 63 can be read"):
        image_of("front", file_of("PNG"), max_pixels=63)
    assert not list(ghostscript.iterdir())


def test_images_of_lerobot_are_limited_by_their_declared_shape(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    arrow = pytest.importorskip("pyarrow", reason="needs PyArrow")
    from mcaprl.recorder.dataset.formats import lerobot_features

    def column(*files: bytes) -> Any:
        found = arrow.array([{"bytes": file} for file in files])
        return arrow.chunked_array([found])

    front = lerobot_features.Feature("front", "image", (3, 8, 8))
    assert front.decode(column(file_of("PNG"))).shape == (1, 8, 8, 3)
    with pytest.raises(LogError, match=r"it declares 13000 x 13000 pixels; at most 192 can be"):
        front.decode(column(png_of(13000, 13000)))
    with pytest.raises(SpaceError, match="a space of 169000000 elements is too large"):
        lerobot_features.Feature("front", "image", (13000, 13000, 1)).decode(column(b""))

    def fail(*_: object) -> None:
        raise MemoryError

    monkeypatch.setattr(np, "stack", fail)
    with pytest.raises(LogError, match="2 images of front do not fit into memory"):
        front.decode(column(file_of("PNG"), file_of("PNG")))


def png_of(width: int, height: int) -> bytes:
    """Return a PNG with one bit per pixel that declares a size, and has no pixels."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        crc = zlib.crc32(kind + data)
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", crc)

    header = struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0)
    body = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"\0")) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + body


@pytest.mark.parametrize("size", [(13000, 13000), (8001, 8000), (2**30, 1)])
@pytest.mark.parametrize("prefix", [b"", bytes(12)])
def test_declared_sizes_are_limited_before_decoding(size: tuple[int, int], prefix: bytes) -> None:
    kind = "16UC1; compressedDepth png" if prefix else "png"
    limit = rf"declares .* pixels; at most {MAX_IMAGE_PIXELS}|exceeds limit"
    with pytest.raises(LogError, match=limit):
        compressed_pixels(kind, prefix + png_of(*size))


@pytest.mark.parametrize("kind", ["jpeg", "png"])
def test_errors_of_pillow_are_one_clear_line(kind: str) -> None:
    whole = file_of(kind)
    for data in (b"", b"\0\0\0\1\x67", whole[:10], whole[: len(whole) // 2]):
        with pytest.raises(LogError) as caught:
            compressed_pixels(kind, data)
        assert "BytesIO" not in str(caught.value)
        assert "\n" not in str(caught.value)


def test_sixteen_bits_of_image_files_may_be_depth() -> None:
    file: Any = BytesIO()
    Image.fromarray(np.array([[0, 1500]], np.uint16)).save(file, "PNG")
    for kind, is_certain in (("png", False), ("mono16; png compressed ", False)):
        assert compressed_pixels(kind, file.getvalue()).is_certain == is_certain
    assert compressed_pixels("16UC1; png compressed ", file.getvalue()).is_certain
    floats: Any = BytesIO()
    Image.fromarray(np.array([[0.0, 1.5]], np.float32)).save(floats, "TIFF")
    found = compressed_pixels("32FC1; tiff compressed ", floats.getvalue())
    assert (found.units_per_m, found.is_certain) == (1.0, True)
