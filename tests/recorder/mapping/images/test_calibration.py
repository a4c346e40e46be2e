"""Rectified images: places worked by hand, and those of OpenCV 5.0 for the same calibration."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import mcaprl
from mcaprl.errors import LogError, UsageError
from mcaprl.recorder.mapping.calibration import Calibration, Rectifier
from mcaprl.recorder.mapping.config import Quantity
from mcaprl.recorder.mapping.image_pixels import compressed_pixels
from mcaprl.recorder.mapping.images import ImageReader
from tests.support.memory_bag import MemoryBag

WIDTH, HEIGHT = 64, 48
K = np.array([[50.0, 0, 31.5], [0, 52, 23.5], [0, 0, 1]])
P = np.array([[48.0, 0, 32], [0, 49, 24], [0, 0, 1]])
# A turn by the vector (0.02, -0.03, 0.01).
R = np.array(
    [
        [0.9995000583306112, -0.010297631831627843, -0.029893012156105903],
        [0.00969770182836127, 0.9997500291653056, -0.020145316160805754],
        [0.030092988823861425, 0.01984535115917247, 0.9993500758297945],
    ]
)
# Place in the recorded image, and gray value, of pixels of the rectified image, by OpenCV's
# initUndistortRectifyMap (fisheye.initUndistortRectifyMap) and remap.
PIXELS = ((0, 0), (63, 0), (10, 40), (33, 22), (60, 45))
FOUND_BY_OPENCV = {
    ("plumb_bob", (-0.3, 0.1, 0.002, -0.001, 0.02)): (
        *((4.647, 3.413, 20), (60.056, 2.453, 127), (12.029, 40.249, 145)),
        *((34.024, 22.4, 250), (58.726, 43.874, 249)),
    ),
    ("rational_polynomial", (0.5, 0.1, 0.002, -0.001, 0.02, 0.8, 0.05, 0.01)): (
        *((3.636, 2.654, 15), (61.376, 1.478, 127), (11.777, 40.466, 145)),
        *((34.024, 22.4, 250), (59.795, 44.671, 254)),
    ),
    ("equidistant", (-0.05, 0.02, -0.01, 0.003)): (
        *((5.436, 3.922, 23), (59.194, 3.043, 128), (12.411, 39.903, 145)),
        *((34.024, 22.4, 250), (57.922, 43.19, 245)),
    ),
}


def scene() -> Any:
    image = np.add.outer(np.arange(HEIGHT) * 3, np.arange(WIDTH) * 2).astype(np.uint8)
    image[20:28, 30:40] = 250
    return image


@pytest.mark.parametrize(("model", "expected"), FOUND_BY_OPENCV.items(), ids=lambda each: each[0])
def test_images_are_rectified_as_by_opencv(model: Any, expected: Any) -> None:
    name, d = model
    calibration = Calibration(WIDTH, HEIGHT, name, np.array(d), K, R, P)
    x, y = calibration.places()
    found = Rectifier(calibration).rectified(scene(), nearest=False)
    for (column, row), (left, top, value) in zip(PIXELS, expected, strict=True):
        assert x[row, column] == pytest.approx(left, abs=6e-4)
        assert y[row, column] == pytest.approx(top, abs=6e-4)
        # OpenCV rounds places to 1/32 of a pixel.
        assert abs(int(found[row, column]) - value) <= 1


def calibration_bag(images: list[Any], **changes: Any) -> MemoryBag:
    count = len(images)
    image = {
        "height": [len(each) for each in images],
        "width": [each.shape[1] for each in images],
        "encoding": ["mono8" if each.dtype == np.uint8 else "16UC1" for each in images],
        "step": [each.strides[0] for each in images],
        "data": [each.tobytes() for each in images],
    }
    fields = {
        **{"width": 4, "height": 3, "distortion_model": "plumb_bob", "d": [0.0] * 5},
        **{"k": [2.0, 0, 1, 0, 2, 1, 0, 0, 1], "r": [0.0] * 9, "p": [0.0] * 12},
        **changes,
    }
    info = {name: [value] * count for name, value in fields.items()}
    kinds = {"/camera.data": "uint8[]", "/camera.encoding": "string"}
    kinds |= {f"/info.{name}": "float64[]" for name in "dkrp"} | {
        "/info.distortion_model": "string"
    }
    return MemoryBag({"/camera": (range(count), image), "/info": (range(count), info)}, kinds)


def read(bag: MemoryBag, **options: Any) -> Any:
    quantity = Quantity.model_validate({"image": "/camera", "undistort": "/info", **options})
    found = ImageReader(bag, "/camera", quantity).read(np.array([0]))
    assert found is not None
    return found[0, ..., 0]


GRAY = np.arange(12, dtype=np.uint8).reshape(3, 4) * 10


def test_without_distortion_and_another_camera_nothing_changes() -> None:
    np.testing.assert_array_equal(read(calibration_bag([GRAY])), GRAY)
    np.testing.assert_array_equal(read(calibration_bag([GRAY], distortion_model="", d=[])), GRAY)


def test_a_rectified_image_by_hand() -> None:
    # P moves the center by half a pixel: each pixel is the mean of that one and the one before it,
    # and the first column is half of the image, half outside.
    p = [2.0, 0, 1.5, 0, 0, 2, 1, 0, 0, 0, 1, 0]
    expected = [[0, 5, 15, 25], [20, 45, 55, 65], [40, 85, 95, 105]]
    assert read(calibration_bag([GRAY], p=p)).tolist() == expected
    # Depth has the nearest pixel: with a shift of 0.75, the one before.
    depth = GRAY.astype(np.uint16) * 100
    p[2] = 1.75
    found = read(calibration_bag([depth.copy()], p=p))
    assert found.tolist() == [[0, 0, 1, 2], [0, 4, 5, 6], [0, 8, 9, 10]]
    # k1 = 1, at the pixel (3, 1): x = (3 - 1) / 2 = 1, r2 = 1, so x becomes 2, or pixel 5.
    found = read(calibration_bag([GRAY], d=[1.0, 0, 0, 0, 0]))
    # Pixel 2, at x = 0.5, becomes 2.25; pixel 0 becomes -0.25, a quarter of which is outside.
    assert found[1].tolist() == [30, 50, 62, 0]
    # Rectified before the crop.
    assert read(calibration_bag([GRAY], d=[1.0, 0, 0, 0, 0]), crop=(1, 1, 2, 1)).tolist() == [
        [50, 62]
    ]


def test_calibrations_that_cannot_be_used() -> None:
    with pytest.raises(UsageError, match="undistort: the bag has no topic /other"):
        read(calibration_bag([GRAY]), undistort="/other")
    with pytest.raises(UsageError, match="undistort: /camera has memory, not CameraInfo"):
        read(calibration_bag([GRAY]), undistort="/camera")
    with pytest.raises(UsageError, match=r"the model 'odd' with 5 numbers; supported: plumb_bob"):
        read(calibration_bag([GRAY], distortion_model="odd"))
    with pytest.raises(UsageError, match="the model 'plumb_bob' with 3 numbers"):
        read(calibration_bag([GRAY], d=[0.0] * 3))
    with pytest.raises(UsageError, match="the camera of /info is not calibrated: K is"):
        read(calibration_bag([GRAY], k=[0.0] * 9))
    with pytest.raises(LogError, match="has 4 x 3 pixels, but its calibration is for 8 x 3"):
        read(calibration_bag([GRAY], width=8))
    bag = calibration_bag([GRAY, GRAY])
    bag._columns["/info"]["width"][1] = 5
    with pytest.raises(LogError, match="the calibration on /info changes"):
        read(bag)
    with pytest.raises(ValueError, match="undistort is for images only"):
        Quantity.model_validate({"field": "/x.y", "undistort": "/info"})


PHOTO = np.zeros((16, 24, 3), np.uint8)
PHOTO[:8, :12] = (250, 0, 0)
PHOTO[:8, 12:] = (0, 250, 0)
# Colors of the corners of the upright photo, from the upper left in lines; see Exif 2.3, tag 274.
CORNERS = {1: "rgkk", 2: "grkk", 3: "kkgr", 4: "kkrg", 5: "rkgk", 6: "krkg", 7: "kgkr", 8: "gkrk"}


@pytest.mark.parametrize(("orientation", "corners"), CORNERS.items())
@pytest.mark.parametrize("format", ["JPEG", "PNG", "WEBP"])
def test_photos_are_turned_as_their_exif_data_say(
    format: str, orientation: int, corners: str
) -> None:
    exif, file = Image.Exif(), BytesIO()
    exif[274] = orientation
    Image.fromarray(PHOTO).save(file, format, exif=exif)
    found = np.asarray(compressed_pixels(format.lower(), file.getvalue()).image)
    assert found.shape == ((24, 16, 3) if orientation > 4 else (16, 24, 3))
    assert (
        "".join(
            "r" if each[0] > 128 else "g" if each[1] > 128 else "k"
            for each in (found[0, 0], found[0, -1], found[-1, 0], found[-1, -1])
        )
        == corners
    )
    # Damaged EXIF data are ignored.
    Image.fromarray(PHOTO).save(file := BytesIO(), format, exif=b"Exif\0\0MM\0*\0\0\0\x08\0\x01")
    assert compressed_pixels(format.lower(), file.getvalue()).image.size == (24, 16)


def test_an_unknown_topic_has_its_place_in_the_mapping(tmp_path: Path) -> None:
    from tests.support.bags import write_rosbag2

    tree = {
        "clock": {"rate_hz": 10},
        "observation": {"depth": {"image": "/camera/depth", "undistort": "/info"}},
        "action": {"fields": ["/cmd_vel.angular.z"], "edges": [[0]]},
    }
    with pytest.raises(UsageError, match=r"observation.depth: undistort: the bag has no topic"):
        mcaprl.open(write_rosbag2(tmp_path / "drive"), mapping=tree)
