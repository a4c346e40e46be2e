"""Names and arrays in HDF5 files.

The files may come from untrusted sources, so sizes are checked before anything is read, and links
to other files are not followed. The sizes of all arrays count together, because several names may
belong to one array.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from io import FileIO
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import LogError, McaprlError, import_extra
from mcaprl.files import open_at_once
from mcaprl.limits import MAX_NESTED_GROUPS, MAX_READ_RATIO, UNPACKED_ALLOWANCE_BYTES
from mcaprl.recorder.dataset.formats.columns import Budget
from mcaprl.system import read_at
from mcaprl.texts import printable

SIGNATURE = b"\x89HDF\r\n\x1a\n"
EXTRA = "interop"
_HEAP, _GLOBAL_HEAP = b"HEAP\0\0\0\0", b"GCOL\1\0\0\0"
_MAX_GLOBAL_HEAP_BYTES = 64 << 20
# HDF5's filters reach a compression ratio of at most 1032. If the declared size of an array exceeds
# its stored size by a larger factor, some of its values were never written.
_MAX_RATIO = 2_000
_SMALL_BYTES = 1 << 20
_CHUNK_BYTES = 1 << 18
_ELSEWHERE = "is stored in another file: copy it into this file"
_GROUP_COST_BYTES = 16 << 10
"""Bytes that each opened group counts, because groups may contain each other."""
_DAMAGED = (
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
    KeyError,
    MemoryError,
    OverflowError,
    SystemError,
)
"""Errors that h5py raises for damaged structures."""
_budget: ContextVar[Budget] = ContextVar("budget")
"""Limit of the file that is open."""


def is_hdf5(path: Path) -> bool:
    """Return whether a path is a file that starts with the HDF5 signature."""
    try:
        with FileIO(open_at_once(path)) as file:
            return file.read(len(SIGNATURE)) == SIGNATURE
    except OSError:
        return False


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    """Open a file for reading."""
    h5py = import_extra("h5py", EXTRA)
    before = _budget.set(Budget.of_files(path, [path]))
    try:
        with _Input(path) as source, h5py.File(source, "r") as file:
            yield file
    except McaprlError:
        raise
    except _DAMAGED as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise LogError(f"{path}: not a readable HDF5 file: {printable(reason)}") from error
    finally:
        _budget.reset(before)


@contextmanager
def created(path: Path, **options: Any) -> Iterator[Any]:
    """Create a file, and yield it as a `h5py.File`."""
    h5py = import_extra("h5py", EXTRA)
    with _Output(path) as output:
        try:
            with h5py.File(output, "w", **options) as file:
                file.output = output
                yield file
        finally:
            if output.error is not None:
                raise output.error


class _Input(FileIO):
    """File that refuses what HDF5's library does not check in damaged files.

    The library allocates what a structure declares, and fills what is past the end of the file with
    zeros; memory that is never written takes no space. It follows circular lists of free space
    without end.
    """

    def __init__(self, path: Path) -> None:
        """Open the file."""
        super().__init__(path, "rb")
        self._size = path.stat().st_size
        self._left = MAX_READ_RATIO * self._size + UNPACKED_ALLOWANCE_BYTES
        start = self.read(16)
        is_old = start[8:9] in (b"\0", b"\1")
        if start.startswith(SIGNATURE) and start[13:15] != b"\x08\x08" and is_old:
            raise OSError("its addresses do not have 8 bytes")
        if start.startswith(SIGNATURE) and start[9:11] != b"\x08\x08" and not is_old:
            raise OSError("its addresses do not have 8 bytes")

    def readinto(self, buffer: Any) -> int:
        """Read bytes, and return their number."""
        count, place = memoryview(buffer).nbytes, self.tell()
        self._left -= count
        if count > self._size - place or self._left < 0:
            raise OSError(f"{count} bytes at {place} are not in the file")
        found = super().readinto(buffer)
        start = bytes(buffer[:8])
        if start == _HEAP and count >= 32:
            self._check_heap(*struct.unpack_from("<QQQ", buffer, 8))
        if start == _GLOBAL_HEAP and count >= 16:
            self._check_global_heap(place, *struct.unpack_from("<Q", buffer, 8))
        return found

    def _check_heap(self, size: int, free: int, data: int) -> None:
        """Check that the list of free blocks in a local heap ends.

        Args:
            size: Size of the heap, bytes.
            free: Offset of the first free block; 1 if there is none.
            data: Address of the heap.
        """
        # A free block has at least 16 bytes: the offset of the next one, and its size.
        for _ in range(min(size, self._size) // 16 + 1):
            if not 1 < free <= size - 16:
                return
            free = int.from_bytes(read_at(self.fileno(), 8, data + free), "little")
        raise OSError("a list of free blocks is circular")

    def _check_global_heap(self, place: int, size: int) -> None:
        """Check that each object in a collection of texts ends after its start."""
        data = read_at(self.fileno(), min(size, _MAX_GLOBAL_HEAP_BYTES), place)
        offset = 16
        while offset + 16 <= len(data):
            index, _, _, length = struct.unpack_from("<HHIQ", data, offset)
            # The size of the free space includes its header.
            step = length if index == 0 else 16 + (length + 7) // 8 * 8
            if step < 16:
                raise OSError("an object in a heap has no size")
            offset += step


def stop_if_full(file: Any) -> None:
    """Raise the first error of writing a file that `created` yielded.

    Writers call this after each part of the data, because HDF5 does not notice such an error.
    """
    if file.output.error is not None:
        raise file.output.error


class _Output(FileIO):
    """File that holds in memory what it cannot write.

    HDF5 must not notice that the disk is full: it would continue with objects that it could not
    write, and the process would crash when they are freed.

    Attributes:
        error: First error.
    """

    error: OSError | None = None

    def __init__(self, path: Path) -> None:
        """Create or replace the file."""
        super().__init__(path, "w+")
        # Offsets and bytes of what could not be written, in the order of the writes.
        self._held: list[tuple[int, bytes]] = []

    def write(self, data: Any) -> int:
        """Write or hold all bytes; return their number."""
        whole = memoryview(data).cast("B")
        rest, start = whole, self.tell()
        try:
            while rest and self.error is None:
                rest = rest[super().write(rest) :]
        except OSError as error:
            self.error = error
        if self.error is not None:
            self._held.append((start, bytes(whole)))
            self.seek(start + len(whole))
        return len(whole)

    def readinto(self, buffer: Any) -> int:
        """Read bytes of the file, or those that are held in memory."""
        target, start = memoryview(buffer).cast("B"), self.tell()
        count = super().readinto(target)
        for offset, data in self._held:
            first, stop = max(offset, start), min(offset + len(data), start + len(target))
            if first < stop:
                target[first - start : stop - start] = data[first - offset : stop - offset]
                count = max(count, stop - start)
        self.seek(start + count)
        return count

    def truncate(self, size: int | None = None) -> int:
        """Change the size of the file; HDF5 does this when it closes the file."""
        try:
            return super().truncate(size)
        except OSError as error:
            self.error = self.error or error
            return self.tell() if size is None else size


def image_settings(shape: tuple[int, ...], dtype: np.dtype[Any]) -> dict[str, Any]:
    """Return arguments of `create_dataset` that store (N, H, W, C) in chunks of whole images."""
    frame_bytes = math.prod(shape[1:]) * dtype.itemsize
    rows = max(1, min(shape[0], _CHUNK_BYTES // frame_bytes))
    return {"chunks": (rows, *shape[1:]), "compression": "lzf"}


def source() -> object:
    """Return the name of the file that is open, for errors."""
    return _budget.get().where


def has(group: Any, name: str) -> bool:
    """Return whether a group has a member with this name."""
    return bool(group.id.links.exists(name.encode()))


def names_in(group: Any) -> list[str]:
    """Return the names of a group's members."""
    names = list(group)
    if not all(isinstance(name, str) for name in names):
        raise LogError(f"{source()}: {group.name} has a name that is not UTF-8")
    return names


