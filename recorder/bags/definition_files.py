"""Definition files of ROS packages: `.msg`, `.srv`, `.action` and `.idl`."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, Final

from mcaprl.errors import LogError, UsageError
from mcaprl.limits import MAX_DEFINITION_BYTES, MAX_DEFINITION_FILES
from mcaprl.recorder.format.reading import full_name, parsed_types

_KINDS: Final = (".msg", ".srv", ".action", ".idl")
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
                raise UsageError(f"{path} has no {', '.join(_KINDS)} files")

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
    if path.suffix in _KINDS and path.is_file():
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
        yield from (Path(folder, name) for name in sorted(names) if name.endswith(_KINDS))


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
