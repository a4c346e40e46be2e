"""Packets of the videos whose frames are the images of a dataset, to be copied as they are."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.recorder.dataset.video import VideoDecoder, codec_in_mp4, is_keyframe

Stream = Callable[[NDArray[np.int64]], Iterator[tuple[str, bytes]]]
"""Function that yields the codec and the data of packets, given their numbers in a video."""


@dataclass(frozen=True)
class Packets:
    """Packets of videos, one for each of F images.

    Attributes:
        streams: The videos.
        places: (F, 2) index of the video, and number of the packet in it.
        lack: Why the images are not the frames of the packets; empty if they are.
        in_logs: Whether a log of the dataset has the packets; otherwise it has the images.
    """

    streams: tuple[Stream, ...]
    places: NDArray[np.int64]
    lack: str = ""
    in_logs: bool = False

    @classmethod
    def of_rows(cls, stream: Stream, rows: NDArray[np.int64], **options: Any) -> Packets:
        """Return the packets `rows` (F,) of one video."""
        return cls((stream,), np.column_stack([np.zeros_like(rows), rows]), **options)

    @classmethod
    def joined(cls, parts: Sequence[Packets]) -> Packets:
        """Concatenate the packets of several datasets."""
        counts = np.cumsum([0, *(len(part.streams) for part in parts)]).tolist()
        moved = [part.places + np.array([k, 0]) for part, k in zip(parts, counts, strict=False)]
        return cls(
            tuple(stream for part in parts for stream in part.streams),
            np.concatenate(moved),
            next((part.lack for part in parts if part.lack), ""),
            all(part.in_logs for part in parts),
        )

    def rows(self, frames: NDArray[np.int64]) -> Packets:
        """Select the packets of images."""
        return replace(self, places=self.places[frames])

    def read(self, frames: Any) -> Iterator[tuple[str, bytes]]:
        """Yield the codec and the data of the packet of each image."""
        places = self.places[frames]
        for part in np.split(places, np.flatnonzero(np.diff(places[:, 0])) + 1):
            if len(part):
                yield from self.streams[part[0, 0]](part[:, 1])

    def codec(self, episodes: Sequence[slice]) -> tuple[str, str]:
        """Return the codec in MP4 files if packets can be copied, and the reason if they cannot.

        Args:
            episodes: Images of each episode, of which the first one must be decoded without packets
                before it.
        """
        if self.lack:
            return "", self.lack
        for k, frames in enumerate(episodes):
            if (np.diff(self.places[frames], axis=0) != (0, 1)).any():
                return "", f"the images of episode {k} are not successive frames of the video"
        names: dict[str, str] = {}
        firsts = self.read(np.array([frames.start for frames in episodes]))
        for k, (kind, data) in enumerate(firsts):
            names[name := codec_in_mp4(kind)] = kind
            if name and not is_keyframe(VideoDecoder(), kind, data):
                return "", f"episode {k} does not begin with a keyframe that has parameter sets"
        if "" in names:
            return "", f"videos of LeRobot are h264, hevc or av1, not {names['']}"
        if len(names) > 1:
            return "", f"the videos have the codecs {', '.join(sorted(names))}"
        return next(iter(names)), ""
