"""Files of a bag, decompressed within limits, and definition files of ROS packages.

Of a `metadata.yaml`, only the few values that are used are read, and all of them are texts: no YAML
type is constructed, and aliases, which can multiply the size of a value, are refused.
"""

from __future__ import annotations

import glob
import os
import re
import shutil
import warnings
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any, Final

import numpy as np
import zstandard
from numpy.typing import NDArray

from mcaprl.errors import LogError, UsageError, import_extra
from mcaprl.files import check_plain, temporary_folder
from mcaprl.limits import (
    MAX_CHUNK_BYTES,
    MAX_DEFINITION_BYTES,
    MAX_DEFINITION_FILES,
    MAX_METADATA_BYTES,
    MAX_METADATA_DEPTH,
    MAX_UNPACKED_BYTES,
    MAX_UNPACKED_RATIO,
)
from mcaprl.recorder.bags.source import McapFile, RawMessage, RosbagFile, TopicSource
from mcaprl.recorder.format.reading import full_name, parsed_types

_DEFINITION_SUFFIXES: Final = (".msg", ".srv", ".action", ".idl")
_FOLDERS: Final = ("msg", "srv", "action")
_PACKAGE_NAME: Final = re.compile(r"<name>\s*(\w+)\s*</name>")
_PARTS: Final = re.compile(r"^-{3,}[ \t]*$", re.MULTILINE)


class DefinitionFiles:
    """Definitions of types in files; each file is parsed when one of its types is needed.

    The package of a file is the folder above its folder `msg`, `srv` or `action`, or else its own
    folder. If there is a `package.xml` in this folder, the package has the name in this file.
    """

    def __init__(self, paths: Sequence[str | Path]) -> None:
        """Find the files."""
        self._paths = [Path(path).absolute() for path in paths]
        self._files: dict[str, list[Path]] = {}
        self._parsed: dict[Path, dict[str, Any] | LogError] = {}
        for path in self._paths:
            count = 0
            for file in _definitions_in(path):
                count += 1
                for name in _names_of(file, _package_of(file)):
                    self._files.setdefault(name, []).append(file)
            if not count:
                raise UsageError(f"{path} has no {', '.join(_DEFINITION_SUFFIXES)} files")

    def __str__(self) -> str:
        """Return the paths."""
        return ", ".join(map(str, self._paths))

    def types_of(self, name: str) -> Any | None:
        """Return constants and fields of the type with this full name; None if no file has it."""
        files = self._files.get(name, [])
        # An IDL file is usually generated from a `.msg` file beside it.
        kinds = {file.suffix for file in files}
        files = [file for file in files if file.suffix != ".idl" or kinds == {".idl"}]
        found: dict[Path, Any] = {}
        for file in files:
            types = self._types_in(file)
            if name in types:
                found[file] = types[name]
        if not found:
            return self._others.get(name)
        first, *rest = found
        for file in rest:
            if found[file] != found[first]:
                raise LogError(f"{name} is defined differently in {first} and {file}: pass one")
        return found[first]

    @cached_property
    def _others(self) -> dict[str, Any]:
        """Types of IDL files, which can have other types than the one in the name of the file."""
        found: dict[str, Any] = {}
        files = {file for files in self._files.values() for file in files if file.suffix == ".idl"}
        for file in sorted(files):
            try:
                found |= self._types_in(file)
            except LogError as error:
                warnings.warn(f"{error}: skipped", stacklevel=2)
        return found

    def _types_in(self, file: Path) -> dict[str, Any]:
        """Return the types of a file by their full names."""
        if file not in self._parsed:
            try:
                self._parsed[file] = _parsed(file, _package_of(file))
            except LogError as error:
                self._parsed[file] = LogError(f"{file}: {error}")
        found = self._parsed[file]
        if isinstance(found, LogError):
            raise LogError(str(found))
        return found


def _definitions_in(path: Path) -> Iterator[Path]:
    """Yield the definition files at a path; links to folders are not followed."""
    if path.suffix in _DEFINITION_SUFFIXES and path.is_file():
        yield path
        return
    if not path.is_dir():
        raise UsageError(f"{path}: no such file or folder of definitions")
    count = 0
    for folder, folders, names in os.walk(path):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        count += len(folders) + len(names)
        if count > MAX_DEFINITION_FILES:
            raise UsageError(
                f"{path} has more than {MAX_DEFINITION_FILES} files: pass the folders of packages"
            )
        yield from (
            Path(folder, name) for name in sorted(names) if name.endswith(_DEFINITION_SUFFIXES)
        )


