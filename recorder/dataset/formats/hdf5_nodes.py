"""Names and arrays in HDF5 files.

The files may come from untrusted sources, so sizes are checked, and links to other files are not
followed.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from io import FileIO
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import LogError, McaprlError, import_extra
from mcaprl.files import open_at_once

SIGNATURE = b"\x89HDF\r\n\x1a\n"
EXTRA = "interop"
# HDF5's filters reach a compression ratio of at most 1032. If the declared size of an array exceeds
# its stored size by a larger factor, some of its values were never written.
_MAX_RATIO = 2_000
_SMALL_BYTES = 1 << 20
_CHUNK_BYTES = 1 << 18
_ELSEWHERE = "is stored in another file: copy it into this file"


def is_hdf5(path: Path) -> bool:
    """Return whether a path is a file that starts with the HDF5 signature."""
    try:
        with FileIO(open_at_once(path)) as file:
            return file.read(len(SIGNATURE)) == SIGNATURE
    except OSError:
        return False


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    """Open a file for reading.

    Raises:
        LogError: The file is missing, or data that is read in the context is damaged.
        MissingExtraError: h5py is not installed.
    """
    h5py = import_extra("h5py", EXTRA)
    try:
        with h5py.File(path, "r") as file:
            yield file
    except McaprlError:
        raise
    # h5py raises errors of many types for damaged structures.
    except (OSError, RuntimeError, TypeError, ValueError) as error:
        raise LogError(f"{path}: not a readable HDF5 file: {error}") from error


@contextmanager
def created(path: Path, **options: Any) -> Iterator[Any]:
    """Create a file, and yield it as a `h5py.File`.

    Args:
        path: File to create or replace.
        options: Arguments of `h5py.File`.

    Raises:
        OSError: The file cannot be written.
        MissingExtraError: h5py is not installed.
    """
    h5py = import_extra("h5py", EXTRA)
    with _Output(path) as output:
        try:
            with h5py.File(output, "w", **options) as file:
                file.output = output
                yield file
        finally:
            if output.error is not None:
                raise output.error


def stop_if_full(file: Any) -> None:
    """Raise the first error of writing a file that `created` yielded.

    Writers call this after each part of the data, because HDF5 does not notice such an error.

    Raises:
        OSError: The file cannot be written, for example because the disk is full.
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


def has(group: Any, name: str) -> bool:
    """Return whether a group has a member with this name."""
    return bool(group.id.links.exists(name.encode()))


def names_in(group: Any) -> list[str]:
    """Return the names of a group's members.

    Raises:
        LogError: A name is not UTF-8.
    """
    names = list(group)
    if not all(isinstance(name, str) for name in names):
        raise LogError(f"{group.file.filename}: {group.name} has a name that is not UTF-8")
    return names


def group_in(parent: Any, name: str) -> Any:
    """Return a group.

    Raises:
        LogError: There is no such group.
    """
    h5py, found = import_extra("h5py", EXTRA), _identifier(parent, name)
    if not isinstance(found, h5py.h5g.GroupID):
        raise LogError(f"{_place(parent, name)} is not a group")
    return h5py.Group(found)


def array_in(parent: Any, name: str) -> NDArray[Any]:
    """Read an array; variable-length strings become NumPy strings.

    Raises:
        LogError: There is no such array, or it is not stored in this file.
    """
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
    if dtype.kind == "V":
        raise LogError(f"{_place(parent, name)} has a compound type, expected numbers")
    if dtype.kind == "O":
        return _objects(h5py.Dataset(found), _place(parent, name))
    values = np.empty(shape, dtype)
    if values.size:
        found.read(h5py.h5s.ALL, h5py.h5s.ALL, values)
    return values


def array_at(parent: Any, path: Sequence[str | int]) -> NDArray[Any]:
    """Read the array at a path of names and indexes.

    An index k is read as the name `_index_k`, under which Minari stores member k of a Tuple.

    Raises:
        LogError: There is no such array, or it is not stored in this file.
    """
    *groups, last = (f"_index_{key}" if isinstance(key, int) else key for key in path)
    for name in groups:
        parent = group_in(parent, name)
    return array_in(parent, last)


def tree_in(parent: Any, name: str) -> Any:
    """Read an array, or the arrays of a group as nested dicts.

    Raises:
        LogError: There is no such member, or it is not stored in this file.
    """
    if not is_group(parent, name):
        return array_in(parent, name)
    group = group_in(parent, name)
    return {key: tree_in(group, key) for key in names_in(group)}


def arrays_below(group: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield the dotted name and the values of each array in a group and its subgroups."""
    for name in names_in(group):
        if is_group(group, name):
            yield from arrays_below(group_in(group, name), (*path, name))
        else:
            yield ".".join((*path, name)), array_in(group, name)


def attributes_of(group: Any) -> dict[str, Any]:
    """Return the attributes as JSON types; the attribute `a/b` is the entry `b` of the dict `a`.

    Raises:
        LogError: The attributes are damaged.
    """
    found: dict[str, Any] = {}
    for path, value in group.attrs.items():
        *groups, name = path.split("/")
        inner = found
        for key in groups:
            inner = inner.setdefault(key, {})
            if not isinstance(inner, dict):
                raise LogError(f"{group.file.filename}: {group.name} has both {key} and {path}")
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
    """Return whether a member is a group.

    Raises:
        LogError: There is no such member.
    """
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
        return np.asarray(array.asstr()[()]).astype(np.str_)
    except UnicodeDecodeError as error:
        raise LogError(f"{place} is not UTF-8 text") from error


def _place(parent: Any, name: str) -> str:
    return f"{parent.file.filename}: {parent.name.rstrip('/')}/{name}"


def _storable_name(key: str) -> str:
    name = re.sub(r"[/\0\ud800-\udfff]", "_", key)
    return name if name.strip(".") else f"_{name}"
