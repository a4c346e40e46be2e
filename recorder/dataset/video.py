"""Frames of video topics: one packet per message, in H.264, H.265, VP9 or AV1, decoded by PyAV.

A stream is decoded forward from a keyframe. A frame that refers to a packet which the bag lacks
would be gray or smeared, so all frames from there to the next keyframe are missing, with a reason.
What shows that a packet is lost depends on the codec:

- H.264 numbers its reference frames (`frame_num`), and AV1 the frames it shows (`order_hint`).
  The numbers begin again at a keyframe. If a keyframe may be lost without a gap in the numbers, a
  pause of more than 1.5 typical intervals, in log_times and stamps, decides.
- The decoder of H.265 knows which frames another one refers to.
- VP9 does neither: such a pause counts as a loss.

Packets are Annex B (H.264, H.265), frames (VP9) and temporal units (AV1), as Foxglove specifies.
Parameter sets that only the begin of a recording has are added to its later keyframes.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import lru_cache
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError, MissingExtraError, UsageError, import_extra
from mcaprl.limits import MAX_IMAGE_PIXELS

NO_KEYFRAME: Final = "there is no keyframe before it"
LOST: Final = "a packet between it and the keyframe before it is lost"
DAMAGED: Final = "a packet between it and the keyframe before it cannot be decoded"
NO_FRAME: Final = "the decoder returns no frame"
_PAUSE: Final = 1.5
_DELAYED: Final = 64
"""More packets than a decoder reads before it returns a frame: 16 in H.264 and H.265."""
_SEARCHED: Final = 64
"""Packets that are decoded although no frame of them is wanted, before a keyframe is searched; and
packets that are read at a time to find one."""


class _Bits:
    """Reader of the first bits of a unit."""

    def __init__(self, data: bytes) -> None:
        self._value, self._left = int.from_bytes(data), 8 * len(data)

    def take(self, count: int) -> int:
        """Return an unsigned number of `count` bits."""
        self._left -= count
        if self._left < 0:
            raise LogError("a header of the stream is cut off")
        return self._value >> self._left & ((1 << count) - 1)

    def golomb(self) -> int:
        """Return an unsigned number in the Exp-Golomb code."""
        zeros = 0
        while not self.take(1):
            zeros += 1
        return (1 << zeros) - 1 + self.take(zeros)


class _Number(NamedTuple):
    """Number of a frame, modulo `period`; frames that do not count are not referred to."""

    value: int
    period: int
    counts: bool = True


class _Look(NamedTuple):
    """What a packet shows without being decoded: parameter sets are empty if it has none."""

    is_key: bool
    parameters: bytes = b""
    number: _Number | None = None


def _starts_of(data: bytes) -> Iterator[int]:
    """Yield the first byte of each NAL unit of Annex B."""
    start = data.find(b"\0\0\1")
    while 0 <= start < len(data) - 3:
        yield start + 3
        start = data.find(b"\0\0\1", start + 3)


def _unit(data: bytes, start: int) -> bytes:
    """Return a NAL unit with a start code."""
    stop = data.find(b"\0\0\1", start)
    return b"\0\0\0\1" + (data[start:stop] if stop >= 0 else data[start:]).rstrip(b"\0")


def _header(unit: bytes) -> _Bits:
    """Return the bits of a part of a NAL unit, without the bytes that keep start codes out."""
    return _Bits(unit.replace(b"\0\0\3", b"\0\0"))


_WITH_CHROMA: Final = (100, 110, 122, 244, 44, 83, 86, 118, 128, 138, 139, 134, 135)
"""Profiles of H.264 whose parameter sets have a chroma format."""


def _h264(data: bytes, known: bytes) -> _Look:
    found = b""
    for start in _starts_of(data):
        kind = data[start] & 31
        if kind in (7, 8):
            found += _unit(data, start)
        if kind in (1, 5):
            bits, is_referred_to = _header(data[start + 1 : start + 33]), bool(data[start] & 0x60)
            number = _frame_number(bits, found or known, counts=is_referred_to)
            return _Look(kind == 5, found, number)
    return _Look(is_key=False, parameters=found)


def _frame_number(bits: _Bits, parameters: bytes, *, counts: bool) -> _Number | None:
    """Return the `frame_num` of a slice (ITU-T H.264, 7.3.3); None without a parameter set."""
    size, has_planes = _frame_number_bits(parameters)
    for _ in range(3):
        bits.golomb()
    bits.take(2 if has_planes else 0)
    return _Number(bits.take(size), 1 << size, counts) if size else None


@lru_cache(maxsize=16)
def _frame_number_bits(parameters: bytes) -> tuple[int, bool]:
    """Return the size of `frame_num`, and whether color planes are separate (7.3.2.1.1)."""
    starts = (each for each in _starts_of(parameters) if parameters[each] & 31 == 7)
    start = next(starts, None)
    if start is None:
        return 0, False
    bits = _header(parameters[start + 1 : start + 1025])
    profile = bits.take(8)
    bits.take(16)
    bits.golomb()
    has_planes = False
    if profile in _WITH_CHROMA:
        chroma = bits.golomb()
        has_planes = chroma == 3 and bool(bits.take(1))
        bits.golomb()
        bits.golomb()
        bits.take(1)
        if bits.take(1):
            for k in range(12 if chroma == 3 else 8):
                if bits.take(1):
                    _skip_scales(bits, 16 if k < 6 else 64)
    return bits.golomb() + 4, has_planes


def _skip_scales(bits: _Bits, count: int) -> None:
    """Skip a scaling list (7.3.2.1.1.1)."""
    last = following = 8
    for _ in range(count):
        if following:
            code = bits.golomb()
            following = (last + ((code + 1) // 2 if code % 2 else -(code // 2))) % 256
        last = following or last


def _h265(data: bytes, _known: bytes) -> _Look:
    found = b""
    for start in _starts_of(data):
        kind = data[start] >> 1 & 63
        if kind in (32, 33, 34):
            found += _unit(data, start)
        if kind < 32:
            return _Look(16 <= kind <= 21, found)
    return _Look(is_key=False, parameters=found)


def _vp9(data: bytes, _known: bytes) -> _Look:
    bits = _Bits(data[:1])
    bits.take(2)
    low, high = bits.take(1), bits.take(1)
    bits.take(low & high)
    return _Look(not bits.take(1) and not bits.take(1))


class _Sequence(NamedTuple):
    """Fields of the sequence header of AV1 that its frame headers depend on."""

    is_still: bool
    has_times: bool
    time_bits: int
    id_bits: int
    chooses_tools: bool
    tools: int
    chooses_motion: bool
    order_bits: int


def _av1(data: bytes, known: bytes) -> _Look:
    found, number = b"", None
    for kind, whole, body in _open_units(data):
        if kind == 1:
            found = whole
        elif kind in (3, 6):
            header = found or next((unit for kind, unit, _ in _open_units(known) if kind == 1), b"")
            if not header:
                return _Look(is_key=False)
            is_key, is_shown, number = _order(body, _sequence_of(header))
            if is_key or is_shown:
                return _Look(is_key, found, number)
    return _Look(is_key=False, parameters=found)


def _open_units(data: bytes) -> Iterator[tuple[int, bytes, bytes]]:
    """Yield the open bitstream units of AV1: kind, the whole unit, and its content."""
    at = 0
    while at < len(data):
        start, head = at, data[at]
        at += 2 if head & 4 else 1
        size = len(data) - at
        if head & 2:
            size = 0
            for k in range(8):
                byte = data[at] if at < len(data) else 0
                at, size = at + 1, size | (byte & 127) << 7 * k
                if byte < 128:
                    break
        yield head >> 3 & 15, data[start : at + size], data[at : at + size]
        at += size


@lru_cache(maxsize=16)
def _sequence_of(unit: bytes) -> _Sequence:
    """Parse a sequence header (AV1 bitstream specification, 5.5)."""
    ((_, _, body),) = _open_units(unit)
    bits = _Bits(body)
    bits.take(4)
    if bits.take(1):
        return _Sequence(True, False, 0, 0, False, 0, False, 0)
    has_times, time_bits, delay_bits = False, 0, 0
    if bits.take(1):
        bits.take(64)
        is_even = bits.take(1)
        if is_even:
            bits.golomb()
        if bits.take(1):
            delay_bits = bits.take(5) + 1
            bits.take(37)
            time_bits = bits.take(5) + 1
            has_times = not is_even
    has_delay = bits.take(1)
    for _ in range(bits.take(5) + 1):
        bits.take(12)
        bits.take(1 if bits.take(5) > 7 else 0)
        if delay_bits and bits.take(1):
            bits.take(2 * delay_bits + 1)
        if has_delay and bits.take(1):
            bits.take(4)
    sizes = bits.take(4) + bits.take(4) + 2
    bits.take(sizes)
    id_bits = 0
    if bits.take(1):
        id_bits = bits.take(4) + 2
        id_bits += bits.take(3) + 1
    bits.take(7)
    has_order = bits.take(1)
    bits.take(2 * has_order)
    tools = 2 if (chooses_tools := bool(bits.take(1))) else bits.take(1)
    chooses_motion = bool(tools and bits.take(1))
    bits.take(1 if tools and not chooses_motion else 0)
    order_bits = bits.take(3) + 1 if has_order else 0
    return _Sequence(
        False, has_times, time_bits, id_bits, chooses_tools, tools, chooses_motion, order_bits
    )


def _order(body: bytes, sequence: _Sequence) -> tuple[bool, bool, _Number | None]:
    """Return whether a frame of AV1 is a key, whether it is shown, and its order (5.9.2)."""
    if sequence.is_still:
        return True, True, None
    bits = _Bits(body[:32])
    if bits.take(1):
        return False, True, None
    kind, is_shown = bits.take(2), bits.take(1)
    if is_shown:
        bits.take(sequence.time_bits if sequence.has_times else 0)
    else:
        bits.take(1)
    is_key = kind == 0 and bool(is_shown)
    if not (kind == 3 or is_key):
        bits.take(1)
    bits.take(1)
    tools = bits.take(1) if sequence.chooses_tools else sequence.tools
    if tools and sequence.chooses_motion:
        bits.take(1)
    bits.take(sequence.id_bits)
    bits.take(0 if kind == 3 else 1)
    size = sequence.order_bits
    number = _Number(bits.take(size), 1 << size) if size else None
    return is_key, bool(is_shown), number


class _Codec(NamedTuple):
    """Codec: its names in messages, the decoder, its options, and how packets are looked at.

    Attributes:
        in_mp4: Name of the codec in the MP4 files of LeRobot; empty if they do not have it.
        is_numbered: Whether packets show the numbers of their frames.
        has_parameters: Whether a keyframe needs parameter sets.
        least_pyav: Oldest version of PyAV whose decoder reports a frame with missing references.
    """

    names: str
    decoder: str
    look: Callable[[bytes, bytes], _Look]
    in_mp4: str = ""
    is_numbered: bool = False
    has_parameters: bool = True
    options: tuple[tuple[str, str], ...] = ()
    least_pyav: int = 0


_CODECS: Final = {
    "h264": _Codec(r"h\.?264|avc", "h264", _h264, "h264", is_numbered=True),
    # Only with `explode`, a frame whose references are missing is an error.
    "h265": _Codec(
        r"h\.?265|hevc",
        "hevc",
        _h265,
        "hevc",
        options=(("err_detect", "explode"),),
        least_pyav=16,
    ),
    "vp9": _Codec("vp9", "vp9", _vp9, has_parameters=False),
    "av1": _Codec("av1", "libdav1d", _av1, "av1", is_numbered=True),
}


@lru_cache(maxsize=16)
def _codec_of(kind: str) -> _Codec:
    """Return the codec that a message names: `h264`, `libx264`, `hevc_nvenc`, `h264;yuv420p`."""
    name = kind.replace("x26", "h26")
    for codec in _CODECS.values():
        if re.search(codec.names, name, re.IGNORECASE):
            return codec
    raise UsageError(f"video '{kind}' is not supported; supported: {', '.join(_CODECS)}")


def codec_in_mp4(kind: str) -> str:
    """Return the name that a codec has in the MP4 files of LeRobot; empty if they lack it."""
    try:
        return _codec_of(kind).in_mp4
    except UsageError:
        return ""


def with_parameters(kind: str, data: bytes, parameters: bytes) -> bytes:
    """Return a packet, with parameter sets if it is a keyframe that has none."""
    if not codec_in_mp4(kind):
        return data
    look = _codec_of(kind).look(data, parameters)
    return parameters + data if look.is_key and not look.parameters else data


def is_parameter_set(kind: str, unit: bytes) -> bool:
    """Return whether a NAL unit of H.264 or H.265, without a start code, is a parameter set."""
    return unit[0] & 31 in (7, 8) if kind == "h264" else unit[0] >> 1 & 63 in (32, 33, 34)


Decoded = tuple[int, Any]
"""Row of a message, and its frame (`av.VideoFrame`), or a text that says why it has none."""


def pyav_version() -> int:
    """Return the major version of PyAV, because what it can do differs."""
    return int(import_extra("av", "video").__version__.split(".")[0])


class VideoDecoder:
    """Decoder of a stream that returns no frame for which a packet is missing.

    With B-frames, a packet's frame is returned after later packets; it still has the row of that
    packet.
    """

    def __init__(self, typical_ns: float = 0.0) -> None:
        """Store the typical interval of the packets in nanoseconds; 0 if it is unknown."""
        self._av = import_extra("av", "video")
        self._typical_ns = typical_ns
        self._context: Any = None
        self._codec: _Codec | None = None
        self._waiting = dict[int, None]()
        self._parameters = b""
        self._number: _Number | None = None
        self._times_ns = tuple[int, ...]()
        self._broken = NO_KEYFRAME

    def starts(self, kind: str, data: bytes) -> bool:
        """Return whether decoding can begin with a packet; its parameter sets are kept."""
        return self._looked(_codec_of(kind), data)[1]

    def _looked(self, codec: _Codec, data: bytes) -> tuple[_Look, bool]:
        if not data:
            raise LogError("the packet is empty")
        look = codec.look(data, self._parameters)
        self._parameters = look.parameters or self._parameters
        return look, look.is_key and bool(self._parameters or not codec.has_parameters)

    def feed(
        self, row: int, kind: str, data: bytes, times_ns: tuple[int, ...] = ()
    ) -> Iterator[Decoded]:
        """Decode the next packet, and yield the frames that are complete with it.

        Args:
            row: Number of the packet, which is that of its frame.
            kind: Codec that the message names.
            data: Content of the packet.
            times_ns: Times of the packet by several clocks, such as log_time and its stamp.
        """
        codec = _codec_of(kind)
        try:
            look, is_start = self._looked(codec, data)
        except LogError as error:
            yield from self.lose(row, str(error))
            return
        if is_start and (self._broken or codec is not self._codec):
            yield from self.end()
            self._open(codec)
            data = data if look.parameters else self._parameters + data
        elif not self._broken and not look.is_key and self._has_loss(codec, look.number, times_ns):
            yield from self.end(LOST)
        self._note(look, times_ns)
        if self._broken:
            yield row, self._broken
            return
        packet = self._av.Packet(data)
        packet.pts = row
        self._waiting[row] = None
        if len(self._waiting) > _DELAYED:
            # A packet of parameter sets alone.
            self._waiting.pop(oldest := next(iter(self._waiting)))
            yield oldest, NO_FRAME
        try:
            frames = self._context.decode(packet)
        except self._av.FFmpegError as error:
            del self._waiting[row]
            yield from self.lose(row, f"the packet cannot be decoded: {error.strerror}")
        else:
            yield from self._checked(frames)

    def lose(self, row: int, reason: str) -> Iterator[Decoded]:
        """Go on without a packet: its frame, and those until the next keyframe, are missing."""
        yield from self.end(DAMAGED)
        yield row, reason

    def end(self, reason: str = NO_KEYFRAME) -> Iterator[Decoded]:
        """Yield the remaining frames; `reason` says why later ones, up to a keyframe, have none."""
        if self._context is not None:
            if not self._broken:
                with suppress(self._av.FFmpegError):
                    yield from self._checked(self._context.decode(None))
            self._context.flush_buffers()
        waiting, self._waiting, self._broken = list(self._waiting), {}, reason
        for row in waiting:
            yield row, NO_FRAME

    def _open(self, codec: _Codec) -> None:
        if codec is not self._codec:
            if pyav_version() < codec.least_pyav:
                raise MissingExtraError(
                    f"PyAV {self._av.__version__} does not report which frames of {codec.decoder} a"
                    f" lost packet damages; version {codec.least_pyav} does: pip install -U"
                    " 'mcaprl[video]'"
                )
            self._context = self._av.CodecContext.create(codec.decoder, "r")
            self._context.thread_count = 1
            self._context.options = {**dict(codec.options), "max_pixels": str(MAX_IMAGE_PIXELS)}
            self._codec = codec
        self._broken, self._number, self._times_ns = "", None, ()

    def _has_loss(self, codec: _Codec, number: _Number | None, times_ns: tuple[int, ...]) -> bool:
        """Return whether a packet is missing before this one, which follows a frame."""
        pauses_ns = (new - old for new, old in zip(times_ns, self._times_ns, strict=False))
        pause = min(pauses_ns, default=0) / self._typical_ns if self._typical_ns else 0.0
        if not codec.is_numbered:
            return not codec.has_parameters and pause > _PAUSE
        old = self._number
        if old is None or number is None or old.period != number.period:
            return False
        if (number.value - old.value) % number.period != 1:
            return True
        # A lost keyframe, whose number is 0, or as many packets as there are numbers.
        return pause > (_PAUSE if number.value == 1 else number.period - 0.5)

    def _note(self, look: _Look, times_ns: tuple[int, ...]) -> None:
        """Keep the number and times of a packet."""
        self._times_ns = times_ns
        if look.number is None:
            # A frame of AV1 that was decoded before and is shown now has the next number.
            old = self._number
            self._number = old and old._replace(value=old.value + 1)
        elif look.number.counts:
            self._number = look.number

    def _checked(self, frames: list[Any]) -> Iterator[Decoded]:
        for frame in frames:
            if frame.pts not in self._waiting:
                continue
            self._waiting.pop(frame.pts)
            if not frame.is_corrupt and not self._broken:
                yield frame.pts, frame
                continue
            yield frame.pts, self._broken or "the packet is damaged"
            self._broken = self._broken or DAMAGED


Message = tuple[str, bytes, tuple[int, ...]] | str
"""Codec, data and times in nanoseconds of a packet; or why the message cannot be read."""


class VideoStream:
    """Packets of a topic, of which the wanted frames are decoded.

    Attributes:
        typical_ns: Typical interval of the packets, nanoseconds; 0 if it is unknown.
    """

    def __init__(
        self,
        read: Callable[[NDArray[np.int64]], Iterator[tuple[int, Message]]],
        begins: NDArray[np.int64],
        times_ns: NDArray[np.int64],
    ) -> None:
        """Store how messages are read.

        Args:
            read: Function that yields the messages of ascending rows, each with its row.
            begins: First row of each recording: a stream does not go on in the next one.
            times_ns: (N,) times of all messages.
        """
        self._read, self._begins, self._count = read, begins, len(times_ns)
        steps_ns = np.diff(times_ns)
        self.typical_ns = float(np.median(steps_ns)) if len(steps_ns) else 0.0

    def before_keyframes(self) -> Iterator[tuple[int, str]]:
        """Yield the first rows of each recording, up to its first keyframe."""
        stops = [*self._begins[1:].tolist(), self._count]
        for begin, stop in zip(self._begins.tolist(), stops, strict=True):
            decoder = VideoDecoder()
            for row, message in self._read(np.arange(begin, stop)):
                if not isinstance(message, str) and is_keyframe(decoder, *message[:2]):
                    break
                yield row, message if isinstance(message, str) else NO_KEYFRAME

    def frames(self, wanted: NDArray[np.int64]) -> Iterator[Decoded]:
        """Yield the frames of ascending rows, and the rows between them that have no frame.

        Of a group of frames, from keyframe to keyframe, without a wanted one, nothing is decoded.
        """
        decoder, stop, recording = VideoDecoder(self.typical_ns), 0, -1
        numbers = np.searchsorted(self._begins, wanted, side="right") - 1
        is_apart = (np.diff(wanted) > _SEARCHED) | (np.diff(numbers) > 0)
        parts = np.split(wanted, np.flatnonzero(is_apart) + 1) if len(wanted) else []
        for part in parts:
            first, last = int(part[0]), int(part[-1])
            number = int(np.searchsorted(self._begins, first, side="right")) - 1
            if number != recording:
                yield from decoder.end()
                decoder, recording = VideoDecoder(self.typical_ns), number
                stop = int(self._begins[number])
                self._learn(decoder, stop, first)
            start = self._start(decoder, stop, first)
            if start is not None:
                yield from decoder.end()
            for row, message in self._read(np.arange(stop if start is None else start, last + 1)):
                if isinstance(message, str):
                    yield from decoder.lose(row, message)
                else:
                    yield from decoder.feed(row, *message)
            stop = last + 1
        yield from decoder.end()

    def _learn(self, decoder: VideoDecoder, begin: int, stop: int) -> None:
        """Let a decoder see the parameter sets at the begin of a recording."""
        for _, message in self._read(np.arange(begin, stop)):
            if not isinstance(message, str) and is_keyframe(decoder, *message[:2]):
                return

    def _start(self, decoder: VideoDecoder, low: int, first: int) -> int | None:
        """Return the last keyframe from `low` to `first`, from which a frame can be decoded."""
        for stop in range(first + 1, low, -_SEARCHED):
            rows = np.arange(max(low, stop - _SEARCHED), stop)
            found = [
                row
                for row, message in self._read(rows)
                if not isinstance(message, str) and is_keyframe(decoder, *message[:2])
            ]
            if found:
                return found[-1]
        return None


def is_keyframe(decoder: VideoDecoder, kind: str, data: bytes) -> bool:
    """Return whether decoding can begin with a packet, whose parameter sets the decoder keeps."""
    try:
        return decoder.starts(kind, data)
    except LogError:
        return False


# Flags of libswscale: SWS_AREA, with SWS_FULL_CHR_H_INT and SWS_ACCURATE_RND.
_BILINEAR: Final = 0x2
_AVERAGE: Final = 0x20 | 0x2000 | 0x40000


class Converter:
    """Conversion of frames to red, green and blue, by their color space, or else BT.601."""

    def __init__(self, size: tuple[int, int] | None = None) -> None:
        """Store the width and height to which frames are averaged; by default, they are not."""
        self._size, self._flags = size, _BILINEAR if size is None else _AVERAGE
        # It keeps the tables of the conversion, which a frame's own method computes each time.
        self._reformatter = import_extra("av.video.reformatter", "video").VideoReformatter()

    def pixels(self, frame: Any) -> NDArray[np.uint8]:
        """Return a frame as (H, W, 3)."""
        width, height = self._size or (frame.width, frame.height)
        image = self._reformatter.reformat(frame, width, height, "rgb24", interpolation=self._flags)
        found: NDArray[np.uint8] = image.to_ndarray()
        return found