def _package_of(file: Path) -> str:
    """Return the name of a file's package."""
    folder = next((each.parent for each in file.parents if each.name in _FOLDERS), file.parent)
    try:
        with (folder / "package.xml").open(encoding="utf-8", errors="replace") as text:
            match = _PACKAGE_NAME.search(text.read(2**16))
    except OSError:
        match = None
    return match[1] if match else folder.name


def _names_of(file: Path, package: str) -> list[str]:
    """Return the full names of the types that a file defines by its name."""
    stem = file.stem
    if file.suffix == ".srv":
        names = [f"srv/{stem}_{part}" for part in ("Request", "Response", "Event")]
    elif file.suffix == ".action":
        parts = ("Goal", "Result", "Feedback", "FeedbackMessage")
        names = [f"action/{stem}_{part}" for part in parts]
    else:
        names = [f"msg/{stem}"]
    return [full_name(f"{package}/{name}") for name in names]


def _parsed(file: Path, package: str) -> dict[str, Any]:
    """Return the types of a file by their full names."""
    try:
        if not file.is_file():
            raise LogError("not a regular file")
        with file.open("rb") as opened:
            data = opened.read(MAX_DEFINITION_BYTES + 1)
    except OSError as error:
        raise LogError(str(error.strerror)) from error
    if len(data) > MAX_DEFINITION_BYTES:
        raise LogError(f"a definition can have at most {MAX_DEFINITION_BYTES} bytes")
    text, stem = data.decode(errors="replace"), file.stem
    if file.suffix == ".idl":
        return parsed_types(stem, text, "ros2idl")
    if file.suffix == ".msg":
        return parsed_types(f"{package}/msg/{stem}", text, "ros2msg")
    texts = _PARTS.split(text.replace("\r\n", "\n"))
    parts = ("Request", "Response") if file.suffix == ".srv" else ("Goal", "Result", "Feedback")
    if len(texts) != len(parts):
        raise LogError(f"a {file.suffix} file has {len(parts)} parts, not {len(texts)}")
    every = dict(zip(parts, texts, strict=True))
    own = f"{package}/{file.suffix[1:]}/{stem}"
    if file.suffix == ".srv":
        every["Event"] = (
            "service_msgs/ServiceEventInfo info\n"
            f"{own}_Request[<=1] request\n{own}_Response[<=1] response\n"
        )
    else:
        every["FeedbackMessage"] = f"unique_identifier_msgs/UUID goal_id\n{own}_Feedback feedback\n"
    found = {}
    for part, each in every.items():
        # Types without a package are messages of this package.
        name = f"{package}/msg/{stem}_{part}"
        types = parsed_types(name, each, "ros2msg")
        found[full_name(f"{own}_{part}")] = types[name]
    return found


_ROOT: Final = "rosbag2_bagfile_information"
_TEXTS: Final = ("compression_mode", "ros_distro")
_LISTS: Final = ("relative_file_paths",)


def read_metadata(path: Path) -> dict[str, Any]:
    """Read the metadata of a bag.

    Returns:
        `relative_file_paths`, a list of texts, and the texts `compression_mode` and `ros_distro`;
        those that the file has.
    """
    yaml = import_extra("ruamel.yaml", "bags")
    try:
        if not path.is_file():
            raise LogError("not a regular file")
        with path.open("rb") as file:
            data = file.read(MAX_METADATA_BYTES + 1)
        if len(data) > MAX_METADATA_BYTES:
            raise LogError(f"it has more than {MAX_METADATA_BYTES} bytes")
        return _values(yaml.YAML(typ="safe").parse(data.decode("utf-8")))
    # ruamel.yaml raises errors of many types for a wrong file.
    except Exception as error:
        why = getattr(error, "problem", None) or getattr(error, "strerror", None) or error
        raise LogError(f"{path} is not the metadata of a rosbag2 bag: {why}") from error


