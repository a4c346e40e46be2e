"""Limits of the memory that a foreign file can make its reader use."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from mcaprl.errors import LogError
from mcaprl.limits import ARRAY_COST_BYTES, MAX_UNPACKED_RATIO, UNPACKED_ALLOWANCE_BYTES
from mcaprl.texts import printable, shortened, size

_MAX_SHOWN = 80


class Budget:
    """Bytes that the arrays of a file or folder may take in memory.

    Files can declare arrays of any size, and compression can make large arrays of few bytes.

    Attributes:
        where: Name of the source, for errors.
    """

    def __init__(self, where: object, stored_bytes: int) -> None:
        """Create a budget in proportion to the size of the source."""
        self.where, self._stored = where, stored_bytes
        self._left = UNPACKED_ALLOWANCE_BYTES + MAX_UNPACKED_RATIO * stored_bytes

    @classmethod
    def of_files(cls, where: object, files: Sequence[Path]) -> Budget:
        """Create a budget for files."""
        try:
            return cls(where, sum(file.stat().st_size for file in files))
        except OSError as error:
            raise LogError(f"{where} cannot be read: {error}") from error

    def take(self, name: str, shape: Sequence[int], item_bytes: int) -> None:
        """Subtract an array before it is read."""
        count = math.prod(shape)
        self._left -= count * item_bytes + ARRAY_COST_BYTES
        if self._left < 0:
            declared = shortened(str(tuple(shape)), _MAX_SHOWN)
            raise LogError(
                f"{self.where}: {printable(name)} has shape {declared}, which is too large for the"
                f" {size(self._stored)} that are stored: unpack the data, or divide it into several"
                " files"
            )
