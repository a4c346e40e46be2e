"""Functions that find the files of a bag, decompress them, and open them."""

from __future__ import annotations

import glob
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import zstandard

from mcaprl.errors import LogError, import_extra
from mcaprl.files import check_plain, read_file, temporary_folder
from mcaprl.recorder.bags.mcap_file import McapFile
from mcaprl.recorder.bags.rosbag_file import RosbagFile

_METADATA = "metadata.yaml"
_KINDS = (".mcap", ".db3", ".bag")
_COMPRESSED = ".zstd"


def find_bags(data: str | Path | Sequence[str | Path]) -> list[Path]:
    """Resolve files, folders and globs to existing paths.

    Raises:
        LogError: There is no such path.
    """
    if not isinstance(data, str | Path):
        return [path for part in data for path in find_bags(part)]
    path = Path(data)
    found = [path] if path.exists() else sorted(map(Path, glob.glob(str(data))))
    if not found:
        raise LogError(f"{data}: no such file, folder or match")
    return found


def open_files(path: Path, opened: ExitStack) -> list[McapFile | RosbagFile]:
    """Open a file, or the files of a folder in their order.

    Args:
        path: Path of the file or folder.
        opened: Stack that closes the files, and removes decompressed copies.

    Raises:
        LogError: The path is not a bag, or the bag is damaged.
    """
    if not path.is_dir():
        return [_open(path, "", opened)]
    metadata = _metadata(path)
    if str(metadata.get("compression_mode") or "").lower() == "message":
        # Each message of this bag is compressed separately. `RosbagFile` decompresses the messages
        # only if it opens the folder instead of a file.
        _check_plain(path)
        folder = RosbagFile(path)
        opened.callback(folder.close)
        return [folder]
    names, distribution = _files_of(path, metadata)
    if not names:
        raise LogError(f"{path} has no {', '.join(_KINDS)} files")
    return [_open(name, distribution, opened) for name in names]


def _files_of(folder: Path, metadata: dict[str, Any]) -> tuple[list[Path], str]:
    """Return the bag files of a folder, and the ROS distribution that its metadata names.

    Files that `metadata.yaml` lists come first, in the listed order. If the recorder was killed,
    `metadata.yaml` is missing or does not list all files.

    Raises:
        LogError: A listed file is missing.
    """
    listed = metadata.get("relative_file_paths") or []
    first = [_existing(folder / Path(str(name)).name) for name in listed]
    kinds = (*_KINDS, *(f"{kind}{_COMPRESSED}" for kind in _KINDS))
    rest = sorted(path for path in folder.iterdir() if path.name.endswith(kinds))
    # A compressed file and its original may both exist; only one of them is opened.
    known = {_plain_name(path) for path in first}
    for path in rest:
        if _plain_name(path) not in known:
            known.add(_plain_name(path))
            first.append(path)
    return first, str(metadata.get("ros_distro") or "")


def _existing(path: Path) -> Path:
    """Return a listed file, or its compressed or decompressed copy.

    Raises:
        LogError: The file is missing.
    """
    plain = path.with_name(_plain_name(path))
    for found in (path, plain, plain.with_name(plain.name + _COMPRESSED)):
        if found.exists():
            return found
    raise LogError(
        f"{path} is listed in {_METADATA}, but is missing: restore it, or delete {_METADATA} to"
        " read the other files"
    )


def _plain_name(path: Path) -> str:
    return path.name.removesuffix(_COMPRESSED)


def _metadata(folder: Path) -> dict[str, Any]:
    path = folder / _METADATA
    if not path.exists():
        return {}
    yaml = import_extra("ruamel.yaml", "bags")
    try:
        found = yaml.YAML(typ="safe").load(read_file(path).decode())
        return dict(found["rosbag2_bagfile_information"])
    except (OSError, UnicodeDecodeError, yaml.YAMLError, KeyError, TypeError, ValueError) as error:
        raise LogError(f"{path} is not the metadata of a rosbag2 bag: {error}") from error


def _check_plain(path: Path) -> None:
    """Raise LogError if a file, or a file in a folder, is a device, socket or FIFO."""
    try:
        check_plain(path)
    except OSError as error:
        raise LogError(f"cannot read {path}: {error.strerror or error}") from error


def _open(path: Path, distribution: str, opened: ExitStack) -> McapFile | RosbagFile:
    plain = path
    _check_plain(path)
    if path.name.endswith(_COMPRESSED):
        plain = opened.enter_context(temporary_folder()) / _plain_name(path)
        try:
            with path.open("rb") as packed, plain.open("wb") as file:
                zstandard.ZstdDecompressor().copy_stream(packed, file)
        except (OSError, zstandard.ZstdError) as error:
            raise LogError(f"{path} cannot be decompressed: {error}") from error
    kind = RosbagFile if plain.suffix in (".db3", ".bag") else McapFile
    found = kind(plain, distribution=distribution)
    opened.callback(found.close)
    found.path = path
    return found