def _values(events: Iterator[Any]) -> dict[str, Any]:
    """Return the used values of a document, given as the events of a YAML parser."""
    # The first two events begin the stream and the document. An empty stream has no third one.
    start = next(islice(events, 2, None), None)
    tree = _value(events, start) if start else None
    found = tree.get(_ROOT) if isinstance(tree, dict) else None
    if found is None:
        raise LogError(f"it has no {_ROOT}")
    used: dict[str, Any] = {}
    for name in (*_TEXTS, *_LISTS):
        if isinstance(found, dict) and name in found:
            kind, expected = (list, "a list") if name in _LISTS else (str, "a text")
            if not isinstance(found[name], kind):
                raise LogError(f"{name} is not {expected}")
            texts = [each for each in found[name] if isinstance(each, str)]
            if texts or kind is str:
                used[name] = found[name] if kind is str else texts
    return used


def _value(events: Iterator[Any], event: Any, depth: int = 0) -> Any:
    """Return the text, list or dict that begins with an event."""
    name = type(event).__name__
    if depth > MAX_METADATA_DEPTH:
        raise LogError(f"it is nested in more than {MAX_METADATA_DEPTH} levels")
    if name == "AliasEvent":
        raise LogError("aliases are not supported")
    if name == "ScalarEvent":
        return str(event.value)
    values = []
    while not type(event := next(events)).__name__.endswith("EndEvent"):
        values.append(_value(events, event, depth + 1))
        if name == "MappingStartEvent":
            if not isinstance(values[-1], str):
                raise LogError("a key is not a text")
            values[-1] = values[-1], _value(events, next(events), depth + 1)
    return values if name == "SequenceStartEvent" else dict(values)


_BLOCK_BYTES = 2**20
# Content size of a frame that does not declare it.
_UNKNOWN = -1
# Part of the free disk space that decompressed files may take.
_FREE_SHARE = 0.9


def decompress_file(path: Path, target: Path) -> None:
    """Decompress a file to `target`."""
    try:
        size = path.stat().st_size
        most = max(MAX_UNPACKED_BYTES, MAX_UNPACKED_RATIO * size)
        free = int(shutil.disk_usage(target.parent).free * _FREE_SHARE)
        with path.open("rb") as packed, target.open("wb") as file:
            declared = zstandard.frame_content_size(packed.read(18))
            packed.seek(0)
            _check_size(path, declared, most, free, target.parent)
            written = 0
            reader = zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True)
            while block := reader.read(_BLOCK_BYTES):
                written += len(block)
                _check_size(path, written, most, free, target.parent)
                file.write(block)
    except (OSError, zstandard.ZstdError) as error:
        raise LogError(f"{path} cannot be decompressed: {error}") from error


def _check_size(path: Path, size: int, most: int, free: int, folder: Path) -> None:
    if size > most:
        raise LogError(
            f"{path} has more than {most} bytes when it is decompressed: at most"
            f" {MAX_UNPACKED_BYTES} bytes, or {MAX_UNPACKED_RATIO} for each byte, are read;"
            " decompress it with zstd if you trust it"
        )
    if size > free:
        raise LogError(
            f"{path} is larger than {free} bytes when it is decompressed, the free space in"
            f" {folder}: set TMPDIR to a folder of a larger disk"
        )


class CompressedTopic:
    """Topic whose messages are compressed one by one."""

    def __init__(self, source: TopicSource) -> None:
        """Store the topic with the compressed messages."""
        self._source, self.definition, self.metadata = source, source.definition, source.metadata

    @property
    def times_ns(self) -> NDArray[np.int64]:
        """(N,) log_times in file order."""
        return self._source.times_ns

    @property
    def positions(self) -> NDArray[np.int64]:
        """(N,) positions in the file."""
        return self._source.positions

    def raw(self, rows: NDArray[np.int64]) -> Iterator[RawMessage]:
        """Yield the messages at the positions `rows` (K,), which are distinct and ascending."""
        for message in self._source.raw(rows):
            try:
                yield message._replace(data=_decompressed(message.data))
            except LogError as error:
                yield message._replace(data=b"", problem=str(error))

    def columns(
        self, fields: Sequence[str], rows: NDArray[np.int64] | None
    ) -> dict[str, NDArray[Any]] | None:
        """Return None: messages are decoded one by one."""
        return None


