"""Arrays in .npz files, whose sizes are checked before they are read. Pickles are never loaded."""

from __future__ import annotations

import lzma
import math
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from mcaprl.errors import LogError, McaprlError
from mcaprl.limits import MAX_NPY_HEADER_BYTES
from mcaprl.recorder.dataset.formats.budget import Budget
from mcaprl.texts import printable, shortened

_DAMAGED = (
    OSError,
    ValueError,
    TypeError,
    KeyError,
    EOFError,
    MemoryError,
    OverflowError,
    SyntaxError,
    struct.error,
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
    lzma.LZMAError,
)


class Archive:
    """An .npz file whose sizes are checked before an array is read.

    Attributes:
        names: Names of the members, without the suffix `.npy`.
    """

    def __init__(self, path: Path, file: zipfile.ZipFile) -> None:
        """Read the list of members; use `Archive.opened` instead."""
        self._file, self._budget = file, Budget.of_files(path, [path])
        self._members: dict[str, zipfile.ZipInfo] = {}
        for member in file.infolist():
            name = member.filename.removesuffix(".npy")
            if name in self._members:
                raise LogError(f"{path} has two arrays with the name '{name}': remove one of them")
            self._members[name] = member
        self.names = list(self._members)

    @classmethod
    @contextmanager
    def opened(cls, path: Path) -> Iterator[Archive]:
        """Open a file."""
        try:
            with zipfile.ZipFile(path) as file:
                yield cls(path, file)
        except McaprlError:
            raise
        except (NotImplementedError, RuntimeError) as error:
            if isinstance(error, RecursionError):
                raise LogError(
                    f"{path} is not a readable .npz file: its header is nested"
                ) from error
            raise LogError(
                f"{path} is compressed or encrypted in an unknown way: {error}"
            ) from error
        # NumPy, its parser of headers, zipfile and its decompressors raise these for damaged files.
        except _DAMAGED as error:
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            raise LogError(f"{path} is not a readable .npz file: {printable(reason)}") from error

    def is_array(self, name: str) -> bool:
        """Return whether a member is an array with dimensions, or something unknown."""
        if not self._members[name].filename.endswith(".npy"):
            return True
        with self._file.open(self._members[name]) as file:
            return len(_header(file)[0]) > 0

    def __getitem__(self, name: str) -> NDArray[Any]:
        """Read an array."""
        member = self._members[name]
        with self._file.open(member) as file:
            shape, dtype = _header(file)
            if dtype.hasobject:
                raise ValueError(f"'{name}' contains Python objects, which are not loaded")
            if math.prod(shape) * dtype.itemsize != member.file_size - file.tell():
                raise ValueError(f"'{name}' has another size than its shape {shape} declares")
            self._budget.take(name, shape, dtype.itemsize)
        with self._file.open(member) as file:
            found: NDArray[Any] = npy.read_array(file, max_header_size=MAX_NPY_HEADER_BYTES)
        return found


def _header(file: IO[bytes]) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Read the header of an array: its shape and dtype."""
    version = npy.read_magic(file)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"version {version} of the format")
    read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    shape, _, dtype = read(file, max_header_size=MAX_NPY_HEADER_BYTES)
    if not all(0 <= size < 2**63 for size in shape):
        raise ValueError(f"an array has the shape {shortened(str(shape), 80)}")
    return shape, dtype
