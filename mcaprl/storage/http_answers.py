"""HTTP answers with bounds on their size, status and duration. Extra: `remote`.

fsspec reads each answer as a whole. A server could send more than was requested, or so little that
the answer never ends.
"""

from __future__ import annotations

import asyncio
import re
import time
from typing import Any

import aiohttp

from mcaprl import limits

_RANGE = re.compile(r"bytes=(\d+)-(\d+)")
_CONTENT_RANGE = re.compile(r"bytes (\d+)-(\d+)/")


class BoundedAnswer(aiohttp.ClientResponse):
    """Answer that is read up to the end of the range, or to `limits.MAX_LISTING_BYTES`."""

    async def start(self, connection: Any) -> aiohttp.ClientResponse:
        """Read the status and the headers."""
        async with asyncio.timeout(limits.SILENCE_TIMEOUT_S):
            return await super().start(connection)

    async def read(self) -> bytes:
        """Return the body."""
        if self._body is None:
            try:
                self._body = await self._bounded()
            except BaseException:
                self.close()
                raise
        return self._body

    async def _bounded(self) -> bytes:
        if self.status >= 400:
            # The caller reports the status.
            self.close()
            return b""
        wanted = _RANGE.fullmatch(self.request_info.headers.get("Range", ""))
        most = limits.MAX_LISTING_BYTES
        if wanted:
            start, stop = int(wanted[1]), int(wanted[2]) + 1
            most = stop - start
            self._check_range(start)
        body, began_s = bytearray(), time.monotonic()
        while part := await self.content.readany():
            body += part
            if len(body) > most:
                raise OSError(
                    f"more than the {most} bytes arrived that were requested: the file has changed,"
                    " or its server ignores ranges; download it first"
                )
            elapsed_s = time.monotonic() - began_s
            if elapsed_s > limits.SLOW_AFTER_S and len(body) < limits.MIN_BYTES_PER_S * elapsed_s:
                raise OSError(f"only {len(body)} bytes arrived in {elapsed_s:.0f} s")
        return bytes(body)

    def _check_range(self, start: int) -> None:
        found = _CONTENT_RANGE.match(self.headers.get("Content-Range", ""))
        encoding = self.headers.get("Content-Encoding", "identity")
        is_other = start > 0 if self.status != 206 else found is not None and int(found[1]) != start
        if is_other or encoding not in ("", "identity"):
            raise OSError(
                f"the answer (status {self.status}) is not the requested range: its server ignores"
                " ranges; download it first"
            )


def options() -> dict[str, Any]:
    """Return the options of fsspec's HTTP file system."""
    timeout = aiohttp.ClientTimeout(
        total=None,
        connect=limits.CONNECT_TIMEOUT_S,
        sock_connect=limits.CONNECT_TIMEOUT_S,
        sock_read=limits.SILENCE_TIMEOUT_S,
    )
    return {
        "client_kwargs": {"response_class": BoundedAnswer, "timeout": timeout},
        # The ranges of a compressed answer would be those of the compressed bytes.
        "headers": {"Accept-Encoding": "identity"},
    }
