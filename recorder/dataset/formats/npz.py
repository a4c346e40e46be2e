"""NumPy archives, written by this package or by other tools.

`write` writes these arrays, for E episodes with N transitions:

    observations              (N, *shape); or arrays `observations/KEY` for the keys of a Dict
    final_observations        (E, *shape), named in the same way
    actions, rewards, terminations, truncations    (N,) or (N, *shape)
    behavior_probs            (N,); for actions of floats, behavior_log_probs
    episode_lengths           (E,)
    log_time_ns               (N + E,), if the data has times
    infos/NAME                (N + E, *shape)

`read` reads the arrays of `flat.NAMES`. The sizes of arrays are checked before they are
read. Pickled objects are never loaded.
"""

from __future__ import annotations

import lzma
import math
import re
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from mcaprl.errors import LogError, McaprlError, SpaceError
from mcaprl.limits import MAX_NPY_HEADER_BYTES
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.formats.columns import NO_NAME, Budget, episode_slices, stored_infos
from mcaprl.recorder.dataset.formats.flat import (
    FINALS,
    INFOS,
    NAMES,
    FlatOptions,
    Kind,
    flat_dataset,
)
from mcaprl.recorder.dataset.formats.hdf5_nodes import with_names_for_hdf5
from mcaprl.recorder.format.metadata import NO_TIMES
from mcaprl.recorder.format.spaces import leaves_of
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


_BLOCK_ROWS = 1024


def matches(path: Path) -> bool:
    """Return whether a path is a .npz file."""
    return path.suffix == ".npz" and path.is_file()


def write(dataset: Dataset, path: Path, *, lossy: bool = False) -> list[str]:
    """Write a dataset.

    Returns:
        One sentence for each of these.
    """
    infos, lost = stored_infos(dataset.infos)
    for name in [name for name in infos if re.search(NO_NAME, name)]:
        lost.append(f"the info '{name}' is left out, because its name is not valid in an archive")
        del infos[name]
    space, renamed = with_names_for_hdf5(dataset.observation_space)
    lost += [f"the key '{key}' is renamed, because an archive cannot store it" for key in renamed]
    if lost and not lossy:
        raise SpaceError(f"{lost[0]}; pass `lossy=True` to write the rest")
    finals = np.array([frames.stop - 1 for _, frames in episode_slices(dataset)])
    with zipfile.ZipFile(path, "w") as archive:
        leaves = leaves_of(dataset.observation_space)
        for leaf, named in zip(leaves, leaves_of(space), strict=True):
            column, name = leaf.of(dataset.frames), "".join(f"/{key}" for key in named.path)
            _put(archive, f"observations{name}", column, dataset.frame_of_step)
            _put(archive, FINALS + name, column, finals)
        arrays = {
            "actions": dataset.actions,
            "rewards": dataset.rewards,
            "terminations": dataset.terminated,
            "truncations": dataset.truncated,
            dataset.behavior_field.plural: dataset.behavior,
            "episode_lengths": dataset.episode_lengths,
        }
        if dataset.metadata.get("times") != NO_TIMES:
            arrays["log_time_ns"] = np.concatenate([e.log_time_ns for e in dataset.episodes])
        arrays |= {f"{INFOS}/{name}": values for name, values in infos.items()}
        for name, values in arrays.items():
            _put_rows(archive, name, values.dtype, values.shape, [values])
    return lost


def read(path: Path, *, one_episode: bool = False, dones: Kind | None = None) -> Dataset:
    """Read an archive. Only the arrays that are needed are read."""
    with Archive.opened(path) as archive:
        taken = [name for name in archive.names if name.split("/")[0] in (*NAMES, INFOS)]
        found = _nested({name: archive[name] for name in taken})
        unread = [name for name in archive.names if name not in taken and archive.is_array(name)]
    infos = found.pop(INFOS, {})
    if not isinstance(infos, dict):
        infos, unread = {}, [*unread, INFOS]
    return flat_dataset(
        found,
        path,
        dict(_dotted(infos)),
        options=FlatOptions(one_episode, dones),
        unread=unread,
    )


def _dotted(tree: Mapping[str, Any]) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield the dotted name and the values of each array in nested dicts."""
    for name, part in tree.items():
        if isinstance(part, Mapping):
            yield from ((f"{name}.{rest}", values) for rest, values in _dotted(part))
        else:
            yield name, part


def _nested(arrays: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
    """Return arrays with names such as `observations/state` as nested dicts."""
    nested: dict[str, Any] = {}
    for name, values in arrays.items():
        *groups, last = name.split("/")
        inner = nested
        for group in groups:
            inner = inner.setdefault(group, {})
            if not isinstance(inner, dict):
                break
        else:
            inner[last] = values
    return nested


def _put(archive: zipfile.ZipFile, name: str, column: Any, rows: NDArray[np.int64]) -> None:
    """Write rows of a column in blocks, because images on disk may be larger than the memory."""
    blocks = (
        np.asarray(column[rows[start : start + _BLOCK_ROWS]])
        for start in range(0, len(rows), _BLOCK_ROWS)
    )
    _put_rows(archive, name, column.dtype, (len(rows), *column.shape[1:]), blocks)


def _put_rows(
    archive: zipfile.ZipFile,
    name: str,
    dtype: np.dtype[Any],
    shape: tuple[int, ...],
    blocks: Iterable[NDArray[Any]],
) -> None:
    header = {"descr": npy.dtype_to_descr(dtype), "fortran_order": False, "shape": shape}
    with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
        npy.write_array_header_2_0(file, header)
        for block in blocks:
            file.write(block.tobytes())