def group_in(parent: Any, name: str) -> Any:
    """Return a group."""
    h5py, found = import_extra("h5py", EXTRA), _identifier(parent, name)
    if not isinstance(found, h5py.h5g.GroupID):
        raise LogError(f"{_place(parent, name)} is not a group")
    _budget.get().take(_place(parent, name), (), _GROUP_COST_BYTES)
    return h5py.Group(found)


def array_in(parent: Any, name: str) -> NDArray[Any]:
    """Read an array; variable-length strings become NumPy strings."""
    h5py = import_extra("h5py", EXTRA)
    # h5py's low-level API is used, because it is several times as fast for small arrays.
    found = _identifier(parent, name)
    space = found.get_space() if isinstance(found, h5py.h5d.DatasetID) else None
    if space is None or space.get_simple_extent_type() == h5py.h5s.NULL:
        raise LogError(f"{_place(parent, name)} is not an array")
    dtype, shape, settings = found.dtype, found.shape, found.get_create_plist()
    if settings.get_layout() == h5py.h5d.VIRTUAL or settings.get_external_count():
        raise LogError(f"{_place(parent, name)} {_ELSEWHERE}")
    stored = found.get_storage_size()
    if math.prod(shape) * dtype.itemsize > _MAX_RATIO * stored + _SMALL_BYTES:
        raise LogError(
            f"{_place(parent, name)} has shape {shape}, but only {stored} bytes are stored"
        )
    if stored > parent.file.id.get_filesize():
        raise LogError(f"{_place(parent, name)} is larger than the file, which is damaged")
    if dtype.kind == "V":
        raise LogError(f"{_place(parent, name)} has a compound type, expected numbers")
    _budget.get().take(_place(parent, name), shape, dtype.itemsize)
    if dtype.kind == "O":
        return _objects(h5py.Dataset(found), _place(parent, name))
    values = np.empty(shape, dtype)
    if values.size:
        found.read(h5py.h5s.ALL, h5py.h5s.ALL, values)
    return values


