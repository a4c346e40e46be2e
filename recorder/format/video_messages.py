"""Messages of videos: one packet of H.264, H.265, VP9 or AV1, as Foxglove plays it."""

from __future__ import annotations

import struct
from typing import Final

from mcaprl.errors import CorruptLogError

VIDEO_TYPE: Final = "foxglove_msgs/msg/CompressedVideo"
VIDEO_TEXT: Final = f"""\
# One image of a video.
builtin_interfaces/Time timestamp
string frame_id
uint8[] data
string format
{"=" * 80}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
# Encapsulation header of CDR, then seconds and nanoseconds; an empty frame_id, and its padding.
_START: Final = struct.Struct("<4sII")
_NO_FRAME: Final = b"\1\0\0\0\0\0\0\0"
_LENGTH: Final = struct.Struct("<I")


def video_message(time_ns: int, kind: str, data: bytes) -> bytes:
    """Return the message of a packet of a codec, such as `h264`."""
    content = _START.pack(b"\0\1\0\0", *divmod(time_ns, 10**9)) + _NO_FRAME
    content += _LENGTH.pack(len(data)) + data
    text = kind.encode() + b"\0"
    return content + bytes(-len(content) % 4) + _LENGTH.pack(len(text)) + text


def packet_of(message: bytes) -> tuple[str, bytes]:
    """Return the codec and the data in a message of `video_message`."""
    start = _START.size + len(_NO_FRAME)
    try:
        (size,) = _LENGTH.unpack_from(message, start)
        data = message[start + 4 : start + 4 + size]
        at = (start + 4 + size + 3) // 4 * 4
        (size,) = _LENGTH.unpack_from(message, at)
        kind = message[at + 4 : at + 3 + size].decode()
    except (struct.error, UnicodeDecodeError) as error:
        raise CorruptLogError(f"a message of a video is damaged: {error}") from error
    if message != video_message(_time_ns(message), kind, data):
        raise CorruptLogError("a message of a video is damaged")
    return kind, data


def _time_ns(message: bytes) -> int:
    _, seconds, nanoseconds = _START.unpack_from(message)
    return int(seconds) * 10**9 + int(nanoseconds)
