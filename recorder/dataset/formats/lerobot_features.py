"""Videos of LeRobot datasets. One file contains the images of many episodes, one after another.

Numbers are stored as a plain column, vectors as fixed-size lists, and arrays of two to five
dimensions as nested lists. An image is stored as a struct: the name and the bytes of an image file.
The file is a lossless PNG, or a TIFF of 32-bit floats for depth in meters.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError, import_extra
from mcaprl.limits import MAX_IMAGE_PIXELS
from mcaprl.recorder.dataset.arrays import exactly
from mcaprl.recorder.dataset.images import decoded_file
from mcaprl.recorder.dataset.video import VideoDecoder, is_keyframe, pyav_version
from mcaprl.recorder.format.behavior import FIELDS
from mcaprl.recorder.format.spaces import MIN_IMAGE_EDGE, Leaf, check_elements

STATE, IMAGE, IMAGES = "observation.state", "observation.image", "observation.images."
ACTION, REWARD, DONE, TRUNCATED = "action", "next.reward", "next.done", "next.truncated"
INFO = "complementary_info."
BEHAVIORS = tuple(f"{INFO}{field.name}" for field in FIELDS)
STEPS = (ACTION, REWARD, DONE, TRUNCATED, *BEHAVIORS)
"""Features of each step: action, reward, end flags, and probability or density of the action."""
INDEXES = ("frame_index", "episode_index", "index", "task_index")
DEFAULTS = ("timestamp", *INDEXES)
"""Features of every dataset."""
MAX_DIMENSIONS = 5
FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
DATA_PATH = f"data/{FILE}.parquet"
VIDEO_PATH = f"videos/{{video_key}}/{FILE}.mp4"
EPISODES_PATH = f"meta/episodes/{FILE}.parquet"
_HEIGHT_WIDTH_CHANNELS = ("height", "width", "channels")


@dataclass(frozen=True)
class Feature:
    """A feature of the data.

    Attributes:
        name: Name of the column.
        dtype: Data type: a NumPy name, `image` or `video`.
        shape: Shape of one value, at least (1,); (height, width, channels) for images.
        names: Names of the elements or dimensions; None if unknown.
        is_depth: Whether an image contains depth.
    """

    name: str
    dtype: str
    shape: tuple[int, ...]
    names: Any = None
    is_depth: bool = False

    @property
    def is_image(self) -> bool:
        """Whether the values are images, in the data files or as video."""
        return self.dtype in ("image", "video")

    @property
    def is_numeric(self) -> bool:
        """Whether the values are numbers or flags."""
        try:
            return np.dtype(self.dtype).kind in "biuf"
        except TypeError:
            return False

    def to_json(self) -> dict[str, Any]:
        """Return the entry of `meta/info.json`."""
        entry = {"dtype": self.dtype, "shape": list(self.shape), "names": self.names}
        depth = {"info": {"is_depth_map": True, "depth_unit": "m"}}
        return entry | depth if self.is_depth else entry

    @classmethod
    def from_json(cls, name: str, entry: dict[str, Any]) -> Feature:
        """Read an entry of `meta/info.json`."""
        info = entry.get("info") or entry.get("video_info") or {}
        shape = tuple(int(size) for size in entry["shape"])
        is_depth = bool(info.get("is_depth_map") or info.get("video.is_depth_map"))
        return cls(name, str(entry["dtype"]), shape, entry.get("names"), is_depth)

    def encode(self, values: NDArray[Any]) -> Any:
        """Return the values (T, *shape) as an Arrow array."""
        arrow = import_extra("pyarrow", "tables")
        if self.dtype == "image":
            files = [image_file(value) for value in values]
            suffix = "tiff" if self.is_depth else "png"
            names = [f"frame-{row:06d}.{suffix}" for row in range(len(files))]
            columns = [arrow.array(files, arrow.binary()), arrow.array(names, arrow.string())]
            return arrow.StructArray.from_arrays(columns, ["bytes", "path"])
        column = arrow.array(np.ascontiguousarray(values).reshape(-1))
        if self.shape == (1,):
            return column
        if len(self.shape) == 1:
            return arrow.FixedSizeListArray.from_arrays(column, self.shape[0])
        for size in reversed(self.shape):
            offsets = np.arange(0, len(column) + 1, size, dtype=np.int32)
            column = arrow.ListArray.from_arrays(arrow.array(offsets), column)
        return column

    def decode(self, column: Any) -> NDArray[Any]:
        """Return the values (T, *shape) of an Arrow column."""
        if self.dtype == "image":
            files = [file for chunk in column.chunks for file in chunk.field("bytes").to_pylist()]
            # The declared shape limits the memory, in whichever order it has its dimensions.
            most = min(math.prod(self.shape), MAX_IMAGE_PIXELS)
            check_elements(math.prod(self.shape))
            try:
                images = [image_of(self.name, file, max_pixels=most) for file in files]
                return _stack(self.name, images)
            except MemoryError as error:
                raise LogError(
                    f"{len(files)} images of {self.name} do not fit into memory"
                ) from error
        parts = [_numbers(self.name, chunk) for chunk in column.chunks if len(chunk)]
        flat = np.concatenate(parts) if parts else np.zeros(0, self.dtype)
        if flat.size != len(column) * math.prod(self.shape):
            raise LogError(f"the values of {self.name} do not have the shape {self.shape}")
        dtype, rows = np.dtype(self.dtype), flat.reshape(len(column), *self.shape)
        if dtype.kind == "f" or dtype == rows.dtype:
            with np.errstate(over="ignore"):
                return rows.astype(dtype, copy=False)
        # Numbers must not lose their fraction.
        return exactly(self.name, rows, dtype)


def default_features() -> list[Feature]:
    """Return the features that every LeRobot dataset has."""
    return [Feature("timestamp", "float32", (1,)), *(Feature(n, "int64", (1,)) for n in INDEXES)]


def feature_of(name: str, leaf: Leaf, names: Sequence[str] = (), *, video: bool = False) -> Feature:
    """Return the feature that stores a leaf of a space."""
    if leaf.encoding or _is_depth(leaf):
        shape = leaf.shape if len(leaf.shape) == 3 else (*leaf.shape, 1)
        if video and leaf.encoding in ("rgb8", "mono8"):
            return Feature(name, "video", (*shape[:2], 3), list(_HEIGHT_WIDTH_CHANNELS))
        is_depth = leaf.encoding is None
        return Feature(name, "image", shape, list(_HEIGHT_WIDTH_CHANNELS), is_depth=is_depth)
    # Arrays with more dimensions than LeRobot supports are flattened. The writer only does this if
    # `lossy` is set.
    shape = leaf.shape if 0 < len(leaf.shape) <= MAX_DIMENSIONS else (leaf.size,)
    labels = list(names) if len(names) == math.prod(shape) and len(shape) == 1 else None
    return Feature(name, str(leaf.dtype), shape, labels)


def observation_names(leaves: Sequence[Leaf]) -> list[str]:
    """Return a unique feature name for each leaf of an observation space."""
    found: list[str] = []
    for leaf in leaves:
        words = [re.sub(r"[^A-Za-z0-9_.-]+", "_", word) or "_" for word in leaf.path]
        if leaf.encoding or _is_depth(leaf):
            name = IMAGES + ".".join(words) if words else IMAGE
        else:
            name = ".".join(("observation", *words)) if words else STATE
            # LeRobot expects image statistics for every feature whose name contains "image".
            name = re.sub("image", "img", name, flags=re.IGNORECASE)
        candidate, number = name, 2
        while candidate in found:
            candidate, number = f"{name}_{number}", number + 1
        found.append(candidate)
    return found


def info_features(infos: Mapping[str, Any], frames: NDArray[np.int64]) -> dict[str, Feature]:
    """Return a feature for each numeric info that is present at every step, by the info's name.

    Args:
        infos: Mapping[str, Any] of the dataset.
        frames: Indexes (N,) of the rows with the infos that the steps returned.
    """
    found: dict[str, Feature] = {}
    taken = {*BEHAVIORS}
    for name, values in infos.items():
        shape = values.shape[1:] or (1,)
        is_number = values.dtype.kind in "biuf" and values.dtype != np.uint64
        if not is_number or len(shape) > MAX_DIMENSIONS or not _present(values)[frames].all():
            continue
        plain = re.sub(r"[^A-Za-z0-9_.-]+", "_", name)
        feature = INFO + re.sub("image", "img", plain, flags=re.IGNORECASE)
        if feature not in taken:
            taken.add(feature)
            found[name] = Feature(feature, str(values.dtype), shape)
    return found


def _present(values: Any) -> NDArray[np.bool_]:
    """Return flags (F,): whether the info is present in each row."""
    mask: NDArray[np.bool_] = np.ma.getmaskarray(values).reshape(len(values), -1)
    return np.logical_not(mask.all(axis=1))


def image_file(values: NDArray[Any]) -> bytes:
    """Return an image (height, width[, channels]) as PNG, or as TIFF if it has floats."""
    images = import_extra("PIL.Image", "video")
    flat = values[:, :, 0] if values.ndim == 3 and values.shape[2] == 1 else values
    file = BytesIO()
    is_tiff = flat.dtype.kind == "f"
    image = images.fromarray(np.ascontiguousarray(flat))
    image.save(file, "TIFF") if is_tiff else image.save(file, "PNG", compress_level=1)
    return file.getvalue()


def image_of(name: str, file: bytes | None, *, max_pixels: int = MAX_IMAGE_PIXELS) -> NDArray[Any]:
    """Decode an image file to (height, width, channels): uint8, or uint16 or float32 for depth.

    Args:
        name: Name of the feature, for messages.
        file: Content of the file; None if the data files do not contain it.
        max_pixels: Maximum number of pixels.
    """
    if file is None:
        raise LogError(f"an image of {name} is not in the data files: only its path is stored")
    try:
        image = decoded_file(file, "video", max_pixels=max_pixels)
    except LogError as error:
        raise LogError(f"an image of {name} is damaged: {error}") from error
    kept = image.mode in ("L", "RGB", "RGBA", "F") or image.mode.startswith("I;16")
    pixels = np.asarray(image if kept else image.convert("RGB"))
    return pixels if pixels.ndim == 3 else pixels[:, :, None]


def _is_depth(leaf: Leaf) -> bool:
    """Return whether a leaf is a depth image.

    A depth image has float32 values, the shape (height, width[, 1]), edges of at least
    `MIN_IMAGE_EDGE` pixels, and a key that contains `depth`.
    """
    is_flat = len(leaf.shape) == 2 or (len(leaf.shape) == 3 and leaf.shape[2] == 1)
    is_named = any("depth" in word.lower() for word in leaf.path[-1:])
    return (
        is_named and is_flat and leaf.dtype == np.float32 and min(leaf.shape[:2]) >= MIN_IMAGE_EDGE
    )


def _stack(name: str, images: list[NDArray[Any]]) -> NDArray[Any]:
    shapes = {image.shape for image in images}
    if len(shapes) > 1:
        raise LogError(f"the images of {name} differ in size: {sorted(shapes)}")
    return np.stack(images)


def _numbers(name: str, column: Any) -> NDArray[Any]:
    """Return the numbers in a column of nested lists as a flat array."""
    types = import_extra("pyarrow", "tables").types
    while True:
        if column.null_count:
            raise LogError(f"{name} has missing values")
        kind = column.type
        if not (types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind)):
            break
        column = column.flatten()
    if not (types.is_integer(column.type) or types.is_floating(column.type)) and (
        not types.is_boolean(column.type)
    ):
        raise LogError(f"{name} has values of type {column.type}, expected numbers")
    array: NDArray[Any] = column.to_numpy(zero_copy_only=False)
    return array


_CODEC, _QUALITY, _KEY_FRAMES = "libx264", 18, 2


def can_mux() -> bool:
    """Return whether PyAV writes packets that it did not encode; version 17 needs a stream."""
    return pyav_version() >= 18


class VideoWriter:
    """Writer of the videos of a camera."""

    def __init__(
        self,
        folder: Path,
        feature: Feature,
        rate: Fraction,
        path: str,
        max_bytes: int,
        chunk_files: int,
        codec: str = "",
    ) -> None:
        """Create a writer; the first episode creates a file.

        Args:
            folder: Folder of the dataset.
            feature: Feature of the camera.
            rate: Number of images per second.
            path: Template of file paths in the folder, with placeholders for the file's indexes.
            max_bytes: Size of a file, in bytes, after which the next file begins.
            chunk_files: Number of files in a folder.
            codec: Codec of packets to be copied; empty if images are encoded.
        """
        self._folder, self._feature, self._rate = folder, feature, rate
        self._path, self._max_bytes, self._chunk_files = path, max_bytes, chunk_files
        self._codec, self._av = codec, import_extra("av", "video")
        self._number, self._frames, self._bytes = -1, 0, 0
        self._container: Any = None
        self._stream: Any = None

    def info(self) -> dict[str, Any]:
        """Return the description of the videos for `meta/info.json`, after they were written."""
        height, width, channels = self._feature.shape
        with self._av.open(str(self._file(0))) as container:
            format = container.streams.video[0].codec_context.pix_fmt
        return {
            "video.height": height,
            "video.width": width,
            "video.codec": self._codec or "h264",
            "video.pix_fmt": format,
            "video.is_depth_map": False,
            "video.fps": float(self._rate) if self._rate.denominator > 1 else int(self._rate),
            "video.channels": channels,
            "has_audio": False,
        }

    def encode(self, images: NDArray[np.uint8]) -> dict[str, Any]:
        """Encode the images of an episode, and return their position for the table of episodes.

        Args:
            images: (T, height, width[, channels]) with one or three channels.
        """
        first = self._begin()
        for image in images:
            color = np.broadcast_to(image.reshape(*image.shape[:2], -1), self._feature.shape)
            frame = self._av.VideoFrame.from_ndarray(np.ascontiguousarray(color), "rgb24")
            frame.pts, frame.time_base = self._frames, 1 / self._rate
            self._mux(self._stream.encode(frame))
            self._frames += 1
        return self._position(first)

    def copy(self, packets: Iterable[tuple[str, bytes]]) -> dict[str, Any]:
        """Write the packets of an episode as they are, and return the position of their frames."""
        first, decoder = self._begin(), VideoDecoder()
        for kind, data in packets:
            packet = self._av.Packet(data)
            packet.pts = packet.dts = self._frames
            packet.time_base, packet.duration = 1 / self._rate, 1
            packet.is_keyframe = is_keyframe(decoder, kind, data)
            self._mux(self._sets.filter(packet))
            self._frames += 1
        return self._position(first)

    def close(self) -> None:
        """Finish the last file."""
        if self._container is not None:
            self._mux([] if self._codec else self._stream.encode(None))
            self._container.close()
            self._container = None

    def _position(self, first: int) -> dict[str, Any]:
        name = f"videos/{self._feature.name}"
        return {
            f"{name}/chunk_index": self._number // self._chunk_files,
            f"{name}/file_index": self._number % self._chunk_files,
            f"{name}/from_timestamp": float(first / self._rate),
            f"{name}/to_timestamp": float(self._frames / self._rate),
        }

    def _file(self, number: int) -> Path:
        chunk, place = divmod(number, self._chunk_files)
        return self._folder / self._path.format(
            video_key=self._feature.name, chunk_index=chunk, file_index=place
        )

    def _begin(self) -> int:
        """Open the next file if it is needed, and return the number of its next image."""
        if self._container is None or self._bytes > self._max_bytes:
            self.close()
            self._number += 1
            self._frames = self._bytes = 0
            path = self._file(self._number)
            path.parent.mkdir(parents=True, exist_ok=True)
            self._container = self._av.open(str(path), "w")
            self._open_stream()
        return self._frames

    def _open_stream(self) -> None:
        height, width, _ = self._feature.shape
        if self._codec:
            self._stream = self._container.add_mux_stream(
                self._codec, self._rate, width=width, height=height, time_base=1 / self._rate
            )
            # A file has the parameter sets of its first packet in its header.
            filter_of = import_extra("av.bitstream", "video").BitStreamFilterContext
            self._sets = filter_of("extract_extradata", self._codec)
            return
        options = {"crf": str(_QUALITY), "g": str(_KEY_FRAMES)}
        self._stream = self._container.add_stream(_CODEC, rate=self._rate, options=options)
        self._stream.height, self._stream.width = height, width
        # 4:2:0 stores one color for each block of 2 x 2 pixels, so height and width must be even.
        self._stream.pix_fmt = "yuv420p" if height % 2 == width % 2 == 0 else "yuv444p"

    def _mux(self, packets: Iterable[Any]) -> None:
        for packet in packets:
            packet.stream = self._stream
            self._bytes += packet.size
            self._container.mux(packet)


def read_frames(path: Path, times_s: NDArray[np.float64], tolerance_s: float) -> NDArray[np.uint8]:
    """Decode the images (K, height, width, 3) of a video at increasing times.

    Args:
        path: Video.
        times_s: (K,) times, seconds since the start of the video.
        tolerance_s: Largest difference between an element of `times_s` and the time of its image.
    """
    av = import_extra("av", "video")
    found: NDArray[np.uint8] | None = None
    row = 0
    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            for frame in container.decode(stream):
                if row == len(times_s):
                    break
                # Consecutive elements of `times_s` can select the same image.
                while row < len(times_s) and abs(frame.time - times_s[row]) <= tolerance_s:
                    image = frame.to_ndarray(format="rgb24")
                    if found is None:
                        found = np.empty((len(times_s), *image.shape), np.uint8)
                    found[row] = image
                    row += 1
    except (av.FFmpegError, OSError, IndexError) as error:
        raise LogError(f"{path} cannot be decoded: {error}") from error
    if found is None or row < len(times_s):
        raise LogError(f"{path} has no image at {times_s[row]:.3f} s")
    return found
