"""Videos of LeRobot datasets. One file contains the images of many episodes, one after another."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError, import_extra
from mcaprl.recorder.dataset.formats.lerobot.features import Feature

_CODEC, _QUALITY, _KEY_FRAMES = "libx264", 18, 2


class VideoWriter:
    """Writer of the videos of a camera.

    Attributes:
        info: Description of the videos for `meta/info.json`.
    """

    def __init__(
        self,
        folder: Path,
        feature: Feature,
        rate: Fraction,
        path: str,
        max_bytes: int,
        chunk_files: int,
    ) -> None:
        """Create a writer; the first episode creates a file.

        Args:
            folder: Folder of the dataset.
            feature: Feature of the camera.
            rate: Number of images per second.
            path: Template of file paths in the folder, with placeholders for the file's indexes.
            max_bytes: Size of a file, in bytes, after which the next file begins.
            chunk_files: Number of files in a folder.
        """
        self._folder, self._feature, self._rate = folder, feature, rate
        self._path, self._max_bytes, self._chunk_files = path, max_bytes, chunk_files
        self._number, self._frames, self._bytes = -1, 0, 0
        self._container: Any = None
        self._stream: Any = None
        height, width, channels = feature.shape
        # 4:2:0 stores one color for each block of 2 x 2 pixels, so height and width must be even.
        self._format = "yuv420p" if height % 2 == width % 2 == 0 else "yuv444p"
        self.info = {
            "video.height": height,
            "video.width": width,
            "video.codec": "h264",
            "video.pix_fmt": self._format,
            "video.is_depth_map": False,
            "video.fps": float(rate) if rate.denominator > 1 else int(rate),
            "video.channels": channels,
            "has_audio": False,
        }

    def add_episode(self, images: NDArray[np.uint8]) -> dict[str, Any]:
        """Write the images of an episode, and return their position for the table of episodes.

        Args:
            images: (T, height, width[, channels]) with one or three channels.
        """
        if self._container is None or self._bytes > self._max_bytes:
            self._next_file()
        av = import_extra("av", "video")
        first = self._frames
        for image in images:
            color = np.broadcast_to(image.reshape(*image.shape[:2], -1), self._feature.shape)
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(color), "rgb24")
            frame.pts, frame.time_base = self._frames, 1 / self._rate
            self._mux(frame)
            self._frames += 1
        name = f"videos/{self._feature.name}"
        return {
            f"{name}/chunk_index": self._number // self._chunk_files,
            f"{name}/file_index": self._number % self._chunk_files,
            f"{name}/from_timestamp": float(first / self._rate),
            f"{name}/to_timestamp": float(self._frames / self._rate),
        }

    def close(self) -> None:
        """Finish the last file."""
        if self._container is not None:
            self._mux(None)
            self._container.close()
            self._container = None

    def _file(self) -> Path:
        chunk, number = divmod(self._number, self._chunk_files)
        return self._folder / self._path.format(
            video_key=self._feature.name, chunk_index=chunk, file_index=number
        )

    def _next_file(self) -> None:
        self.close()
        self._number += 1
        self._frames = self._bytes = 0
        self._file().parent.mkdir(parents=True, exist_ok=True)
        self._container = import_extra("av", "video").open(str(self._file()), "w")
        options = {"crf": str(_QUALITY), "g": str(_KEY_FRAMES)}
        self._stream = self._container.add_stream(_CODEC, rate=self._rate, options=options)
        height, width, _ = self._feature.shape
        self._stream.height, self._stream.width = height, width
        self._stream.pix_fmt = self._format

    def _mux(self, frame: Any) -> None:
        for packet in self._stream.encode(frame):
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