def _decompressed(data: bytes) -> bytes:
    """Decompress a message."""
    found: bytes | None = None
    try:
        size = zstandard.frame_content_size(data)
        if size == _UNKNOWN:
            found = zstandard.ZstdDecompressor().stream_reader(data).read(MAX_CHUNK_BYTES + 1)
            size = len(found)
        if size > MAX_CHUNK_BYTES:
            raise LogError(f"a compressed message has more than {MAX_CHUNK_BYTES} bytes")
        return found if found is not None else zstandard.ZstdDecompressor().decompress(data)
    except zstandard.ZstdError as error:
        raise LogError(f"a message cannot be decompressed: {error}") from error


_METADATA = "metadata.yaml"
_KINDS = (".mcap", ".db3", ".bag")
_COMPRESSED = ".zstd"
_COPY = ".images"
"""Suffix of the uncompressed copy of a bag's images; see `mapping.image_copy`."""
_SUFFIXES = (*_KINDS, *(f"{kind}{_COMPRESSED}" for kind in _KINDS))
_MAX_DEPTH = 3
"""Number of levels of folders below a given folder that are searched for bags."""
_MAX_ENTRIES = 100_000
"""Number of files and folders that are looked at in one search."""


def is_bag_file(path: Path) -> bool:
    """Return whether the name of a file is that of a bag of any format."""
    return path.name.endswith(_SUFFIXES)


def find_bags(data: str | Path | Sequence[str | Path]) -> list[Path]:
    """Resolve files, folders and globs to the existing paths of bags.

    A folder is a bag if it has bag files or `metadata.yaml`. The bags in the folders of a folder
    without `metadata.yaml` are found, too, up to three levels down and in the order of their names.
    A warning names folders that have no bags.

    Copies of images, which are beside their bags, are left out.
    """
    if not isinstance(data, str | Path):
        parts = [part for part in data if Path(part).suffix != _COPY] or data
        every = [path for part in parts for path in find_bags(part)]
        # A bag that is listed under several paths is read once.
        return list({os.path.realpath(path): path for path in every}.values())
    path = Path(data)
    found = [path] if path.exists() else sorted(map(Path, glob.glob(str(data))))
    if not found:
        raise LogError(f"{data}: no such file, folder or match")
    found = [each for each in found if each.suffix != _COPY] or found
    if found[0].suffix == _COPY:
        raise LogError(f"{found[0]} is a copy of images: give the bag beside it")
    bags = {each: _bags_in(each) if each.is_dir() else [each] for each in found}
    if len(found) > 1 and any(is_bag_file(each) or each.is_dir() for each in found):
        # A glob such as `bags/*` also matches notes and images beside the bags.
        bags |= {each: [] for each in found if not is_bag_file(each) and not each.is_dir()}
    if not any(bags.values()):
        raise LogError(
            f"{found[0]} has no {', '.join(_KINDS)} files, nor do its folders: pass a bag file, a"
            " rosbag2 folder, or a folder of these"
        )
    _note_ignored([each for each, inner in bags.items() if not inner])
    return [each for inner in bags.values() for each in inner]


def _bags_in(folder: Path) -> list[Path]:
    """Return a folder if it is a bag, and all bags in its folders unless it has `metadata.yaml`."""
    seen, left = set[str](), _MAX_ENTRIES

    def walk(place: Path, depth: int) -> list[Path]:
        nonlocal left
        # Links may form a loop.
        if os.path.realpath(place) in seen:
            return []
        seen.add(os.path.realpath(place))
        entries = _entries(place)
        left -= len(entries)
        if left < 0:
            raise LogError(
                f"{folder} has more than {_MAX_ENTRIES} files and folders: pass the paths of the"
                " bags in it"
            )
        is_whole = any(each.name == _METADATA for each in entries)
        found = [place] if is_whole or any(map(is_bag_file, entries)) else []
        if is_whole or depth == _MAX_DEPTH:
            return found
        inner = [each for each in entries if each.is_dir() and not each.name.startswith(".")]
        bags = {each: walk(each, depth + 1) for each in inner}
        found += [bag for each in bags.values() for bag in each]
        if found:
            _note_ignored([each for each, inside in bags.items() if not inside])
        return found

    return walk(folder, 0)


