"""Packets of MP4 files, in the form in which logs and bags have them.

Units of H.264 and H.265 have a length in MP4 files, and a start code in logs (Annex B): four bytes
for parameter sets and the first unit of a packet, else three, as x264 and x265 write them.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError, import_extra
from mcaprl.recorder.dataset.video import is_parameter_set, with_parameters

_KINDS = {"hevc": "h265"}


def packet_times(path: Path) -> tuple[NDArray[np.float64], str]:
    """Return the times of the packets of a video, and why they cannot be copied.

    Returns:
        (P,) times in seconds, as they are in the file; and the reason, empty if there is none.
    """
    with _packets(path) as (stream, packets):
        times = [packet.pts for packet in packets]
        times_s = np.array(times, np.float64) * float(stream.time_base)
    if (np.diff(times_s) <= 0).any():
        return times_s, "its packets are not in the order of its frames (B-frames)"
    return times_s, ""


def read_packets(path: Path, rows: NDArray[np.int64]) -> Iterator[tuple[str, bytes]]:
    """Yield the codec and the data of packets; keyframes have parameter sets."""
    # The packets before are read as well, so a file is read once if the rows ascend.
    for part in np.split(rows, np.flatnonzero(np.diff(rows) <= 0) + 1):
        wanted = set(part.tolist())
        with _packets(path) as (stream, packets):
            context = stream.codec_context
            name = context.codec.canonical_name
            kind, header = _KINDS.get(name, name), bytes(context.extradata or b"")
            size, parameters = _header(kind, header)
            for row, packet in enumerate(packets):
                if row in wanted:
                    data = bytes(packet)
                    data = _annex_b(kind, data, size) if size else data
                    yield kind, with_parameters(kind, data, parameters)


@contextmanager
def _packets(path: Path) -> Iterator[tuple[Any, Iterator[Any]]]:
    """Open a video, and yield its stream and an iterator of its packets."""
    av = import_extra("av", "video")
    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            yield stream, (each for each in container.demux(stream) if each.pts is not None)
    except (av.FFmpegError, OSError, IndexError) as error:
        raise LogError(f"{path} cannot be read: {error}") from error


def _header(kind: str, header: bytes) -> tuple[int, bytes]:
    """Return the size of a unit's length, 0 for none, and the parameter sets in a file's header."""
    if kind == "av1":
        # ISO binding of AV1, 2.3.3: open bitstream units follow four bytes.
        return 0, header[4:] if header[:1] == b"\x81" else header
    if kind not in ("h264", "h265") or header[:1] != b"\1":
        return 0, header
    # ISO/IEC 14496-15, 5.3.3.1 and 8.3.3.1: arrays of sets, each with a length of two bytes.
    is_h264 = kind == "h264"
    size = (header[4 if is_h264 else 21] & 3) + 1
    found, at = b"", 5 if is_h264 else 23
    for array in range(2 if is_h264 else header[22]):
        if is_h264:
            count, at = header[at] & (255 if array else 31), at + 1
        else:
            count, at = int.from_bytes(header[at + 1 : at + 3]), at + 3
        for _ in range(count):
            stop = at + 2 + int.from_bytes(header[at : at + 2])
            found, at = found + b"\0\0\0\1" + header[at + 2 : stop], stop
    return size, found


def _annex_b(kind: str, data: bytes, size: int) -> bytes:
    """Return a packet whose units have start codes instead of lengths of `size` bytes."""
    found, at = b"", 0
    while at + size < len(data):
        stop = at + size + int.from_bytes(data[at : at + size])
        unit = data[at + size : stop]
        is_long = not found or is_parameter_set(kind, unit)
        found, at = found + (b"\0\0\0\1" if is_long else b"\0\0\1") + unit, stop
    return found