def array_at(parent: Any, path: Sequence[str | int]) -> NDArray[Any]:
    """Read the array at a path of names and indexes.

    An index k is read as the name `_index_k`, under which Minari stores member k of a Tuple.
    """
    *groups, last = (f"_index_{key}" if isinstance(key, int) else key for key in path)
    for name in groups:
        parent = group_in(parent, name)
    return array_in(parent, last)


def tree_in(parent: Any, name: str, depth: int = 0) -> Any:
    """Read an array, or the arrays of a group as nested dicts."""
    if not is_group(parent, name):
        return array_in(parent, name)
    group = _nested_group(parent, name, depth)
    return {key: tree_in(group, key, depth + 1) for key in names_in(group)}


def has_rows(parent: Any, name: str, depth: int = 0) -> bool:
    """Return whether a member is an array with dimensions, or a group with such an array."""
    if is_group(parent, name):
        group = _nested_group(parent, name, depth)
        return any(has_rows(group, key, depth + 1) for key in names_in(group))
    return bool(getattr(_identifier(parent, name), "shape", ()))


def _nested_group(parent: Any, name: str, depth: int) -> Any:
    """Return a group; refuse groups that contain themselves."""
    if depth > MAX_NESTED_GROUPS:
        raise LogError(f"{_place(parent, name)} is nested too deeply: it may contain itself")
    return group_in(parent, name)


def arrays_below(group: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield the dotted name and the values of each array in a group and its subgroups."""
    for name in names_in(group):
        if is_group(group, name):
            inner = _nested_group(group, name, len(path))
            yield from arrays_below(inner, (*path, name))
        else:
            yield ".".join((*path, name)), array_in(group, name)


def attributes_of(group: Any) -> dict[str, Any]:
    """Return the attributes as JSON types; the attribute `a/b` is the entry `b` of the dict `a`."""
    found: dict[str, Any] = {}
    for path, value in group.attrs.items():
        *groups, name = path.split("/")
        inner = found
        for key in groups:
            inner = inner.setdefault(key, {})
            if not isinstance(inner, dict):
                raise LogError(f"{source()}: {group.name} has both {key} and {path}")
        inner[name] = value.tolist() if isinstance(value, np.generic | np.ndarray) else value
    return found


def with_names_for_hdf5(space: spaces.Space[Any]) -> tuple[spaces.Space[Any], list[str]]:
    """Rename the keys of a Dict space that cannot be names in an HDF5 file.

    Returns:
        The space with its leaves in the same order, and the keys that were renamed.
    """
    if not isinstance(space, spaces.Dict):
        return space, []
    parts: dict[str, spaces.Space[Any]] = {}
    renamed = []
    for key, part in space.spaces.items():
        name = _storable_name(key)
        if name != key:
            renamed.append(key)
            while name in parts or name in space.spaces:
                name += "_"
        parts[name], inner = with_names_for_hdf5(part)
        renamed += inner
    return spaces.Dict(list(parts.items())), renamed


def is_group(parent: Any, name: str) -> bool:
    """Return whether a member is a group."""
    return isinstance(_identifier(parent, name), import_extra("h5py", EXTRA).h5g.GroupID)


def _identifier(parent: Any, name: str) -> Any:
    """Return the low-level h5py object of a member."""
    h5py, path = import_extra("h5py", EXTRA), name.encode()
    try:
        if parent.id.links.get_info(path).type != h5py.h5l.TYPE_EXTERNAL:
            return h5py.h5o.open(parent.id, path)
    except (KeyError, ValueError, RuntimeError) as error:
        raise LogError(f"{_place(parent, name)} is missing") from error
    raise LogError(f"{_place(parent, name)} {_ELSEWHERE}")


def _objects(array: Any, place: str) -> NDArray[Any]:
    """Read an array whose elements are strings, or arrays of different lengths."""
    if import_extra("h5py", EXTRA).check_string_dtype(array.dtype) is None:
        return np.asarray(array[()])
    try:
        texts = np.asarray(array.asstr()[()])
    except UnicodeDecodeError as error:
        raise LogError(f"{place} is not UTF-8 text") from error
    longest = max((len(text) for text in texts.flat), default=0) if texts.ndim else 0
    _budget.get().take(place, texts.shape, 4 * longest)
    return texts.astype(np.str_)


def _place(parent: Any, name: str) -> str:
    return f"{source()}: {parent.name.rstrip('/')}/{name}"


def _storable_name(key: str) -> str:
    name = re.sub(r"[/\0\ud800-\udfff]", "_", key)
    return name if name.strip(".") else f"_{name}"
