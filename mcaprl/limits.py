"""Limits on what a file or a server may make this package do, one constant each."""

from __future__ import annotations

from typing import Final

MAX_REMOTE_BYTES: Final = 2**42
"""Size of a remote file; a server may declare any size, and marks of its blocks take memory."""
MAX_LISTING_BYTES: Final = 64 << 20
"""Bytes of an HTTP answer to a request without a range, such as the page of a folder."""
MAX_FETCHED_BYTES: Final = 64 << 20
"""Bytes that are requested from a server at the same time, because they are held in memory."""
MAX_REQUESTS: Final = 32
"""Requests that run at the same time, so that each gets a share of a slow connection."""
CONNECT_TIMEOUT_S: Final = 10.0
"""Time for a connection to an HTTP server, which takes milliseconds to a few seconds."""
SILENCE_TIMEOUT_S: Final = 12.0
"""Time without a byte from an HTTP server, because a silent server would be awaited for ever."""
SLOW_AFTER_S: Final = 12.0
"""Time after which the rate of an answer is checked, because the first bytes may take long."""
MIN_BYTES_PER_S: Final = 500.0
"""Mean rate of an HTTP answer, because a dripping server would be awaited for ever."""
MAX_OPEN_LOGS: Final = 1000
"""Logs that a stream keeps open, because each takes memory and one of the system's 65,530 maps."""
CLIENT_TIMEOUT_S: Final = 10.0
"""Time that a viewer may take for its request or for the next part of an answer."""