def _entries(folder: Path) -> list[Path]:
    """Return the files and folders of a folder by name; none if it may not be read."""
    try:
        return [folder / name for name in sorted(os.listdir(folder))]
    except OSError as error:
        warnings.warn(f"{folder} cannot be read: {error.strerror}", stacklevel=2)
        return []


def _note_ignored(paths: Sequence[Path]) -> None:
    if paths:
        more = f" and {len(paths) - 3} more" if len(paths) > 3 else ""
        names = ", ".join(str(each) for each in paths[:3])
        warnings.warn(f"ignored, because they are not bags: {names}{more}", stacklevel=2)


def open_recordings(
    paths: Sequence[Path], opened: ExitStack
) -> dict[str, list[McapFile | RosbagFile]]:
    """Open the files of bags, by the path of their recording.

    The files that a `metadata.yaml` lists are the parts of one recording, whether the folder or
    some of its files are given. Every other file is a recording.
    """
    parts: dict[str, list[McapFile | RosbagFile]] = {}
    for path in paths:
        for key, file in _opened(path, opened):
            parts.setdefault(key, []).append(file)
    return parts


def _opened(path: Path, opened: ExitStack) -> Iterator[tuple[str, McapFile | RosbagFile]]:
    """Open a file, or the files of a folder; yield each with the path of its recording."""
    if not path.is_dir():
        folder = path.parent
        metadata = _metadata(folder, is_optional=True)
        is_part = _plain_name(path) in map(_plain_name, _listed(folder, metadata))
        key = folder if is_part else path
        yield os.path.realpath(key), _open(path, metadata if is_part else {}, opened)
        return
    metadata = _metadata(path)
    listed = [_existing(part) for part in _listed(path, metadata)]
    others = _unlisted(path, listed)
    if not listed and not others:
        raise LogError(f"{path} has no {', '.join(_KINDS)} files")
    for part in (*listed, *others):
        yield os.path.realpath(path if part in listed else part), _open(part, metadata, opened)


def _listed(folder: Path, metadata: dict[str, Any]) -> list[Path]:
    """Return the files that the metadata of a folder lists."""
    return [folder / Path(str(name)).name for name in metadata.get("relative_file_paths") or []]


def _unlisted(folder: Path, listed: Sequence[Path]) -> list[Path]:
    """Return the bag files of a folder that its metadata does not list.

    If the recorder was killed, `metadata.yaml` is missing or does not list all files.
    """
    # A compressed file and its original may both exist; only one of them is opened.
    known, found = {_plain_name(path) for path in listed}, []
    for path in sorted(path for path in folder.iterdir() if is_bag_file(path)):
        if _plain_name(path) not in known:
            known.add(_plain_name(path))
            found.append(path)
    return found


def _existing(path: Path) -> Path:
    """Return a listed file, or its compressed or decompressed copy."""
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


def _metadata(folder: Path, *, is_optional: bool = False) -> dict[str, Any]:
    """Return what is used of the metadata of a rosbag2 folder; empty if there is none."""
    path = folder / _METADATA
    try:
        return read_metadata(path) if path.exists() else {}
    except LogError:
        if is_optional:
            return {}
        raise


def _check_plain(path: Path) -> None:
    """Raise LogError if a file, or a file in a folder, is a device, socket or FIFO."""
    try:
        check_plain(path)
    except OSError as error:
        raise LogError(f"cannot read {path}: {error.strerror or error}") from error


def _open(path: Path, metadata: dict[str, Any], opened: ExitStack) -> McapFile | RosbagFile:
    """Open a file of a bag with this metadata."""
    plain = path
    _check_plain(path)
    if path.name.endswith(_COMPRESSED):
        plain = opened.enter_context(temporary_folder()) / _plain_name(path)
        decompress_file(path, plain)
    kind = RosbagFile if plain.suffix in (".db3", ".bag") else McapFile
    found = kind(plain, distribution=metadata.get("ros_distro", ""))
    opened.callback(found.close)
    found.path = path
    if metadata.get("compression_mode", "").lower() == "message":
        for sources in found.topics.values():
            sources[:] = [CompressedTopic(source) for source in sources]
    return found
